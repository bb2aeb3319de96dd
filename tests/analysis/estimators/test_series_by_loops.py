"""Samples in order, gaps, weights and turns against plain loops over random sequences."""

import statistics

import numpy as np
import pytest

from undulog.analysis.estimators.series import (
    STILL,
    Series,
    clean,
    clean_together,
    coverage,
    gaps_after,
    moves,
    sample_weights,
)
from undulog.analysis.estimators.turning import (
    TURN,
    reversals,
    turning_beside_others,
    turns_without_end,
    unwrapped,
)
from undulog.capture.log.read.sample_times import LARGEST, Signal


def test_raw_samples_are_sorted_and_sorted_out_as_in_a_loop():
    rng = np.random.default_rng(3)
    for number in range(150):
        count = int(rng.integers(0, 7))
        t_ns = rng.integers(0, 2 + number % 12, count) + 500
        if number % 3 == 0:
            t_ns = np.sort(t_ns)
        values = rng.choice([1.0, 2.0, np.nan, np.inf, -LARGEST, 1.01 * LARGEST], count)
        finite = [k for k in range(count) if abs(values[k]) <= LARGEST]
        ordered = sorted(finite, key=lambda k: t_ns[k])
        firsts = [k for i, k in enumerate(ordered) if i == 0 or t_ns[ordered[i - 1]] != t_ns[k]]
        cleaned = clean("q", t_ns, values, 480)
        np.testing.assert_array_equal(cleaned.values, values[firsts])
        np.testing.assert_allclose(
            cleaned.t_s, [(t_ns[k] - 480) * 1e-9 for k in firsts], rtol=1e-15
        )
        assert cleaned.dropped_nan == count - len(finite)
        assert cleaned.dropped_duplicates == len(finite) - len(firsts)
        assert not cleaned.values.flags.writeable


def test_a_series_without_samples_has_no_period_and_lost_nothing():
    none = Series("q", np.zeros(0), np.zeros(0))
    assert np.isnan(none.period_s)
    assert (none.count, none.dropped_nan, none.dropped_duplicates) == (0, 0, 0)
    assert none.gaps.tolist() == []


def test_signals_with_the_largest_numbers_share_their_times_too():
    t_ns = np.array([0, 10, 20])
    rows = {
        "whole": np.zeros(3),
        "large": np.array([LARGEST, -LARGEST, 0.0]),
        "beyond": np.array([0.0, 1.01 * LARGEST, 0.0]),
    }
    cleaned = clean_together({k: Signal(k, "N", t_ns, row) for k, row in rows.items()}, 0)
    assert cleaned["large"].t_s is cleaned["whole"].t_s
    assert not cleaned["large"].values.flags.writeable
    assert cleaned["beyond"].dropped_nan == 1
    # The first one lost a sample: its times are its own, those of the next are shared.
    first_lost = {"beyond": rows["beyond"], "whole": rows["whole"], "large": rows["large"]}
    cleaned = clean_together({k: Signal(k, "N", t_ns, row) for k, row in first_lost.items()}, 0)
    assert [series.count for series in cleaned.values()] == [2, 3, 3]
    assert cleaned["large"].t_s is cleaned["whole"].t_s


def test_a_channel_moves_by_more_than_rounding():
    assert not moves(np.zeros(0))
    assert not moves(np.array([3.0]))
    for size, still in ((0.5, 1e-9), (1.0, 1e-9), (4.0, 4e-9)):
        for sign in (1, -1):
            assert moves(sign * np.array([size, size - 1.01 * still]))
            assert not moves(sign * np.array([size, size - 0.99 * still]))
    assert not moves(np.array([0.0, STILL]))


def random_steps():
    rng = np.random.default_rng(5)
    for _ in range(150):
        yield rng.choice([1.0, 2.0, 3.0, 4.0, 6.0, 9.0, 13.0], rng.integers(1, 9))


