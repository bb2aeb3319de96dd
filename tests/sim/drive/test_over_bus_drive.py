"""Whole drives over a bus, in no time: what the session, the recorder and the report have of them.

In lockstep the robot reports what it was commanded; by the clock it is ArcSnake's joint, asked in
each tick of a clock that the test moves.
"""

import dataclasses
import itertools
import json
from contextlib import contextmanager
from types import SimpleNamespace

import numpy as np
import pytest

from support.arm_limits import ARM_LIMITS
from support.simulated_clock import SimulatedClock
from undulog.capture import Session, load_robot
from undulog.capture.bus.encoding import BusEncoder
from undulog.capture.common.errors import LogWriteError, SourceError, UsageError
from undulog.capture.common.process import StopRequest
from undulog.capture.log.messages.frames import DIR_RX, DIR_TX, empty_frames
from undulog.capture.recorder.status import SessionClock
from undulog.capture.robot.description import parse_robot
from undulog.capture.robot.model import ClockDomain, Direction, Quantity
from undulog.sim.drive import over_bus
from undulog.sim.drive.links import VirtualRobotLink
from undulog.sim.drive.loop import WallPace
from undulog.sim.drive.motion import MotionSource
from undulog.sim.drive.outcome import DriveEnding, FaultKind
from undulog.sim.drive.over_bus import bus_plan, drive_bus
from undulog.sim.drive.session import BusSession
from undulog.sim.gait.contract import GaitTick

SNAKE = load_robot("snake25")
SHIPPED = load_robot("arcsnake-joint")
ARM = parse_robot(SHIPPED.toml + ARM_LIMITS, "arm.toml", dict(SHIPPED.databases))
NS, MS = 1_000_000_000, 1_000_000
EPOCH_NS = 1_735_689_600 * NS  # 2025-01-01, when simulated time begins
ON = "can:socketcand:can0?port=1"


class Ways:
    """A gait: each joint goes up by ``step`` a tick; it turns from one mode to another."""

    names = ("a", "b")

    def __init__(self, count, step=0.002, fails=None):
        self.count, self.rise, self.fails = count, step, fails

    def step(self, time_s, readings):
        del readings
        tick = round(time_s * 100)
        if self.fails is not None and tick == 5:
            raise self.fails
        mode = "walk" if tick < 8 else "turn"
        command = np.full(self.count, self.rise * tick)
        return GaitTick(command, np.array([float(tick), 7.0]), mode, ())


def motion(robot, gait):
    """Something to be driven by the robot."""
    return MotionSource(
        "commands", "wave.mcap", robot, lambda: None, 0.2, (), lambda *_: gait, {}, {}
    )


class Snake(VirtualRobotLink):
    """A virtual robot in lockstep without a connection.

    Attributes:
        tally: Where it counts, as drive_bus has it.
    """

    place, clock, closed = "can:snake", ClockDomain.SIMULATED, 0

    def __init__(self, name="snake25"):
        self.robot_name, self.lockstep = name, True
        self.tick, self.angles, self.tally = -1, np.zeros(25), None
        self.report = BusEncoder(SNAKE, Direction.RX)
        self.keys = [(joint, Quantity.POSITION, "") for joint in SNAKE.joint_names]

    def wait_tick(self, timeout_s):
        del timeout_s
        self.tick += 1
        if self.tick in {4, 9}:  # both in a second: the other one is told at the end
            self.tally.malformed("strange bytes", 2)
        frames = self.report.encode(dict(zip(self.keys, self.angles.tolist(), strict=True)))
        frames["dir"], frames["t_device_ns"] = DIR_RX, self.tick * 10 * MS
        return self.tick, [frames]

    def send(self, frames, earliest_ns=None):
        assert earliest_ns is None  # all ticks are a period apart
        self.angles = np.radians(frames["data"][:, :2].copy().view("<i2")[:, 0] * 0.01)
        return np.full(len(frames), 1, dtype=np.int64)

    def close(self):
        self.closed += 1


class Recorder:
    """What is told to a recorder."""

    dropped = 0

    def __init__(self, path, names):
        self.path, self.names, self.notes, self.values, self.closed = path, names, [], [], 0
        self.taken, self.error = 17, None

    def note(self, text, level="info"):
        self.notes.append((level, text))

    def publish(self, tick, t_ns):
        self.values.append((t_ns, tick.mode, tick.values[0]))

    def close(self):
        self.closed += 1


