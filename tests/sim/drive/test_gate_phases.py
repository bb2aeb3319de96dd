"""From phase to phase: when the gate changes, what it says of it, and how it says that it ended."""

import dataclasses
import itertools

import numpy as np
import pytest

from support.gate_bench import COUNT, LIMITS, RATE_HZ, ROBOT, Bench, Wave, fastest
from undulog.capture.common.errors import SourceError
from undulog.capture.robot.model import OnFault
from undulog.sim.drive.gate import Gate
from undulog.sim.drive.outcome import DriveEnding, FaultKind, GateFault, GatePhase, Outcome

STEADY = "the joints were brought straight within 0.2 s"  # they are straight
HALTED = "nothing more was sent; the servos hold their last commands"
NAMES = ROBOT.joint_names


class Still(Wave):
    """A gait that stays in one pose."""

    def __init__(self, *pose):
        super().__init__(0.0)
        self.pose = np.zeros(COUNT)
        self.pose[: len(pose)] = pose

    def at(self, time_s):
        return self.pose


def texts(bench, level=None):
    return [text for kind, text in bench.remarks if level in {None, kind}]


def changes(bench):
    """What it says of its phases."""
    phases = "|".join(GatePhase)
    return [text for text in texts(bench, "info") if text[6:].split(",")[0] in phases]


# -- from the pose to the gait ------------------------------------------------------------------


@pytest.mark.parametrize(
    ("pose", "ramps"),
    [
        ((0.0049,), False),
        ((0.005,), False),
        ((0.0051,), True),
        ((0.0, 0.0051), True),
        ((-0.0049, 0.0049), False),
    ],
)
def test_a_first_pose_within_a_step_of_the_ramp_is_run_at_once(pose, ramps):
    bench = Bench(Still(*pose))
    bench.step()
    assert bench.gate.phase is (GatePhase.APPROACH if ramps else GatePhase.RUN)
    assert bench.gate.run_from == (None if ramps else 0)
    assert bench.gate.run_ticks == (0 if ramps else 1)


def test_the_way_to_the_first_pose_is_told_with_its_longest_joint():
    bench = Bench(Still(0.1, -0.25, 0.2), start=0.05)
    bench.step()
    first, second = texts(bench)
    assert first == "gate: reading the pose"
    assert second == (  # 1.5 x 0.3 rad / 0.5 rad/s
        "gate: approach, 0.9 s to the first pose, joint02 has the longest way, from 0.050 to "
        "-0.250 rad"
    )
    bench.until(GatePhase.RUN)
    assert changes(bench)[2:] == ["gate: run"]
    assert bench.gate.run_from == 89  # the first command is 10 ms on its way
    assert len(bench.sent) == 90


def test_of_a_first_pose_that_is_no_angle_or_beyond_a_limit_the_rest_is_approached():
    pose = np.full(COUNT, 0.1)
    pose[3], pose[4], pose[5] = np.nan, 2.0, -2.0
    bench = Bench(Still(*pose), start=0.02, duration_s=0.1)
    bench.until(GatePhase.RUN)
    expected = np.clip(np.where(np.isnan(pose), 0.02, pose), LIMITS.lower, LIMITS.upper)
    np.testing.assert_allclose(bench.sent[-1], expected, atol=1e-12)


def test_a_robot_in_lockstep_is_not_asked_who_it_is_and_needs_no_interval():
    bench = Bench(Still())
    bench.step(another_robot="somebody else", received=False)
    assert bench.gate.phase is GatePhase.RUN
    assert bench.gate.silence.interval is None


def test_a_bus_that_reports_too_seldom_is_not_driven():
    bench = Bench(Still(), listen_s=0.5)
    for tick in range(200):
        assert bench.step(received=tick in {0, 60, 120, 180}).command is None
    with pytest.raises(SourceError) as refused:
        bench.step(received=False)
    assert str(refused.value) == (
        "can:test: no command was sent: too few reports of joint angles in 2 s to supervise a drive"
    )
    slow = Bench(Still(), listen_s=0.5)
    for tick in range(181):
        assert slow.gate.phase is GatePhase.POSE
        slow.step(received=tick % 45 == 0)
    assert slow.gate.phase is GatePhase.RUN
    assert slow.gate.silence.interval == 45
    assert slow.tick == 181


def test_trouble_beside_the_robot_refuses_too_and_a_stop_ends_it_quietly():
    bench = Bench(listen_s=0.5)
    bench.gate.report(GateFault(FaultKind.LOG, "the disk is full"))
    with pytest.raises(SourceError, match="can:test: no command was sent: the disk is full"):
        bench.step()
    bench = Bench(listen_s=0.5)
    step = bench.step(stop="asked")
    assert (step.phase, step.command, step.requested, step.gait) == (
        GatePhase.DONE,
        None,
        None,
        None,
    )
    assert bench.gate.outcome == Outcome(DriveEnding.STOPPED, "asked", "no command was sent")
    assert bench.gate.done


