"""Intervals of distortion levels: how often they hold what thousands of realisations have."""

import numpy as np
import pytest

from undulog.analysis.experiment.best_linear import (
    detection_lines,
    input_inverse,
    over_realisations,
    realisation_response,
)
from undulog.analysis.experiment.distortion_spread import LevelSpread, distortion_spread
from undulog.analysis.parts.frequency_response.nonparametric import line_power

N, PERIODS = 256, 3
LINES = np.array([k for k in range(1, 52, 2) if k % 8 != 5])  # a quarter of the odd lines left out
FREE = np.setdiff1d(np.arange(LINES[0], LINES[-1]), LINES)
LOW_PASS = 1 / (1 + 1j * np.arange(N // 2 + 1) / 15)


def filtered(u):
    return np.fft.irfft(np.fft.rfft(u, axis=-1) * LOW_PASS, N, axis=-1)


SYSTEMS = {
    "polynomial": lambda u: u + 0.1 * u**2 + 0.1 * u**3,
    "saturation": lambda u: np.clip(u + 0.2, -1.0, 1.0),
    "dead band": lambda u: np.sign(u + 0.1) * np.maximum(np.abs(u + 0.1) - 0.4, 0.0),
    "memory": lambda u: filtered(u + 0.2 * u**3 + 0.1 * u**2),
}


def spectra(rng, count):
    """Return spectra of multisines of random phases, shape (count, N // 2 + 1)."""
    phases = rng.uniform(0, 2 * np.pi, (count, LINES.size))
    inputs = np.zeros((count, N // 2 + 1), complex)
    inputs[:, LINES] = np.exp(1j * phases) * N / np.sqrt(2 * LINES.size)
    return inputs


def truth(system):
    """Levels of distortion, and of odd and even lines, of 4,000 realisations without noise."""
    inputs = spectra(np.random.default_rng(99), 4000)
    outputs = np.fft.rfft(system(np.fft.irfft(inputs, N, axis=1)), axis=1)
    responses = outputs[:, LINES] / inputs[:, LINES]
    gain = np.sum(np.abs(responses.mean(axis=0)) ** 2)
    power = np.mean(np.abs(outputs) ** 2, axis=0)
    levels = [responses.var(axis=0).sum() / gain]
    levels += [power[FREE[k == FREE % 2]].mean() / power[LINES].mean() for k in (1, 0)]
    return np.sqrt(levels)


def measured(system, rng, realisations, spread):
    """Return the three levels of one experiment with noise."""
    inputs = spectra(rng, realisations)
    outputs = system(np.fft.irfft(inputs, N, axis=1))[:, None]
    noise = 0.02 * rng.standard_normal((realisations, PERIODS, N))
    y = np.fft.rfft(outputs + noise, axis=2)
    pairs = [
        realisation_response(input_inverse(u[None, None, LINES]), out[None][:, :, LINES])
        for u, out in zip(inputs, y, strict=True)
    ]
    values, noises = (np.stack([pair[k][0] for pair in pairs]) for k in (0, 1))
    whole = over_realisations(values, noises, spread.excited)
    powers = [line_power(out[None]).mean(axis=0) for out in y]
    beside = detection_lines(powers, LINES, spread)
    return whole.relative_distortion, beside.odd, beside.even


@pytest.mark.parametrize("realisations", [1, 2, 4, 8])
@pytest.mark.parametrize("name", SYSTEMS)
def test_intervals_of_levels_hold_the_truth(name, realisations):
    """At least 92 %: 86 of 100 (99 % of a binomial distribution)."""
    rng, exact = np.random.default_rng(realisations), truth(SYSTEMS[name])
    spread = distortion_spread(LINES, np.ones(LINES.size), realisations)
    held, stated = np.zeros(3), np.zeros(3)
    for _ in range(100):
        levels = measured(SYSTEMS[name], rng, realisations, spread)
        for k, (level, true) in enumerate(zip(levels, exact, strict=True)):
            if level.ci95 is not None:
                stated[k] += 1
                held[k] += level.ci95[0] <= true <= level.ci95[1]
    assert stated.tolist() == [0 if realisations == 1 else 100, 100, 100]
    assert (held >= 0.86 * stated).all(), held


def test_of_more_realisations_the_spread_is_narrower():
    spreads = [distortion_spread(LINES, np.ones(LINES.size), count) for count in (2, 4, 16)]
    for which in ("excited", "odd", "even"):
        highs = [getattr(spread, which).high for spread in spreads]
        assert highs == sorted(highs, reverse=True)
        assert all(getattr(spread, which).low < 1 for spread in spreads)
    alone = distortion_spread(np.array([5]), np.ones(1), 4)
    assert alone.excited == alone.odd == alone.even == LevelSpread()
