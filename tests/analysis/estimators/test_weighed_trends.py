"""Weights of trends and of correlations, by sums over all pairs, and which trend is chosen."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import optimize, special, stats

from undulog.analysis.estimators.slow_changes import (
    CycleNoise,
    _alike,
    _chance,
    _changes,
    _clearest,
    _criterion,
    _excess,
    _fit,
    _halves,
    _independent,
    _mixture,
    _noises,
    _parts,
    _posterior,
    _rest,
    _weighed,
    _zoomed,
    slow_changes,
)
from undulog.analysis.estimators.trends import Trend, families, steady, transients

PLACE = np.arange(14.0)
GRID = list(_noises(PLACE, np.ones(14)))


def scatter(seed, count=14, joints=2):
    return np.random.default_rng(seed).normal(size=(2 * joints, count))


def test_the_grid_is_a_flat_prior_of_the_correlation():
    place, relative = np.array([0.0, 1, 2, 5, 6]), np.array([1.0, 0.5, 2.0, 1.0, 1.5])
    white, *others = _noises(place, relative)
    correlations = np.array([0.3, 0.5, 0.7, 0.8, 0.9, 0.95, 0.98])
    edges = np.r_[0.0, (correlations[1:] + correlations[:-1]) / 2, 1.0]
    shares = (0.0, 0.1, 0.25, 0.5, 0.75)
    assert (white.correlation, white.prior) == (0.0, 0.5)
    for k, noise in enumerate(others):
        i, share = k // 5, shares[k % 5]
        assert noise.correlation == correlations[i]
        assert noise.prior == pytest.approx(np.diff(edges)[i] / 10)
        apart = np.abs(place[:, None] - place)
        matrix = (1 - share) * correlations[i] ** apart + share * np.diag(relative**2)
        np.testing.assert_allclose(
            noise.whiten @ matrix @ noise.whiten.T, np.eye(5), atol=1e-9, err_msg=str(k)
        )
        assert noise.log_det == pytest.approx(np.linalg.slogdet(matrix)[1])


def test_gains_and_lags_have_one_correlation_with_even_chance():
    rng = np.random.default_rng(2)
    log, prior = rng.normal(size=(2, 4, 3)), np.array([[0.5], [0.2], [0.2], [0.1]])
    weights, best = _weighed(log, prior)
    likely = np.exp(log)
    expected = np.zeros((2, 4, 3))
    for part in (0, 1):
        for i in range(4):
            for j in range(4):
                pair = prior[i, 0] * (0.5 * (i == j) + 0.5 * prior[j, 0])
                expected[part, i] += pair * likely[part, i] * likely[1 - part, j]
        expected[part] /= expected[part].sum()
        assert best[part] == np.unravel_index(np.argmax(expected[part]), (4, 3))
    np.testing.assert_allclose(weights, expected)
    far, _ = _weighed(np.array([[[0.0, -5000.0]], [[-5000.0, 0.0]]]), np.ones((1, 1)))
    assert np.isfinite(far).all()


def test_joints_that_scatter_together_say_less():
    row = scatter(3)
    series = np.concatenate([row[:2], row[:2] + 1e-3 * row[2:]])
    shapes = steady(14)
    fits = [_fit(shapes, noise, series) for noise in GRID]
    posterior = _posterior(shapes, fits, GRID, series)
    log = np.stack([fit.restricted.T for fit in fits], axis=1)
    prior = np.array([noise.prior for noise in GRID])[:, None]
    _, best = _weighed(log, prior)
    white = np.concatenate(
        [
            _rest(shapes, s, GRID[i], series[rows])
            for (i, s), rows in zip(best, (slice(2), slice(2, 4)), strict=True)
        ]
    )
    assert posterior.temper == pytest.approx(_independent(white) / 4)
    assert posterior.temper < 0.75
    np.testing.assert_allclose(posterior.weights, _weighed(posterior.temper * log, prior)[0])
    assert posterior.best == _weighed(posterior.temper * log, prior)[1]


def test_what_a_trend_leaves_is_orthogonal_to_it_and_white():
    noise, series = GRID[12], scatter(4)
    line, *_ = families(PLACE)
    rest = _rest(line, 0, noise, series)
    design = noise.whiten @ line.designs[0]
    plain = np.linalg.lstsq(design, noise.whiten @ series.T, rcond=None)[0]
    np.testing.assert_allclose(rest.T, noise.whiten @ series.T - design @ plain, atol=1e-9)


def test_the_criterion_is_akaikes_corrected():
    line, curve, settling, ringing = families(PLACE)
    series = scatter(5)
    for family, nonlinear in ((line, 0), (curve, 0), (settling, 1), (ringing, 2)):
        free = 4 * (family.designs.shape[2] + 1) + nonlinear + 1
        corrected = -2 * -7.0 + 2 * free + 2 * free * (free + 1) / (56 - free - 1)
        assert _criterion(family, -7.0, series) == pytest.approx(corrected)
    few = np.ones((4, 3))  # fewer numbers than parameters
    assert _criterion(line, 0.0, few) == 2 * 13 * 12


def test_the_chance_has_the_moments_of_a_logarithm_of_beta_variables():
    before, after = np.array([9.0, 4.0, 7.0]), np.array([[8.0, 3.0, 7.0], [4.0, 1.0, 6.0]])
    for family in families(PLACE):
        p = family.designs.shape[2]
        a, b = (14 - p) / 2, (p - 1) / 2
        mean = 3 * (special.psi(a + b) - special.psi(a))
        variance = 3 * (special.polygamma(1, a) - special.polygamma(1, a + b)) / 0.6
        sums = np.log(before / after).sum(axis=1)
        expected = stats.gamma.sf(sums, mean**2 / variance, scale=variance / mean)
        np.testing.assert_allclose(_chance(before, after, family, 0.6), expected)


def test_gains_and_lags_are_alike_within_two_standard_errors():
    error = np.sqrt(2 * special.polygamma(1, 5.0) / (0.75 * 4))
    gains = np.array([1.0, 2.0, 3.0, 4.0])
    for factor, alike in ((1.99, True), (2.01, False), (-1.99, True), (-2.01, False)):
        assert _alike(gains, gains * np.exp(factor * error), 10, 0.75) is alike
    lone = np.sqrt(2 * special.polygamma(1, 5.0))  # not less than a joint
    assert _alike(gains, gains * np.exp(1.99 * lone), 10, 0.1)
    assert not _alike(gains, gains * np.exp(2.01 * lone), 10, 0.1)


def test_changes_are_a_slope_or_the_start_of_a_transient():
    line, curve, settling, ringing = families(PLACE)
    np.testing.assert_allclose(_changes(line, PLACE), [[0.0, 1.0]])
    slope = (curve.designs[0, -1] - curve.designs[0, 0]) / 13
    np.testing.assert_allclose(_changes(curve, PLACE), [[0.0, slope[1], slope[2]]])
    np.testing.assert_allclose(_changes(settling, PLACE), np.tile([0.0, 1.0], (24, 1)))
    np.testing.assert_allclose(_changes(ringing, PLACE), np.tile([0.0, 1.0, 0.0], (180, 1)))
    short = steady(1)
    np.testing.assert_array_equal(_changes(short, np.zeros(1)), [[0.0]])
    np.testing.assert_array_equal(short.designs, [[[1.0]]])


def test_slices_cover_all_trends():
    assert [(part.start, part.stop) for part in _parts(7, 10_000)] == [(0, 3), (3, 6), (6, 9)]
    assert [part.start for part in _parts(2, 10**6)] == [0, 1]
    assert [part.start for part in _parts(40_000, 1)] == [0, 32_768]


@pytest.mark.parametrize("alike", [False, True])
def test_coefficients_are_mixtures_over_the_grid(alike):
    series = scatter(6)
    line, *_ = families(PLACE)
    noises, weights = [GRID[0], GRID[9]], np.array([[[0.7], [0.3]], [[0.4], [0.6]]])
    fits = [_fit(line, noise, series) for noise in noises]
    rows = np.array([[1.0, 0.5]])
    result = _mixture(fits, weights, rows, 12, alike=alike)
    for k in range(4):
        part = k // 2
        mean = np.array([(rows @ fit.beta[0])[0, k] for fit in fits])
        variance = np.array([fit.rss[0, k] for fit in fits])
        if alike:
            variance = (variance + [fit.rss[0, (k + 2) % 4] for fit in fits]) / 2
        shares = np.array([(rows @ fit.cov[0] @ rows.T)[0, 0] for fit in fits])
        scale, dof = np.sqrt(variance / 12 * shares), 24 if alike else 12
        share = weights[part, :, 0]
        ends = [
            optimize.brentq(
                lambda x, q=q, m=mean, s=scale, d=dof, w=share: w @ stats.t.cdf((x - m) / s, d) - q,
                -99,
                99,
            )
            for q in (0.025, 0.975)
        ]
        centre = share @ mean
        assert result.value[k] == pytest.approx(centre)
        assert result.half[k] == pytest.approx(max(ends[1] - centre, centre - ends[0]), rel=1e-6)


def test_one_part_of_a_fit_is_gains_and_the_other_lags():
    series = scatter(7)
    fits = [_fit(steady(14), noise, series) for noise in (GRID[0], GRID[9])]
    gains, lags = _halves(*fits)
    np.testing.assert_array_equal(gains.rss, fits[0].rss[:, :2])
    np.testing.assert_array_equal(lags.rss, fits[1].rss[:, 2:])


# -- which trend ----------------------------------------------------------------------------------


def planted(kind, size):
    """White scatter with a trend of that size in all series."""
    rest = scatter(8, 24, 3)
    place = np.arange(24.0)
    waves = {
        "drifting": (place - 11.5) / 11.5,
        "settling": np.exp(-place / 1.2),
        "ringing": np.exp(-place / 4.0) * np.cos(2.2 * place),
    }
    basis = np.stack([np.ones(24), waves[kind]], axis=1)
    rest -= (basis @ np.linalg.lstsq(basis, rest.T, rcond=None)[0]).T
    return 1 + rest + size * waves[kind]


def chance_of(kind, size):
    """The least chance of a trend of this kind over its grid."""
    series, place = planted(kind, size), np.arange(24.0)
    white = next(_noises(place, np.ones(24)))
    null, least = _fit(steady(24), white, series), 1.0
    for family in families(place):
        if family.kind != kind:
            continue
        fit = _fit(family, white, series)
        temper = _posterior(family, [fit], [white], series).temper
        least = min(least, float(_chance(null.rss[0], fit.rss, family, temper).min()))
    return least


@pytest.mark.parametrize(
    ("kind", "trials"), [("drifting", 1.0), ("settling", 4.0), ("ringing", 20.0)]
)
def test_a_trend_is_chosen_from_its_chance_on(kind, trials):
    """3 of 1,000 over all that was tried."""
    white = next(_noises(np.arange(24.0), np.ones(24)))
    sizes = [
        optimize.brentq(
            lambda size, share=share: np.log(chance_of(kind, size) * trials / 3e-3 / share),
            0.05,
            4.0,
            xtol=1e-5,
        )
        for share in (0.9, 1.1)
    ]
    chosen = [_clearest(planted(kind, size), np.arange(24.0), [white]).kind for size in sizes]
    assert chosen == [kind, "steady"]


@pytest.mark.parametrize("variance", [2e-4, 0.0])
def test_a_transient_without_an_end_is_a_drift(variance):
    place = np.arange(20.0)
    series = 1 + 0.01 * scatter(9, 20, 3) + np.exp(-place / 50.0)
    result = slow_changes(series, place, CycleNoise(np.full(6, variance), 0.01, np.ones(20)))
    assert result.trend is Trend.DRIFTING
    assert np.isnan(result.tau[0])


@pytest.mark.parametrize(("turn", "sizes"), [(0.0, (24, 1)), (0.8, (12, 16))])
def test_a_fine_grid_is_as_narrow_as_the_likelihood(turn, sizes):
    place = np.arange(40.0)
    wave = np.exp(-place / 5.0) * np.cos(turn * place)
    series = 1 + 0.005 * scatter(10, 40, 3) + 0.1 * wave
    *_, settling, ringing = families(place)
    white = [next(_noises(place, np.ones(40)))]
    fine = _zoomed(ringing if turn else settling, series, place, white)
    assert (np.unique(fine.tau).size, np.unique(fine.turn).size) == sizes
    assert fine.tau.min() < 5.0 < fine.tau.max()
    assert np.ptp(fine.tau) < 2.0
    weights = _posterior(fine, [_fit(fine, white[0], series)], white, series).weights[0, 0]
    assert 1 / np.sum(weights**2) >= (25 if turn else 8)
    # Likely at all is only what lies inside the grid.
    edge = (fine.tau == fine.tau.min()) | (fine.tau == fine.tau.max())
    assert weights[edge].sum() < 0.1
    if turn:
        assert fine.turn.min() < turn < fine.turn.max() < 1.2


def test_a_grid_that_is_fine_stays():
    place = np.arange(14.0)
    *_, settling, _ = families(place)
    series = 1 + scatter(11)
    assert _zoomed(settling, series, place, [GRID[0]]) is settling


def test_scatter_that_noise_explains_has_no_correlation():
    """Just within or beyond one chance of twenty."""
    place, rows = np.arange(30.0), scatter(17, 31, 4)
    rows = 1 + rows[:, 1:] + 0.5 * rows[:, :-1]
    variance, white = rows.var(axis=1, ddof=1), next(_noises(place, np.ones(30)))
    for target, correlated in ((0.045, True), (0.055, False)):
        factor = optimize.brentq(
            lambda x, t=target: _excess(steady(30), white, rows, explained(x * variance)) - t,
            0.2,
            2.0,
        )
        result = slow_changes(rows, place, explained(factor * variance))
        assert (result.trend, result.excess) == (Trend.STEADY, pytest.approx(target))
        assert (max(result.correlation) > 0) is correlated


def explained(variance):
    return CycleNoise(variance, 0.02, np.ones(30))


def test_the_share_of_the_level_is_that_of_the_likeliest_trend():
    series = scatter(13, 14, 2)
    series[:2] *= 3
    noise = CycleNoise(10 * series.var(axis=1), 0.01, np.ones(14))
    result = slow_changes(series, PLACE, noise)
    assert result.trend is Trend.STEADY
    assert result.share == pytest.approx((1 / 14, 1 / 14))
    assert replace(result, turn=1.0).turn == 1.0
    assert transients(PLACE, np.array([2.0]), np.zeros(1)).designs.shape == (1, 14, 2)
