"""Noise beside a frequency against dense projections, and the variance of a shared frequency."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from undulog.analysis.estimators.harmonic import HarmonicModel, fit_at
from undulog.analysis.estimators.quantisation import draws, not_negative, rounding_covariance
from undulog.analysis.estimators.series import Series
from undulog.analysis.estimators.spectrum import (
    FundamentalNoise,
    ResidualBins,
    _common_bins,
    _Demodulated,
    bins_per_side,
    omega_variance,
    residual_noise,
    residual_spectrum,
)

OMEGA = 2 * np.pi * 0.9
MODEL = HarmonicModel(harmonics=2, trend=2, lines=(3.1,))


def columns(t, omega=OMEGA, model=MODEL):
    """The model's columns by their definition."""
    turns = [*model.lines, *(h * omega for h in range(1, model.harmonics + 1))]
    rows = [t**d for d in range(model.trend + 1)]
    for turn in turns:
        rows += [np.cos(turn * t), -np.sin(turn * t)]
    return np.stack(rows, axis=1)


def wave(t, rng):
    return np.cos(OMEGA * t + 1) + 0.2 * np.sin(3.1 * t) + rng.normal(0, 0.1, t.size)


def dense_bins(series, span, side):
    """Residual and what is left of a unit in each bin, by plain projections."""
    q = np.linalg.qr(columns(series.t_s))[0]
    rest = series.values - q @ (q.T @ series.values)
    offset = np.repeat(np.arange(1, side + 1), 2) * np.tile([1, -1], side) * 2 * np.pi / span
    waves = np.exp(-1j * np.outer(OMEGA + offset, series.t_s))
    kept = series.count - np.sum(np.abs(waves @ q) ** 2, axis=1)
    return waves @ rest, kept, offset


def record(rng, count, step=0.01):
    t = np.arange(count) * step + rng.uniform(-0.2, 0.2, count) * step - 2.0
    t[[0, -1]] = np.array([0, count - 1]) * step - 2.0
    return t


@pytest.mark.parametrize(("counts", "tolerance"), [((500, 500), 1e-9), ((20_000, 20_000), 1e-3)])
def test_bins_are_what_a_dense_projection_leaves(counts, tolerance):
    rng = np.random.default_rng(1)
    step = 5.0 / counts[0]
    times = [record(rng, count, step) for count in counts]
    series = [Series("q", t, wave(t, rng)) for t in (times[0], times[0], times[1])]
    noise, bins = residual_spectrum(series, fit_at(series, OMEGA, MODEL))
    side = 3  # 4.5 cycles
    # The line is 1.06 bins below the tone: it takes the pair beside the tone.
    for k, channel in enumerate(series):
        rest, kept, offset = dense_bins(channel, 5.0, side)
        pairs = np.repeat(kept.reshape(-1, 2).min(axis=1) > 0.5 * channel.count, 2)
        assert 2 <= pairs.sum() < 2 * side
        np.testing.assert_allclose(bins.offset, offset[pairs], rtol=1e-9)
        scale = np.abs(rest).max()
        expected = rest[pairs] / np.sqrt(kept[pairs])
        np.testing.assert_allclose(
            bins.values[k] * scale, expected * scale, atol=tolerance * scale**2
        )
        usable = kept > 0.5 * channel.count
        level = np.mean(np.abs(rest[usable]) ** 2 / kept[usable])
        assert noise.level[k] == pytest.approx(level, rel=10 * tolerance)
        assert noise.dof[k] == 2 * np.count_nonzero(usable)
        design = columns(channel.t_s)
        inverse = np.linalg.inv(design.T @ design)
        unscaled, parts = inverse[5:7, 5:7], (inverse @ design.T)[5:7]
        squares = (channel.values - design @ (inverse @ design.T @ channel.values)) ** 2
        squares = np.minimum(squares, (4 / stats.norm.ppf(0.75)) ** 2 * np.median(squares))
        shape = parts * squares @ parts.T
        shape *= np.trace(unscaled) / np.trace(shape)
        near = {"rtol": 1e-3}
        if channel.count > 4096:  # the shape is that of some samples
            near = {"rtol": 0.15, "atol": 0.1 * noise.level[k] * np.trace(unscaled)}
        np.testing.assert_allclose(noise.covariance[k], noise.level[k] * shape, **near)
        assert bins.spread[k] == pytest.approx(np.trace(unscaled))
    assert not bins.rounding.any()