# -- the run ------------------------------------------------------------------------------------


@pytest.mark.parametrize("duration_s", [0.01, 0.05, 0.29, 0.58])
def test_a_run_has_a_tick_at_either_end_and_says_that_it_is_complete(duration_s):
    bench = Bench(Still(), duration_s=duration_s)
    ticks = round(duration_s * RATE_HZ) + 1
    steps = [bench.step() for _ in range(ticks)]
    assert [step.phase for step in steps] == [GatePhase.RUN] * ticks
    assert bench.gate.done
    assert bench.gate.outcome == Outcome(
        DriveEnding.COMPLETE, "", "the servos hold their last commands"
    )
    assert (bench.gate.run_ticks, bench.gate.run_s) == (ticks, duration_s)
    assert all(step.gait is not None for step in steps)
    after = bench.step()
    assert after.remarks == ()
    assert (after.phase, after.command) == (GatePhase.DONE, None)
    assert texts(bench) == ["gate: reading the pose", "gate: run", "gate: done"]
    assert bench.gate.held_ticks == 0


def test_ticks_that_were_left_out_are_told_with_what_the_gait_lost():
    bench = Bench(Still(0.1), duration_s=60.0)
    bench.step()
    bench.step(skip=1, late_s=0.0123)
    bench.step(skip=7, late_s=0.0755)
    assert texts(bench, "warn") == [
        "gate: 0.012 s late, a control tick was left out",
        "gate: 0.075 s late, 7 control ticks were left out",
    ]
    bench.until(GatePhase.RUN)
    progress = len(bench.sent)
    assert progress == pytest.approx(100 * 1.5 * 0.1 / 0.5, abs=1)  # no jump on the ramp
    bench.step(skip=1, late_s=0.01)
    bench.step()
    bench.step(skip=12, late_s=0.12)
    assert texts(bench, "warn")[2:] == [
        "gate: 0.010 s late, a control tick was left out, 0.01 s of the gait",
        "gate: 0.120 s late, 12 control ticks were left out, 0.12 s of the gait",
    ]
    assert bench.gate.run_s == pytest.approx((bench.tick - 1 - bench.gate.run_from) / RATE_HZ)
    assert bench.gate.run_ticks == len(bench.sent) - progress + 1


def test_a_run_that_skips_its_end_ends_at_its_last_time():
    bench = Bench(Still(), duration_s=0.1)
    bench.step()
    bench.step(skip=15)
    assert (bench.gate.run_s, bench.gate.run_ticks, bench.gate.done) == (0.1, 2, True)
    assert bench.gait.asked == [0.0, 0.1]


def test_what_the_gate_changes_is_told_once_a_joint_and_reason():
    pose = np.zeros(COUNT)
    pose[0], pose[1], pose[3] = 0.6, 0.3, np.nan
    bench = Bench(Still(), duration_s=60.0).running(3)
    bench.gait.pose = pose
    least, most = np.full(COUNT, -1.0), np.full(COUNT, 1.0)
    most[2] = least[2] = 0.0
    pose[2] = 0.03
    for _ in range(4):
        bench.step(bounds=(least, most), current=np.where(np.arange(COUNT) == 4, 1.5, 0.0))
    assert texts(bench, "warn") == [
        "gate: joint01: command cut to the limits of the joint",
        "gate: joint01: command held back to 4 rad/s",
        "gate: joint02: command held back to 4 rad/s",
        "gate: joint03: command held back until a reply confirms those before",
        "gate: joint04: command is no number; the one before is held",
        "gate: joint05: draws more than 1.4 A: its command gives way",
    ]
    assert bench.gate.cuts == {"by_position": 4, "by_rate": 8, "unconfirmed": 4, "not_finite": 4}
    assert Bench().gate.cuts == {}


def test_a_command_that_gives_way_is_sent_and_what_was_wanted_is_told():
    bench = Bench(Still(0.1), duration_s=60.0).running(5)
    step = bench.step(lambda angle: angle.__setitem__(0, 0.06), current=1.5)
    assert step.command[0] == pytest.approx(0.06 + 0.8 * 0.04)
    np.testing.assert_array_equal(step.requested, bench.gait.pose)


# -- faults and stops ---------------------------------------------------------------------------


