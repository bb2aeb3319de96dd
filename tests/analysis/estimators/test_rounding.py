"""What rounding makes, by rounding: steps, draws of the fundamental, limits of what counts."""

import numpy as np
import pytest

from undulog.analysis.estimators.harmonic import HarmonicModel, fit_at
from undulog.analysis.estimators.quantisation import (
    _common_step,
    _origin,
    draws,
    lattice_step,
    not_negative,
    rounding_covariance,
    steady_noise,
)
from undulog.analysis.estimators.series import Series

STEP = 0.01


def test_noise_beside_the_steps_makes_rounding_white():
    q = STEP
    assert steady_noise(q, 1.0, 0.13 * q**2 / 3) == pytest.approx((0.13 * q**2) ** 0.5)
    assert steady_noise(q, q**2 / 12 + 0.1 * q**2, 1.0) == pytest.approx(0.1**0.5 * q)
    assert steady_noise(q, 0.0, 1.0) == 0.0
    for share, there in ((0.159, True), (0.161, False)):  # 0.4 squared
        assert (steady_noise(q, 1.0, share * q**2 / 3) is not None) is there
    assert steady_noise(0.0, 1.0, 1.0) is None
    assert steady_noise(0.0, 0.0, 0.0) is None


def test_long_records_have_fewer_draws():
    assert [draws(count) for count in (1, 40_000, 40_001)] == [48, 48, 16]


def test_the_part_of_a_matrix_that_is_not_negative():
    rotation = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0]
    matrix = rotation @ np.diag([2.0, -1.0, 0.5]) @ rotation.T
    expected = rotation @ np.diag([2.0, 0.0, 0.5]) @ rotation.T
    np.testing.assert_allclose(not_negative(matrix), expected, atol=1e-12)


def test_a_mean_near_a_step_or_half_way_is_on_it():
    """The lattice is moved by what the mean is off, up to a tenth of a step."""
    for mean, level, origin in (
        (0.0009, 0.0, 0.0009),
        (0.0011, 0.0, 0.0),
        (0.0059, 0.0, 0.0009),
        (0.0041, 0.0, -0.0009),
        (0.0039, 0.0, 0.0),
        (-0.0209, 0.03, 0.0291),
    ):
        assert _origin(mean, level, STEP) == pytest.approx(origin, abs=1e-12)


def test_levels_in_the_middle_of_a_record_have_its_step():
    rng = np.random.default_rng(2)
    values = rng.normal(size=20_000)
    middle = slice(7952, 7952 + 4096)
    values[middle] = STEP * rng.integers(0, 99, 4096)
    assert lattice_step(values) == pytest.approx(STEP)
    values[middle.start] = values[middle.stop - 1] = 0.123456789
    assert lattice_step(values) == 0.0
    for levels, step in ((5, STEP), (4, 0.0)):
        assert lattice_step(STEP * (np.arange(200) % levels)) == pytest.approx(step)


def test_a_step_is_the_common_measure_of_all_differences():
    apart = STEP * np.array([6, 10, 15, 21.0])
    assert _common_step(apart, 1e-12) == pytest.approx(STEP, rel=1e-9)
    assert _common_step(apart[:3], 1e-12) == 0.0
    assert _common_step(np.r_[apart[:3], 1e-13], 1e-12) == 0.0  # a difference of rounding is none
    # A twentieth of itself in doubt, three times over two steps, it may be there by chance.
    even = STEP * np.array([1, 2, 3, 4.0])
    assert _common_step(even, STEP / 61) == pytest.approx(STEP)
    assert _common_step(even, STEP / 59) == 0.0
    # It is the mean over all of them.
    rough = even + np.array([1, -1, 1, 1]) * 1e-6
    assert _common_step(rough, 1e-5) == pytest.approx(rough.sum() / 10, rel=1e-12)


def test_a_lattice_of_any_multiples_is_found():
    """Euclid's algorithm on differences that are off by up to the blur."""
    rng = np.random.default_rng(11)
    for _ in range(200):
        counts = np.unique(rng.integers(1, 40, rng.integers(4, 9)))
        step, blur = rng.uniform(0.5, 2.0), 1e-7
        apart = step * counts + 0.4 * blur * rng.uniform(-1, 1, counts.size)
        common = step * np.gcd.reduce(counts)
        mean = apart.sum() / np.rint(apart / common).sum() if counts.size >= 4 else 0.0
        for differences in (rng.permutation(apart), np.append(apart, 0.9 * blur)):
            assert _common_step(differences, blur) == pytest.approx(mean, rel=1e-12)


