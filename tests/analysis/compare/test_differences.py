"""Intervals and decisions on arrays: coverage and family-wise error over hundreds of seeds."""

import numpy as np
import pytest
from scipy import stats

from undulog.analysis.compare.decisions import Margins, decide
from undulog.analysis.compare.quantities import Quantities, from_runs, independent, paired
from undulog.analysis.estimators.intervals import holm
from undulog.capture.common.errors import UsageError

SEEDS = 600
JOINTS = 13


def single(rng, truth, sigma, dof):
    """What a session gives: estimates, and variances that are estimates, too."""
    variance = sigma**2 * rng.chisquare(dof, truth.size) / dof
    return Quantities(rng.normal(truth, sigma), variance, np.full(truth.size, float(dof)))


def keys_of(count):
    return [(quantity, f"joint{i}") for quantity in ("gain", "lag") for i in range(count)]


def simultaneous(difference, truth):
    return bool(np.all(np.abs(difference.value - truth) <= difference.half))


def within(share, expected, trials=SEEDS):
    """Whether a share is the expected one, to three standard errors."""
    return abs(share - expected) < 3 * np.sqrt(expected * (1 - expected) / trials)


def test_welch_and_paired_agree_with_scipy():
    rng = np.random.default_rng(0)
    a, b = rng.normal(0, 1, (5, 4)), rng.normal(0.5, 2, (7, 4))
    difference = independent(from_runs(a), from_runs(b))
    np.testing.assert_allclose(difference.p, stats.ttest_ind(b, a, equal_var=False).pvalue)
    np.testing.assert_allclose(paired(a, b[:5]).p, stats.ttest_rel(b[:5], a).pvalue)


def test_holm_by_hand():
    np.testing.assert_allclose(holm(np.array([0.01, 0.04, 0.03, 0.005])), [0.03, 0.06, 0.06, 0.02])
    assert holm(np.array([0.9, 0.8])).max() == 1.0


def test_two_sessions_intervals_hold_together_and_false_names_are_rare():
    """Unequal noise and few degrees of freedom; no difference, then a difference everywhere."""
    rng = np.random.default_rng(1)
    truth = rng.uniform(-0.3, 0.3, 2 * JOINTS)
    step = rng.normal(0, 0.05, truth.size)
    sigma_a = rng.uniform(1e-3, 4e-3, truth.size)
    sigma_b = rng.uniform(1e-3, 4e-3, truth.size)
    together, alone, false = [], [], []
    for _ in range(SEEDS):
        a = single(rng, truth, sigma_a, 16)
        difference = independent(a, single(rng, truth + step, sigma_b, 24))
        together.append(simultaneous(difference, step))
        half = stats.t.ppf(0.975, difference.dof) * difference.error
        alone.append(np.mean(np.abs(difference.value - step) <= half))
        false.append(bool(np.any(holm(independent(a, single(rng, truth, sigma_b, 24)).p) < 0.05)))
    assert within(np.mean(alone), 0.95, SEEDS * truth.size / 4)
    assert np.mean(together) > 0.95 - 3 * np.sqrt(0.05 * 0.95 / SEEDS)
    assert np.mean(false) < 0.05 + 3 * np.sqrt(0.05 * 0.95 / SEEDS)
    assert np.mean(false) > 0.02  # it is a test of the level, not one that never finds anything


@pytest.mark.parametrize(("runs", "is_paired"), [((6, 6), False), ((4, 8), False), ((6, 6), True)])
def test_groups_hold_the_level_whatever_runs_share(runs, is_paired):
    """Joints of a run move together, and with pairs so do both runs of a pair."""
    rng = np.random.default_rng(2)
    k, false, covered = 2 * JOINTS, [], []
    mixing = np.eye(k) + 0.5 * rng.normal(size=(k, k)) / np.sqrt(k)
    for _ in range(SEEDS):
        a, b = (
            rng.normal(size=(r, k)) @ mixing * size for r, size in zip(runs, (1, 2), strict=True)
        )
        if is_paired:
            shared = 10 * rng.normal(size=(runs[0], k))
            a, b = a + shared, b + shared
        difference, null = (
            paired(a, other) if is_paired else independent(from_runs(a), from_runs(other))
            for other in (b + 0.7, b)
        )
        covered.append(simultaneous(difference, 0.7))
        false.append(bool(np.any(holm(null.p) < 0.05)))
    assert np.mean(false) < 0.05 + 3 * np.sqrt(0.05 * 0.95 / SEEDS)
    assert np.mean(covered) > 0.95 - 3 * np.sqrt(0.05 * 0.95 / SEEDS)


def test_equivalence_is_claimed_wrongly_in_one_of_twenty_at_the_margin():
    """One joint exactly at the margin, the others equal: TOST's level is that of this joint."""
    rng = np.random.default_rng(3)
    margin, sigma = 0.02, 0.004
    claimed = {0.0: [], margin: []}
    for shift, notes in claimed.items():
        truth = np.zeros(2 * JOINTS)
        truth[3] = shift
        for _ in range(SEEDS):
            a = single(rng, np.zeros(truth.size), sigma / 2, 20)
            b = single(rng, truth, sigma / 2, 20)
            decided = decide(keys_of(JOINTS), a, b, independent(a, b), Margins(lag_rad=1.0))
            notes.append(decided.equivalence[0].p < 0.05)
    assert np.mean(claimed[0.0]) > 0.95
    assert within(np.mean(claimed[margin]), 0.05)


def test_what_differs_is_ranked_by_size_in_margins_and_named():
    names = keys_of(4)
    a = Quantities(np.zeros(8), np.full(8, 1e-8), np.full(8, 30.0))
    b = Quantities(np.array([0, 0, -0.06, 0.001, 0, 0, -0.1, 0]), a.variance, a.dof)
    decided = decide(names, a, b, independent(a, b), Margins())
    largest = [(difference.quantity, difference.place) for difference in decided.differences[:3]]
    assert largest == [("lag", "joint2"), ("gain", "joint2"), ("gain", "joint3")]
    assert [joint.name for joint in decided.named] == ["joint2", "joint3"]
    gain = decided.differences[1]
    assert (gain.difference.value, gain.a) == (pytest.approx(np.exp(-0.06) - 1), 1.0)
    assert (gain.b, gain.size) == (pytest.approx(np.exp(-0.06)), pytest.approx(3.0))


def test_runs_that_agree_to_the_last_digits_do_not_differ():
    a = np.full((3, 2), 0.1)
    b = a + 1e-16 * np.array([[1.0], [2.0], [0.0]])
    assert independent(from_runs(a), from_runs(b)).p.min() > 0.5
    assert paired(a, b).p.min() > 0.5


def test_one_run_is_no_group():
    with pytest.raises(UsageError, match="2 runs a side at least"):
        from_runs(np.zeros((1, 3)))
    with pytest.raises(UsageError, match="3 and 2 runs don't make pairs"):
        paired(np.zeros((3, 1)), np.zeros((2, 1)))
