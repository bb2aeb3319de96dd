"""Joint samples: tables of common times, resampling against closed forms, and rounding."""

import itertools
import statistics

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from undulog.replay.samples import tracks

T = np.arange(5, dtype=np.int64) * 10


def track(name, t_ns=T, values=None):
    return tracks.Track(name, t_ns, np.arange(len(t_ns), dtype=float) if values is None else values)


def test_joints_with_the_same_times_share_one_table():
    (table,) = tracks.tables([track("a"), track("b", T.copy(), 2.0 * np.arange(5))])
    assert table.names == ("a", "b")
    np.testing.assert_array_equal(table.values, np.stack([np.arange(5), 2 * np.arange(5)], axis=1))


def test_joints_with_times_of_their_own_keep_them():
    tables = tracks.tables([track("a"), track("b", T + 3), track("c")])
    assert [table.names for table in tables] == [("a", "c"), ("b",)]
    np.testing.assert_array_equal(tables[1].t_ns, T + 3)


def test_nan_that_fills_up_foreign_messages_is_left_out():
    kept = tracks.without_filler(track("a", T, np.array([0.0, np.nan, np.nan, np.nan, 4.0])))
    np.testing.assert_array_equal(kept.t_ns, [0, 40])
    np.testing.assert_array_equal(kept.values, [0.0, 4.0])


def test_half_of_the_samples_or_more_are_fillers():
    half = track("a", T[:4], np.array([0.0, np.nan, 2.0, np.nan]))
    np.testing.assert_array_equal(tracks.without_filler(half).t_ns, [0, 20])


def test_quantities_of_a_joint_are_paired_in_the_order_of_the_first():
    first, second = [track("c"), track("a"), track("x")], [track("a", T + 1), track("c", T + 2)]
    assert tracks.pairs(first, second) == [(first[0], second[1]), (first[1], second[0])]


def test_pieces_are_joined_one_after_another():
    whole = tracks.one_after_another([track("a", T[:2]), track("a", T[2:], np.ones(3))])
    assert (whole.name, whole.t_ns.tolist()) == ("a", T.tolist())
    np.testing.assert_array_equal(whole.values, [0, 1, 1, 1, 1])


def test_a_lost_sample_stays_a_hole():
    lossy = track("a", T, np.array([0.0, 1.0, np.nan, 3.0, 4.0]))
    assert tracks.without_filler(lossy) is lossy


def test_resampling_puts_columns_in_order_and_leaves_unknown_joints_nan():
    b = track("b", T + 5)
    resampled = tracks.resampled([b, track("a")], ("a", "x", "b"), T[1:3], tracks.interpolate)
    np.testing.assert_allclose(resampled[:, [0, 2]], [[1.0, 0.5], [2.0, 1.5]])
    assert np.isnan(resampled[:, 1]).all()
    held = tracks.resampled([b], ("b",), T[1:3], tracks.hold)
    np.testing.assert_array_equal(held, [[0.0], [1.0]])


def test_joints_in_turn_have_one_sample_between_two_of_the_first():
    t = 10 * np.arange(5, dtype=np.int64)
    assert tracks.in_turn(t, t + 3)
    assert tracks.in_turn(t, t - 3)
    assert tracks.in_turn(t[[0, 1, 3, 4]], t[[0, 1, 3, 4]] + 3)  # a pause of both
    assert not tracks.in_turn(t, t[::2] + 3)
    assert not tracks.in_turn(t, np.sort(np.concatenate([t + 3, t + 6])))
    assert not tracks.in_turn(t, t[:0])


increasing = st.lists(st.integers(1, 6), min_size=1, max_size=8).map(np.cumsum)


@given(increasing, increasing, st.integers(-8, 8))
def test_turns_are_one_between_any_two_of_the_first_but_at_an_end(first, other, shift):
    other = other + shift
    counts = [np.sum((other >= a) & (other < b)) for a, b in itertools.pairwise(first)]
    taken = np.flatnonzero(counts)
    expected = (
        len(taken) >= max(len(first) - 2, 1)
        and np.ptp(taken) == len(taken) - 1
        and max(counts) == 1
    )
    assert tracks.in_turn(first.astype(np.int64), other.astype(np.int64)) == expected


def test_joints_in_turn_are_brought_to_the_first_ones_times():
    table = tracks.join_tracks([track("a"), track("b", T - 4, 0.1 * (T - 4))])
    assert table.names == ("a", "b")
    np.testing.assert_array_equal(table.t_ns, T)
    np.testing.assert_allclose(table.values[:-1, 1], 0.1 * T[:-1], atol=1e-12)
    assert np.isnan(table.values[-1, 1])  # nothing comes after it


