"""Tests, norms and mixtures against scipy, closed forms and draws."""

import dataclasses

import numpy as np
import pytest
from scipy import optimize, stats

from undulog.analysis.estimators.intervals import (
    EQUIVALENT_GAIN,
    EQUIVALENT_LAG_RAD,
    NoisyMatrix,
    ResponseErrors,
    around,
    equivalence_p,
    holm,
    mixture_interval,
    noise_draws,
    norm_ratio,
    positive_interval,
    response_errors,
    t_factor,
    welch_satterthwaite,
)
from undulog.analysis.estimators.spectrum import ResidualBins

RNG = np.random.default_rng(5)


def test_the_factor_is_students():
    for dof in (1, 2.5, 30):
        assert t_factor(dof) == pytest.approx(stats.t.ppf(0.975, dof))
    assert around(2.0, 0.5) == (1.5, 2.5)
    assert EQUIVALENT_GAIN == 0.02
    assert pytest.approx(np.radians(1.0)) == EQUIVALENT_LAG_RAD


def test_alike_is_shown_by_the_worst_of_two_one_sided_tests():
    deviation, error = np.array([0.5, -0.9, 0.1]), np.array([0.2, 0.4, 0.1])
    dof = np.array([5.0, 9.0, 20.0])
    expected = max(
        stats.t.sf((1.5 - abs(d)) / e, k) for d, e, k in zip(deviation, error, dof, strict=True)
    )
    assert equivalence_p(deviation, error, dof, 1.5) == pytest.approx(expected)
    assert equivalence_p(np.array([2.0]), np.array([0.1]), 5.0, 1.5) > 0.99
    none = np.zeros(1)
    assert equivalence_p(none + 1.0, none, 3.0, 1.5) == 0.0
    assert equivalence_p(none + 2.0, none, 3.0, 1.5) == 1.0


def test_holm_steps_down():
    p = np.array([0.01, 0.04, 0.03, 0.005])
    np.testing.assert_allclose(holm(p), [0.03, 0.06, 0.06, 0.02])
    np.testing.assert_array_equal(holm(np.array([0.9, 0.8])), [1.0, 1.0])


def test_a_sum_of_variances_has_welchs_degrees_of_freedom():
    variances, dof = np.array([[1.0, 2.0], [3.0, 0.0]]), np.array([[8.0, 8.0], [16.0, 16.0]])
    np.testing.assert_allclose(welch_satterthwaite(variances, dof), [16 / (1 / 8 + 9 / 16), 8.0])
    assert welch_satterthwaite(0 * variances, dof)[0] == 8.0


# -- norms ----------------------------------------------------------------------------------------


def test_half_widths_one_by_one_and_together():
    error, dof = np.array([[1.0, 2.0, 3.0]] * 3), np.full((3, 3), 7.0)
    matrix = NoisyMatrix(np.zeros((3, 3)), error, dof)
    np.testing.assert_allclose(matrix.half, error * stats.t.ppf(0.975, 7))
    np.testing.assert_allclose(matrix.half_together, error * stats.t.ppf(1 - 0.05 / 12, 7))


def test_independent_noise_is_students():
    error, dof = np.array([[0.5, 2.0]]), np.array([[4.0, 50.0]])
    drawn = np.concatenate([noise_draws(NoisyMatrix(error, error, dof), k) for k in range(10)])
    assert drawn.shape == (4000, 1, 2)
    for k, name in enumerate(("few", "many")):
        test = stats.kstest(drawn[:, 0, k] / error[0, k], stats.t(dof[0, k]).cdf)
        assert test.pvalue > 0.001, name


def test_correlated_noise_has_its_correlation_and_one_level_a_draw():
    correlation = np.array([[1.0, 0.8], [0.8, 1.0]])
    error, dof = np.full((2, 3), 2.0), np.full((2, 3), 4.0)
    matrix = NoisyMatrix(error, error, dof, correlation)
    drawn = np.concatenate([noise_draws(matrix, k) for k in range(20)])
    test = stats.kstest(drawn[:, 0, 1] / 2.0, stats.t(4.0).cdf)
    assert test.pvalue > 0.001
    both = stats.spearmanr(drawn[:, 0, 0], drawn[:, 1, 0]).statistic
    assert both == pytest.approx(0.78, abs=0.03)
    columns = stats.spearmanr(drawn[:, 0, 0], drawn[:, 0, 1]).statistic
    sizes = stats.spearmanr(np.abs(drawn[:, 0, 0]), np.abs(drawn[:, 0, 1])).statistic
    assert abs(columns) < 0.05
    assert sizes > 0.1  # too small together, or too large


