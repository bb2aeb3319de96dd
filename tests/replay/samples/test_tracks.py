"""Joints sampled together share a table; everything else keeps its own times."""

import numpy as np

from undulog.replay.samples.sampling import hold, interpolate
from undulog.replay.samples.tracks import (
    Track,
    in_turn,
    join_tracks,
    resampled,
    tables,
    without_filler,
)

T = np.arange(5, dtype=np.int64) * 10


def track(name, t_ns=T, values=None):
    return Track(name, t_ns, np.arange(len(t_ns), dtype=float) if values is None else values)


def test_joints_with_the_same_times_share_one_table():
    (table,) = tables([track("a"), track("b", T.copy(), 2.0 * np.arange(5))])
    assert table.names == ("a", "b")
    np.testing.assert_array_equal(table.values, np.stack([np.arange(5), 2 * np.arange(5)], axis=1))


def test_joints_with_times_of_their_own_keep_them():
    found = tables([track("a"), track("b", T + 3), track("c")])
    assert [table.names for table in found] == [("a", "c"), ("b",)]
    np.testing.assert_array_equal(found[1].t_ns, T + 3)


def test_nan_that_fills_up_foreign_messages_is_left_out():
    values = np.array([0.0, np.nan, np.nan, np.nan, 4.0])
    found = without_filler(track("a", T, values))
    np.testing.assert_array_equal(found.t_ns, [0, 40])
    np.testing.assert_array_equal(found.values, [0.0, 4.0])


def test_a_lost_sample_stays_a_hole():
    lossy = track("a", T, np.array([0.0, 1.0, np.nan, 3.0, 4.0]))
    assert without_filler(lossy) is lossy


def test_resampling_puts_columns_in_order_and_leaves_unknown_joints_nan():
    found = resampled([track("b", T + 5), track("a")], ("a", "x", "b"), T[1:3], interpolate)
    np.testing.assert_allclose(found[:, [0, 2]], [[1.0, 0.5], [2.0, 1.5]])
    assert np.isnan(found[:, 1]).all()
    np.testing.assert_array_equal(
        resampled([track("b", T + 5)], ("b",), T[1:3], hold), [[0.0], [1.0]]
    )


def test_joints_in_turn_have_one_sample_between_two_of_the_first():
    t = 10 * np.arange(5, dtype=np.int64)
    assert in_turn(t, t + 3)
    assert in_turn(t, t - 3)
    assert in_turn(t[[0, 1, 3, 4]], t[[0, 1, 3, 4]] + 3)  # a pause of both
    assert not in_turn(t, t[::2] + 3)
    assert not in_turn(t, np.sort(np.concatenate([t + 3, t + 6])))
    assert not in_turn(t, t[:0])


def test_joints_in_turn_are_brought_to_the_first_ones_times():
    table = join_tracks([track("a"), track("b", T - 4, 0.1 * (T - 4))])
    assert table.names == ("a", "b")
    np.testing.assert_array_equal(table.t_ns, T)
    np.testing.assert_allclose(table.values[:-1, 1], 0.1 * T[:-1], atol=1e-12)
    assert np.isnan(table.values[-1, 1])  # nothing comes after it
