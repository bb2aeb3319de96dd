"""The gate's state machine and its watch, tick by tick, against a robot of closed form."""

import dataclasses

import numpy as np
import pytest

from support.gate_bench import COUNT, LIMITS, RATE_HZ, ROBOT, Bench, Wave, fastest, reading
from undulog.capture import load_robot
from undulog.capture.common.errors import SourceError, UsageError
from undulog.capture.log.messages.frames import DIR_TX, ERROR_FLAG, empty_frames
from undulog.capture.robot.model import OnFault
from undulog.capture.sources.events import BUS_OFF
from undulog.sim.drive.feedback import BusCheck
from undulog.sim.drive.gate import HOLD_S, POSE_S
from undulog.sim.drive.outcome import (
    DriveEnding,
    FaultKind,
    GateFault,
    GatePhase,
    jitter,
)


def test_from_the_pose_by_a_ramp_to_the_first_command_then_the_gait_as_it_is():
    bench = Bench(start=0.1)
    bench.until(GatePhase.DONE)
    assert bench.gate.outcome.how is DriveEnding.COMPLETE
    way = np.abs(bench.gait.at(0.0) - 0.1).max()
    ramp_ticks = int(np.ceil(1.5 * way / 0.5 * RATE_HZ - 1e-9)) - 1
    sent = np.array(bench.sent)
    assert bench.gate.run_from == ramp_ticks
    np.testing.assert_array_equal(
        sent[ramp_ticks:], [bench.gait.at(tick / RATE_HZ) for tick in range(101)]
    )
    assert fastest(sent[: ramp_ticks + 1]) <= 0.5 / RATE_HZ * (1 + 1e-9)
    assert np.abs(sent[0] - 0.1).max() <= 0.5 / RATE_HZ
    assert bench.gait.asked == [tick / RATE_HZ for tick in range(101)]  # once a tick, in order
    assert bench.gate.step(bench.tick, reading(0.0)).command is None


def test_nothing_is_sent_until_every_joint_is_known():
    bench = Bench()

    def unknown(angle):
        angle[[3, 8]] = np.nan

    for _ in range(int(POSE_S * RATE_HZ)):
        assert bench.step(unknown).command is None
    with pytest.raises(SourceError, match="joint04, joint09 reported no angle within 2 s"):
        bench.step(unknown)
    assert bench.sent == []


def test_a_bus_that_has_to_be_listened_to_is():
    bench = Bench(start=0.0, listen_s=0.5)
    assert [bench.step().command is None for _ in range(60)] == [True] * 50 + [False] * 10


@pytest.mark.parametrize(
    ("more", "error"),
    [
        ({"another_robot": "somebody else"}, UsageError),
        ({"trouble": GateFault(FaultKind.STRANGER, "somebody else")}, SourceError),
    ],
)
def test_before_the_first_command_trouble_is_a_refusal(more, error):
    bench = Bench(listen_s=0.01)
    if error is UsageError:
        bench.step(**more)  # it listens
    with pytest.raises(error, match="no command was sent: somebody else"):
        bench.step(**more)
    assert bench.sent == []


def test_a_joint_far_beyond_its_limits_is_not_driven_and_one_a_little_beyond_is_brought_back():
    far = Bench(start=0.9)
    with pytest.raises(SourceError, match=r"joint01 is at 0.900 rad, 0.376 rad beyond its limits"):
        far.step()
    near = Bench(start=0.6)
    near.until(GatePhase.DONE)
    assert np.abs(near.sent).max() <= np.pi / 6


def stuck(angle):
    angle[6] = 0.0


CASES = {
    "tracking": (stuck, {}, "joint07: tracking error 0.4", 0.3),
    "current": (None, {"current": 1.5}, "joint01: current 1.5 A, more than 1.4 A", 0.3),
    "temperature": (None, {"temperature": 71.0}, "joint01: temperature 71 degC, more", 0.3),
    "voltage": (None, {"voltage": 4.5}, "joint01: voltage 4.5 V, less than 5 V", 0.3),
    "lost": (None, {"silence_s": 0.26}, "the robot is lost: no angle for more than 0.25 s", 0.0),
    "late": (None, {"late_s": 0.3}, "a control tick was 0.3 s late, more than 0.2 s", 0.0),
}