def test_a_ratio_of_norms_takes_the_noise_off_and_covers():
    above, below = np.array([[0.6, 0.0], [0.0, 0.8]]), np.array([[2.0, 0.0], [0.0, 0.0]])
    held = values = 0
    for _ in range(300):
        noisy = [matrix + RNG.normal(0.0, 0.1, (2, 2)) for matrix in (above, below)]
        noises = [RNG.normal(0.0, 0.1, (400, 2, 2)) for _ in range(2)]
        ratio = norm_ratio(noisy[0], noises[0], noisy[1], noises[1])
        held += ratio.ci95[0] <= 0.5 <= ratio.ci95[1]
        values += ratio.value
    assert held >= 285
    assert values / 300 == pytest.approx(0.5, abs=0.01)  # 0.51 with the noise in it


def test_a_ratio_by_hand():
    noise = np.full((100, 1), 3.0)
    ratio = norm_ratio(np.array([5.0]), noise, np.array([10.0]), 2 * noise)
    assert ratio.value == pytest.approx(4.0 / 8.0)
    assert ratio.ci95 == pytest.approx((2.0 / 16.0, 8.0 / 4.0))
    low = norm_ratio(np.array([2.0]), noise, np.array([10.0]), 2 * noise)
    assert (low.value, low.ci95[0]) == (0.0, 0.0)
    lost = norm_ratio(np.array([5.0]), noise, np.array([5.0]), 2 * noise)
    assert (lost.value, lost.ci95) == (None, None)
    wide = np.concatenate([np.full((96, 1), 1.0), np.full((4, 1), 9.0)])
    unsure = norm_ratio(np.array([5.0]), noise, np.array([8.0]), wide)
    assert unsure.value == pytest.approx(4.0 / (64.0 - 0.96 - 0.04 * 81) ** 0.5)
    assert unsure.ci95 is None


# -- errors of a response -------------------------------------------------------------------------


def test_errors_of_a_logarithm_are_relative_errors():
    command, response = np.array([2.0, 1j, 0.0]), np.array([1j, 2.0, 1.0])
    bins = RNG.normal(size=(2, 3, 4)) + 1j * RNG.normal(size=(2, 3, 4))
    rounding = np.zeros((3, 2, 2))
    spread = np.array([4.0, 1.0, 1.0])
    parts = [
        ResidualBins(**_bins(values, spread, rounding + np.diag(added)))
        for values, added in zip(bins, ([0.0, 0.0], [0.04, 0.01]), strict=True)
    ]
    errors = response_errors(
        command, parts[0], response, parts[1], omega_variance=0.25, delay_between_s=np.arange(3.0)
    )
    scale = np.sqrt(spread)[:2, None]
    expected = scale * (bins[1][:2] / response[:2, None] - bins[0][:2] / command[:2, None])
    np.testing.assert_allclose(errors.bins[:2], expected)
    assert np.isnan(errors.bins[2]).all()
    # Divided by j, an error of the real part turns the response, one of the imaginary enlarges it.
    np.testing.assert_allclose(errors.rounding[0], np.diag([0.01, 0.04]), atol=1e-15)
    np.testing.assert_allclose(errors.rounding[1], np.diag([0.01, 0.0025]), atol=1e-15)
    np.testing.assert_allclose(errors.steps[0], [0.02, 0.08], atol=1e-15)
    np.testing.assert_allclose(errors.turn, [0.0, 0.5, 1.0])
    some = errors.select([2, 0])
    np.testing.assert_array_equal(some.turn, [1.0, 0.0])
    np.testing.assert_array_equal(some.bins[1], errors.bins[0])
    np.testing.assert_array_equal(some.steps[1], errors.steps[0])
    np.testing.assert_array_equal(some.rounding[1], errors.rounding[0])
    with pytest.raises(dataclasses.FrozenInstanceError):
        some.turn = None
    assert isinstance(some, ResponseErrors)


