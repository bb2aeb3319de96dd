"""The reversal test on arrays: foreign tests of one joint, invariances, level, power, shares."""

import heterogeneity_tables
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import PermutationMethod, nct, ttest_ind
from scipy.stats import t as t_distribution

from undulog.analysis.experiment.mirror import Strata, mirror_test
from undulog.analysis.experiment.reversal import ordered_pairs, reversal_of, variance_shares
from undulog.capture.common.errors import UsageError


def scattered(rng, profile, runs, scatter):
    noise = rng.normal(0.0, scatter, (2, runs, profile.size))
    return profile + noise[0] + 1j * noise[1]


def both_ways(rng, boundary, module, *, runs=(6, 6), scatter=0.01):
    """Runs of modules of their own on top of what identical ones do."""
    return (
        scattered(rng, boundary + module, runs[0], scatter),
        scattered(rng, boundary[::-1] + module, runs[1], scatter),
    )


def pattern(joints):
    return np.log(heterogeneity_tables.boundary_pattern(joints))


def permuted_welch(forward, reverse):
    """Welch's test of one joint by all labellings, as SciPy has it."""
    every = PermutationMethod(n_resamples=np.inf)
    return ttest_ind(forward.real, reverse.real, equal_var=False, method=every)


@pytest.mark.parametrize("runs", [(6, 6), (4, 5), (3, 7)])
def test_one_joint_is_a_permuted_welch_test(runs):
    rng = np.random.default_rng(3)
    for shift in (0.0, 0.7, 1.5):
        forward = (rng.normal(shift, 1.0, (runs[0], 1))).astype(complex)
        reverse = (rng.normal(0.0, 1.0, (runs[1], 1))).astype(complex)
        test = mirror_test(forward, reverse)
        foreign = permuted_welch(forward, reverse)
        assert test.score[0, 0] == pytest.approx(foreign.statistic[0], rel=1e-9)
        assert test.dof[0, 0] == pytest.approx(foreign.df[0], rel=1e-9)
        if runs[0] == runs[1]:
            assert test.p == pytest.approx(foreign.pvalue[0], abs=1e-12)
            continue
        # Of unequal numbers SciPy doubles the smaller tail, which isn't the share of larger |t|.
        both = np.concatenate([forward.real[:, 0], reverse.real[:, 0]])
        every = every_labelling(*runs)
        t = [ttest_ind(both[mask], both[~mask], equal_var=False).statistic for mask in every]
        share = np.mean(np.abs(t) >= np.abs(foreign.statistic[0]) * (1 - 1e-9))
        assert test.p == pytest.approx(share, abs=1e-12)


def every_labelling(r1, r2):
    for number in range(1 << (r1 + r2)):
        labels = np.array([bool(number >> k & 1) for k in range(r1 + r2)])
        if labels.sum() == r1:
            yield labels


def labellings(plus, minus, strata=1):
    """Of as many runs of either way in each stratum."""
    index = np.arange(strata)
    return Strata.of(np.repeat(index, plus), np.repeat(index, minus)).labellings()


def test_labellings_are_all_there_are():
    assert labellings(4, 5).shape == (126, 9)
    assert labellings(6, 6).shape == (462, 12)  # the other 462 only turn the signs
    for labels in (labellings(4, 5), labellings(6, 6)):
        assert len(np.unique(labels, axis=0)) == len(labels)
        assert not (labels[:, None] == ~labels[None]).all(axis=-1).any()
        assert labels[0, : labels[0].sum()].all()
    many = labellings(10, 10)
    assert many.shape == (10_000, 20)
    assert (many.sum(axis=1) == 10).all()
    assert many[0, :10].all()
    # Each run is '+' in half of the random labellings: 4 standard errors.
    assert np.abs(many[1:].mean(axis=0) - 0.5).max() < 0.02


