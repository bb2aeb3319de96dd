"""The statuses of a recording: their levels at each boundary, their values, sums over topics."""

import dataclasses
import math

import numpy as np
import pytest

from support.simulated_clock import SimulatedClock
from undulog.capture.common.clock import Clock
from undulog.capture.log.messages.definitions import ERROR, OK, STALE, WARN
from undulog.capture.recorder.source_clock import ClockEstimate
from undulog.capture.recorder.status import (
    LOW_TIME_S,
    NO_TIME_S,
    SILENT_S,
    SLOW_TICK_S,
    EachSecond,
    RecorderSnapshot,
    SessionClock,
    SourceSnapshot,
    TickTally,
    TopicSnapshot,
    combined,
    group_of,
    source_state,
    statuses,
)

SNAPSHOT = RecorderSnapshot(
    session_id="s",
    path="run.mcap",
    robot=None,
    state="recording",
    now_ns=0,
    elapsed_s=12.3456,
    messages=100,
    size=2_000,
    byte_rate=10.0,
    free=100_000,
    part=None,
    verdict="good",
    reasons=(),
    notes=(),
    sources=(),
    topics=(),
)


def of(name="recorder", **changes):
    """One status of a changed snapshot."""
    (match,) = [s for s in statuses(dataclasses.replace(SNAPSHOT, **changes)) if s.name == name]
    return match


# -- clocks and schedules -------------------------------------------------------------------------


def test_the_clock_of_a_session_is_the_wall_s_at_its_start_and_monotonic_since():
    time = SimulatedClock(7_123_456_789, 1_700_000_000_987_654_321)
    clock = SessionClock(time.clock)
    assert clock.now_ns() == clock.epoch_ns == 1_700_000_008_111_111_110
    time.wall_ahead_ns -= 3600 * 10**9
    time.pass_s(1.5)
    assert clock.now_ns() == clock.epoch_ns + 1_500_000_000


def test_a_task_that_is_late_by_a_second_is_not_run_twice():
    done = []
    schedule = EachSecond([lambda: done.append(1)], 0)  # due at 0.5 s
    for now_ns in (500_000_000, 2_499_999_999, 2_500_000_000, 3_499_999_999, 5_000_000_000):
        schedule.run(now_ns)
    assert len(done) == 4
    schedule.run(5_999_999_999)
    assert len(done) == 4
    schedule.run(6_000_000_000)
    assert len(done) == 5


def test_the_start_of_a_session_is_in_the_middle_of_two_looks_at_the_monotonic_clock():
    looks = iter([1000, 1007, 5000])
    clock = SessionClock(Clock(lambda: next(looks), lambda: 70_000, int))
    assert (clock.epoch_ns, clock.now_ns()) == (70_000, 70_000 - 1003 + 5000)


@pytest.mark.parametrize("count", [1, 2, 3, 7])
def test_tasks_are_spread_over_the_first_second_and_then_each_a_second_apart(count):
    done, begin_ns = [], 77
    schedule = EachSecond([lambda k=k: done.append((now_ns, k)) for k in range(count)], begin_ns)
    steps_ns = 10**9 // (count + 1)
    due = [(begin_ns + second * 10**9 + (k + 1) * steps_ns, k)
           for second in range(3) for k in range(count)]  # fmt: skip
    for now_ns in sorted(at_ns - early for at_ns, _ in due for early in (0, 1)):
        schedule.run(now_ns)
    assert done == due


# -- the recorder and the session -----------------------------------------------------------------


def test_a_recorder_that_is_well_gives_its_facts():
    status = of(tick_p99_s=0.002, tick_max_s=0.01, backlog=3, unsynced=7, part=2)
    assert (status.level, status.message) == (OK, "recording")
    assert status.values == {
        "elapsed_s": "12.346", "state": "recording", "messages": "100", "size_bytes": "2000",
        "free_bytes": "100000", "part": "2", "tick_p99_s": "0.002", "tick_max_s": "0.01",
        "backlog_frames": "3", "unsynced_messages": "7",
    }  # fmt: skip
    assert not {"part", "tick_p99_s", "free_bytes"} & of(free=None).values.keys()


