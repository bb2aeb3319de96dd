"""A tilted floor in a reversal: strata of mirror images, the checks without them, headings."""

import dataclasses
import json
import math
from itertools import product

import numpy as np
import pytest
from scipy import stats

from undulog.analysis.experiment import reversal
from undulog.analysis.experiment.mirror import Strata, mirror_test
from undulog.capture.common.errors import UsageError

M = 7
PLACE = np.linspace(0.0, 1.0, M)
BOUNDARY = 0.05 * PLACE**2 - 1j * (0.1 + 0.1 * np.sin(np.pi * PLACE) + 0.03 * PLACE)
FALL = 0.03 * (0.5 + np.sin(np.pi * PLACE)) * (1 - 0.5j)
"""What a floor that falls along the body changes: every joint, the middle one most."""
NAMES = tuple("abcdefg")
TURNED = (np.array([0.0, 0.0, 0.0, np.pi, np.pi, np.pi]),) * 2


def runs(rng, *, tilt=0.0, module=0.0, turned=False, scatter=0.002, count=6):
    """Runs either way, head to tail; of turned ones half of each way lie the other way round.

    The floor pulls the other way where the robot is turned; a reversed wave is the mirror image.
    """
    sign = np.ones(count)
    if turned:
        sign[count // 2 :] = -1
    z = rng.normal(0.0, scatter, (2, 2, count, M))
    forward = BOUNDARY + tilt * sign[:, None] * FALL + module
    reverse = (BOUNDARY - tilt * sign[:, None] * FALL)[:, ::-1] + module
    return forward + z[0, 0] + 1j * z[0, 1], reverse + z[1, 0] + 1j * z[1, 1]


@pytest.mark.parametrize(("plus", "minus"), [((3, 3), (3, 3)), ((2, 4), (3, 2))])
def test_labels_are_permuted_within_strata(plus, minus):
    """One joint, by brute force: every labelling, the score from its definition."""
    rng = np.random.default_rng(2)
    strata = tuple(np.repeat([0, 1], counts) for counts in (plus, minus))
    forward = (rng.normal(1.2, 1.0, (sum(plus), 1)) + strata[0][:, None]).astype(complex)
    reverse = (rng.normal(0.0, 1.0, (sum(minus), 1)) + strata[1][:, None]).astype(complex)
    test = mirror_test(forward, reverse, strata)
    values = np.concatenate([forward, reverse]).real[:, 0]
    stratum = np.concatenate(strata)
    weights = np.array([p * q / (p + q) for p, q in zip(plus, minus, strict=True)])
    weights /= weights.sum()

    def score(labels):
        difference = np.zeros(2)
        squares, counts = np.zeros(2), np.zeros((2, 2))
        for s, way in product((0, 1), (0, 1)):
            cell = values[(stratum == s) & (labels == (way == 0))]
            difference[s] += (1 - 2 * way) * cell.mean()
            squares[way] += ((cell - cell.mean()) ** 2).sum()
            counts[way, s] = len(cell)
        variance = squares / (counts - 1).sum(axis=1) * (weights**2 / counts).sum(axis=1)
        return weights @ difference / math.sqrt(variance.sum())

    observed = np.arange(len(values)) < sum(plus)
    every = [
        labels
        for bits in product((False, True), repeat=len(values))
        if all((labels := np.array(bits))[stratum == s].sum() == plus[s] for s in (0, 1))
    ]
    assert (test.labellings, test.strata) == (len(every), 2)
    assert test.score[0, 0] == pytest.approx(score(observed), rel=1e-9)
    share = np.mean([abs(score(labels)) >= abs(score(observed)) * (1 - 1e-9) for labels in every])
    assert test.p == pytest.approx(share, abs=1e-12)


def test_many_labellings_of_strata_are_drawn_at_random():
    index = np.repeat([0, 1], 6)
    strata = Strata.of(index, index)
    labels = strata.labellings()
    assert (strata.count, labels.shape) == (924**2, (10_000, 24))
    for s in (0, 1):
        assert (labels[:, strata.index == s].sum(axis=1) == 6).all()
    with pytest.raises(UsageError, match="fewer than 2 runs of a way"):
        Strata.of(np.array([0, 0, 1]), np.array([0, 0, 1, 1]))


def test_turned_runs_cancel_a_tilt_that_one_heading_leaves():
    rng = np.random.default_rng(3)
    test = mirror_test(*runs(rng, tilt=1.0, scatter=1e-6))
    np.testing.assert_allclose(test.difference, 2 * FALL, atol=1e-5)
    strata = reversal.heading_strata(*TURNED)
    both = mirror_test(*runs(rng, tilt=1.0, turned=True, scatter=1e-6), strata)
    assert np.abs(both.difference).max() < 1e-5
    # The scatter is that within the strata: a tilt a thousand times as large isn't in it.
    np.testing.assert_allclose(both.error, 1e-6 * (2 / 6) ** 0.5, rtol=0.9)


def test_a_tilt_names_no_module_in_either_plan():
    """Identical modules on a floor whose effect is ten times a run's scatter, 300 experiments."""
    rng = np.random.default_rng(4)
    stated = named = single = 0
    strata = reversal.heading_strata(*TURNED)
    for _ in range(300):
        named += bool(
            reversal.ordered_pairs(NAMES, mirror_test(*runs(rng, tilt=1.0, turned=True), strata))
        )
    assert named / 300 < 0.065
    for _ in range(60):
        both_ways = runs(rng, tilt=1.0)
        test = mirror_test(*both_ways)
        pairs = reversal.ordered_pairs(NAMES, test)
        stated += bool(pairs)
        single += bool(pairs) and reversal.tilt_check(*both_ways, test).excluded
        assert test.p == pytest.approx(2 / 924)
    assert single == 0
    assert stated > 0  # a pair may be stated; never without the tilt


@pytest.mark.parametrize("joint", [0, 1, 2])
@pytest.mark.parametrize("size", [-0.05, 0.05])
def test_a_module_is_ordered_whatever_the_floor(joint, size):
    rng = np.random.default_rng(5)
    module = np.zeros(M, dtype=complex)
    module[joint] = size * (1 + 1j)
    pair = (NAMES[joint], NAMES[-1 - joint])
    expected = pair if size < 0 else pair[::-1]
    balanced = reversal.reversal_of(NAMES, *runs(rng, tilt=3.0, module=module, turned=True), TURNED)
    assert (balanced.pairs[0].name, balanced.pairs[0].mirror) == expected
    assert balanced.tilt.headings == "balanced"
    level = reversal.reversal_of(NAMES, *runs(rng, module=module))
    assert (level.pairs[0].name, level.pairs[0].mirror) == expected
    assert level.tilt.headings == "unknown"
    assert level.tilt.excluded
    assert level.tilt.ratio.ci95[1] < 0.5
    assert level.tilt.middle < 0.5
    # Gravity that leans by more than the motion makes speaks against it; a small lean doesn't.
    forward, reverse = runs(rng, module=module)
    for lean, excluded in ((0.02, False), (0.0005, True)):
        gravity = reversal.floor_lean(np.full(12, lean) + rng.normal(0, 1e-5, 12), np.zeros(12))
        assert (
            reversal.reversal_of(NAMES, forward, reverse, None, gravity).tilt.excluded == excluded
        )


def test_the_ratio_of_common_to_contrast():
    rng = np.random.default_rng(6)
    d = rng.normal(size=M) + 1j * rng.normal(size=M)
    both, odd = d + d[::-1], d - d[::-1]
    truth = np.linalg.norm(both) / np.linalg.norm(odd)
    held = 0
    for _ in range(40):
        z = rng.normal(0.0, 0.2, (2, 2, 6, M))
        forward = d + z[0, 0] + 1j * z[0, 1]
        low, high = reversal.common_ratio(forward, np.zeros((6, M)) + z[1, 0] + 1j * z[1, 1]).ci95
        held += low <= truth <= high
    # 40 at 90 % or more: standard error 5 %.
    assert held >= 33
    alike = np.tile(BOUNDARY, (6, 1))
    assert reversal.common_ratio(alike, alike[:, ::-1]).value is None
    even = np.ones((6, 4), dtype=complex) + rng.normal(0, 0.01, (6, 4))
    tested = mirror_test(even, 1.1 * even[:, ::-1])
    assert reversal.tilt_check(even, 1.1 * even[:, ::-1], tested).middle is None


def test_without_a_contrast_nothing_is_infinite():
    result = reversal.reversal_of(NAMES, *runs(np.random.default_rng(3), scatter=0.02))
    assert (result.middle, result.tilt.middle) == ("d", None)
    assert not result.tilt.excluded
    json.dumps(dataclasses.asdict(result), allow_nan=False)


def test_strata_from_headings():
    forward = np.array([0.0, 0.05, np.pi, -np.pi])
    index = reversal.heading_strata(forward, np.array([np.pi, -3.1, 0.0, 2 * np.pi]))
    assert [part.tolist() for part in index] == [[0, 0, 1, 1], [0, 0, 1, 1]]
    # Turned along with its wave, every run is in one stratum.
    index = reversal.heading_strata(np.zeros(2), np.full(2, np.pi))
    assert [part.tolist() for part in index] == [[0, 0], [0, 0]]
    # One heading alone, an unknown one, or too few of a mirror image leave no strata.
    assert reversal.heading_strata(np.zeros(3), np.zeros(3)) is None
    assert reversal.heading_strata(forward, np.array([np.pi, -3.1, 0.0, np.nan])) is None
    assert reversal.heading_strata(forward, np.array([np.pi, np.pi, np.pi, 0.0])) is None


def test_recorded_gravity_takes_the_sensors_offset_out_where_headings_differ():
    rng = np.random.default_rng(7)
    heading = np.tile([0.0, np.pi], 6)
    held = {"both": 0, "one": 0}
    for _ in range(200):
        lean = 0.01 * np.cos(heading) + 0.03 + rng.normal(0.0, 0.002, 12)
        low, high = reversal.floor_lean(lean, heading).ci95
        held["both"] += low <= 0.01 <= high
        estimate = reversal.floor_lean(lean[::2], np.full(6, np.nan))
        held["one"] += estimate.ci95[0] <= 0.04 <= estimate.ci95[1]
    t = stats.t.ppf(0.975, 5) * lean[::2].std(ddof=1) / 6**0.5
    assert estimate.ci95[1] - estimate.ci95[0] == pytest.approx(2 * t, rel=1e-9)
    assert all(0.91 <= count / 200 <= 0.99 for count in held.values())
    assert reversal.floor_lean(np.array([0.1, np.nan, 0.1]), np.zeros(3)).value is None


def test_pairs_are_ordered_by_their_contrast_not_by_one_direction():
    """A change that both joints of a pair share in one direction hides no pair and makes none."""
    rng = np.random.default_rng(8)
    module = np.zeros(M, dtype=complex)
    module[1] = -0.02
    forward, reverse = runs(rng, module=module)
    forward[:, [1, 5]] += 0.05
    pairs = reversal.ordered_pairs(NAMES, mirror_test(forward, reverse))
    assert [(pair.name, pair.mirror) for pair in pairs] == [("b", "f")]