def test_a_random_subset_agrees_with_all_labellings():
    rng = np.random.default_rng(5)
    forward = rng.normal(0.6, 1.0, (9, 1)).astype(complex)
    reverse = rng.normal(0.0, 1.0, (9, 1)).astype(complex)
    test = mirror_test(forward, reverse)
    assert (test.labellings, test.tried) == (48_620, 10_000)
    p = permuted_welch(forward, reverse).pvalue[0]
    assert test.p == pytest.approx(p, abs=4 * (p * (1 - p) / 10_000) ** 0.5)


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(2, 9))
def test_what_the_test_does_not_depend_on(seed, joints):
    rng = np.random.default_rng(seed)
    forward, reverse = both_ways(rng, pattern(joints), 0.02 * rng.normal(size=joints))
    test = mirror_test(forward, reverse)
    # The order of the runs; which way is called forward; any boundary pattern; the scale.
    shuffled = mirror_test(rng.permutation(forward), rng.permutation(reverse))
    turned = mirror_test(reverse, forward)
    free = rng.normal(size=joints) + 1j * rng.normal(size=joints)
    moved = mirror_test(3 * forward + free, 3 * reverse + free[::-1])
    # Head and tail.
    flipped = mirror_test(forward[:, ::-1], reverse[:, ::-1])
    for other in (shuffled, turned, moved, flipped):
        assert other.p == pytest.approx(test.p, abs=1e-12)
        assert other.statistic == pytest.approx(test.statistic, rel=1e-6)
    np.testing.assert_allclose(turned.difference, -test.difference[::-1], atol=1e-12)
    np.testing.assert_allclose(flipped.difference, test.difference[::-1], atol=1e-12)


def test_it_is_blind_to_mirror_symmetric_modules_and_to_the_middle_one():
    rng = np.random.default_rng(7)
    module = np.array([0.0, 0.3, 0.0, 0.5, 0.0, 0.3, 0.0])
    forward, reverse = both_ways(rng, pattern(7), module, scatter=1e-6)
    assert np.abs(mirror_test(forward, reverse).difference).max() < 1e-5


@pytest.mark.nightly
@pytest.mark.parametrize("noise", [{}, {"ar": 0.9}], ids=["white", "AR"])
def test_identical_modules_are_called_different_in_one_experiment_of_twenty(noise):
    """5,000 experiments, a boundary pattern, noise on the encoders' samples: 5 % +- 1."""
    assert heterogeneity_tables.false_positives(5, **noise) == pytest.approx(0.05, abs=0.01)


@pytest.mark.nightly
@pytest.mark.parametrize("size", [1.0, 3.0, 5.0, 9.0])
def test_a_weak_module_is_found_and_named(size):
    """One module of 13 with more lag; ``size`` in standard errors of d: sqrt(2/6) of a run's.

    The contrast with its mirror must pass the Bonferroni limit of 26 Student's t: the noncentral t
    says how often. The permutations find a little more.
    """
    rng = np.random.default_rng(11)
    scatter, sets = 0.005, 200
    names = [f"joint{i + 1:02d}" for i in range(13)]
    module = np.zeros(13, dtype=complex)
    module[9] = -1j * size * scatter * (2 / 6) ** 0.5
    detected = right = 0
    for _ in range(sets):
        test = mirror_test(*both_ways(rng, pattern(13), module, scatter=scatter))
        pairs = ordered_pairs(names, test)
        detected += test.p < 0.05
        first = [(pair.name, pair.mirror, pair.by) for pair in pairs[:1]]
        right += first == [("joint10", "joint04", "lag")]
    missed = nct.cdf(t_distribution.isf(0.05 / 26 / 2, 10), 10, 2**0.5 * size)
    assert detected / sets == pytest.approx(1 - missed, abs=0.09)  # standard error up to 3.5 %
    if size >= 3:
        assert right / detected > 0.95
    if size >= 9:
        assert right == detected == sets


def test_a_strong_module_orders_its_pair():
    """The sign names the joint that answers less; the stronger one is its mirror."""
    rng = np.random.default_rng(2)
    module = np.array([0.1, 0, 0, 0, 0])
    pairs = ordered_pairs("abcde", mirror_test(*both_ways(rng, pattern(5), module, scatter=0.003)))
    assert [(pair.name, pair.mirror, pair.by) for pair in pairs] == [("e", "a", "gain")]
    low, high = pairs[0].log_gain_contrast.ci95
    assert low < -0.1 < high


def test_ground_that_differs_fore_and_aft_names_no_module():
    """Both joints of a pair respond otherwise when the wave is turned: no module does that."""
    rng = np.random.default_rng(4)
    y = pattern(7)
    forward, reverse = scattered(rng, y, 6, 0.002), scattered(rng, y[::-1] - 0.05j, 6, 0.002)
    result = reversal_of("abcdefg", forward, reverse)
    assert (result.p, result.pairs) == (pytest.approx(2 / 924), ())


