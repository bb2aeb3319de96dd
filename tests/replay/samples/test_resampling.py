"""Resampling, gaps, thinning and rounding against plain loops over random samples."""

import statistics
from types import SimpleNamespace

import numpy as np
import pytest

from undulog.capture.common.errors import DataError
from undulog.replay.samples import tracks

NAN = np.nan


def times(*values):
    return np.array(values, dtype=np.int64)


def records():
    """Times that lie close together, coincide and have gaps; values with holes."""
    rng = np.random.default_rng(12)
    for number in range(50):
        steps = rng.choice([0, 1, 2, 3, 5, 6, 10, 11, 15, 16, 30], rng.integers(0, 9))
        t = 7 + np.cumsum(steps).astype(np.int64)
        shape = (t.size,) if number % 2 else (t.size, 2)
        values = rng.normal(size=shape)
        values[rng.random(shape) < 0.1] = np.nan
        near = [t + off for off in (-1, 0, 1, 25, 26)]
        yield t, values, np.sort(np.concatenate([rng.integers(0, 7 + steps.sum() + 160, 9), *near]))


def step_of(t):
    steps = [b - a for a, b in zip(t[:-1].tolist(), t[1:].tolist(), strict=True) if b > a]
    return int(statistics.median(steps)) if steps else 0


def ends_here(t, i):
    """Whether nothing follows a sample within five typical steps."""
    return i + 1 == len(t) or t[i + 1] - t[i] > 5 * step_of(t)


def test_lines_between_samples_are_those_of_a_loop():
    for t, values, at in records():
        interpolated = tracks.interpolate(t, values, at)
        assert interpolated.shape == (at.size, *values.shape[1:])
        for instant, row in zip(at.tolist(), interpolated, strict=True):
            before = [i for i, stamp in enumerate(t.tolist()) if stamp <= instant]
            expected = np.full(values.shape[1:], NAN)
            if before and t[before[-1]] == instant:
                expected = values[before[-1]]
            elif before and not ends_here(t, before[-1]):
                i = before[-1]
                share = (instant - t[i]) / (t[i + 1] - t[i])
                expected = values[i] + share * (values[i + 1] - values[i])
            np.testing.assert_allclose(row, expected, atol=1e-12)


def test_held_samples_are_those_of_a_loop():
    for t, values, at in records():
        held = tracks.hold(t, values, at)
        assert held.shape == (at.size, *values.shape[1:])
        for instant, row in zip(at.tolist(), held, strict=True):
            before = [i for i, stamp in enumerate(t.tolist()) if stamp <= instant]
            is_held = before and instant - t[before[-1]] <= 5 * step_of(t)
            expected = values[before[-1]] if is_held else np.full(values.shape[1:], NAN)
            np.testing.assert_array_equal(row, expected)


@pytest.mark.parametrize("silence", [None, 0, 5, 6, 25, 26, 1000])
def test_a_row_of_nan_ends_each_run_of_a_loop(silence):
    for t, values, _ in records():
        end = None if silence is None or not t.size else int(t[-1]) + silence
        rows = []
        for i, at in enumerate(t.tolist()):
            rows.append((at, values[i]))
            silent = end is not None and end - at > 5 * step_of(t)
            if silent if i + 1 == t.size else ends_here(t, i):
                rows.append((at + step_of(t), np.full(values.shape[1:], NAN)))
        found_t, marked = tracks.mark_gaps(t, values, end)
        assert found_t.tolist() == [at for at, _ in rows]
        np.testing.assert_array_equal(marked, np.reshape([row for _, row in rows], marked.shape))
        if len(rows) == t.size:
            assert found_t is t
            assert marked is values


def test_no_samples_before_an_end_stay_none():
    t, values = times(), np.zeros((0, 2))
    marked = tracks.mark_gaps(t, values, 1000)
    assert (marked[0] is t, marked[1] is values) == (True, True)


def test_a_step_of_a_nanosecond_may_have_gaps_too():
    assert tracks.gaps(times(0, 1, 2, 3, 9)).tolist() == [False, False, False, True]
    assert tracks.gaps(times(0, 1, 2, 3, 8)).tolist() == [False] * 4