def _bins(values, spread, rounding):
    """Fields of :class:`ResidualBins`; those that these errors don't need stay empty."""
    given = {"values": values, "spread": spread, "rounding": rounding, "steps": 2 * rounding}
    names = [field.name for field in dataclasses.fields(ResidualBins)]
    return {name: given.get(name, np.zeros(3)) for name in names}


# -- mixtures -------------------------------------------------------------------------------------


@pytest.mark.parametrize("dof", [3, 12])
def test_a_mixture_has_the_quantiles_of_its_parts_together(dof):
    share = np.array([[0.5], [0.3], [0.2]])
    mean, scale = RNG.normal(size=(3, 4)), RNG.uniform(0.1, 2.0, (3, 4))
    centre, half = mixture_interval(share, mean, scale, dof)
    np.testing.assert_allclose(centre, (share * mean).sum(axis=0))
    for k in range(4):

        def below(x, k=k):
            return float(np.sum(share[:, 0] * stats.t.cdf((x - mean[:, k]) / scale[:, k], dof)))

        ends = [optimize.brentq(lambda x, q=q: below(x) - q, -99, 99) for q in (0.025, 0.975)]
        assert half[k] == pytest.approx(max(ends[1] - centre[k], centre[k] - ends[0]), rel=1e-9)


def test_one_part_is_students_t():
    centre, half = mixture_interval(np.ones((1, 1)), np.array([[2.0]]), np.array([[0.5]]), 5)
    assert (centre[0], half[0]) == pytest.approx((2.0, 0.5 * stats.t.ppf(0.975, 5)))


def test_parts_far_apart_still_have_an_interval():
    share, mean = np.array([[0.9], [0.1]]), np.array([[0.0], [1000.0]])
    _, half = mixture_interval(share, mean, np.array([[1.0], [1e-3]]), 4)
    # 2.5 % lie above the far part's 75 % quantile.
    top = 1000.0 + 1e-3 * stats.t.ppf(0.75, 4)
    assert half[0] == pytest.approx(top - 100.0, rel=1e-9)


def test_a_positive_quantity_has_its_weighted_quantiles():
    draws = np.exp(RNG.normal(1.0, 0.5, 20_000))
    quantiles = positive_interval(draws, np.full(draws.size, 1 / draws.size))
    np.testing.assert_allclose(quantiles, np.quantile(draws, [0.5, 0.025, 0.975]), rtol=1e-3)
    three = positive_interval(np.array([4.0, 1.0, 2.0]), np.array([0.25, 0.25, 0.5]))
    assert three == pytest.approx((2.0, 1.0, 4.0))  # running middles: 0.125, 0.5, 0.875


def test_ends_of_a_mixture_are_reached_by_newtons_steps(monkeypatch):
    """Six of them: with a density that is off they would not be there."""
    monkeypatch.setattr("undulog.analysis.estimators.intervals._MOST_STEPS", 6)
    rng = np.random.default_rng(3)
    share, dof = np.array([[0.5], [0.3], [0.2]]), 7
    mean, scale = rng.normal(size=(3, 50)), rng.uniform(0.8, 1.6, (3, 50))
    centre, half = mixture_interval(share, mean, scale, dof)
    for end, quantile in ((centre + half, 0.975), (centre - half, 0.025)):
        below = (share * stats.t.cdf((end - mean) / scale, dof)).sum(axis=0)
        # The wider side of each reaches its quantile, the other lies beyond it.
        assert (np.sign(quantile - 0.5) * (below - quantile) > -1e-12).all()
    low = (share * stats.t.cdf((centre - half - mean) / scale, dof)).sum(axis=0)
    high = (share * stats.t.cdf((centre + half - mean) / scale, dof)).sum(axis=0)
    worst = np.minimum(np.abs(low - 0.025), np.abs(high - 0.975))
    assert worst.max() < 1e-10
