"""Slow changes from cycle to cycle against least squares, Student's t and planted trends."""

import numpy as np
import pytest
from scipy import linalg, special, stats

from undulog.analysis.estimators.slow_changes import (
    CycleNoise,
    _chance,
    _excess,
    _fit,
    _independent,
    _noises,
    slow_changes,
)
from undulog.analysis.estimators.trends import Trend, families, steady

COUNT = 12
CYCLES = np.arange(float(COUNT))
EVEN = np.ones(COUNT)


def scattered(seed=1, sizes=(0.02, 0.001), joints=3, count=COUNT, steps=None):
    """Series near 1 and near 0: white scatter of gains and of lags."""
    rng = np.random.default_rng(seed)
    mean = np.r_[np.linspace(0.9, 1.1, joints), np.linspace(-0.1, 0.1, joints)]
    size = np.repeat(sizes, joints)
    noise = rng.normal(size=(2 * joints, count)) if steps is None else steps(rng)
    return mean[:, None] + size[:, None] * noise, size


def explained(size, relative=EVEN):
    """Noise within the cycles that explains the scatter between them: no correlation is sought."""
    return CycleNoise((1.1 * size) ** 2, 0.01, relative)


def test_white_scatter_has_students_intervals():
    series, size = scattered()
    changes = slow_changes(series, CYCLES + 5, explained(size))
    assert (changes.trend, changes.dof, changes.turn) == (Trend.STEADY, COUNT - 1, 0.0)
    assert changes.correlation == (0.0, 0.0)
    assert not changes.alike  # gains scatter twenty times as much
    np.testing.assert_allclose(changes.level.value, series.mean(axis=1))
    half = stats.t.ppf(0.975, COUNT - 1) * stats.sem(series, axis=1)
    np.testing.assert_allclose(changes.level.half, half, rtol=1e-9)
    np.testing.assert_allclose(changes.change.value, 0.0)
    assert changes.effective == pytest.approx(COUNT)
    assert changes.share == pytest.approx((1 / COUNT, 1 / COUNT))
    assert changes.residuals.shape == (6, COUNT - 1)
    np.testing.assert_allclose(np.sum(changes.residuals**2, axis=1), COUNT * series.var(axis=1))


def test_gains_and_lags_that_scatter_alike_are_pooled():
    series, size = scattered(sizes=(0.02, 0.02))
    changes = slow_changes(series, CYCLES, explained(size))
    assert changes.alike
    variance = series.var(axis=1, ddof=1)
    pooled = (variance + np.roll(variance, 3)) / 2
    half = stats.t.ppf(0.975, 2 * (COUNT - 1)) * np.sqrt(pooled / COUNT)
    np.testing.assert_allclose(changes.level.half, half, rtol=1e-9)


def test_cycles_count_by_their_noise():
    relative = np.linspace(0.5, 2.0, COUNT)
    series, size = scattered(steps=lambda rng: relative * rng.normal(size=(6, COUNT)))
    changes = slow_changes(series, CYCLES, explained(size, relative))
    weight = 1 / relative**2
    mean = series @ weight / weight.sum()
    np.testing.assert_allclose(changes.level.value, mean)
    rss = ((series - mean[:, None]) ** 2) @ weight
    error = np.sqrt(rss / (COUNT - 1) / weight.sum())
    np.testing.assert_allclose(changes.level.half, stats.t.ppf(0.975, COUNT - 1) * error, rtol=1e-9)
    assert changes.effective == pytest.approx(weight.sum())


@pytest.mark.parametrize("cycle", [CYCLES, np.array([3.0, 4, 5, 7, 8, 11, 12, 13, 14, 16, 17, 18])])
def test_a_drift_is_a_regression_line(cycle):
    series, size = scattered()
    series += 5 * size[:, None] * (cycle - cycle.mean()) * np.array([1, -1, 0.5, 1, 1, -1])[:, None]
    changes = slow_changes(series, cycle, explained(size))
    assert (changes.trend, changes.dof) == (Trend.DRIFTING, COUNT - 2)
    for k, row in enumerate(series):
        line = stats.linregress(cycle, row)
        factor = stats.t.ppf(0.975, COUNT - 2)
        assert changes.level.value[k] == pytest.approx(row.mean())
        assert changes.change.value[k] == pytest.approx(line.slope)
        assert changes.change.half[k] == pytest.approx(factor * line.stderr, rel=1e-6)
        at_mean = line.stderr * np.sqrt(np.mean((cycle - cycle.mean()) ** 2))
        assert changes.level.half[k] == pytest.approx(factor * at_mean, rel=1e-6)