def test_gaps_are_those_of_a_plain_median():
    for step in random_steps():
        expected = [k for k, interval in enumerate(step) if interval > 3 * statistics.median(step)]
        assert gaps_after(step).tolist() == expected


def test_weights_are_those_of_a_loop():
    rng = np.random.default_rng(6)
    for step in random_steps():
        t = 5.0 + np.r_[0.0, np.cumsum(step)]
        before, after = rng.choice([0.0, 0.5, 2.0, 11.0], 2)
        start, stop = t[0] - before, t[-1] + after
        half = [(before + after) / 2, *(step / 2), (before + after) / 2]
        usual = statistics.median(step) / 2
        half = [usual if width > 3 * usual else width for width in half]
        expected = [half[k] + half[k + 1] for k in range(t.size)]
        np.testing.assert_allclose(sample_weights(t, start, stop), expected)
        share = min(1.0, sum(expected) / (stop - start))
        assert coverage(t, start, stop) == pytest.approx(share)


# -- turns ----------------------------------------------------------------------------------------


def most_swings(levels):
    """The longest way to and fro by two levels or more; the first leg leads from 0."""
    first = 1 if levels[0] > 0 else -1
    best = {}
    for i, level in enumerate(levels):
        # The ends of leg m, which goes up or down, at this level.
        best[i] = 1 if (level - 0) * first > 0 else 0
        for j in range(i):
            way = first if best[j] % 2 == 0 else -first
            if best[j] and (level - levels[j]) * way >= 2:
                best[i] = max(best[i], best[j] + 1)
    return max(0, max(best.values()) - 1)


def test_changes_of_direction_are_the_longest_way_to_and_fro():
    rng = np.random.default_rng(7)
    for _ in range(300):
        steps = rng.choice([-2, -1, 1, 2], rng.integers(1, 11))
        levels = np.cumsum(steps).tolist()
        assert reversals(levels) == most_swings(levels), levels


def zigzag(legs):
    """Angle over so many legs of one and a half turns, the first of three."""
    corners = np.cumsum([0.0, 3.0, *(1.5 * (-1) ** (k + 1) for k in range(legs - 1))])
    return TURN * np.interp(np.arange(60 * legs + 1) / 60, np.arange(legs + 1), corners) + 0.01


def test_a_screw_turns_back_five_times_at_most():
    assert [turns_without_end(zigzag(legs)) for legs in range(1, 10)] == [True] * 6 + [False] * 3


def test_a_joint_with_stops_has_two_turns():
    line = np.linspace(0.0, 1.0, 200)
    assert not turns_without_end(2 * TURN * line - TURN)
    assert turns_without_end(2.001 * TURN * line - TURN)
    assert turns_without_end(np.array([0.0, 2.5 * TURN]))
    assert not turns_without_end(np.array([0.0, 1.5 * TURN]))


def test_a_wrap_is_a_step_of_more_than_three_quarters_of_a_turn():
    for share, there in ((0.749, False), (0.751, True), (1.0, True), (1.01, False)):
        for sign in (1, -1):
            angle = sign * TURN * np.array([0.0, share, share / 2, 0.0, share])
            expected = sign * TURN * np.array([0.0, share - 1, share / 2 - 1, -1.0, share - 2])
            # From half the range to zero it is a step of less.
            np.testing.assert_allclose(unwrapped(angle), expected if there else angle, atol=1e-12)
    assert unwrapped(np.zeros(1)).tolist() == [0.0]


def test_turning_joints_are_named_in_the_order_of_the_commands():
    t = np.arange(150) / 20
    commands = {"b": 9 * t, "yaw": 0.3 * np.sin(3 * t), "a": -7 * t, "still": np.zeros(400)}
    assert turning_beside_others(commands) == ("b", "a")
    assert turning_beside_others({"yaw": commands["yaw"]}) == ()
    assert turning_beside_others({}) == ()