@pytest.fixture
def stage(tmp_path, monkeypatch):
    """Drive over a link; the path is that of the session."""
    stage = SimpleNamespace(path=tmp_path / "a.mcap", recorders=[], priorities=[])

    @contextmanager
    def raised():
        stage.priorities.append("raised")
        yield SimpleNamespace(refused=stage.refused)
        stage.priorities.append("lowered")

    def recorder(path, names):
        stage.recorders.append(Recorder(path, names))
        return stage.recorders[-1]

    def drive(link, robot, gait, *, duration_s=0.2, recorder=None, stop=None, **more):
        def opened(address, tally):
            assert address.text == ON
            link.tally = tally
            return link

        monkeypatch.setattr(over_bus, "open_link", opened)
        plan = bus_plan(
            motion(robot, gait), ON, stage.path, duration_s=duration_s, recorder=recorder
        )
        return drive_bus(plan, stop=stop or StopRequest(), **more)

    stage.drive, stage.refused = drive, False
    times = iter((100.0, 107.5))
    watch = SimpleNamespace(monotonic=lambda: next(times), time_ns=itertools.count(5).__next__)
    monkeypatch.setattr(over_bus, "time", watch)
    monkeypatch.setattr(over_bus, "raised_priority", raised)
    monkeypatch.setattr(over_bus, "GaitPublisher", recorder)
    return stage


def events_of(session):
    """What was logged: level and text."""
    return [(message.level, message.msg) for _, message in session.messages("/rosout")]


def test_a_drive_in_lockstep_is_told_to_session_recorder_and_screen(stage):
    link, seen, recorder = Snake(), [], stage.path.with_suffix(".sock")
    report = stage.drive(link, SNAKE, Ways(25), recorder=recorder, on_tick=seen.append)
    assert (report.outcome.how, report.lockstep, report.ticks) == (DriveEnding.COMPLETE, True, 21)
    assert (report.approach_s, report.gait_s, report.wall_s) == (0.0, 0.2, 7.5)
    assert (report.malformed, report.dropped, report.jitter, report.feedback) == (4, 0, None, None)
    assert (report.tally.sent, report.tally.received) == (21 * 25, 21 * 25)
    assert report.first_frames == [f"{0x101 + k:03X}#0000" for k in range(25)]
    assert (report.taken, report.not_taken, link.closed) == (17, None, 1)
    assert [tick.tick for tick in seen] == list(range(21))
    assert stage.priorities == []  # it waits for each command
    (publisher,) = stage.recorders
    assert (publisher.path, publisher.names, publisher.closed) == (recorder, ("a", "b"), 1)
    assert publisher.values == [(5 + k, "walk" if k < 8 else "turn", float(k)) for k in range(21)]
    drives = f"drives wave.mcap (commands) on {ON}"
    phases = [f"gate: {phase}" for phase in ("reading the pose", "run", "done")]
    assert publisher.notes == [
        ("info", text) for text in (drives, *phases, "drove wave.mcap for 0.2 s")
    ]
    with Session.open(stage.path) as session:
        assert session.verdict == "degraded"  # some bytes could not be read
        ends = "complete; the servos hold their last commands"
        unread = "messages of the bus that could not be read: 4"
        assert events_of(session) == [
            (20, drives), (20, phases[0]), (20, phases[1]), (30, "strange bytes (2 times)"),
            (20, phases[2]), (20, ends), (30, unread),
        ]  # fmt: skip
        commands = session.joints("/joint_commands").signal("joint07")
        assert (commands.t_ns - EPOCH_NS).tolist() == [10 * MS * k for k in range(21)]
        np.testing.assert_allclose(commands.values, 0.002 * np.arange(21))
        frames = session.frames("/can/can0")
        for way in (DIR_TX, DIR_RX):
            times_ns = frames["t_host_ns"][frames["dir"] == way].astype(np.int64) - EPOCH_NS
            assert times_ns.tolist() == np.repeat(10 * MS * np.arange(21), 25).tolist()
        facts = session.metadata
        assert facts["undulog.gate"]["rate"] == "4.0"
        assert "undulog.gate.jitter" not in facts
        assert "undulog.gate.feedback" not in facts
        assert [message.data for _, message in session.messages("/gait/mode")] == ["walk", "turn"]


def test_samples_that_a_recorder_did_not_take_are_told(stage):
    Recorder.dropped = 3
    try:
        report = stage.drive(Snake(), SNAKE, Ways(25), recorder=stage.path, duration_s=0.01)
    finally:
        Recorder.dropped = 0
    expected = "3 samples: the recorder was too slow"
    assert (report.not_taken, report.taken) == (expected, 17)