def test_a_response_that_settles_has_its_time_constant_level_and_change():
    series, size = scattered(count=40, sizes=(0.002, 0.002))
    cycle = np.arange(40.0)
    turned = 0.1 * np.array([1, 2, -1, 1, 0.5, 2])[:, None] * np.exp(-cycle / 4.0)
    steady_level = np.r_[np.linspace(0.9, 1.1, 3), np.linspace(-0.1, 0.1, 3)]
    changes = slow_changes(series + turned, cycle, explained(size, np.ones(40)))
    assert changes.trend is Trend.SETTLING
    assert changes.turn == 0.0
    assert changes.tau[1] < 4.0 < changes.tau[2]
    assert changes.tau[2] - changes.tau[1] < 0.8
    np.testing.assert_array_less(np.abs(changes.level.value - steady_level), 2 * changes.level.half)
    np.testing.assert_array_less(
        np.abs(changes.change.value - turned[:, 0]), 2 * changes.change.half
    )
    assert changes.change.half.max() < 0.01


def test_a_response_that_rings_has_its_rotation():
    series, size = scattered(count=40, sizes=(0.002, 0.002))
    cycle = np.arange(40.0)
    phase = np.array([0.0, 1.0, 2.0, 0.5, 1.5, 2.5])[:, None]
    ringing = 0.1 * np.cos(0.8 * cycle + phase) * np.exp(-cycle / 5.0)
    changes = slow_changes(series + ringing, cycle, explained(size, np.ones(40)))
    assert changes.trend is Trend.SETTLING
    assert changes.turn == pytest.approx(0.8, abs=0.03)
    assert changes.tau[0] == pytest.approx(5.0, rel=0.15)


def test_few_cycles_show_no_trend():
    series, size = scattered(count=4)
    series += np.arange(4.0)
    changes = slow_changes(series, np.arange(4.0), explained(size, np.ones(4)))
    assert changes.trend is Trend.STEADY


def autoregression(rng, correlation, joints, count):
    steps = rng.normal(size=(2 * joints, count + 200))
    values = np.zeros_like(steps)
    for k in range(1, count + 200):
        values[:, k] = correlation * values[:, k - 1] + steps[:, k]
    return values[:, 200:] * np.sqrt(1 - correlation**2)


def test_correlated_scatter_widens_the_intervals_until_they_cover():
    held, count = [], 40
    for seed in range(12):
        series, _ = scattered(
            seed, (0.02, 0.02), 6, count, steps=lambda rng: autoregression(rng, 0.8, 6, count)
        )
        unknown = CycleNoise(np.zeros(12), 0.01, np.ones(count))
        changes = slow_changes(series, np.arange(float(count)), unknown)
        assert changes.excess == 0.0
        truth = np.r_[np.linspace(0.9, 1.1, 6), np.linspace(-0.1, 0.1, 6)]
        held += (np.abs(changes.level.value - truth) <= changes.level.half).tolist()
        assert 0.5 <= max(changes.correlation) <= 0.98
        assert changes.effective < count / 2
    assert np.mean(held) > 0.9  # 0.60 with Student's interval of white scatter


# -- the parts, by their definitions --------------------------------------------------------------


def test_the_grid_of_scatter_is_an_autoregression_and_white_noise():
    place, relative = np.array([0.0, 1.0, 3.0, 4.0]), np.array([1.0, 2.0, 0.5, 1.0])
    white, *others = _noises(place, relative)
    np.testing.assert_allclose(white.whiten, np.diag(1 / relative))
    assert (white.correlation, white.prior) == (0.0, 0.5)
    assert len(others) == 35
    assert sum(other.prior for other in others) == pytest.approx(0.5)
    mixed = others[2]  # 0.3, a quarter white
    matrix = 0.75 * 0.3 ** np.abs(place[:, None] - place) + 0.25 * np.diag(relative**2)
    inverse = np.linalg.inv(matrix)
    np.testing.assert_allclose(mixed.whiten.T @ mixed.whiten, inverse, atol=1e-12)
    for model in (white, mixed):
        expected = -np.linalg.slogdet(model.whiten.T @ model.whiten)[1]
        assert model.log_det == pytest.approx(expected)