def test_a_record_longer_by_a_twentieth_has_bins_of_its_own():
    rng = np.random.default_rng(2)
    series = [
        Series("q", t, wave(t, rng)) for t in (np.arange(n) / 100 for n in (1000, 1049, 1055))
    ]
    fit = fit_at(series, OMEGA, MODEL)
    level = residual_noise(series, fit).level
    for channel, span, value in zip(series, (10.0, 10.0, 10.55), level, strict=True):
        rest, kept, _ = dense_bins(channel, span, 6)
        usable = kept > 0.5 * channel.count
        expected = np.mean(np.abs(rest[usable]) ** 2 / kept[usable])
        assert value == pytest.approx(expected, rel=1e-6)


def test_the_number_of_bins_grows_with_the_cycles():
    counts = [bins_per_side(cycles) for cycles in (0.1, 1.0, 2.0, 3.0, 4.6, 6.0, 7.4, 9.0, 90.0)]
    assert counts == [1, 1, 1, 2, 3, 4, 5, 6, 6]


def test_an_exact_channel_keeps_the_level_of_its_rounding():
    t = np.arange(1000) / 100
    series = [Series("q", t, 3 * np.cos(OMEGA * t)), Series("q", t, np.zeros(1000))]
    fit = fit_at(series, OMEGA)
    noise, bins = residual_spectrum(series, fit)
    floor = 1e-13 * 4500 / 1000
    assert noise.level[0] == pytest.approx(floor, rel=0.01)
    block = fit.inverse_gram[0, 1:3, 1:3]
    np.testing.assert_allclose(bins.rounding[0], floor * block, rtol=0.01)
    np.testing.assert_allclose(noise.covariance[0], floor * block, rtol=0.01)
    assert noise.level[1] == 0.0


def test_rounding_that_the_bins_do_not_show_counts_instead_of_them():
    t, step = np.arange(1000) / 50, 2 * np.pi / 4096
    values = step * np.rint(0.4 * np.sin(np.pi * t + 0.3) / step)
    series = [Series("q", t, values)]
    fit = fit_at(series, np.pi)
    noise, bins = residual_spectrum(series, fit)
    rounded = rounding_covariance(series[0], fit, 0, step, 0.0)
    rest = np.abs(bins.values[0]) ** 2
    block = fit.inverse_gram[0, 1:3, 1:3]
    floor = 1e-13 * fit.total[0] / 1000
    shown = max(rest.mean(), floor) * block
    added = not_negative(rounded - shown)
    np.testing.assert_allclose(noise.covariance[0], shown + added, rtol=1e-3)
    hidden = max(floor - rest.mean(), 0.0) * block
    np.testing.assert_allclose(bins.rounding[0], hidden + added, rtol=1e-3)
    assert noise.level[0] == pytest.approx(np.trace(shown + added) / np.trace(block), rel=1e-3)
    assert noise.dof[0] == draws(1000) == 48


def test_rounding_counts_from_thirteen_tenths_of_the_noise_on(monkeypatch):
    t, step = np.arange(1000) / 50, 2 * np.pi / 4096
    series = [Series("q", t, step * np.rint(0.4 * np.sin(np.pi * t + 0.3) / step))]
    fit = fit_at(series, np.pi)
    name = "undulog.analysis.estimators.spectrum.rounding_covariance"
    monkeypatch.setattr(name, lambda *_: np.zeros((2, 2)))
    noise = residual_noise(series, fit)
    for factor, dof in ((1.28, noise.dof[0]), (1.32, 48.0)):
        monkeypatch.setattr(name, lambda *_, factor=factor: factor * noise.covariance[0])
        raised = residual_noise(series, fit)
        assert raised.dof[0] == dof
        expected = factor if dof == 48 else 1.0
        np.testing.assert_allclose(
            raised.covariance, expected * noise.covariance, rtol=1e-6, atol=1e-24
        )