def test_a_gait_that_fails_is_the_verdict_and_is_raised(stage):
    link = Snake()
    with pytest.raises(ZeroDivisionError):
        stage.drive(link, SNAKE, Ways(25, fails=ZeroDivisionError()), recorder=stage.path)
    assert (link.closed, stage.recorders[0].closed) == (1, 1)
    assert stage.recorders[0].notes[-1] == ("error", "ZeroDivisionError")  # it has no text
    assert not link.angles.any()  # it came to rest before
    with Session.open(stage.path) as session:
        assert session.verdict == "bad"
        assert events_of(session)[-1] == (40, "ZeroDivisionError")
        reasons = session.metadata["undulog.health"]["reasons"]
        assert json.loads(reasons) == ["ZeroDivisionError"]


def test_a_disk_that_fills_ends_it_by_a_ramp(stage, monkeypatch):
    link, ticks = Snake(), []
    full = property(lambda _: "the disk is full" if len(ticks) > 5 else None)
    monkeypatch.setattr(BusSession, "shortage", full)
    more = {"recorder": stage.path, "on_tick": ticks.append}
    report = stage.drive(link, SNAKE, Ways(25), duration_s=9.0, **more)
    assert (report.outcome.fault.kind, report.outcome.why) == (FaultKind.LOG, "the disk is full")
    assert (report.ticks, link.angles.any()) == (6, False)
    drove = "drove wave.mcap for 0.05 s, the disk is full"
    assert stage.recorders[-1].notes[-1] == ("error", drove)


def test_a_session_that_can_not_be_written_is_raised_with_what_became_of_the_robot(stage):
    def on_tick(tick):
        if tick.tick == 3:
            raise LogWriteError(stage.path, "no space left")

    link = Snake()
    with pytest.raises(LogWriteError) as raised:
        stage.drive(link, SNAKE, Ways(25), on_tick=on_tick)
    untold = link.tick - 3 + 1
    assert str(raised.value) == (
        f"{stage.path}: no space left; the joints were brought straight within 0.22 s; the last "
        f"{untold} control ticks are not in the session"
    )
    assert not link.angles.any()


def test_the_robot_of_another_motion_is_sent_nothing(stage):
    link = Snake("other")
    with pytest.raises(UsageError) as refused:
        stage.drive(link, SNAKE, Ways(25))
    assert str(refused.value) == f"{ON} is other, and wave.mcap is for snake25; nothing was sent"
    assert (link.closed, link.tick, stage.path.exists()) == (1, -1, False)


# -- by the clock -------------------------------------------------------------------------------


class Arm:
    """ArcSnake's joint: it answers the commands and requests of a tick by the next one.

    Attributes:
        held: Times from and to which nothing is received [ns]; what was held up comes then.
    """

    place, clock, closed = "can:arm", ClockDomain.HOST, 0
    robot_name, lockstep = "arcsnake-joint", False

    def __init__(self, time, *, lost_at=None, held=(0, 0)):
        self.time, self.answers, self.sent_ns = time, [], []
        self.lost_at, self.held, self.angle = lost_at, held, np.zeros(4, dtype=np.uint8)

    def receive(self):
        if self.lost_at is not None and len(self.sent_ns) >= self.lost_at:
            raise SourceError(self.place, "the bus is lost")
        if self.held[0] <= self.time.now_ns < self.held[1]:
            return []
        pending, self.answers = self.answers, []
        frames = empty_frames(len(pending))
        frames["id_flags"], frames["dlc"], frames["dir"] = 0x14B, 8, DIR_RX
        if pending:
            stamps, frames["data"] = zip(*pending, strict=True)
            late = self.time.now_ns == self.held[1]
            frames["t_host_ns"] = self.time.clock.wall_ns() if late else stamps
        return [frames] if pending else []

    def send(self, frames, earliest_ns=None):
        times_ns = []
        for k, frame in enumerate(frames):
            if earliest_ns is not None:  # on the session's clock
                ahead_ns = int(earliest_ns[k]) - self.time.clock.wall_ns()
                self.time.pass_s(max(ahead_ns, 0) / NS)
            times_ns.append(self.time.clock.wall_ns())
            if frame["data"][0] == 0xA4:
                self.sent_ns.append(self.time.now_ns)
                self.angle = frame["data"][4:].copy()
            else:
                angle = int(np.frombuffer(self.angle, "<i4")[0])
                answer = [0x92, *angle.to_bytes(7, "little", signed=True)]
                self.answers.append((times_ns[-1], answer))
        return np.array(times_ns, dtype=np.int64)

    def close(self):
        self.closed += 1


class Paced(Arm, VirtualRobotLink):
    """The same, of a virtual robot that keeps to real time."""