@pytest.mark.parametrize("how", list(OnFault))
@pytest.mark.parametrize("kind", CASES)
def test_each_fault_is_found_in_its_time_and_ends_as_the_file_says(kind, how):
    change, more, text, after_s = CASES[kind]
    limits = dataclasses.replace(LIMITS, on_fault=how, voltage=np.full(COUNT, 5.0))
    bench = Bench(Wave(0.5), duration_s=60.0, limits=limits)
    bench.until(GatePhase.RUN)
    while kind == "tracking" and abs(bench.angle[6]) < 0.36:
        bench.step()
    first = bench.tick
    while bench.gate.phase is GatePhase.RUN:
        bench.step(change, **more)
    assert (bench.tick - 1 - first) / RATE_HZ == pytest.approx(after_s, abs=0.0101)
    outcome = bench.gate.outcome
    assert (outcome.fault.kind, outcome.how) == (kind, DriveEnding.FAULT)
    assert outcome.why.startswith(text)
    begun = len(bench.sent)
    while bench.gate.phase is GatePhase.ENDING:
        bench.step(change, **more)
    assert fastest(bench.sent[begun - 2 :]) <= 4.0 / RATE_HZ * (1 + 1e-9)
    assert len(bench.sent) - begun <= (0.53 / 4.0 + 1.5 * 0.53 / 0.5 + 0.21) * RATE_HZ
    if how is OnFault.RAMP_DOWN and kind != "current":
        np.testing.assert_allclose(bench.sent[-1], 0.0, atol=1e-12)
    if how is OnFault.HOLD:
        np.testing.assert_allclose(bench.sent[-1], bench.sent[-5], atol=1e-12)
    assert bench.gate.step(bench.tick, reading(0.0)).command is None  # and nothing after it


def test_an_excess_that_goes_away_in_time_is_no_fault():
    bench = Bench(duration_s=3.0).running()
    remarks = []
    for k in range(280):
        remarks += bench.step(current=1.5 if k % 29 < 28 else 1.0).remarks  # 0.28 s of 0.29 s
    assert bench.gate.phase is GatePhase.RUN
    shown = "gate: {}: draws more than 1.4 A: its command gives way"
    assert {text for _, text in remarks} >= {shown.format(name) for name in ROBOT.joint_names}


@pytest.mark.parametrize("kind", [FaultKind.BUS_OFF, FaultKind.STRANGER])
def test_where_nobody_listens_or_another_commands_nothing_more_is_sent(kind):
    bench = Bench(duration_s=60.0).running()
    count = len(bench.sent)
    assert bench.step(trouble=GateFault(kind, "so")).command is None
    assert (bench.gate.phase, len(bench.sent)) == (GatePhase.DONE, count)
    assert bench.gate.outcome.ended.startswith("nothing more was sent")


def test_a_late_tick_is_caught_up_without_a_jump_and_too_late_a_one_is_a_fault():
    bench = Bench(Wave(0.5, 1.0), duration_s=60.0).running()
    for _ in range(5):
        for _ in range(20):
            bench.step()
        bench.step(skip=19, late_s=0.19)
    assert bench.gate.phase is GatePhase.RUN
    assert bench.gate.cuts["by_rate"] > 0
    assert fastest(bench.sent) <= 4.0 / RATE_HZ * (1 + 1e-9)
    before = bench.sent[-1]
    bench.step(skip=100, late_s=1.0)
    assert bench.gate.phase is GatePhase.ENDING
    assert fastest([before, bench.sent[-1]]) <= 0.5 / RATE_HZ * (1 + 1e-9)


def test_asked_to_stop_it_ends_and_asked_again_at_once():
    bench = Bench(duration_s=60.0).running(50)
    bench.step(stop="asked")
    assert bench.gate.phase is GatePhase.ENDING
    bench.step(stop="asked")
    assert bench.step(stop="asked", at_once=True).command is None
    assert bench.gate.phase is GatePhase.DONE
    outcome = bench.gate.outcome
    assert (outcome.how, outcome.why) == (DriveEnding.STOPPED, "asked, twice")


def test_what_goes_wrong_while_it_ends_is_reported_once_and_ends_nothing_twice():
    bench = Bench(duration_s=60.0).running(50)
    remarks = list(bench.step(stop="asked").remarks)
    while bench.gate.phase is GatePhase.ENDING:
        remarks += bench.step(stop="asked", temperature=99.0).remarks
    logs = [text for level, text in remarks if level == "error"]
    assert logs == ["fault while ending: joint01: temperature 99 degC, more than 70 degC for 0.3 s"]
    assert bench.gate.outcome.how is DriveEnding.STOPPED
    np.testing.assert_allclose(bench.sent[-1], 0.0, atol=1e-12)


