"""The table of docs/explanation/estimators.md on contrasts between joints that share noise.

``.venv/bin/python studies/contrast_tables.py`` prints it as Markdown; it takes about half a minute.
"""

from __future__ import annotations

import sys

import numpy as np
from scipy.signal import lfilter

from undulog.analysis.estimators.harmonic import fit_at
from undulog.analysis.estimators.intervals import t_factor
from undulog.analysis.estimators.series import Series
from undulog.analysis.estimators.spectrum import FundamentalNoise, residual_spectrum
from undulog.analysis.parts.comparison.profile import scatter_of
from undulog.analysis.response.response import respond

JOINTS, RATE, OMEGA = 9, 100.0, 2 * np.pi * 0.97
AMPLITUDE, GAIN, LAG = 0.5, 0.9, 0.3

FINE = 20
"""Steps of the noise within one sampling interval."""

SHARED = {
    "nothing": "nothing",
    "additive": "noise of the sensors",
    "modulation": "noise of the waves' amplitude and phase",
}


def contrasts():
    """Each joint against the mean of the others, ends against middle, linear trend; (11, 9)."""
    against_rest = np.eye(JOINTS) - (1 - np.eye(JOINTS)) / (JOINTS - 1)
    ends = np.full(JOINTS, -1 / (JOINTS - 2))
    ends[[0, -1]] = 0.5
    place = np.arange(JOINTS) - (JOINTS - 1) / 2
    return np.vstack([against_rest, ends, place / (place @ place)])


def coloured(random, runs, count, correlation):
    """Return AR(1) noise of unit variance, (runs, count)."""
    white = random.normal(size=(runs, count + 200 * bool(correlation)))
    if not correlation:
        return white
    share = (1 - correlation**2) ** 0.5
    return lfilter([share], [1.0, -correlation], white)[:, 200:]


def simulated(shared, correlation, *, runs, apart_s=8e-4, duration_s=10.3, every=(1, 1, 1), seed=3):
    """Return responses of identical joints that are polled in turn.

    Coloured noise lies on a grid that is finer than the samples, so that joints see the same
    course of it at their own times; of white noise they share the samples.

    Args:
        shared: One of ``SHARED``.
        correlation: Of the noise from sample to sample; 0 is white.
        runs: Records.
        apart_s: Time from one joint's samples to the next joint's [s].
        duration_s: Length of the record [s].
        every: Joints take every so many samples, in turn.
        seed: Of the generator.

    Returns:
        Responses in the order joint, run, and phases of the commands [rad], (9,).
    """
    random = np.random.default_rng(seed)
    count = round(duration_s * RATE)
    fine = np.arange((count + 2) * FINE) / FINE / RATE - duration_s / 2
    smooth = correlation ** (1 / FINE)
    courses = [coloured(random, runs, fine.size, smooth) for _ in range(2)] if correlation else []
    ticks = random.normal(size=(2, runs, count))
    phase = 0.4 - np.arange(JOINTS) * np.pi / 4
    series = []
    for joint in range(JOINTS):
        step = every[joint % 3]
        chosen = (np.arange(count) * FINE + round(apart_s * joint * RATE * FINE))[::step]
        first, second = (
            [course[:, chosen] for course in courses] if correlation else ticks[:, :, ::step]
        )
        alone = coloured(random, runs, count, correlation)[:, ::step]
        wave, size = OMEGA * fine[chosen] + phase[joint] - LAG, GAIN * AMPLITUDE
        if shared == "nothing":
            values = size * np.cos(wave) + 0.01 * alone
        elif shared == "additive":
            values = size * np.cos(wave) + 0.01 * first + 0.003 * alone
        else:
            values = size * (1 + 0.02 * first) * np.cos(wave + 0.02 * second) + 0.003 * alone
        series += [Series("r", fine[chosen], row) for row in values]
    return series, phase


def judged(shared, correlation, *, runs=300, **more):
    """Return shares of intervals of contrasts between identical joints that hold zero.

    Args:
        shared: See :func:`simulated`.
        correlation: See :func:`simulated`.
        runs: Records.
        **more: See :func:`simulated`.

    Returns:
        Shares of gain and of lag, (2, 11); and the same for intervals from the sum of the joints'
        own variances.
    """
    responses, phase = simulated(shared, correlation, runs=runs, **more)
    fit = fit_at(responses, OMEGA)
    noise, bins = residual_spectrum(responses, fit)
    t = responses[0].t_s
    commands = [Series("c", t, AMPLITUDE * np.cos(OMEGA * t + angle)) for angle in phase]
    asked = fit_at(commands, OMEGA)
    exact, exact_bins = residual_spectrum(commands, asked)
    weights, inside = contrasts(), []
    for run in range(runs):
        indices = np.arange(JOINTS) * runs + run
        estimates = respond(
            asked.fundamental,
            exact,
            fit.fundamental[indices],
            FundamentalNoise(noise.level[indices], noise.dof[indices], noise.covariance[indices]),
            bins=(exact_bins, bins.select(indices)),
        )
        values = weights @ np.log(estimates.gain), weights @ estimates.lag_rad
        apart = [
            (weights**2 @ variance, np.full(len(weights), estimates.dof[0] * JOINTS))
            for variance in (estimates.log_gain_variance, estimates.lag_variance)
        ]
        judge = [
            (scatter.variance(weights), np.full(len(weights), scatter.columns.shape[1]))
            for scatter in scatter_of(estimates.errors)
        ]
        inside.append([_holds(values, judge), _holds(values, apart)])
    return np.mean(inside, axis=0)


def _holds(values, judge):
    """Return whether each interval holds zero, (2, 11)."""
    factors = [[t_factor(freedom) for freedom in dof] for _, dof in judge]
    return np.abs(values) <= np.array(factors) * np.sqrt([variance for variance, _ in judge])


def main():
    """Print the table; with ``--quick`` of few records."""
    seeds, runs = ((1,), 30) if "--quick" in sys.argv else (range(1, 5), 300)
    columns = ("each joint: gain", "lag", "ends: gain", "lag", "trend: gain", "lag")
    print(f"| joints share | correlation | {' | '.join(columns)} | summed, ends: gain | lag |")
    print("|---" * 10 + "|")
    for shared, name in SHARED.items():
        for correlation in (0.0, 0.9):
            parts = [judged(shared, correlation, seed=seed, runs=runs) for seed in seeds]
            (gain, lag), summed = np.mean(parts, axis=0)
            cells = [gain[:JOINTS].mean(), lag[:JOINTS].mean()]
            cells += [gain[JOINTS], lag[JOINTS], gain[-1], lag[-1], *summed[:, JOINTS]]
            text = " | ".join(f"{100 * share:.1f} %" for share in cells)
            print(f"| {name} | {correlation:g} | {text} |")


if __name__ == "__main__":
    main()
