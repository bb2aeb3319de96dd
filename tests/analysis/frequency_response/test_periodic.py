"""Noise and distortion of systems whose truth is computed from many noise-free realisations."""

import numpy as np
import pytest

from undulog.analysis.frequency_response.periodic import (
    best_linear_approximation,
    detection_lines,
)

N = 512
ODD = np.arange(1, 120, 2)


def multisine(rng, lines, realisations, n=N):
    """Random phases, amplitude 1 a line; shape (realisations, n)."""
    spectrum = np.zeros((realisations, n // 2 + 1), complex)
    spectrum[:, lines] = np.exp(2j * np.pi * rng.random((realisations, lines.size))) * n / 2
    return np.fft.irfft(spectrum, n) / np.sqrt(lines.size / 2)


def low_pass(values, corner):
    """First-order low-pass in steady state, by its response at each line."""
    lines = np.arange(values.shape[-1] // 2 + 1)
    return np.fft.irfft(np.fft.rfft(values) / (1 + 1j * lines / corner), values.shape[-1])


def system(values, square=0.0, cube=0.0):
    """A polynomial between two low-passes."""
    inner = low_pass(values, 60)
    return low_pass(inner + square * inner**2 + cube * inner**3, 90)


def periods(values, noise, rng, count=2):
    repeated = np.repeat(values[:, None], count, axis=1)
    return repeated + noise * rng.normal(size=repeated.shape)


def band(values):
    return float(np.sqrt(np.mean(values)))


@pytest.mark.parametrize(("square", "cube"), [(0.0, 0.15), (0.2, 0.0), (0.15, 0.1)])
def test_distortion_is_that_of_a_thousand_noise_free_realisations(square, cube):
    rng = np.random.default_rng(2)
    lines = np.sort(rng.permutation(ODD)[: 3 * ODD.size // 4])  # a quarter is left out
    truth_u = multisine(rng, lines, 1000)
    truth_y = system(truth_u, square, cube)
    exact = np.fft.rfft(truth_y)[:, lines] / np.fft.rfft(truth_u)[:, lines]
    scatter = exact.var(axis=0)
    found, odd, even = [], [], []
    for _ in range(20):
        u = multisine(rng, lines, 10)
        inputs, outputs = periods(u, 0.0, rng), periods(system(u, square, cube), 0.02, rng)
        estimate = best_linear_approximation(inputs, outputs)
        assert list(estimate.lines) == list(lines)
        inside = np.abs(estimate.value - exact.mean(axis=0)) ** 2 / estimate.total
        assert inside.mean() == pytest.approx(1.0, abs=0.6)  # E|e|^2 is what it says it is
        found.append(estimate.distortion.mean())
        free = detection_lines(outputs, lines)
        odd.append(free.odd)
        even.append(free.even)
    if cube:  # a typical set of ten realisations, not only their mean
        assert np.sqrt(np.mean(found)) == pytest.approx(band(scatter), rel=0.1)
        assert np.median(np.abs(np.sqrt(found) / band(scatter) - 1)) < 0.1
    else:  # a square makes no odd lines of odd lines
        assert np.mean(found) == pytest.approx(0.0, abs=1e-5)
    y = np.fft.rfft(truth_y) / N
    unexcited = np.setdiff1d(np.arange(1, lines.max() + 1), lines)
    for parity, level in ((1, odd), (0, even)):
        chosen = unexcited[unexcited % 2 == parity]
        expected = np.mean(np.abs(y[:, chosen]) ** 2)
        assert np.sqrt(max(np.mean(level), 0.0)) == pytest.approx(
            np.sqrt(expected), rel=0.1, abs=2e-4
        )


def test_a_linear_system_has_no_distortion_beyond_noise():
    rng = np.random.default_rng(3)
    u = multisine(rng, ODD, 10)
    outputs = periods(system(u), 0.05, rng, count=4)
    estimate = best_linear_approximation(periods(u, 0.0, rng, count=4), outputs)
    exact = 1 / (1 + 1j * ODD / 60) / (1 + 1j * ODD / 90)
    assert np.mean(np.abs(estimate.value - exact) ** 2 / estimate.noise) == pytest.approx(
        1, abs=0.4
    )
    mean, scatter = estimate.distortion.mean(), estimate.noise.mean() * 10
    assert abs(mean) < 4 * scatter / np.sqrt(9 * ODD.size)
    assert estimate.relative_distortion < 0.02


def test_what_one_record_can_not_say_is_nan():
    rng = np.random.default_rng(4)
    u = multisine(rng, ODD, 1)
    one = best_linear_approximation(u[:, None], system(u)[:, None])
    assert np.isnan(one.noise).all()
    assert np.isnan(one.distortion).all()
    several = best_linear_approximation(periods(u, 0.0, rng), periods(system(u), 0.01, rng))
    assert np.isfinite(several.noise).all()
    assert np.isnan(several.total).all()
