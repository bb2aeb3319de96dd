"""The tables of docs/explanation/estimators.md: lag and gain by our fit and by three common ways.

``.venv/bin/python studies/estimator_tables.py`` prints them as Markdown; it takes about a minute;
with ``--quick`` some seconds, with few draws, only to see that it runs.
"""

from __future__ import annotations

import argparse
import time

import numpy as np
from scipy.signal import correlate, correlation_lags, hilbert, lfilter

from undulog.analysis.estimators.harmonic import fit_at, fit_shared
from undulog.analysis.estimators.intervals import t_factor
from undulog.analysis.estimators.series import Series
from undulog.analysis.estimators.spectrum import FundamentalNoise, residual_noise, residual_spectrum
from undulog.analysis.response.response import respond

GAIN, LAG = 0.9, 0.2
"""Truth: gain, and lag [rad]."""

STEP = 2 * np.pi / 4096
"""Of an encoder with 12 bits: 0.088 degrees [rad]."""

ROUNDED = {
    "0.5 Hz at 50 Hz, any mean": {},
    "0.5 Hz at 50 Hz, mean zero": {"mean": 0.0},
    "0.5 Hz at 50 Hz, mean half a step": {"mean": STEP / 2},
    "the same, 10.4 cycles": {"mean": 0.0, "cycles": 10.4},
    "the same, command rounded as well": {"mean": 0.0, "command_too": True},
    "the same, all waves begin at a sample": {"mean": 0.0, "command_too": True, "phase": 0.0},
    "the same, noise of 0.2 steps": {"mean": 0.0, "sigma": 0.2 * STEP},
    "the same, noise of 1 step": {"mean": 0.0, "sigma": STEP},
    "the same, harmonics left unfitted": {"mean": 0.0, "fifth": 0.003},
    "steps of 1 degree, mean zero": {"mean": 0.0, "step": np.radians(1)},
    "amplitude of 5 to 20 steps, mean zero": {"mean": 0.0, "step": 0.04},
    "0.5 Hz at 10 Hz, mean zero": {"mean": 0.0, "rate": 10.0},
    "0.833 Hz at 50 Hz, mean zero": {"mean": 0.0, "frequency": 5 / 6},
    "0.5003 Hz at 50 Hz, any mean": {"frequency": 0.5003},
    "0.97 Hz at 50 Hz, any mean": {"frequency": 0.97},
}
"""Cases of rounded responses: what differs from the first."""


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
    """Return an exact command and noisy responses, each on its own times.

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
    response_t = t + skew_s
    clean = GAIN * amplitude * np.sin(omega * response_t + phase - LAG)
    return (
        t,
        amplitude * np.sin(omega * t + phase),
        response_t[kept],
        (clean + sigma * noise)[:, kept],
    )


def fitted(t, command, response_t, responses, guess):
    """Our fit: lag errors, gain errors (relative), and half widths of both 95 % intervals."""
    series = [
        Series("c", t, command),
        *(Series("r", response_t, response) for response in responses),
    ]
    fit = fit_shared(series, guess)
    noise = residual_noise(series, fit)
    estimates, half = responded(fit, noise, [0] * len(responses), slice(1, None))
    return estimates.lag_rad - LAG, estimates.gain / GAIN - 1, half


def responded(fit, noise, commands, answers):
    """Return responses, and half widths of the 95 % intervals of lag and log gain, (2, draws)."""
    part = [
        FundamentalNoise(noise.level[k], noise.dof[k], noise.covariance[k])
        for k in (commands, answers)
    ]
    estimates = respond(fit.fundamental[commands], part[0], fit.fundamental[answers], part[1])
    factor = np.array([t_factor(dof) for dof in estimates.dof])
    return estimates, factor * np.sqrt([estimates.lag_variance, estimates.log_gain_variance])


def by_hilbert(command, response):
    """Mean phase difference and amplitude ratio of the analytic signals (scipy.signal.hilbert)."""
    c, a = hilbert(command - command.mean()), hilbert(response - response.mean())
    return float(np.angle(np.sum(c * a.conj()))), float(np.mean(np.abs(a)) / np.mean(np.abs(c)))


def by_correlation(t, command, response, omega):
    """Return lag of the largest cross-correlation (scipy.signal.correlate), ratio of deviations."""
    lags = correlation_lags(response.size, command.size)
    best = lags[np.argmax(correlate(response, command))]
    return float(omega * best * (t[1] - t[0])), float(response.std() / command.std())


def by_fft(t, command, response, omega):
    """Return the FFT bin nearest to the gait's frequency (scipy.fft by way of numpy)."""
    c, a = np.fft.rfft(command), np.fft.rfft(response)
    k = round(omega / (2 * np.pi) * t.size * (t[1] - t[0]))
    return float(np.angle(c[k] / a[k])), float(abs(a[k]) / abs(c[k]))


