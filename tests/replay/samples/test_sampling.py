"""Resampling against closed forms, and that gaps stay gaps."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from undulog.replay.samples.sampling import (
    decimate,
    gaps,
    hold,
    interpolate,
    mark_gaps,
    ordered,
    typical_step_ns,
)

MS = 1_000_000


def ticks(*milliseconds):
    return np.array(milliseconds, dtype=np.int64) * MS


def test_every_second_sample_of_100_hz_makes_50_hz():
    t = np.arange(1000, dtype=np.int64) * 10 * MS
    np.testing.assert_array_equal(decimate(t, 50.0), np.arange(0, 1000, 2))


def test_decimation_survives_jitter():
    rng = np.random.default_rng(1)
    t = np.arange(1000, dtype=np.int64) * 10 * MS + rng.integers(-2 * MS, 2 * MS, 1000)
    assert np.array_equal(decimate(t, 50.0) % 2, np.zeros(500))


def test_slow_samples_are_all_kept():
    t = np.arange(20, dtype=np.int64) * 100 * MS
    assert len(decimate(t, 50.0)) == 20


def test_nothing_decimates_to_nothing():
    assert decimate(ticks(), 50.0).size == 0


@given(
    st.lists(st.integers(1, 40), min_size=2, max_size=30),
    st.floats(-5, 5),
    st.floats(-5, 5),
    st.lists(st.integers(0, 1200), min_size=1, max_size=20),
)
def test_a_straight_line_is_interpolated_exactly_or_not_at_all(steps, slope, offset, wanted):
    t = np.cumsum(np.array(steps, dtype=np.int64)) * MS
    at = np.array(wanted, dtype=np.int64) * MS
    found = interpolate(t, slope * t / MS + offset, at)
    known = np.isfinite(found)
    np.testing.assert_allclose(found[known], (slope * at / MS + offset)[known], atol=1e-9)
    assert not known[(at < t[0]) | (at > t[-1])].any()
    assert known[np.isin(at, t)].all()


def test_nothing_is_drawn_across_a_gap():
    t = ticks(0, 10, 20, 30, 200, 210)
    assert gaps(t).tolist() == [False, False, False, True, False]
    found = interpolate(t, np.arange(6.0), ticks(25, 30, 35, 100, 200, 205))
    np.testing.assert_array_equal(found, [2.5, 3.0, np.nan, np.nan, 4.0, 4.5])


def test_a_missing_sample_spoils_its_neighbourhood_only():
    t = ticks(0, 10, 20, 30)
    values = np.array([0.0, np.nan, 2.0, 3.0])
    found = interpolate(t, values, ticks(0, 5, 10, 15, 20, 25))
    np.testing.assert_array_equal(found, [0.0, np.nan, np.nan, np.nan, 2.0, 2.5])


def test_tables_are_interpolated_column_by_column():
    t = ticks(0, 10)
    found = interpolate(t, np.array([[0.0, 10.0], [1.0, 20.0]]), ticks(5))
    np.testing.assert_array_equal(found, [[0.5, 15.0]])


def test_a_command_is_held_until_the_next():
    t = ticks(0, 10, 20)
    found = hold(t, np.array([1.0, 2.0, 3.0]), ticks(-1, 0, 9, 10, 19, 69, 71))
    np.testing.assert_array_equal(found, [np.nan, 1.0, 1.0, 2.0, 2.0, 3.0, np.nan])


def test_without_samples_nothing_is_known():
    assert np.isnan(interpolate(ticks(), np.zeros(0), ticks(1))).all()
    assert np.isnan(hold(ticks(), np.zeros(0), ticks(1))).all()
    assert typical_step_ns(ticks(5)) == 0


def test_a_gap_gets_one_row_of_nan_a_step_after_its_last_sample():
    t, values = mark_gaps(ticks(0, 10, 20, 100, 110), np.arange(5.0)[:, None])
    np.testing.assert_array_equal(t, ticks(0, 10, 20, 30, 100, 110))
    np.testing.assert_array_equal(values[:, 0], [0, 1, 2, np.nan, 3, 4])


def test_silence_before_the_end_is_a_gap():
    t, values = mark_gaps(ticks(0, 10, 20), np.zeros((3, 2)), end_ns=100 * MS)
    np.testing.assert_array_equal(t, ticks(0, 10, 20, 30))
    assert np.isnan(values[-1]).all()


def test_whole_samples_are_left_alone():
    t, values = ticks(0, 10, 20), np.zeros((3, 2))
    found = mark_gaps(t, values, end_ns=40 * MS)
    assert found[0] is t
    assert found[1] is values


def test_samples_out_of_order_are_sorted():
    t, values = ordered(ticks(10, 0, 20), np.array([1.0, 0.0, 2.0]))
    np.testing.assert_array_equal(t, ticks(0, 10, 20))
    np.testing.assert_array_equal(values, [0.0, 1.0, 2.0])


@pytest.mark.parametrize("count", [0, 1])
def test_too_few_samples_have_no_gaps(count):
    t = ticks(*range(count))
    assert gaps(t).size == 0
    assert mark_gaps(t, np.zeros((count, 1)))[0].size == count