MS, NAN = 1_000_000, np.nan


def ticks(*milliseconds):
    return np.array(milliseconds, dtype=np.int64) * MS


def test_a_rate_keeps_at_most_that_many_samples_a_second():
    t = np.arange(1000, dtype=np.int64) * 10 * MS
    np.testing.assert_array_equal(tracks.decimate(t, 50.0), np.arange(0, 1000, 2))
    jittered = t + np.random.default_rng(1).integers(-2 * MS, 2 * MS, 1000)
    assert np.array_equal(tracks.decimate(jittered, 50.0) % 2, np.zeros(500))
    assert len(tracks.decimate(10 * t[:20], 50.0)) == 20
    from_origin = tracks.decimate(t[:20] + 15 * MS, 50.0, origin_ns=0)  # slots from -5 ms on
    np.testing.assert_array_equal(from_origin, np.arange(0, 20, 2))
    np.testing.assert_array_equal(tracks.decimate(t[1:8], 50.0, origin_ns=0), [0, 1, 3, 5])
    assert tracks.decimate(ticks(), 50.0).size == 0


@given(
    st.lists(st.integers(1, 40), min_size=2, max_size=30),
    st.floats(-5, 5),
    st.floats(-5, 5),
    st.lists(st.integers(0, 1200), min_size=1, max_size=20),
)
def test_a_straight_line_is_interpolated_exactly_or_not_at_all(steps, slope, offset, at_ms):
    t = np.cumsum(np.array(steps, dtype=np.int64)) * MS
    at = np.array(at_ms, dtype=np.int64) * MS
    interpolated = tracks.interpolate(t, slope * t / MS + offset, at)
    finite = np.isfinite(interpolated)
    np.testing.assert_allclose(interpolated[finite], (slope * at / MS + offset)[finite], atol=1e-9)
    assert not finite[(at < t[0]) | (at > t[-1])].any()
    assert finite[np.isin(at, t)].all()


def test_nothing_is_drawn_across_a_gap():
    t = ticks(0, 10, 20, 30, 200, 210)
    assert tracks.gaps(t).tolist() == [False, False, False, True, False]
    interpolated = tracks.interpolate(t, np.arange(6.0), ticks(25, 30, 35, 100, 200, 205))
    np.testing.assert_array_equal(interpolated, [2.5, 3.0, np.nan, np.nan, 4.0, 4.5])


@pytest.mark.parametrize(
    ("t", "values", "at", "expected"),
    [
        ((0, 10, 20, 30), [0, NAN, 2, 3], (0, 5, 10, 15, 20, 25), [0, NAN, NAN, NAN, 2, 2.5]),
        ((0, 10), [[0.0, 10.0], [1.0, 20.0]], (5,), [[0.5, 15.0]]),
    ],
)
def test_a_missing_sample_spoils_its_neighbourhood_only(t, values, at, expected):
    interpolated = tracks.interpolate(ticks(*t), np.array(values), ticks(*at))
    np.testing.assert_array_equal(interpolated, expected)


def test_a_command_is_held_until_the_next():
    at = ticks(-1, 0, 9, 10, 19, 69, 71)
    held = tracks.hold(ticks(0, 10, 20), np.array([1.0, 2.0, 3.0]), at)
    np.testing.assert_array_equal(held, [np.nan, 1.0, 1.0, 2.0, 2.0, 3.0, np.nan])
    table = tracks.hold(ticks(0, 10), np.array([[1.0, 2.0], [3.0, 4.0]]), ticks(-5, 5, 60, 61))
    np.testing.assert_array_equal(table, [[NAN, NAN], [1.0, 2.0], [3.0, 4.0], [NAN, NAN]])
    alone = tracks.hold(ticks(5), np.array([1.0]), ticks(4, 5, 6))  # nobody knows for how long
    np.testing.assert_array_equal(alone, [NAN, 1.0, NAN])


def test_without_samples_nothing_is_known():
    assert np.isnan(tracks.interpolate(ticks(), np.zeros(0), ticks(1))).all()
    assert np.isnan(tracks.hold(ticks(), np.zeros(0), ticks(1))).all()
    assert tracks.typical_step_ns(ticks(5)) == 0


def test_a_gap_gets_one_row_of_nan_a_step_after_its_last_sample():
    t, values = tracks.mark_gaps(ticks(0, 10, 20, 100, 110), np.arange(5.0)[:, None])
    np.testing.assert_array_equal(t, ticks(0, 10, 20, 30, 100, 110))
    np.testing.assert_array_equal(values[:, 0], [0, 1, 2, np.nan, 3, 4])