def compared(*, frequency=0.97, duration=7.3, rate=100.0, sigma=0.01, draws=2000, seed=1):
    """Return bias, standard deviation, RMSE over bound and time of the four ways.

    Returns:
        Name to (lag bias, lag sd, lag RMSE / bound, gain RMSE / bound, seconds an estimate).
    """
    random = np.random.default_rng(seed)
    how = {"draws": draws, "cycles": duration * frequency, "rate": rate, "sigma": sigma}
    t, command, response_t, responses = sampled(random, **how, frequency=frequency)
    omega = 2 * np.pi * frequency
    bound = (2 * sigma**2 / ((GAIN * 0.5) ** 2 * t.size)) ** 0.5
    rows = {}
    start = time.process_time()
    lag, gain, half = fitted(t, command, response_t, responses, 1.002 * omega)
    took = (time.process_time() - start) / draws
    covered = float(np.mean(np.abs(lag) <= half[0]))
    rows["harmonic least squares, shared frequency"] = (*_figures(lag, gain, bound), covered, took)
    ways = {
        "Hilbert transform (SciPy)": lambda y: by_hilbert(command, y),
        "maximum of the cross-correlation (SciPy)": lambda y: by_correlation(t, command, y, omega),
        "nearest FFT bin": lambda y: by_fft(t, command, y, omega),
    }
    for name, way in ways.items():
        start = time.process_time()
        estimates = np.array([way(response) for response in responses])
        took = (time.process_time() - start) / draws
        rows[name] = (
            *_figures(estimates[:, 0] - LAG, estimates[:, 1] / GAIN - 1, bound),
            None,
            took,
        )
    return rows


def _figures(lag, gain, bound):
    """Return bias and sd of lag [degrees], RMSE over bound of lag and gain."""
    degrees = np.degrees([lag.mean(), lag.std()])
    return (*degrees, *(np.sqrt(np.mean(errors**2)) / bound for errors in (lag, gain)))


def coverage(cycles, ar, *, draws=4000, seed=1, **more):
    """Return share of 95 % intervals that hold the truth: of lag and of gain."""
    random = np.random.default_rng(seed)
    data = sampled(random, draws=draws, cycles=cycles, rate=100.0, sigma=0.01, ar=ar, **more)
    lag, gain, half = fitted(*data, 2 * np.pi * 1.002)
    inside = np.abs([lag, np.log1p(gain)]) <= half
    return inside.mean(axis=1)