@pytest.mark.parametrize("rate_hz", [1e9 / 7, 1e9 / 8, 1e9 / 9, 4e8])
@pytest.mark.parametrize("origin", [None, 0, 11, 200])
def test_a_slot_keeps_its_first_sample_in_a_loop(rate_hz, origin):
    period = round(1e9 / rate_hz)
    for t, *_ in records():
        seen, kept = set(), []
        for i, at in enumerate(t.tolist()):
            since = at - (t[0] if origin is None else origin)
            slot = (since + period // 4) // period  # a quarter of a period before its multiple
            if slot not in seen:
                kept.append(i)
            seen.add(slot)
        assert tracks.decimate(t, rate_hz, origin).tolist() == kept


def test_a_slot_of_two_seconds_begins_half_a_second_early():
    t = times(0, 1_499_999_999, 1_500_000_000, 3_499_999_999, 3_500_000_000)
    assert tracks.decimate(t, 0.5).tolist() == [0, 2, 4]


def test_a_line_is_cut_into_five_hundred_steps_at_least():
    """The range of all but the lowest and the highest hundredth decides."""
    inner = np.linspace(0.0, 1.0, 99)  # of 101 samples
    for span, step in ((500.0, 1.0), (499.5, 0.5), (1000.0, 2.0), (999.0, 1.0), (0.4, 2.0**-11)):
        values = np.r_[-1e3, span * inner, NAN, 1e6] - 40.0
        assert tracks.plot_step(values) == step
    # Where these are all the same, the range of all of them does.
    for top, step in ((500.0, 1.0), (499.0, 0.5)):
        assert tracks.plot_step(np.r_[np.zeros(300), top]) == step


def test_values_are_rounded_to_the_nearest_multiple_column_by_column():
    rng = np.random.default_rng(4)
    values, steps = rng.normal(size=(60, 4)), np.array([0.25, 0.0, 2.0**-9, 1.0])
    before = values.copy()
    rounded = tracks.rounded(values, steps)
    np.testing.assert_array_equal(values, before)
    np.testing.assert_array_equal(rounded[:, 1], values[:, 1])
    for column in (0, 2, 3):
        multiple = rounded[:, column] / steps[column]
        np.testing.assert_array_equal(multiple, np.rint(multiple))
        assert np.abs(rounded[:, column] - values[:, column]).max() <= steps[column] / 2
    assert tracks.rounded(values, np.zeros(4)) is values


# -- what is drawn of a session -------------------------------------------------------------------


def session_of(counts, kind="sensor_msgs/msg/JointState"):
    """A session with so many messages of each topic."""
    channels = {
        topic: SimpleNamespace(type_name=kind, count=count) for topic, count in counts.items()
    }
    return SimpleNamespace(channels=channels)


def test_a_hundred_topics_are_drawn_the_contracts_first():
    strangers = {f"/s{k:03}": 1 for k in range(97)}
    usual = {"/joint_states": 1, "/joint_current": 5, "/joint_commands": 2}
    others = {"/joint_command_offset": 1, "/joint_sample_offset": 1, "/never": 0}
    names = [*strangers, *usual]
    assert tracks.drawn_topics(session_of(strangers | others | usual)) == (names, 0)
    more = {"/x": 1, "/y": 1}
    drawn, left_out = tracks.drawn_topics(session_of(strangers | more | usual))
    assert (drawn, left_out) == (names, 2)
    assert tracks.drawn_topics(session_of(usual, "sensor_msgs/msg/Imu")) == ([], 0)
    fields = tracks.wanted_fields(session_of(usual))
    assert fields == {
        "/joint_states": ["position", "velocity", "effort"],
        "/joint_current": ["position"],
        "/joint_commands": ["position"],
    }
    assert tracks.wanted_fields(session_of({"/s": 1})) == {"/s": ["position"]}


def test_a_thousand_joints_are_drawn_and_more_are_refused():
    def session_of_joints(count):
        values, t_ns = np.ones((count, 1)), [times(k) for k in range(count)]
        signals = SimpleNamespace(names=tuple(map(str, range(count))), t_ns=t_ns, values=values)
        columns = {("/s", "position"): signals}
        return SimpleNamespace(
            path=SimpleNamespace(name="run.mcap"), joint_columns=lambda *_, **__: columns
        )

    fields = {"/s": ["position"]}
    lines = tracks.read_columns(session_of_joints(1000), fields)["/s", "position"]
    assert [(line.name, line.t_ns.tolist()) for line in lines] == [
        (str(k), [k]) for k in range(1000)
    ]
    message = r"run\.mcap: /s has 1001 joints; at most 1000 are drawn"
    with pytest.raises(DataError, match=message):
        tracks.read_columns(session_of_joints(1001), fields)
