"""Noise and distortion of systems whose truth is computed from many noise-free realisations."""

import numpy as np
import pytest
from scipy import stats

from undulog.analysis.common.estimate import Estimate
from undulog.analysis.experiment.best_linear import (
    detection_lines,
    input_inverse,
    over_realisations,
    realisation_response,
)
from undulog.analysis.parts.frequency_response.nonparametric import line_power

N = 512
ODD = np.arange(1, 120, 2)


def best_linear_approximation(inputs, outputs, lines):
    """Of one input and one output, from samples of whole steady periods, shape (M, P, n)."""
    length = inputs.shape[2]
    u, y = (np.fft.rfft(values, axis=2)[:, :, lines] / length for values in (inputs, outputs))
    responses = [
        realisation_response(input_inverse(command.mean(axis=0)[None, None]), out[None])
        for command, out in zip(u, y, strict=True)
    ]
    return over_realisations(
        *map(np.stack, zip(*((v[0], n[0]) for v, n in responses), strict=True))
    )


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


@pytest.mark.nightly
@pytest.mark.parametrize(("square", "cube"), [(0.0, 0.15), (0.2, 0.0), (0.15, 0.1)])
def test_distortion_is_that_of_a_thousand_noise_free_realisations(square, cube):
    rng = np.random.default_rng(2)
    lines = np.sort(rng.permutation(ODD)[: 3 * ODD.size // 4])  # a quarter is left out
    truth_u = multisine(rng, lines, 1000)
    truth_y = system(truth_u, square, cube)
    exact = np.fft.rfft(truth_y)[:, lines] / np.fft.rfft(truth_u)[:, lines]
    mean, scatter = exact.mean(axis=0), exact.var(axis=0)
    relative = np.sqrt(scatter.sum() / np.sum(np.abs(mean) ** 2))
    y = np.abs(np.fft.rfft(truth_y)) ** 2
    free = np.setdiff1d(np.arange(lines.min(), lines.max()), lines)
    power = y[:, lines].mean()
    truth = {k: np.sqrt(y[:, free[free % 2 == k]].mean() / power) for k in (0, 1)}
    errors, distortions, odd, even, inside = [], [], [], [], []
    for _ in range(40):
        u = multisine(rng, lines, 10)
        inputs, outputs = periods(u, 0.0, rng), periods(system(u, square, cube), 0.02, rng)
        estimate = best_linear_approximation(inputs, outputs, lines)
        errors.append(np.mean(np.abs(estimate.value - mean) ** 2 / estimate.total))
        distortions.append(estimate.relative_distortion)
        spectra = np.fft.rfft(outputs, axis=2) / N
        levels = detection_lines(list(line_power(spectra)), lines)
        odd.append(levels.odd)
        even.append(levels.even)
        inside.append(
            [
                low <= true <= high
                for (low, high), true in (
                    (distortions[-1].ci95, relative),
                    (odd[-1].ci95, truth[1]),
                    (even[-1].ci95, truth[0]),
                )
            ]
        )
    # |e|^2 / total has the distribution F(2, 18), of the mean 18 / 16.
    assert np.mean(errors) == pytest.approx(18 / 16, abs=0.15)
    for values, true in ((distortions, relative), (odd, truth[1]), (even, truth[0])):
        got = np.array([value.value for value in values])
        if true > 0.01:  # a typical set of ten realisations, not only their mean
            assert np.sqrt(np.mean(got**2)) == pytest.approx(true, rel=0.1)
            assert np.median(np.abs(got / true - 1)) < 0.1
        else:  # a square makes no odd lines of odd lines, a cube no even ones
            assert got.max() < 0.01
    covered = np.mean(inside, axis=0)
    sure = [true > 0.01 for true in (relative, truth[1], truth[0])]
    assert (covered[sure] >= 0.85).all()  # 40 draws: 0.95 less three standard deviations


def test_a_linear_system_has_no_distortion_and_lies_within_the_intervals():
    rng = np.random.default_rng(3)
    exact = 1 / (1 + 1j * ODD / 60) / (1 + 1j * ODD / 90)
    inside, zero, ratio = [], [], []
    for _ in range(60):
        u = multisine(rng, ODD, 10)
        outputs = periods(system(u), 0.05, rng)
        estimate = best_linear_approximation(periods(u, 0.0, rng), outputs, ODD)
        reach = stats.t.ppf(0.975, 18) * np.sqrt(estimate.total / 2)
        inside.append(np.abs(np.abs(estimate.value) - np.abs(exact)) <= reach)
        zero.append(estimate.relative_distortion.ci95[0] == 0.0)
        ratio.append(np.mean(np.abs(estimate.value - exact) ** 2 / estimate.noise.mean()))
        assert estimate.relative_distortion.value < 0.03
    assert 0.91 <= np.mean(inside) <= 0.98
    assert np.mean(zero) >= 0.9
    flat = np.mean(ratio)
    assert flat == pytest.approx(1.0, abs=0.1)


def test_few_realisations_have_wide_intervals():
    rng = np.random.default_rng(5)
    for count in (2, 3):
        inside = []
        for _ in range(60):
            u = multisine(rng, ODD, count)
            y = periods(system(u), 0.05, rng)
            distortion = best_linear_approximation(periods(u, 0.0, rng), y, ODD).relative_distortion
            inside.append(distortion.ci95[0] == 0.0)
        assert np.mean(inside) >= 0.85


@pytest.mark.parametrize("joints", [2, 3])
def test_orthogonal_inputs_identify_every_response(joints):
    """Outputs that mix all inputs: G_j of each is found, and its noise is what it says."""
    rng = np.random.default_rng(6)
    k, P, sigma = 40, 2, 0.1
    exact = rng.normal(size=(joints, k)) + 1j * rng.normal(size=(joints, k))
    turns = np.exp(2j * np.pi / joints * np.outer(np.arange(joints), np.arange(joints)))
    errors = []
    for _ in range(50):
        phases = np.exp(2j * np.pi * rng.random((joints, 1, k)))
        u = phases * turns[:, :, None]
        y = np.einsum("mk,mek->ek", exact, u)[:, None].repeat(P, axis=1)
        y = y + sigma / np.sqrt(2) * (rng.normal(size=y.shape) + 1j * rng.normal(size=y.shape))
        value, noise = realisation_response(input_inverse(u), y)
        errors.append((np.abs(value - exact) ** 2, noise))
    squared, stated = np.mean(errors, axis=(0, 2, 3))
    assert squared == pytest.approx(sigma**2 / P / joints, rel=0.1)
    assert stated == pytest.approx(squared, rel=0.1)


def test_what_one_record_can_not_say_is_missing():
    rng = np.random.default_rng(4)
    u = multisine(rng, ODD, 1)
    estimate = best_linear_approximation(u[:, None], system(u)[:, None], ODD)
    assert np.isnan(estimate.noise).all()
    assert np.isnan(estimate.distortion).all()
    several = best_linear_approximation(periods(u, 0.0, rng), periods(system(u), 0.01, rng), ODD)
    assert np.isfinite(several.noise).all()
    assert np.isnan(several.total).all()
    assert several.relative_distortion == Estimate()
    u = multisine(rng, ODD, 3)
    once = best_linear_approximation(u[:, None], system(u)[:, None], ODD)
    assert np.isfinite(once.total).all()
    assert once.relative_distortion == Estimate()
