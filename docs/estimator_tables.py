"""The tables of docs/estimators.md: lag and gain by our fit and by three common ways.

``.venv/bin/python docs/estimator_tables.py`` prints them as Markdown; it takes about a minute;
with ``--quick`` some seconds, with few draws, only to see that it runs.
"""

from __future__ import annotations

import argparse
import time

import numpy as np
from scipy.signal import correlate, correlation_lags, hilbert, lfilter

from analysis.estimators.harmonic import fit_shared
from analysis.estimators.series import Series
from analysis.estimators.spectrum import Noise, residual_noise
from analysis.response import respond, t_factor

GAIN, LAG = 0.9, 0.2
"""Truth: gain, and lag [rad]."""


def sampled(
    random,
    *,
    draws,
    cycles,
    rate,
    sigma,
    frequency=1.0,
    skew_s=0.0,
    lost=0.0,
    ar=0.0,
    amplitude=0.5,
):
    """An exact command and noisy responses, each on its own times.

    Args:
        random: Generator.
        draws: Responses.
        cycles: Length of the record.
        rate: Samples a second.
        sigma: Standard deviation of the noise [rad].
        frequency: Of the gait [Hz].
        skew_s: By how much the response is sampled later than the command [s].
        lost: Share of the response's samples that are missing, at random.
        ar: Coefficient of the noise's autoregression; 0 is white.
        amplitude: Of the command [rad].

    Returns:
        Times and values of the command, (n,), and of the responses, (k,) and (draws, k).
    """
    count = round(cycles / frequency * rate)
    t = (np.arange(count) - count / 2) / rate
    omega, phase = 2 * np.pi * frequency, random.uniform(-3, 3)
    kept = np.sort(random.permutation(count)[: round((1 - lost) * count)])
    noise = random.normal(size=(draws, count + 200 * bool(ar)))
    if ar:
        noise = lfilter([(1 - ar**2) ** 0.5], [1.0, -ar], noise)[:, 200:]
    own = t + skew_s
    clean = GAIN * amplitude * np.sin(omega * own + phase - LAG)
    return t, amplitude * np.sin(omega * t + phase), own[kept], (clean + sigma * noise)[:, kept]


def fitted(t, command, own, responses, guess):
    """Our fit: lag errors, gain errors (relative), and half widths of both 95 % intervals."""
    series = [Series("c", t, command), *(Series("r", own, one) for one in responses)]
    fit = fit_shared(series, guess)
    noise = residual_noise(series, fit)
    m = len(responses)
    part = [
        Noise(noise.level[k], noise.dof[k], noise.covariance[k]) for k in ([0] * m, slice(1, None))
    ]
    found = respond(np.repeat(fit.fundamental[:1], m), part[0], fit.fundamental[1:], part[1])
    factor = np.array([t_factor(dof) for dof in found.dof])
    half = factor * np.sqrt([found.lag_variance, found.log_gain_variance])
    return found.lag_rad - LAG, found.gain / GAIN - 1, half


def by_hilbert(command, response):
    """Mean phase difference and amplitude ratio of the analytic signals (scipy.signal.hilbert)."""
    c, a = hilbert(command - command.mean()), hilbert(response - response.mean())
    return float(np.angle(np.sum(c * a.conj()))), float(np.mean(np.abs(a)) / np.mean(np.abs(c)))


def by_correlation(t, command, response, omega):
    """Lag of the largest cross-correlation (scipy.signal.correlate), ratio of deviations."""
    lags = correlation_lags(response.size, command.size)
    best = lags[np.argmax(correlate(response, command))]
    return float(omega * best * (t[1] - t[0])), float(response.std() / command.std())


def by_fft(t, command, response, omega):
    """The FFT bin nearest to the gait's frequency (scipy.fft by way of numpy)."""
    c, a = np.fft.rfft(command), np.fft.rfft(response)
    k = round(omega / (2 * np.pi) * t.size * (t[1] - t[0]))
    return float(np.angle(c[k] / a[k])), float(abs(a[k]) / abs(c[k]))


def compared(*, frequency=0.97, duration=7.3, rate=100.0, sigma=0.01, draws=2000, seed=1):
    """Bias, standard deviation, RMSE over bound and time of the four ways.

    Returns:
        Name to (lag bias, lag sd, lag RMSE / bound, gain RMSE / bound, seconds an estimate).
    """
    random = np.random.default_rng(seed)
    t, command, own, responses = sampled(
        random,
        draws=draws,
        cycles=duration * frequency,
        rate=rate,
        sigma=sigma,
        frequency=frequency,
    )
    omega = 2 * np.pi * frequency
    bound = (2 * sigma**2 / ((GAIN * 0.5) ** 2 * t.size)) ** 0.5
    rows = {}
    start = time.process_time()
    lag, gain, half = fitted(t, command, own, responses, 1.002 * omega)
    took = (time.process_time() - start) / draws
    covered = float(np.mean(np.abs(lag) <= half[0]))
    rows["harmonic least squares, shared frequency"] = (*_figures(lag, gain, bound), covered, took)
    for name, way in (
        ("Hilbert transform (SciPy)", lambda y: by_hilbert(command, y)),
        (
            "maximum of the cross-correlation (SciPy)",
            lambda y: by_correlation(t, command, y, omega),
        ),
        ("nearest FFT bin", lambda y: by_fft(t, command, y, omega)),
    ):
        start = time.process_time()
        found = np.array([way(one) for one in responses])
        took = (time.process_time() - start) / draws
        rows[name] = (*_figures(found[:, 0] - LAG, found[:, 1] / GAIN - 1, bound), None, took)
    return rows


def _figures(lag, gain, bound):
    """Bias and sd of lag [degrees], RMSE over bound of lag and gain."""
    degrees = np.degrees([lag.mean(), lag.std()])
    return (*degrees, *(np.sqrt(np.mean(one**2)) / bound for one in (lag, gain)))


def coverage(cycles, ar, *, draws=4000, seed=1, **more):
    """Share of 95 % intervals that hold the truth: of lag and of gain."""
    random = np.random.default_rng(seed)
    data = sampled(random, draws=draws, cycles=cycles, rate=100.0, sigma=0.01, ar=ar, **more)
    lag, gain, half = fitted(*data, 2 * np.pi * 1.002)
    inside = np.abs([lag, np.log1p(gain)]) <= half
    return inside.mean(axis=1)


def main():
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="few draws")
    draws = {"draws": 40} if parser.parse_args().quick else {}
    print("| estimator | lag: bias | sd | RMSE / bound | gain: RMSE / bound | 95 % covers | time |")
    print("|---|---|---|---|---|---|---|")
    for name, (bias, sd, lag, gain, covered, took) in compared(**draws).items():
        held = "none given" if covered is None else f"{100 * covered:.1f} %"
        print(
            f"| {name} | {bias:.4f}° | {sd:.4f}° | {lag:.2f} | {gain:.2f} | {held} | "
            f"{1e6 * took:.0f} µs |"
        )
    print("\n| cycles | white: lag | gain | AR(0.9): lag | gain | AR(0.9), 20 % lost: lag | gain |")
    print("|---|---|---|---|---|---|---|")
    for cycles in (7.0, 7.4, 10.0, 20.0):
        kinds = ({"ar": 0.0}, {"ar": 0.9}, {"ar": 0.9, "lost": 0.2})
        parts = [coverage(cycles, **kind, **draws) for kind in kinds]
        cells = " | ".join(f"{100 * one:.1f} %" for part in parts for one in part)
        print(f"| {cycles:g} | {cells} |")


if __name__ == "__main__":
    main()