def test_a_fault_while_it_ends_for_another_reason_is_told_and_changes_nothing():
    bench = Bench(Still(), duration_s=60.0).running(3)
    bench.step(late_s=0.3)
    first = bench.gate.outcome
    why = "a control tick was 0.3 s late, more than 0.2 s"
    assert first.fault == GateFault(FaultKind.LATE, why, "", 0.3, 0.2)
    assert (first.why, first.ended) == (why, STEADY)
    for _ in range(3):
        bench.step(late_s=0.4)
        bench.step(silence_s=1.0)
    assert texts(bench, "error") == [
        f"fault: {why}",
        "fault while ending: the robot is lost: no angle for more than 0.25 s",
    ]
    assert bench.gate.outcome == first
    bench.until(GatePhase.DONE)
    assert changes(bench)[2:] == [f"gate: ending, {why}; ramp-down", "gate: done"]
    assert bench.gate.outcome == first


def test_lateness_at_its_limit_is_borne():
    bench = Bench(Still(), duration_s=60.0).running()
    for late_s in (0.2, 0.1999):
        bench.step(late_s=late_s)
    assert bench.gate.phase is GatePhase.RUN


def test_a_stop_that_becomes_a_fault_is_one():
    bench = Bench(Still(), duration_s=60.0).running(3)
    bench.step(stop="asked")
    assert bench.gate.outcome == Outcome(DriveEnding.STOPPED, "asked", STEADY)
    step = bench.step(stop="asked", trouble=GateFault(FaultKind.BUS_OFF, "bus-off"))
    assert (step.phase, step.command) == (GatePhase.DONE, None)
    fault = GateFault(FaultKind.BUS_OFF, "bus-off")
    assert bench.gate.outcome == Outcome(DriveEnding.FAULT, "bus-off", HALTED, fault)
    assert changes(bench)[-1] == "gate: done, nothing is sent any more"


def test_asked_twice_the_first_outcome_stays_where_it_is_a_fault():
    bench = Bench(Still(), duration_s=60.0).running(3)
    bench.step(late_s=0.5)
    before = bench.gate.outcome
    bench.step(stop="asked", at_once=True)
    assert bench.gate.outcome == dataclasses.replace(before, ended=HALTED)
    other = Bench(Still(), duration_s=60.0).running(3)
    other.step(stop="asked", at_once=True)
    assert other.gate.outcome == Outcome(DriveEnding.STOPPED, "asked, twice", HALTED)


def test_where_the_robots_file_says_so_the_joints_are_held():
    limits = dataclasses.replace(LIMITS, on_fault=OnFault.HOLD)
    bench = Bench(Still(0.1), limits=limits, duration_s=60.0).running(3)
    bench.step(stop="asked")
    assert bench.gate.outcome.ended == "the joints were held where they were"
    count = len(bench.sent)
    bench.until(GatePhase.DONE)
    assert len(bench.sent) - count == 19  # 0.2 s in all
    assert changes(bench)[-2:] == ["gate: ending, asked; hold", "gate: done"]


def test_a_bus_that_is_lost_is_the_outcome_unless_a_fault_was():
    bench = Bench(Still(), duration_s=60.0).running(3)
    bench.gate.lost("the robot is gone")
    gone = GateFault(FaultKind.BUS, "the robot is gone")
    lost = Outcome(DriveEnding.FAULT, "the robot is gone", "nothing more was sent", gone)
    assert (bench.gate.outcome, bench.gate.done) == (lost, True)
    bench = Bench(Still(), duration_s=60.0).running(3)
    bench.step(stop="asked")
    bench.gate.lost("the robot is gone")
    assert bench.gate.outcome == lost
    bench = Bench(Still(), duration_s=60.0).running(3)
    bench.step(late_s=0.5)
    before = bench.gate.outcome
    bench.gate.lost("the robot is gone")
    assert (bench.gate.outcome, bench.gate.done) == (before, True)


def test_a_gait_that_fails_holds_the_command_before_and_is_asked_no_more():
    class Failing(Still):
        def step(self, time_s, readings):
            if len(self.asked) == 3:
                raise KeyError("range")
            return super().step(time_s, readings)

    bench = Bench(Failing(0.004), duration_s=60.0)
    steps = [bench.step() for _ in range(5)]
    assert [step.gait is None for step in steps] == [False] * 3 + [True] * 2
    np.testing.assert_array_equal(steps[3].command, steps[2].command)
    assert (steps[3].phase, steps[4].phase) == (GatePhase.RUN, GatePhase.ENDING)
    why = "the gait failed: KeyError: 'range'"
    assert bench.gate.outcome.fault == GateFault(FaultKind.GAIT, why)
    assert isinstance(bench.gate.gait_error, KeyError)


# -- silence ------------------------------------------------------------------------------------