@pytest.mark.parametrize(
    ("left_s", "level"),
    [
        (LOW_TIME_S, OK),
        (LOW_TIME_S - 1, WARN),
        (NO_TIME_S, WARN),
        (NO_TIME_S - 1, ERROR),
        (0.0, ERROR),
    ],
)
def test_a_disk_is_told_of_in_time(left_s, level):
    status = of(byte_rate=10.0, free=round(10 * left_s))
    assert status.level == level
    text = "recording" if level == OK else f"the disk is full in {left_s:.0f} s"
    assert status.message == text


@pytest.mark.parametrize(
    "changes", [{"free": None}, {"byte_rate": None}, {"byte_rate": 0.0}, {"byte_rate": -1.0}]
)
def test_without_a_rate_nobody_knows_how_long_a_disk_lasts(changes):
    snapshot = dataclasses.replace(SNAPSHOT, **{"free": 1} | changes)
    assert snapshot.time_left_s is None
    assert of(**{"free": 1} | changes).level == OK
    assert SNAPSHOT.time_left_s == 10_000.0


def test_ticks_that_take_long_are_a_warning():
    assert of(tick_p99_s=SLOW_TICK_S).level == OK
    slow = of(tick_p99_s=1.01 * SLOW_TICK_S)
    text = "the computer can't keep up with the recorder's ticks"
    assert (slow.level, slow.message) == (WARN, text)


def test_a_session_has_its_verdict_and_eight_reasons():
    reasons = tuple(f"why {k}" for k in range(10))
    for verdict, level in (("good", OK), ("degraded", WARN), ("bad", ERROR)):
        status = of("session", verdict=verdict, reasons=reasons)
        assert (status.level, status.message) == (level, f"{verdict}: why 0")
    assert status.values == {
        "verdict": "bad", "reasons": "10", **{f"reason.{k + 1}": f"why {k}" for k in range(8)}
    }  # fmt: skip
    assert of("session").message == "good"


# -- sources --------------------------------------------------------------------------------------

SOURCE = SourceSnapshot("can0", "can:socketcan:can0", connected=True, age_s=0.1)


@pytest.mark.parametrize(
    ("changes", "level", "text"),
    [
        ({}, OK, "connected"),
        ({"age_s": None}, OK, "connected"),
        ({"age_s": SILENT_S}, OK, "connected"),
        ({"age_s": 1.6, "dropped": 3}, STALE, "silent for 2 s"),
        ({"dropped": 3}, WARN, "connected, lost 3"),
        ({"dropped": 0}, OK, "connected"),
        ({"connected": False, "age_s": 9.0}, ERROR, "not connected"),
        ({"connected": False, "finished": True, "dropped": 3}, OK, "ended"),
    ],
)
def test_states_of_a_source(changes, level, text):
    assert source_state(dataclasses.replace(SOURCE, **changes)) == (level, text)


def test_values_of_a_source():
    clock = ClockEstimate(True, 123, -23.42, 0.1, 0.00214, 0.0093, 1_000_000, 1)
    source = dataclasses.replace(
        SOURCE,
        frames=7,
        rate_hz=1234.5678,
        malformed=2,
        error_frames=1,
        load=(0.2, 0.25),
        clock=clock,
    )
    status = of("source can0", sources=(source,))
    assert status.hardware_id == "can:socketcan:can0"
    values = dict(status.values)
    assert {key: values.pop(key) for key in [*values] if not key.startswith("clock_")} == {
        "frames": "7", "rate_hz": "1234.57", "malformed": "2", "error_frames": "1",
        "reconnects": "0", "load": "0.25",
    }  # fmt: skip
    assert values["clock_offset_ns"] == "123"
    assert "load" not in of("source can0", sources=(SOURCE,)).values
    assert "dropped" not in status.values  # not known
    assert (
        of("source can0", sources=(dataclasses.replace(SOURCE, dropped=0),)).values["dropped"]
        == "0"
    )


def test_what_is_not_given_of_a_source_or_a_recorder_is_zero_or_left_out():
    status = of("source b", sources=(SourceSnapshot("b", "x", connected=True),))
    none = dict.fromkeys(("frames", "malformed", "error_frames", "reconnects"), "0")
    assert (status.level, status.message, status.values) == (OK, "connected", none)
    recorder = of().values
    assert (recorder["backlog_frames"], recorder["unsynced_messages"]) == ("0", "0")
    group = of("topics x", topics=(TopicSnapshot("/x", 1, None, 0.5),)).values
    assert (group["nan"], group["oldest_s"], group.get("jitter")) == ("0", "0.5", None)
    assert SNAPSHOT.events == ()


