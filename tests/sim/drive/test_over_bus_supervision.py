"""What a drive over a bus reports of its supervision, and the arguments that it refuses."""

import dataclasses
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from support.gate_bench import Bench, Wave
from undulog.capture import load_robot
from undulog.capture.common.errors import LogWriteError, UsageError
from undulog.capture.log.messages.frames import EXTENDED_FLAG, empty_frames
from undulog.capture.sources.contract import SourceCounts
from undulog.sim.drive.loop import LoopTally
from undulog.sim.drive.motion import find_motion
from undulog.sim.drive.outcome import DriveEnding, Outcome
from undulog.sim.drive.over_bus import (
    _candump,
    _feedback,
    _report,
    _Telling,
    _unwritten,
    bus_address,
    bus_plan,
)
from undulog.sim.drive.report import Feedback

ROBOT = load_robot("snake25")
LOOP = SimpleNamespace(by_replies=True, tally=LoopTally(late_s=[0.001, 0.003]))


def planned(duration_s=None, robot=None):
    return bus_plan(find_motion("flat"), "can:virtual:a", Path("a.mcap"), robot, duration_s)


@pytest.mark.parametrize(("every", "interval"), [(1, 1), (2, 2), (5, 5)])
def test_the_reply_interval_is_told_in_seconds(every, interval):
    bench = Bench(Wave(0.0), duration_s=60.0, listen_s=0.5)
    assert _feedback(bench.gate, LOOP) is None
    for tick in range(55):
        bench.step(received=tick % every == 0)
    feedback = _feedback(bench.gate, LOOP)
    assert feedback == Feedback(True, pytest.approx(interval / 100), 3 * interval, 0.01)


def test_a_report_has_what_gate_loop_and_bus_counted():
    bench = Bench(Wave(0.0), duration_s=60.0, listen_s=0.5)
    spacing = SimpleNamespace(waits=4, longest_s=0.002)
    early = _report(planned(), bench.gate, LOOP, spacing, SourceCounts())
    assert early.outcome == Outcome(DriveEnding.STOPPED, "", "")
    assert (early.approach_s, early.gait_s, early.ticks, early.held_s) == (None, 0.0, 0, 0.0)
    assert (early.feedback, early.dropped, early.malformed) == (None, 0, 0)
    for tick in range(80):
        bench.step(received=tick < 60)
    counts = SourceCounts()
    counts.malformed, counts.dropped = 3, 7
    report = _report(planned(), bench.gate, LOOP, spacing, counts)
    assert report.outcome is bench.gate.outcome
    assert (report.approach_s, report.gait_s, report.ticks) == (0.5, 0.11, 12)
    assert report.held_s == pytest.approx(0.18)
    assert (report.waits, report.longest_wait_s) == (4, 0.002)
    assert (report.malformed, report.dropped, report.lockstep) == (3, 7, False)
    assert (report.jitter.ticks, report.jitter.worst_s) == (2, 0.003)
    assert report.feedback.hold_after_ticks == 3
    lockstep = _report(planned(), bench.gate, LOOP, None, counts)
    assert (lockstep.waits, lockstep.longest_wait_s, lockstep.lockstep) == (0, 0.0, True)


def test_the_supervision_is_written_when_it_is_armed_and_when_it_changes():
    noted = []
    session = SimpleNamespace(
        log_event=lambda *event: noted.append(event),
        writer=SimpleNamespace(note=lambda name, facts: noted.append((name, facts["most_steps"]))),
    )
    telling = _Telling(None, session, None, None, None, None, None)
    asked = Feedback(True, 0.01, 3, 0.01)
    for feedback in (None, None, asked, asked, dataclasses.replace(asked), None, asked):
        telling.feedback(feedback)
    assert noted == [("undulog.gate.feedback", "1")]
    telling.feedback(dataclasses.replace(asked, by_replies=False))
    (level, text), facts = noted[1:]
    assert level == "warn"
    assert text == (
        "gate: joints were received more often than requested: commands are not confirmed by "
        "replies"
    )
    assert facts == ("undulog.gate.feedback", "4")


@pytest.mark.parametrize("seconds", [0.01, 1.0, 86400.0])
def test_a_drive_may_be_as_long_as_a_day(seconds):
    assert planned(seconds).duration_s == seconds
    assert planned().duration_s == find_motion("flat").duration_s


@pytest.mark.parametrize("seconds", [0.0, 0.0099, 86400.1, float("nan"), -1.0])
def test_a_drive_of_no_length_or_too_long_is_refused(seconds):
    with pytest.raises(UsageError) as refused:
        planned(seconds)
    assert str(refused.value) == f"a duration of {seconds:g} s; it can be 0.01 to 86400 s"


def test_joints_that_the_bus_map_lacks_are_named():
    def lacking(direction, quantity, *names):
        signals = tuple(
            signal
            for signal in ROBOT.bus.signals
            if (signal.direction, signal.quantity) != (direction, quantity)
            or signal.target not in names
        )
        return dataclasses.replace(ROBOT, bus=dataclasses.replace(ROBOT.bus, signals=signals))

    for direction, quantity in (("tx", "command"), ("rx", "position")):
        with pytest.raises(UsageError) as refused:
            planned(robot=lacking(direction, quantity, "joint03", "joint20"))
        assert str(refused.value) == (
            f"the bus map of snake25 has no {quantity} ({direction}) of joint03, joint20: it can't "
            "be driven on a bus"
        )
    planned(robot=lacking("rx", "velocity", "joint03"))


@pytest.mark.parametrize("on", ["twin", "unix:/tmp/a", "cans:virtual:a", "can"])
def test_what_is_no_bus_is_refused(on):
    with pytest.raises(UsageError, match=f"--on {on}: expected twin, twin:SCENARIO or can:"):
        bus_address(on)
    assert bus_address("can:virtual:a").text == "can:virtual:a"


def test_a_session_that_can_not_be_written_says_what_is_lost():
    gate, tally = SimpleNamespace(outcome=None), LoopTally()
    session = SimpleNamespace(close=lambda: None)
    error = LogWriteError("a.mcap", "no space left")
    assert str(_unwritten(error, session, gate, tally)) == "a.mcap: no space left"
    gate.outcome, tally.untold = Outcome(DriveEnding.FAULT, "why", "the joints were held"), 12
    assert str(_unwritten(error, session, gate, tally)) == (
        "a.mcap: no space left; the joints were held; the last 12 control ticks are not in the "
        "session"
    )

    def fails():
        raise LogWriteError("a.mcap", "the rest is elsewhere")

    session.close = fails
    assert str(_unwritten(error, session, gate, LoopTally())) == (
        "a.mcap: the rest is elsewhere; the joints were held"
    )


def test_frames_are_shown_as_candump_has_them():
    frames = empty_frames(3)
    frames["id_flags"], frames["dlc"] = [0x101, 0x1ABCDEF | EXTENDED_FLAG, 0x7], [2, 8, 0]
    frames["data"] = np.arange(16, 24)
    assert [_candump(frame) for frame in frames] == [
        "101#1011",
        "01ABCDEF#1011121314151617",
        "007#",
    ]