def rounded(
    *, draws=1000, seed=1, frequency=0.5, rate=50.0, cycles=10.0, step=STEP, mean=None,
    phase=None, sigma=0.0, fifth=0.0, command_too=False,
):  # fmt: skip
    """Return coverage and width of 95 % intervals where position is rounded to steps.

    Args:
        draws: Responses, each with its own amplitude (0.2 to 0.8 rad), phase and lag.
        seed: Of the generator.
        frequency: Of the gait [Hz].
        rate: Samples a second.
        cycles: Length of the record.
        step: Of the encoder [rad].
        mean: Of the responses [rad]; any if None.
        phase: Of the commands [rad]; any if None.
        sigma: Noise before rounding [rad].
        fifth: Of a fourth and a fifth harmonic, which aren't fitted, as a share of the amplitude.
        command_too: Whether the command is rounded as well; else it is exact.

    Returns:
        Shares covered, (2,): of lag and of gain; the same from the residual alone, (2,); and
        median half width over RMS error, (2,), both times the amplitude.
    """
    random = np.random.default_rng(seed)
    count = round(cycles / frequency * rate)
    t = (np.arange(count) - count // 2) / rate
    omega = 2 * np.pi * frequency
    size = random.uniform(0.2, 0.8, (draws, 1))
    turned = random.uniform(-np.pi, np.pi, (draws, 1)) if phase is None else phase
    lag = random.uniform(0.1, 0.4, (draws, 1))
    level = random.uniform(-0.3, 0.3, (draws, 1)) if mean is None else mean
    wave = omega * t + turned - lag
    more = fifth * (np.sin(5 * wave + 2) + np.cos(4 * wave))
    answer = GAIN * size * (np.sin(wave) + more) + level
    answer = step * np.rint((answer + sigma * random.normal(size=answer.shape)) / step)
    command = size * np.sin(omega * t + turned)
    command = step * np.rint(command / step) if command_too else command
    series = [Series("q", t, samples) for samples in (*command, *answer)]
    fit = fit_at(series, omega)
    noise, bins = residual_spectrum(series, fit)
    level = np.mean(np.abs(bins.values) ** 2, axis=1)
    dof = np.full(level.size, 2.0 * bins.offset.size)
    alone = FundamentalNoise(level, dof, (bins.spread * level / 2)[:, None, None] * np.eye(2))
    covered = []
    for noise_model in (alone, noise):
        estimates, half = responded(fit, noise_model, slice(draws), slice(draws, None))
        error = np.array([estimates.lag_rad - lag[:, 0], np.log(estimates.gain / GAIN)])
        covered.append(np.mean(np.abs(error) <= half, axis=1))
    rms = np.sqrt(np.mean((error * size[:, 0]) ** 2, axis=1))
    return covered[1], covered[0], np.median(half * size[:, 0], axis=1) / rms


def main():
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="few draws")
    draws = {"draws": 40} if parser.parse_args().quick else {}
    print("| estimator | lag: bias | sd | RMSE / bound | gain: RMSE / bound | 95 % covers | time |")
    print("|---|---|---|---|---|---|---|")
    for name, (bias, sd, lag, gain, covered, took) in compared(**draws).items():
        held = "none given" if covered is None else f"{100 * covered:.1f} %"
        figures = f"{bias:.4f}° | {sd:.4f}° | {lag:.2f} | {gain:.2f}"
        print(f"| {name} | {figures} | {held} | {1e6 * took:.0f} µs |")
    print("\n| cycles | white: lag | gain | AR(0.9): lag | gain | AR(0.9), 20 % lost: lag | gain |")
    print("|---|---|---|---|---|---|---|")
    for cycles in (7.0, 7.4, 10.0, 20.0):
        kinds = ({"ar": 0.0}, {"ar": 0.9}, {"ar": 0.9, "lost": 0.2})
        parts = [coverage(cycles, **kind, **draws) for kind in kinds]
        cells = " | ".join(f"{100 * share:.1f} %" for part in parts for share in part)
        print(f"| {cycles:g} | {cells} |")
    columns = ("lag", "gain", "half width / RMSE: lag", "gain", "residual alone: lag", "gain")
    print(f"\n| rounded to steps | {' | '.join(columns)} |")
    print("|---|---|---|---|---|---|---|")
    for name, case in ROUNDED.items():
        covered, alone, width = rounded(**case, **draws)
        both, few = (
            " | ".join(f"{100 * share:.1f} %" for share in part) for part in (covered, alone)
        )
        print(f"| {name} | {both} | {width[0]:.2f} | {width[1]:.2f} | {few} |")


if __name__ == "__main__":
    main()