@pytest.mark.parametrize(("runs", "floor"), [((3, 3), 0.1), ((4, 4), 2 / 70), ((4, 5), 1 / 126)])
def test_few_runs_leave_a_floor_under_p(runs, floor):
    rng = np.random.default_rng(1)
    module = np.array([1.0, 0, 0, 0, 0, 0])
    test = mirror_test(*both_ways(rng, pattern(6), module, runs=runs, scatter=1e-3))
    assert (test.floor, test.p) == (pytest.approx(floor), pytest.approx(floor))


def test_intervals_hold_together():
    rng = np.random.default_rng(6)
    module = 0.02 * rng.normal(size=9) - 0.03j * rng.normal(size=9)
    truth = module - module[::-1]
    held = 0
    for _ in range(300):
        test = mirror_test(*both_ways(rng, pattern(9), module))
        miss = test.difference - truth
        held += (np.abs([miss.real, miss.imag]) <= test.critical * test.error).all()
    # 300 at 95 %: standard error 1.3 %.
    assert 0.91 < held / 300 < 0.99


def test_runs_that_agree_to_the_bit_give_finite_numbers():
    same = np.tile(pattern(5), (6, 1))
    assert mirror_test(same, same[:, ::-1]).p == 1.0
    other = mirror_test(same, same[:, ::-1] + 0.1)
    assert other.p == pytest.approx(2 / 924)
    assert np.isfinite(other.score).all()


def test_what_can_not_be_tested_is_refused():
    runs = np.zeros((6, 5), dtype=complex)
    with pytest.raises(UsageError, match="6 runs one way and 1 the other"):
        mirror_test(runs, runs[:1])
    with pytest.raises(UsageError, match="5 joints one way and 4 the other"):
        mirror_test(runs, runs[:, 1:])


def test_shares_in_closed_form():
    rng = np.random.default_rng(8)
    boundary, module = pattern(9), 0.05 * rng.normal(size=9) + 0.05j * rng.normal(size=9)
    shares = variance_shares(*both_ways(rng, boundary, module, scatter=1e-7))
    module_part = np.mean(np.abs(module - module[::-1])[np.arange(9) != 4] ** 2) / 2
    ways = [np.var(pattern + module, ddof=1) for pattern in (boundary, boundary[::-1])]
    assert shares.module_variance.value == pytest.approx(module_part, rel=1e-5)
    assert shares.boundary_variance.value == pytest.approx(np.mean(ways) - module_part, rel=1e-5)
    assert shares.module_share.value == pytest.approx(module_part / np.mean(ways), rel=1e-5)
    assert shares.boundary_share.value == pytest.approx(1 - module_part / np.mean(ways), rel=1e-5)


def test_noise_is_nobodys_share():
    """Identical modules without any pattern: on average no variance is left, for either."""
    rng = np.random.default_rng(9)
    nothing = (np.zeros(13), np.zeros(13))
    shares = [variance_shares(*both_ways(rng, *nothing, scatter=0.02)) for _ in range(60)]
    noise = np.mean([share.noise_variance for share in shares])
    assert noise == pytest.approx(2 * 0.02**2 / 6, rel=0.1)  # gain and lag
    assert np.mean([share.module_variance.value for share in shares]) < 0.3 * noise
    assert np.mean([share.boundary_variance.value for share in shares]) < 0.3 * noise
    assert all(share.module_variance.ci95[0] == 0 for share in shares[:20])


def test_the_interval_of_the_share_covers():
    rng = np.random.default_rng(10)
    boundary = pattern(13)
    module = 0.02 * rng.normal(size=13) + 0.02j * rng.normal(size=13)
    truth = variance_shares(*both_ways(rng, boundary, module, scatter=1e-9)).module_share.value
    held = 0
    for _ in range(100):
        shares = variance_shares(*both_ways(rng, boundary, module, scatter=0.01))
        low, high = shares.module_share.ci95
        held += low <= truth <= high
    # 100 at 95 %: standard error 2.2 %; of six runs each way a bootstrap reaches a little less.
    assert held / 100 > 0.88