def test_silence_before_the_end_is_a_gap():
    t, values = ticks(0, 10, 20), np.zeros((3, 2))
    marked = tracks.mark_gaps(t, values, end_ns=100 * MS)
    np.testing.assert_array_equal(marked[0], ticks(0, 10, 20, 30))
    assert np.isnan(marked[1][-1]).all()
    same = tracks.mark_gaps(t, values, end_ns=70 * MS)  # five steps are none yet
    assert same[0] is t
    both = tracks.mark_gaps(ticks(0, 10, 20, 100), np.zeros((4, 1)), end_ns=200 * MS)
    np.testing.assert_array_equal(both[0], ticks(0, 10, 20, 30, 100, 110))
    whole = tracks.mark_gaps(t, values, end_ns=40 * MS)
    assert all(part is given for part, given in zip(whole, (t, values), strict=True))


@given(st.lists(st.integers(0, 9), max_size=8))
def test_any_order_becomes_that_of_a_stable_sort(times):
    t, values = np.array(times, dtype=np.int64), np.arange(float(len(times)))
    ordered = tracks.ordered(t, values)
    order = sorted(range(len(times)), key=times.__getitem__)
    np.testing.assert_array_equal(ordered[0], t[order])
    np.testing.assert_array_equal(ordered[1], values[order])


def test_samples_out_of_order_are_sorted():
    t, values = tracks.ordered(ticks(10, 0, 20), np.array([1.0, 0.0, 2.0]))
    np.testing.assert_array_equal(t, ticks(0, 10, 20))
    np.testing.assert_array_equal(values, [0.0, 1.0, 2.0])
    t = ticks(0, 10, 10, 20)
    assert tracks.ordered(t, np.zeros(4))[0] is t
    _, values = tracks.ordered(ticks(10, 10, 0), np.array([1.0, 2.0, 0.0]))
    np.testing.assert_array_equal(values, [0.0, 1.0, 2.0])


def test_a_typical_step_is_the_median_of_those_that_are_some():
    for t, step in (((0, 1, 2), 1), ((5, 5, 5, 8), 3), ((0, 1, 3, 3, 9), 2), ((4, 4), 0), ((), 0)):
        assert tracks.typical_step_ns(np.array(t, dtype=np.int64)) == step


@given(st.lists(st.integers(0, 12), min_size=1, max_size=12))
def test_a_gap_is_five_times_the_median_of_the_steps_that_are_some(steps):
    t = 2 * np.cumsum([0, *steps])
    median = statistics.median([step for step in steps if step] or [0])
    assert tracks.gaps(t).tolist() == [step > 5 * median for step in steps]


@pytest.mark.parametrize("count", [0, 1])
def test_too_few_samples_have_no_gaps(count):
    t = ticks(*range(count))
    assert tracks.gaps(t).size == 0
    assert tracks.mark_gaps(t, np.zeros((count, 1)))[0].size == count


@pytest.mark.parametrize("size", [1e-6, 0.3, 45.0, 1e5])
def test_a_step_is_a_power_of_two_below_a_five_hundredth_of_the_range(size):
    values = size * np.sin(np.linspace(0.0, 20.0, 5000))
    step = tracks.plot_step(values)
    assert np.log2(step) == np.round(np.log2(step))
    room = np.ptp(np.quantile(values, [0.01, 0.99]))
    assert room / tracks.LEVELS / 2 < step <= room / tracks.LEVELS
    assert np.abs(tracks.rounded(values[:, None], [step])[:, 0] - values).max() <= room / 1000


def test_a_step_follows_the_range_of_nearly_all_samples():
    values = np.sin(np.linspace(0.0, 20.0, 5000))
    spiky = values.copy()
    spiky[::500] = 1e6
    assert tracks.plot_step(spiky) == tracks.plot_step(values)
    still = np.zeros(5000)
    still[100:110] = 1.0
    assert tracks.plot_step(still) == 2.0**-9  # of its whole range


def test_a_flat_line_and_no_line_are_left_alone():
    flat = (np.full(10, 3.3), np.zeros(0), np.full(3, np.nan))
    assert [tracks.plot_step(line) for line in flat] == [0, 0, 0]
    values = np.array([[0.1, 0.1], [np.nan, 0.3]])
    np.testing.assert_array_equal(tracks.rounded(values, [0.0, 0.0]), values)
    np.testing.assert_array_equal(tracks.rounded(values, [0.25, 0.0]), [[0.0, 0.1], [np.nan, 0.3]])