# -- topics ---------------------------------------------------------------------------------------


def test_topics_are_grouped_by_kind():
    names = {
        "/joint_states": "joints",
        "/joint_power/mechanical": "joints",
        "/ir/07": "ir",
        "/can/can0": "can/can0",
        "/imu": "imu",
    }
    assert {name: group_of(name) for name in names} == names


def test_a_group_has_sums_and_the_worst():
    first = TopicSnapshot("/a", 10, 5.0, 0.5, 1, 2, 0.1, None, ("y", "x"), ("p",), 3)
    second = TopicSnapshot("/b", 20, None, 0.25, None, None, None, 4, ("x",), ("q",), 1)
    both = combined("ab", [first, second])
    assert both == TopicSnapshot("ab", 30, 5.0, 0.5, 1, 2, 0.1, 4, ("x", "y"), ("p", "q"), 4)
    none = combined("b", [second])
    assert (none.rate_hz, none.gaps, none.jitter) == (None, None, None)
    third = dataclasses.replace(first, rate_hz=0.1, gaps=2, missing=3, jitter=0.3, dropped=5)
    some = combined("ac", [first, third])
    assert (some.rate_hz, some.gaps, some.missing, some.jitter, some.dropped) == (5.1, 3, 5, 0.3, 5)


def joints(**changes):
    topic = TopicSnapshot("/joint_states", 9_990, 100.0, 0.01, 1, 10, 0.02, 0)
    return of("topics joints", topics=(dataclasses.replace(topic, **changes),))


def test_what_is_wrong_with_a_group_is_named():
    assert (joints().level, joints().message) == (OK, "ok")  # 10 of 10,000 is what is good
    assert joints(missing=11).message == "11 samples missing"
    assert joints(missing=11).level == WARN
    assert joints(dropped=1).message == "1 messages dropped"
    assert joints(dropped=None, missing=None, gaps=None).message == "ok"
    odd = joints(dropped=2, frozen=("a", "b"), at_limit=("c",))
    assert odd.message == "2 messages dropped; frozen: a, b; at their limits: c"
    assert joints(rate_hz=None, gaps=None, nan=5).values == {
        "topics": "1", "messages": "9990", "rate_hz": "0", "oldest_s": "0.01", "gaps": "0",
        "missing": "10", "dropped": "0", "jitter": "0.02", "nan": "5",
    }  # fmt: skip


def test_topics_without_a_rhythm_have_no_group():
    events = TopicSnapshot("/rosout", 3, 0.1, 5.0)
    listed = statuses(dataclasses.replace(SNAPSHOT, topics=(events,)))
    assert [status.name for status in listed] == ["recorder", "session"]


# -- ticks ----------------------------------------------------------------------------------------


def test_durations_of_ticks_are_within_a_bin_of_the_true_quantiles():
    tally = TickTally()
    assert dataclasses.astuple(tally.result()) == (0, 0.0, 0.0, 0.0)
    durations_ns = np.random.default_rng(1).lognormal(15.0, 1.0, 5_000).astype(int)
    for duration in durations_ns.tolist():
        tally.add(duration)
    quantiles = tally.result()
    assert quantiles.count == 5_000
    assert quantiles.max_s == durations_ns.max() * 1e-9
    for point, part in ((quantiles.p50_s, 0.5), (quantiles.p99_s, 0.99)):
        true_s = np.quantile(durations_ns, part, method="inverted_cdf") * 1e-9
        assert 1.0 <= point / true_s <= 10 ** (1 / 40) * (1 + 1e-6)


@pytest.mark.parametrize("duration_ns", [0, 999, 1_000, 7_000_000, 10**10, 10**12])
def test_a_single_tick_is_its_own_quantile_or_the_edge_above(duration_ns):
    tally = TickTally()
    tally.add(duration_ns)
    quantiles = tally.result()
    assert quantiles.p50_s == quantiles.p99_s == quantiles.max_s == duration_ns * 1e-9
    assert math.isfinite(quantiles.p50_s)
