"""What a drive over a bus says of itself: for people, for JSON, for the session."""

import dataclasses
from pathlib import Path
from types import SimpleNamespace

import pytest

from support.twin_chains import chain
from undulog.capture import load_robot
from undulog.capture.sources.contract import parse_address
from undulog.sim.drive.limits import gate_limits
from undulog.sim.drive.loop import LoopTally
from undulog.sim.drive.outcome import (
    DriveEnding,
    FaultKind,
    GateEvent,
    GateFault,
    Outcome,
    jitter,
)
from undulog.sim.drive.report import BusPlan, BusReport, Feedback

COMPLETE = Outcome(DriveEnding.COMPLETE, "", "the joints are straight")
FAULT = GateFault(FaultKind.CURRENT, "joint01: current 3 A", "joint01", 3.0, 1.4, 2.5)
STOPPED = Outcome(DriveEnding.FAULT, "joint01: current 3 A", "the joints were held", FAULT)


@pytest.fixture(scope="module")
def plan(tmp_path_factory):
    path = tmp_path_factory.mktemp("robot") / "chain.toml"
    safety = {"max_rate": 4.0, "ramp_rate": 1.0, "max_tracking_error": 0.3, "max_current": 1.4}
    safety |= {"max_temperature": 70.0, "reply_timeout_s": 1.0, "max_late_s": 1.5}
    text = chain(3) + "[safety]\n" + "".join(f"{key} = {value}\n" for key, value in safety.items())
    path.write_text(text + 'fault_after_s = 0.5\non_fault = "hold"\n')
    robot = load_robot(path)
    driven = SimpleNamespace(name="wave.mcap", kind="commands")
    address = parse_address("can:socketcand:can0?port=28600")
    return BusPlan(driven, robot, gate_limits(robot), address, 5.0, Path("out.mcap"))


@pytest.fixture
def report(plan):
    tally = LoopTally(loop_s=6.5, sent=1500, received=4000, decoded=3900)
    return BusReport(plan, COMPLETE, tally, False, 1.25, 5.0, 500, {}, None, wall_s=13.0)


def test_a_complete_drive_in_lines(report):
    assert report.complete
    assert report.remarks() == []
    assert report.lines() == [
        "can:socketcand:can0?port=28600: drove wave.mcap for 5 s",
        "commands for chain3, 500 ticks in real time, begun after 1.25 s; the joints are straight",
        "1500 frames sent, 4000 received, 3900 of them with readings",
        "session: out.mcap",
    ]


def test_one_that_was_stopped_says_where_and_why(report, plan):
    report.outcome, report.gait_s, report.lockstep, report.approach_s = STOPPED, 2.5, True, None
    report.plan = dataclasses.replace(plan, recorder=Path("/run/r.sock"))
    report.taken, report.not_taken = 200, "it is gone"
    assert not report.complete
    assert report.lines() == [
        "can:socketcand:can0?port=28600: stopped at 2.5 s of 5 s: joint01: current 3 A",
        "commands for chain3, 500 ticks in lockstep with the robot; the joints were held",
        "1500 frames sent, 4000 received, 3900 of them with readings",
        "session: out.mcap",
        "the recorder at /run/r.sock received 200 samples of the gait",
        "warning: it did not receive all: it is gone",
    ]


def test_what_was_not_as_it_should_be_is_remarked(report):
    report.jitter = jitter([0.001, 0.002, 0.003])
    report.tally.overruns, report.malformed, report.dropped = 2, 3, 4
    report.waits, report.longest_wait_s = 5, 0.98765
    report.cuts = {"position": 0, "over_rate": 6, "yields": 7}
    assert report.remarks() == [
        GateEvent("info", "ticks were late by 2.00 ms (median), 2.98 ms (99 %), 3.00 ms at worst"),
        GateEvent("warn", "2 control ticks were left out, as the one before took too long"),
        GateEvent("warn", "messages of the bus that could not be read: 3"),
        GateEvent("warn", "messages of the bus that were dropped: 4"),
        GateEvent(
            "info",
            "commands that followed a late one and waited: 5, up to 987.65 ms, so that no command "
            "was too fast",
        ),
        GateEvent("warn", "the gate changed commands of single joints: 6 over rate, 7 yields"),
    ]
    lines = report.lines()
    assert lines[3].startswith("ticks were late by")
    assert lines[4] == f"warning: {report.remarks()[1].text}"
    report.tally.overruns = 1
    assert report.remarks()[1].text.startswith("1 control tick was left out")