@pytest.fixture
def timed(stage, monkeypatch):
    """Drive the arm by a clock that the test moves."""
    time = stage.time = SimulatedClock()
    monkeypatch.setattr(over_bus, "SessionClock", lambda: SessionClock(time.clock))
    monkeypatch.setattr(over_bus, "WallPace", lambda link: WallPace(link, time.clock))
    return stage


def test_by_the_clock_it_listens_first_and_spaces_what_follows_a_late_tick(timed):
    timed.refused, time = True, timed.time
    link, begun_ns = Paced(time), time.now_ns

    def late(tick):
        if tick.tick == 60:
            time.pass_s(0.0157)  # the next one comes 5.7 ms late

    report = timed.drive(link, ARM, Ways(1, step=0.0195), on_tick=late)
    assert (report.outcome.how, report.lockstep) == (DriveEnding.COMPLETE, False)
    assert (report.approach_s, report.gait_s, report.ticks) == (0.5, 0.2, 21)  # LISTEN_S
    assert len(link.sent_ns) == 21
    assert link.sent_ns[0] == begun_ns + 500 * MS
    spans_ms = np.diff(link.sent_ns) / MS
    assert spans_ms[9:14].tolist() == pytest.approx([10, 15.7, 4.875, 9.425, 10])  # at 4 rad/s
    assert (report.waits, report.longest_wait_s) == (1, pytest.approx(0.004875 - 0.0043))
    assert (report.jitter.ticks, report.jitter.worst_s) == (71, pytest.approx(0.0057))
    assert report.held_s == 0.0
    facts = report.feedback.to_dict()
    assert (facts["confirmed_by"], facts["reply_interval_s"]) == ("replies", 0.01)
    assert timed.priorities == ["raised", "lowered"]
    with Session.open(timed.path) as session:
        lowered = [
            text for _, text in events_of(session) if text.startswith("priority was refused: ")
        ]
        assert len(lowered) == 1
        assert session.metadata["undulog.gate.feedback"] == report.feedback.facts()
        assert session.metadata["undulog.gate.jitter"]["ticks"] == "71"
        given = session.joints("/joint_commands").signal("joint01")
        np.testing.assert_allclose(given.values, 0.0195 * np.arange(21), atol=1e-12)
        assert given.t_ns[0] == begun_ns + time.wall_ahead_ns + 500 * MS


def test_what_no_reply_has_confirmed_holds_the_next_command_back(timed):
    """Nothing is received in tick 66; the replies of two ticks come in tick 67."""
    begun_ns = timed.time.now_ns
    link = Arm(timed.time, held=(begun_ns + 660 * MS, begun_ns + 670 * MS))
    report = timed.drive(link, ARM, Ways(1, step=0.039))
    expected = 0.039 * np.arange(21)
    step = 4.0 * 0.01
    expected[16:18] = expected[14] + step  # from where it surely is
    expected[18:] = expected[17] + step * np.arange(1, 4)  # it makes up for that, step by step
    with Session.open(timed.path) as session:
        given = session.joints("/joint_commands").signal("joint01")
        np.testing.assert_allclose(given.values, expected, atol=1e-7)
        assert not any("priority" in text for _, text in events_of(session))
    assert (report.cuts["by_position"], report.cuts["by_rate"]) == (0, 4)
    assert report.cuts["unconfirmed"] in {2, 3}  # a step in 10 ms may round to be late by 1 ns
    assert (report.held_s, report.feedback.by_replies) == (0.0, True)


def test_a_bus_that_is_lost_is_the_outcome(timed):
    link = Arm(timed.time, lost_at=7)
    report = timed.drive(link, ARM, Ways(1))
    assert (report.outcome.fault.kind, report.outcome.why) == (
        FaultKind.BUS,
        "can:arm: the bus is lost",
    )
    assert (report.ticks, link.closed, report.complete) == (7, 1, False)


def test_a_robot_and_a_length_of_ones_own_take_the_place_of_the_motions(tmp_path):
    driven = motion(SNAKE, Ways(25))
    other = dataclasses.replace(SNAKE, name="other")
    plan = bus_plan(driven, ON, tmp_path / "a.mcap")
    assert (plan.robot, plan.duration_s, plan.recorder, plan.force) == (SNAKE, 0.2, None, False)
    assert plan.limits.joint_names == SNAKE.joint_names
    plan = bus_plan(driven, ON, tmp_path / "a.mcap", other, 3.0, recorder=tmp_path, force=True)
    assert (plan.robot.name, plan.duration_s, plan.force) == ("other", 3.0, True)
    assert (plan.recorder, plan.address.text) == (tmp_path, ON)