def test_while_the_bus_is_silent_nothing_is_sent_and_then_it_ends():
    bench = Bench(duration_s=60.0, listen_s=0.5).running(50)
    sent, last = len(bench.sent), bench.sent[-1]
    steps = [bench.step(received=False) for _ in range(200)]
    assert [step.command is not None for step in steps] == [True] * 2 + [False] * 198
    assert bench.gate.phase is GatePhase.HOLD
    assert np.abs(bench.sent[-1] - last).max() <= 2 * 4.0 / RATE_HZ
    bench.until(GatePhase.DONE)
    np.testing.assert_allclose(bench.sent[-1], 0.0, atol=1e-12)
    assert fastest(bench.sent[sent + 2 :]) <= 0.5 / RATE_HZ
    assert bench.gate.outcome.fault.kind is FaultKind.SILENT
    assert bench.gate.outcome.ended.startswith("the servos held for 2 s, then the joints were ")


def test_a_bus_that_stays_silent_gets_no_ramp():
    bench = Bench(duration_s=60.0, listen_s=0.5).running()
    for k in range(int(HOLD_S * RATE_HZ)):
        bench.step(received=False, silence_s=k / RATE_HZ)
    assert bench.gate.phase is GatePhase.DONE
    assert (bench.gate.outcome.how, bench.gate.outcome.fault.kind) == (DriveEnding.FAULT, "silent")
    assert bench.gate.outcome.ended.startswith("nothing more was sent")


def test_asked_to_stop_before_anything_was_sent_nothing_is():
    bench = Bench(listen_s=1.0)
    bench.step()
    assert bench.step(stop="asked").command is None
    outcome = bench.gate.outcome
    assert (outcome.how, outcome.ended) == (DriveEnding.STOPPED, "no command was sent")


def test_a_gait_that_says_nonsense_moves_nothing():
    class Nonsense(Wave):
        def at(self, time_s):
            return np.full(COUNT, np.nan) if time_s > 0.1 else np.zeros(COUNT)

    bench = Bench(Nonsense(), duration_s=0.3)
    remarks = []
    while bench.gate.phase is not GatePhase.DONE:
        remarks += bench.step().remarks
    assert not np.array(bench.sent).any()
    logs = [text for level, text in remarks if level == "warn"]
    assert logs[0] == "gate: joint01: command is no number; the one before is held"
    assert len(logs) == COUNT  # once a joint


@pytest.mark.parametrize("from_the_gait", [True, False])
def test_a_gait_that_fails_and_a_log_that_can_not_be_written_end_as_a_fault_does(from_the_gait):
    class Failing(Wave):
        def step(self, time_s, readings):
            if from_the_gait and time_s > 0.5:
                raise ZeroDivisionError("no range")
            return super().step(time_s, readings)

    bench = Bench(Failing(), duration_s=60.0).running()
    if not from_the_gait:
        bench.gate.report(GateFault(FaultKind.LOG, "the disk is full"))
    bench.until(GatePhase.DONE)
    np.testing.assert_allclose(bench.sent[-1], 0.0, atol=1e-12)
    assert fastest(bench.sent) <= 4.0 / RATE_HZ
    outcome = bench.gate.outcome
    if from_the_gait:
        assert isinstance(bench.gate.gait_error, ZeroDivisionError)
        assert outcome.why == "the gait failed: ZeroDivisionError: no range"
    else:
        assert (outcome.how, outcome.why) == (DriveEnding.FAULT, "the disk is full")


def frames_of(*identifiers, way=0):
    frames = empty_frames(len(identifiers))
    frames["id_flags"] = identifiers
    frames["dlc"], frames["dir"] = 8, way
    return frames


def test_who_is_on_the_bus():
    presence = BusCheck(ROBOT)
    assert presence.add(frames_of(0x201, 0x202, 0x300)) is None
    assert presence.another_robot() is None
    assert presence.add(frames_of(0x101, way=DIR_TX)) is None  # an echo of our own
    assert "frame 107 was received" in presence.add(frames_of(0x201, 0x107)).text
    assert presence.add(frames_of(ERROR_FLAG | BUS_OFF)).kind is FaultKind.BUS_OFF
    assert presence.add(frames_of(ERROR_FLAG | 0x80)) is None  # a hit frame is repeated
    presence.add(frames_of(*[0x14B] * 7))
    assert "received 4 are of snake25" in presence.another_robot()
    # A request and its reply that share an identifier cannot be separated.
    assert BusCheck(load_robot("arcsnake-joint")).add(frames_of(0x14B)) is None


def test_lateness_is_summed_up_as_numpy_has_it():
    assert jitter([]) is None
    late = np.random.default_rng(3).exponential(2e-3, 5000)
    lateness = jitter(late.tolist())
    assert lateness.median_s == pytest.approx(np.median(late))
    assert (lateness.p99_s, lateness.worst_s) == (
        pytest.approx(np.percentile(late, 99)),
        late.max(),
    )
    assert sum(lateness.counts) == 5000
    assert lateness.counts[3] == ((late > 0.5e-3) & (late <= 1e-3)).sum()
    assert list(lateness.to_dict()["counts"])[3] == "<= 1 ms"