@pytest.mark.parametrize("at_tick", [60, 75])
def test_silence_is_told_in_ticks_and_seconds_and_held_for_as_long(at_tick):
    bench = Bench(Still(), duration_s=60.0, listen_s=0.5)
    for _ in range(at_tick):
        bench.step()
    sent = [bench.step(received=False).command is not None for _ in range(10)]
    assert sent == [True] * 2 + [False] * 8  # 3 ticks
    fault = bench.gate.outcome.fault
    assert fault.text == (
        "the bus was silent: no joint was received for 3 control ticks (0.03 s), at a reply "
        "interval of 0.01 s"
    )
    assert (fault.kind, fault.joint) == (FaultKind.SILENT, "")
    assert (fault.value, fault.limit) == pytest.approx((0.03, 0.03))
    assert fault.since_s == pytest.approx((at_tick - 1) / RATE_HZ)
    assert changes(bench)[-1] == "gate: hold, nothing is sent until a joint is received"
    assert bench.gate.held_ticks == 8
    bench.step(received=False, skip=5)
    assert bench.gate.held_ticks == 14  # with those that did not take place
    assert bench.step().command is None
    assert texts(bench)[-1] == "gate: a joint was received again"
    assert bench.gate.held_ticks == 15
    assert bench.step().command is not None
    assert bench.gate.phase is GatePhase.ENDING
    ended = f"the servos held for 0.15 s, then {STEADY}"
    assert bench.gate.outcome.ended == ended
    assert changes(bench)[-1] == f"gate: ending, {fault.text}; ramp-down"
    bench.until(GatePhase.DONE)
    assert bench.gate.outcome == Outcome(DriveEnding.FAULT, fault.text, ended, fault)


def test_each_ending_after_a_silence_begins_a_tick_after_the_first_joint():
    bench = Bench(Still(0.2), duration_s=60.0, listen_s=0.5).running(3)
    for _ in range(3):  # the next silence comes while it ends
        sent = [bench.step(received=False).command is not None for _ in range(3)]
        assert sent == [True, True, False]
        assert bench.step().command is None
        assert bench.gate.phase is GatePhase.HOLD
        assert bench.step().command is not None
        assert bench.gate.phase is GatePhase.ENDING
    assert bench.gate.held_ticks == 6


def test_silence_while_it_ends_holds_and_ends_again():
    bench = Bench(Still(0.2), duration_s=60.0, listen_s=0.5).running(3)
    bench.step(stop="asked")
    while bench.gate.phase is GatePhase.ENDING:
        bench.step(received=False, stop="asked")
    assert bench.gate.phase is GatePhase.HOLD
    assert bench.gate.outcome.how is DriveEnding.FAULT
    count = len(bench.sent)
    for _ in range(20):
        bench.step(received=False, stop="asked")
    assert len(bench.sent) == count
    bench.until(GatePhase.DONE, stop="asked")
    np.testing.assert_allclose(bench.sent[-1], 0.0, atol=1e-12)
    assert fastest(bench.sent[count - 1 :]) <= 0.5 / RATE_HZ * (1 + 1e-9)


def test_while_it_holds_other_faults_wait_but_a_lost_bus_or_a_second_stop_ends_it():
    def holding():
        bench = Bench(Still(), duration_s=60.0, listen_s=0.5).running(3)
        for _ in range(5):
            bench.step(received=False)
        assert bench.gate.phase is GatePhase.HOLD
        return bench

    bench = holding()
    silent = bench.gate.outcome
    bench.step(received=False, late_s=3.0)
    assert (bench.gate.phase, bench.gate.outcome) == (GatePhase.HOLD, silent)
    bench.step(received=False, trouble=GateFault(FaultKind.STRANGER, "another one"))
    assert bench.gate.outcome == dataclasses.replace(silent, ended=HALTED)
    assert bench.gate.done
    bench = holding()
    bench.step(received=False, stop="asked")
    assert bench.gate.phase is GatePhase.HOLD
    bench.step(received=False, stop="asked", at_once=True)
    assert bench.gate.outcome == dataclasses.replace(silent, ended=HALTED)
    assert bench.gate.done


def test_a_bus_that_is_silent_for_ten_seconds_is_given_up():
    bench = Bench(Still(), duration_s=60.0, listen_s=0.5).running(3)
    count = next(
        k for k in itertools.count(1) if bench.step(received=False).phase is GatePhase.DONE
    )
    assert count == 1000
    assert bench.gate.held_ticks == 998
    assert bench.gate.outcome.ended == HALTED
    skipping = Bench(Still(), duration_s=60.0, listen_s=0.5).running(3)
    for _ in range(3):
        skipping.step(received=False)
    skipping.step(received=False, skip=995)
    assert skipping.gate.phase is GatePhase.HOLD
    skipping.step(received=False)
    assert skipping.gate.done


def test_a_gate_begins_with_nothing():
    gate = Gate(Wave(), LIMITS, duration_s=1.0, place="can:test")
    assert (gate.phase, gate.done, gate.outcome, gate.gait_error) == (
        GatePhase.POSE,
        False,
        None,
        None,
    )
    assert (gate.run_from, gate.run_ticks, gate.run_s, gate.held_ticks) == (None, 0, 0.0, 0)