def draw_errors(count, amplitude, noise, *, turned, seed=5):
    """Errors of the fundamental over motions like the fitted, rounded to the lattice."""
    rng = np.random.default_rng(seed)
    t = np.arange(500) / 50
    reach = min(8 * STEP / amplitude, 0.2)
    design = np.stack([t**0, np.cos(np.pi * t), -np.sin(np.pi * t)], axis=1)
    size = amplitude * (1 + reach * rng.uniform(-1, 1, count))
    phase = turned * np.pi / 50 / 2 * rng.uniform(-1, 1, count)
    wave = size * np.cos(np.pi * t[:, None] + 0.3 + phase)
    moved = wave + noise * rng.normal(size=wave.shape)
    return np.linalg.lstsq(design, STEP * np.rint(moved / STEP) - wave, rcond=None)[0][1:]


def covariance(count, *options, turned):
    errors = draw_errors(count, *options, turned=turned)
    return errors @ errors.T / count


@pytest.mark.parametrize(("amplitude", "noise"), [(0.3, 0.0), (0.05, 0.0), (0.3, 0.003)])
def test_the_fundamental_of_a_rounded_wave_scatters_as_when_it_is_rounded(amplitude, noise):
    t = np.arange(500) / 50
    values = STEP * np.rint(amplitude * np.cos(np.pi * t + 0.3) / STEP)
    series = Series("q", t, values)
    fit = fit_at([series], np.pi, HarmonicModel(harmonics=1))
    fitted = rounding_covariance(series, fit, 0, STEP, noise)
    kept, moved = (covariance(1000, amplitude, noise, turned=turned) for turned in (0, 1))
    expected = moved + not_negative(kept - moved)
    # 24 draws in each half: their variance is known within a third.
    assert np.trace(fitted) == pytest.approx(np.trace(expected), rel=0.6)
    np.testing.assert_array_equal(fitted, rounding_covariance(series, fit, 0, STEP, noise))
    np.testing.assert_allclose(fitted, fitted.T, rtol=1e-9)
    assert (np.linalg.eigvalsh(fitted) > 0).all()


@pytest.mark.parametrize("size", [0.005, 0.3, 1.2])
@pytest.mark.parametrize("noise", [0.0, 0.003])
def test_draws_are_those_of_their_definition(size, noise):
    """Amplitude and, in every second draw, phase differ; the mean stays."""
    t = np.arange(500) / 50
    series = Series("q", t, STEP * np.rint((size * np.cos(np.pi * t + 0.3) + 0.004) / STEP))
    model = HarmonicModel(harmonics=2)
    fit = fit_at([Series("p", t, np.cos(np.pi * t)), series], np.pi, model)
    fundamental = fit.fundamental[1]
    design = np.stack([f(h * np.pi * t) for h in (1, 2) for f in (np.cos, lambda x: -np.sin(x))])
    design = np.concatenate([np.ones((1, t.size)), design])
    inverse = np.linalg.inv(design @ design.T)[1:3]
    parts = np.ravel([(a.real, a.imag) for a in fit.amplitudes[1]])
    moving = parts @ design[1:]
    ahead = (1j * fundamental * np.exp(1j * np.pi * t)).real
    rng = np.random.default_rng(0)
    reach = min(8 * STEP / max(abs(fundamental), STEP), 0.2)
    larger = 1 + reach * rng.uniform(-1, 1, 48)
    angle = np.pi / 50 / 2 * rng.uniform(-1, 1, 48)
    angle[::2] = 0.0
    mean = fit.trend[1, 0] - _origin(fit.trend[1, 0], series.values[0], STEP)
    place = (mean + larger[:, None] * moving + angle[:, None] * ahead) / STEP
    moved = place
    if noise:
        moved = place + noise / STEP * rng.standard_normal(place.shape, np.float32)
    error = STEP * (np.rint(moved) - place) @ (inverse @ design).T
    kept, turned = (half.T @ half / 24 for half in (error[::2], error[1::2]))
    expected = turned + not_negative(kept - turned)
    result = rounding_covariance(series, fit, 1, STEP, noise)
    np.testing.assert_allclose(result, expected, rtol=1e-6)