def test_pairs_that_a_fit_took_are_left_out():
    transform = np.arange(1.0, 7.0)[None] + 1j
    kept = np.array([9.0, 6.0, 8.0, 4.0, 5.1, 7.0])
    spread, rounding = np.array([2.0]), np.ones((1, 2, 2))
    bins = _common_bins([[0]], [_Demodulated(transform, kept, 10)], 4.0, spread, rounding)
    chosen = [0, 1, 4, 5]
    np.testing.assert_allclose(bins.values, transform[:, chosen] / np.sqrt(kept[chosen]))
    np.testing.assert_allclose(bins.offset, np.pi / 2 * np.array([1, -1, 3, -3]))
    assert (bins.spread, bins.rounding) == (spread, rounding)
    # Where all were taken the best pair has to do.
    few = _Demodulated(transform, kept / 3, 10)
    offset = _common_bins([[0]], [few], 4.0, spread, rounding).offset
    np.testing.assert_allclose(offset, np.pi / 2 * np.array([1, -1]))
    assert few.usable().tolist() == [True] + [False] * 5
    assert _Demodulated(transform, kept, 10).usable().tolist() == [True] * 3 + [False, True, True]
    # Of two groups the one that a fit took more of decides.
    other = _Demodulated(transform, np.array([4.9, 9.0, 9.0, 9.0, 9.0, 9.0]), 10)
    both = [_Demodulated(transform, kept, 10), other]
    assert _common_bins([[0], [1]], both, 4.0, np.ones(2), rounding).offset.size == 2


def test_chosen_channels_keep_their_bins():
    values = np.arange(6.0).reshape(3, 2) + 0j
    bins = ResidualBins(values, np.array([1.0, -1.0]), np.arange(3.0), np.zeros((3, 2, 2)))
    some = bins.select([2, 0])
    np.testing.assert_array_equal(some.values, values[[2, 0]])
    assert some.spread.tolist() == [2.0, 0.0]
    assert some.offset.tolist() == [1.0, -1.0]
    assert some.rounding.shape == (2, 2, 2)


def test_variance_along_a_direction_is_a_quadratic_form():
    covariance = np.array([[[4.0, 1.0], [1.0, 2.0]], [[1.0, 0.0], [0.0, 9.0]]])
    noise = FundamentalNoise(np.ones(2), np.ones(2), covariance)
    direction = np.array([0.6 + 0.8j, 1j])
    np.testing.assert_allclose(noise.along(direction), [0.36 * 4 + 2 * 0.48 + 0.64 * 2, 9.0])


def test_the_variance_of_a_shared_frequency():
    t = np.arange(100) / 10
    series = [Series("q", t, np.cos(3 * t)), Series("q", t, np.sin(3 * t))]
    fit = replace(
        fit_at(series, 3.0), weight=np.array([4.0, 0.5]), information=np.array([3.0, 7.0])
    )
    block = np.zeros((2, 2, 2))
    white = FundamentalNoise(np.array([0.25, 2.0]), np.array([24.0, 8.0]), block)
    variance, dof = omega_variance(fit, white)
    assert variance == pytest.approx(1 / (3 / 0.25 + 7 / 2.0))
    parts = np.array([12.0, 3.5]) / 15.5**2
    assert dof == pytest.approx(parts.sum() ** 2 / (parts[0] ** 2 / 24 + parts[1] ** 2 / 8))
    louder = FundamentalNoise(np.array([0.75, 2.0]), np.array([24.0, 8.0]), block)
    assert omega_variance(fit, louder)[0] == pytest.approx((3 * 12.0 + 3.5) / 15.5**2)
    assert omega_variance(fit, FundamentalNoise(np.zeros(2), np.ones(2), block)) == (0.0, 1.0)
    still = replace(fit, weight=np.zeros(2))
    assert omega_variance(still, white) == (float("inf"), 1.0)


@pytest.mark.parametrize(("share", "ratio"), [(0.0, 1.0), (0.05, 1.5)])
def test_noise_that_grows_with_the_motion_moves_the_amplitude_more(share, ratio):
    """Of noise times cos(wt) the part along the amplitude has E cos^4 = 3/8, not 1/4."""
    rng, t = np.random.default_rng(5), np.arange(0.0, 60.0, 0.01)
    motion = np.cos(OMEGA * t)
    noise = np.where(share > 0, share * motion, 0.05) * rng.standard_normal(t.size)
    series = [Series("q", t, motion + noise)]
    fit = fit_at(series, OMEGA, MODEL)
    measured = residual_noise(series, fit)
    along, across = (measured.along(np.array([way])) for way in (1.0 + 0j, 1j))
    usual = measured.level * np.trace(fit.inverse_gram[0, 5:7, 5:7]) / 2
    assert along / usual == pytest.approx(ratio, rel=0.1)
    assert across / usual == pytest.approx(2.0 - ratio, rel=0.1)