def test_a_fit_is_generalised_least_squares_with_its_likelihoods():
    place = np.arange(9.0)
    series, _ = scattered(count=9)
    *_, shapes = families(place)
    noise = list(_noises(place, np.linspace(1.0, 2.0, 9)))[8]
    fit = _fit(shapes, noise, series)
    inverse = noise.whiten.T @ noise.whiten
    for s in (0, 7, len(shapes.tau) - 1):
        x = shapes.designs[s]
        information = x.T @ inverse @ x
        beta = np.linalg.solve(information, x.T @ inverse @ series.T)
        rest = series.T - x @ beta
        rss = np.einsum("ck,cd,dk->k", rest, inverse, rest)
        np.testing.assert_allclose(fit.beta[s], beta, rtol=1e-6)
        np.testing.assert_allclose(fit.cov[s], np.linalg.inv(information), rtol=1e-6)
        np.testing.assert_allclose(fit.rss[s], rss, rtol=1e-9)
        full = -0.5 * np.sum(9 * np.log(rss) - np.linalg.slogdet(inverse)[1])
        assert fit.full[s] == pytest.approx(full)
        # The restricted likelihood is that of what is orthogonal to the columns.
        basis = linalg.null_space(x.T)
        contrast = basis.T @ np.linalg.inv(inverse) @ basis
        log_det = np.linalg.slogdet(contrast)[1]
        likelihoods = -0.5 * (log_det + (9 - 3) * np.log(rss))
        expected = likelihoods[:3].sum(), likelihoods[3:].sum()
        np.testing.assert_allclose(fit.restricted[s], expected, rtol=1e-9)


def test_independent_parts_are_counted():
    row = np.random.default_rng(3).normal(size=200)
    assert _independent(np.stack([row, 2 * row, -row])) == pytest.approx(1.0, abs=0.02)
    many = np.random.default_rng(4).normal(size=(6, 200))
    assert _independent(many) == pytest.approx(6.0, abs=0.2)
    assert _independent(np.stack([row, row, many[0], many[0]])) == pytest.approx(2.0, abs=0.1)
    assert _independent(np.stack([row, np.zeros(200)])) == _independent(row[None]) == 1.0


def test_the_chance_of_scatter_is_that_of_a_logarithm_of_chi_square():
    series = np.random.default_rng(5).normal(size=(1, 10))
    noise = next(_noises(np.arange(10.0), np.ones(10)))
    shapes = steady(10)
    variance = series.var(axis=1, ddof=1)
    # A pair that is alike: 4 squared correlations, less 2 / 9 that independent ones have by chance.
    independent = 4 / (4 - 2 / 9)
    pair = np.concatenate([series, series])
    for factor in (0.5, 1.0, 3.0):
        cycle_noise = CycleNoise(np.repeat(variance / factor, 2), 0.02, np.ones(10))
        expected = special.psi(4.5) - np.log(4.5)
        error = ((special.polygamma(1, 4.5) + 0.04) / independent) ** 0.5
        chance = stats.norm.sf((np.log(factor) - expected) / error)
        assert _excess(shapes, noise, pair, cycle_noise) == pytest.approx(chance, rel=1e-3)
    assert _excess(shapes, noise, pair, CycleNoise(np.zeros(2), 0.02, np.ones(10))) == 0.0
    ones = np.ones((2, 1))
    alone = CycleNoise(np.ones(2), 0.02, np.ones(1))
    assert _excess(steady(1), next(_noises(np.zeros(1), np.ones(1))), ones, alone) == 1.0


def test_the_chance_of_a_trend_holds_its_level():
    rng = np.random.default_rng(6)
    line, *_ = families(np.arange(15.0))
    chances = []
    for _ in range(300):
        series = rng.normal(size=(8, 15))
        before = np.sum((series - series.mean(axis=1, keepdims=True)) ** 2, axis=1)
        design = line.designs[0]
        rest = series.T - design @ np.linalg.lstsq(design, series.T, rcond=None)[0]
        after = np.sum(rest**2, axis=0)
        chances.append(_chance(before, after[None], line, 1.0)[0])
    assert stats.kstest(chances, "uniform").pvalue > 0.01
    half = _chance(before, after[None], line, 0.5)[0]
    assert abs(half - 0.5) < abs(chances[-1] - 0.5) + 0.1  # less is known