def test_facts_are_plain_values_with_units_in_their_names(report, plan):
    facts = report.facts()
    assert facts["real_time_factor"] == 0.5
    assert (facts["pace"], facts["armed"], facts["recorder"]) == ("real time", True, None)
    assert (facts["outcome"], facts["why"], facts["fault"]) == ("complete", None, None)
    assert (facts["duration_s"], facts["planned_duration_s"], facts["whole_s"]) == (5.0, 5.0, 6.5)
    assert (facts["sent"], facts["received"], facts["decoded"]) == (1500, 4000, 3900)
    assert (facts["feedback"], facts["lateness"], facts["gait_not_told"]) == (None, None, None)
    assert (facts["driven"], facts["kind"], facts["robot"]) == ("wave.mcap", "commands", "chain3")
    report.outcome, report.lockstep = STOPPED, True
    report.plan = dataclasses.replace(plan, recorder=Path("r.sock"))
    report.feedback = Feedback(False, 0.02, 6, 0.01)
    report.jitter, report.wall_s = jitter([0.0]), 0.0
    facts = report.facts()
    assert (facts["pace"], facts["recorder"]) == ("lockstep", "r.sock")
    assert facts["fault"] == {
        "kind": "current", "joint": "joint01", "value": 3.0, "limit": 1.4, "since_s": 2.5,
    }  # fmt: skip
    assert facts["feedback"]["most_steps"] == 7
    assert facts["lateness"]["ticks"] == 1
    assert facts["real_time_factor"] == pytest.approx(6500.0)  # of no time at all


def test_what_nobody_counted_is_nothing(report, plan):
    report.wall_s = 0.5
    assert report.facts() == {
        "driven": "wave.mcap", "kind": "commands", "on": plan.address.text, "robot": "chain3",
        "path": "out.mcap", "planned_duration_s": 5.0, "recorder": None, "armed": True,
        "pace": "real time", "outcome": "complete", "why": None, "ended": "the joints are straight",
        "fault": None, "complete": True, "duration_s": 5.0, "approach_s": 1.25, "whole_s": 6.5,
        "ticks": 500, "overruns": 0, "sent": 1500, "received": 4000, "decoded": 3900, "waits": 0,
        "longest_wait_s": 0.0, "malformed": 0, "dropped": 0, "held_s": 0.0, "feedback": None,
        "changed": {}, "lateness": None, "real_time_factor": 13.0, "first_frames": [],
        "gait_told": 0, "gait_not_told": None,
    }  # fmt: skip
    bare = BusReport(plan, COMPLETE, LoopTally(), False, None, 0.0, 0, {}, None)
    assert (bare.wall_s, bare.facts()["real_time_factor"]) == (0.0, 0.0)
    tally = LoopTally()
    assert (tally.loop_s, tally.commanded, tally.untold, tally.late_s) == (0.0, False, 0, [])
    counts = (tally.overruns, tally.sent, tally.received, tally.decoded)
    assert counts == (0, 0, 0, 0)


def test_how_many_steps_may_be_on_their_way():
    asked, unasked = Feedback(True, 0.01, 3, 0.01), Feedback(False, 0.01, 3, 0.01)
    assert (asked.most_steps, unasked.most_steps) == (1, 4)
    assert asked.facts() == {
        "confirmed_by": "replies",
        "reply_interval_s": "0.01",
        "hold_after_ticks": "3",
        "hold_after_s": "0.03",
        "most_steps": "1",
    }
    assert unasked.facts()["confirmed_by"] == "nothing"
