"""Samples in order, gaps, the time that each sample stands for."""

import dataclasses

import numpy as np
import pytest

from support.frozen_records import mutable_dataclasses
from undulog.analysis.estimators.series import (
    Series,
    clean,
    clean_together,
    coverage,
    gaps_after,
    sample_weights,
    shared_times,
)
from undulog.capture.log.read.sample_times import LARGEST, Signal

T = np.array([0.0, 1.0, 2.0, 4.0])
ONE = Series("q", T, np.array([1.0, 3.0, 2.0, 6.0]), 5, 7)


def test_a_series_between_and_at_other_times():
    part = ONE.between(1.0, 4.0)
    assert (part.t_s.tolist(), part.values.tolist()) == ([1.0, 2.0], [3.0, 2.0])
    assert (part.name, part.dropped_nan, part.dropped_duplicates, part.count) == ("q", 5, 7, 2)
    np.testing.assert_allclose(ONE.at(np.array([-1.0, 0.5, 3.0, 9.0])), [1.0, 2.0, 4.0, 6.0])
    assert ONE.at(ONE.t_s) is ONE.values
    # Whole nanoseconds, but for rounding: half of one is no time.
    np.testing.assert_array_equal(ONE.rows_from(T + 0.4e-9), [0, 1, 2, 3])
    np.testing.assert_array_equal(ONE.rows_from(T + 0.6e-9), [1, 2, 3, 4])
    assert ONE.period_s == 1.0
    assert np.isnan(Series("q", T[:1], T[:1]).period_s)
    assert Series("q", T[:2], T[:2]).period_s == 1.0
    with pytest.raises(dataclasses.FrozenInstanceError):
        ONE.name = "x"


def test_a_gap_is_more_than_three_median_steps():
    assert gaps_after(np.array([1.0, 1.0, 3.0, 1.0])).tolist() == []
    assert gaps_after(np.array([1.0, 1.0, 3.01, 1.0, 9.0])).tolist() == [2, 4]
    # Half of the steps are a third of the longest: the median itself has to be looked at.
    assert gaps_after(np.array([1.0, 1.0, 4.0, 4.0])).tolist() == []
    assert gaps_after(np.array([])).tolist() == []
    assert Series("q", np.array([0.0, 1.0, 2.0, 9.0]), np.zeros(4)).gaps.tolist() == [2]


def test_raw_samples_are_put_in_order():
    t_ns = np.array([30, 10, 20, 20, 40, 50])
    cleaned = clean("q", t_ns, np.array([3.0, 1.0, 2.0, 9.0, np.nan, 2 * LARGEST]), 10)
    np.testing.assert_allclose(cleaned.t_s, [0.0, 1e-8, 2e-8])
    np.testing.assert_array_equal(cleaned.values, [1.0, 2.0, 3.0])
    assert (cleaned.dropped_nan, cleaned.dropped_duplicates) == (2, 1)
    assert clean("q", t_ns[:1], np.array([-LARGEST]), 0).count == 1
    assert not cleaned.t_s.flags.writeable
    whole = np.array([1, 2, 3])
    assert clean("q", t_ns[:3] * 0 + [1, 2, 3], whole, 0).values.dtype == np.float64
    values = np.array([1.0, 2.0])
    assert np.shares_memory(clean("q", np.array([1, 2]), values, 0).values, values)
    twice = clean("q", np.array([5, 5, 6]), np.array([1.0, 2.0, 3.0]), 0)
    assert (twice.values.tolist(), twice.dropped_duplicates) == ([1.0, 3.0], 1)
    assert clean("q", np.zeros(0, np.int64), np.zeros(0), 0).count == 0


def test_unix_times_keep_their_nanoseconds():
    origin = 1_700_000_000_123_456_789
    cleaned = clean("q", origin + np.array([1, 1_000_000_003]), np.zeros(2), origin)
    np.testing.assert_allclose(cleaned.t_s, [1e-9, 1.000000003], rtol=0, atol=1e-16)


def test_signals_of_one_times_share_them():
    t_ns = np.array([0, 10, 20])
    signals = {
        "a": Signal("a", "rad", t_ns, np.zeros(3)),
        "b": Signal("b", "rad", t_ns, np.array([0.0, np.nan, 0.0])),
        "c": Signal("c", "rad", t_ns, np.ones(3)),
        "d": Signal("d", "rad", t_ns.copy(), np.ones(3)),
    }
    cleaned = clean_together(signals, 0)
    assert cleaned["c"].t_s is cleaned["a"].t_s
    assert cleaned["b"].t_s.tolist() == [0.0, 2e-8]
    assert cleaned["b"].dropped_nan == 1
    assert cleaned["d"].t_s is not cleaned["a"].t_s
    assert (cleaned["c"].name, cleaned["c"].values.tolist()) == ("c", [1.0] * 3)


def test_weights_are_half_of_the_steps_on_either_side():
    # Closed upon itself: half a second before the first sample, and half after the last one.
    np.testing.assert_allclose(
        sample_weights(np.array([0.5, 1.0, 2.5]), 0.0, 3.0), [0.75, 1.0, 1.25]
    )
    t = np.array([0.0, 1.0, 2.0, 3.0, 13.0, 14.0])  # a gap of 10: each side has half a step of it
    np.testing.assert_allclose(sample_weights(t, 0.0, 15.0), [1.0, 1.0, 1.0, 1.0, 1.0, 1.0])
    late = np.array([9.0, 10.0, 11.0, 12.0])  # the window begins long before
    np.testing.assert_allclose(sample_weights(late, 0.0, 13.0), [1.0, 1.0, 1.0, 1.0])
    assert sample_weights(t[:0], 0.0, 1.0).size == 0
    assert sample_weights(t[:1], 0.0, 1.0).tolist() == [0.0]
    assert coverage(t, 0.0, 15.0) == pytest.approx(6 / 15)
    assert coverage(np.arange(10.0), 0.0, 10.0) == 1.0
    assert coverage(t, 5.0, 5.0) == coverage(t, 5.0, 4.0) == 0.0


def test_channels_of_the_same_times_in_a_row_are_one_group():
    other = Series("q", T + 1, T)
    equal = Series("q", T.copy(), T)
    assert shared_times([ONE, equal, other, other, ONE]) == [[0, 1], [2, 3], [4]]
    assert shared_times([]) == []


def test_what_is_handed_on_can_not_be_changed():
    assert mutable_dataclasses("undulog.analysis.estimators") == set()
