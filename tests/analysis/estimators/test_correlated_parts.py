"""Slow changes whose gains and lags scatter differently, and what of a fit is handed on."""

import numpy as np
import pytest
from scipy import stats

from undulog.analysis.estimators.slow_changes import CycleNoise, _noises, slow_changes
from undulog.analysis.estimators.trends import Trend, transients

COUNT = 40
PLACE = np.arange(float(COUNT))


def autoregression(rng, correlation, rows, count=COUNT):
    """Rows of unit variance."""
    values = np.zeros((rows, count))
    values[:, 0] = rng.normal(size=rows)
    for k in range(1, count):
        step = rng.normal(size=rows)
        values[:, k] = correlation * values[:, k - 1] + np.sqrt(1 - correlation**2) * step
    return values


def unknown(rows, count=COUNT):
    return CycleNoise(np.zeros(rows), 0.01, np.ones(count))


@pytest.mark.parametrize("correlated", ["gains", "lags"])
def test_gains_and_lags_have_each_their_correlation_share_and_residuals(correlated):
    rng = np.random.default_rng(2)
    white, wander = rng.normal(size=(5, COUNT)), autoregression(rng, 0.9, 5)
    rows = (wander, white) if correlated == "gains" else (white, wander)
    series = 1 + 0.01 * np.concatenate(rows)
    changes = slow_changes(series, PLACE, unknown(10))
    assert changes.trend is Trend.STEADY
    lone, shared = sorted(changes.correlation)
    assert (lone, changes.correlation.index(shared)) == (0.0, 0 if correlated == "gains" else 1)
    assert 0.5 <= shared <= 0.98
    # White scatter has n - 1 independent errors about the mean, whose variance is an nth of theirs.
    part, other = (slice(0, 5), slice(5, 10)) if correlated == "lags" else (slice(5, 10), slice(5))
    index = 0 if correlated == "lags" else 1
    assert changes.share[index] == pytest.approx(1 / COUNT)
    power = np.sum(changes.residuals[part] ** 2, axis=1)
    np.testing.assert_allclose(power, COUNT * series[part].var(axis=1))
    # Of those that wander one noise of the grid explains both.
    grid = [noise for noise in _noises(PLACE, np.ones(COUNT)) if noise.correlation == shared]
    ones = [model.whiten.sum(axis=1) for model in grid]
    shares = [1 / (column @ column) for column in ones]
    near = int(np.argmin(np.abs(np.array(shares) - changes.share[1 - index])))
    assert changes.share[1 - index] == pytest.approx(shares[near])
    rest = grid[near].whiten @ series[other].T
    rest -= np.outer(ones[near], ones[near] @ rest) * shares[near]
    power = np.sum(changes.residuals[other] ** 2, axis=1)
    np.testing.assert_allclose(power, np.sum(rest**2, axis=0))
    # The level is known as well as by the lesser of both.
    assert changes.effective == pytest.approx(1 / max(changes.share), rel=0.6)
    assert changes.effective < 0.5 * COUNT
    assert not changes.alike
    half = changes.level.half / (0.01 * stats.t.ppf(0.975, COUNT - 1) / np.sqrt(COUNT))
    assert np.median(half[part]) == pytest.approx(1.0, abs=0.35)
    assert np.median(half[other]) > 1.7


def test_a_transient_that_outlasts_half_of_the_window_is_a_drift():
    """Its end is not seen, however well the longest time constant fits."""
    rng = np.random.default_rng(4)
    place = np.arange(20.0)
    sizes = 0.3 * np.array([1.0, -1.0, 0.5, 0.8, 1.0, -0.6])[:, None]
    noise = CycleNoise(np.full(6, 1.2e-6), 0.01, np.ones(20))
    for tau, trend in ((10.5, Trend.DRIFTING), (6.0, Trend.SETTLING)):
        series = 1 + sizes * np.exp(-place / tau) + 1e-3 * rng.normal(size=(6, 20))
        # The longest of the grid, 10 cycles, fits better than a parabola.
        designs = (transients(place, np.array([10.0]), np.zeros(1)).designs[0], np.vander(place, 3))
        rest = [np.linalg.lstsq(design, series.T, rcond=None)[1].sum() for design in designs]
        assert tau < 10 or rest[0] < rest[1]
        assert slow_changes(series, place, noise).trend is trend


def test_five_cycles_are_enough_for_a_drift():
    rng = np.random.default_rng(8)
    for count, trend in ((5, Trend.DRIFTING), (4, Trend.STEADY)):
        place = np.arange(float(count))
        series = 1 + 0.1 * place + 1e-3 * rng.normal(size=(8, count))
        changes = slow_changes(series, place, CycleNoise(np.full(8, 2e-6), 0.01, np.ones(count)))
        assert changes.trend is trend


def test_a_time_constant_and_a_change_are_found_where_only_lags_settle():
    rng = np.random.default_rng(5)
    sizes = np.r_[0.0, 0.0, 0.0, 0.2, -0.3, 0.4][:, None]
    series = 1 + sizes * np.exp(-PLACE / 5.0) + 2e-3 * rng.normal(size=(6, COUNT))
    changes = slow_changes(series, PLACE, CycleNoise(np.full(6, 5e-6), 0.01, np.ones(COUNT)))
    assert changes.trend is Trend.SETTLING
    assert changes.tau[1] < 5.0 < changes.tau[2]
    assert changes.tau[2] / changes.tau[1] < 1.2
    np.testing.assert_allclose(changes.change.value, sizes[:, 0], atol=6e-3)
    assert (np.abs(changes.change.value - sizes[:, 0]) < 2 * changes.change.half).all()
    assert changes.residuals.shape == (6, COUNT - 2)
    assert changes.dof == COUNT - 2


def test_missing_cycles_lengthen_the_way_between_neighbours():
    """Pairs of cycles far apart: within a pair all is shared, between pairs nothing."""
    rng = np.random.default_rng(6)
    place = np.sort(np.r_[200.0 * np.arange(16), 200.0 * np.arange(16) + 1])
    base = np.repeat(rng.normal(size=(8, 16)), 2, axis=1)
    series = 1 + 0.01 * (base + 0.1 * rng.normal(size=(8, 32)))
    changes = slow_changes(series, place + 3.0, unknown(8, 32))
    assert changes.trend is Trend.STEADY
    assert min(changes.correlation) >= 0.9
    assert changes.effective == pytest.approx(16, rel=0.12)
