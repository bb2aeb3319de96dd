"""The control loop over a bus that answers requests, on a clock that the test moves.

The servo is ArcSnake's RMD-X8, written from its manual: 0x92 asks for the angle, 0xA4 commands it.
"""

import os
import pty
import signal
import struct
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from support.arm_limits import ARM_LIMITS
from support.simulated_clock import SimulatedClock
from undulog.capture import load_robot
from undulog.capture.common.errors import LogWriteError, SourceError
from undulog.capture.common.process import StopRequest
from undulog.capture.log.messages.frames import DIR_RX, ERROR_FLAG, empty_frames
from undulog.capture.robot.description import parse_robot
from undulog.capture.sources.events import BUS_OFF
from undulog.sim.drive.feedback import Confirmation
from undulog.sim.drive.gate import Gate
from undulog.sim.drive.limits import Spacing, gate_limits
from undulog.sim.drive.loop import BusTick, ConsoleWatch, ControlLoop, WallPace, stop_reason
from undulog.sim.drive.outcome import DriveEnding, FaultKind
from undulog.sim.gait.contract import GaitTick

SHIPPED = load_robot("arcsnake-joint")
ROBOT = parse_robot(SHIPPED.toml + ARM_LIMITS, "arm.toml", dict(SHIPPED.databases))
LIMITS = gate_limits(ROBOT)
ADDRESS, PERIOD_NS = 0x14B, 10_000_000


class Servo:
    """One motor and its bus: what is sent is answered by the next tick.

    Attributes:
        taken: Each message: time [ns], first byte.
        silent: Times from and to which it answers nothing [ns].
    """

    place = "can:arm"

    def __init__(self, time, silent=(0, 0)):
        self.time, self.silent = time, silent
        self.degrees, self.taken, self.answers, self.earliest = 0.0, [], [], []
        self.lost_after = None

    def receive(self):
        if self.lost_after is not None and len(self.taken) >= self.lost_after:
            raise SourceError(self.place, "the bus is lost")
        pending, self.answers = self.answers, []
        if not pending:
            return []
        frames = empty_frames(len(pending))
        frames["id_flags"], frames["dlc"], frames["dir"] = ADDRESS, 8, DIR_RX
        frames["t_host_ns"] = self.time.now_ns
        frames["data"] = [list(data) for data in pending]
        return [frames]

    def send(self, frames, earliest_ns=None):
        self.earliest.append(None if earliest_ns is None else earliest_ns.tolist())
        for frame in frames:
            data = bytes(frame["data"])
            self.taken.append((self.time.now_ns, data[0]))
            reply = bytes([0x92]) + round(self.degrees * 100).to_bytes(7, "little", signed=True)
            if data[0] == 0xA4:
                self.degrees = struct.unpack("<i", data[4:])[0] / 100
                reply = struct.pack("<BbhhH", 0xA4, 30, 10, 0, 0)
            if not self.silent[0] <= self.time.now_ns < self.silent[1]:
                self.answers.append(reply)
            self.time.pass_s(1e-6)
        return np.full(len(frames), self.time.now_ns - 1000, dtype=np.int64)


class Noted(Confirmation):
    """What it was armed with."""

    armed = None

    def arm(self, *measured):
        self.armed = measured
        super().arm(*measured)


class Swing:
    names = ()

    def step(self, time_s, readings):
        self.readings = readings
        return GaitTick(np.array([0.2 * np.sin(5.0 * time_s)]), np.empty(0), "walk", ())


def drive(
    *, silent_s=(0.0, 0.0), duration_s=0.5, on_tick=None, stop=None, lost_after=None,
    unasked_at=None, listen_s=0.5, **more,
):  # fmt: skip
    """Drive the servo; returns loop, gate, servo, and ticks."""
    time, ticks = SimulatedClock(), []
    servo = Servo(time, [time.now_ns + round(at_s * 1e9) for at_s in silent_s])
    servo.lost_after = lost_after
    gate = Gate(Swing(), LIMITS, duration_s=duration_s, place=servo.place, listen_s=listen_s)
    now_ns = time.clock.monotonic_ns
    loop = ControlLoop(
        gate,
        ROBOT,
        servo,
        WallPace(servo, time.clock),
        spacing=Spacing(LIMITS.rate, now_ns),
        confirmation=Noted(LIMITS.rate, 0.01, now_ns),
    )
    begun_ns = time.now_ns

    def note_tick(tick):
        ticks.append(tick)
        if tick.tick == unasked_at:
            servo.answers += servo.answers[-1:]
        if on_tick is not None:
            on_tick(tick)

    namespace = SimpleNamespace(loop=loop, gate=gate, servo=servo, ticks=ticks, begun_ns=begun_ns)
    try:
        loop.run(stop or StopRequest(), note_tick, **more)
    except (SourceError, LogWriteError) as error:  # the tests look at both
        namespace.error = error
    return namespace


def test_it_asks_in_each_tick_and_commands_before_it_asks():
    run = drive()
    assert run.gate.outcome.how is DriveEnding.COMPLETE
    words = {}
    for at_ns, word in run.servo.taken:
        words.setdefault((at_ns - run.begun_ns) // PERIOD_NS, []).append(word)
    assert words == {k: [0x92] if k < 50 else [0xA4, 0x92] for k in range(101)}
    tally = run.loop.tally
    assert (tally.sent, tally.received, tally.decoded) == (152, 150, 150)
    assert (tally.commanded, tally.untold, tally.overruns) == (True, 0, 0)
    assert tally.loop_s == 1.0
    assert tally.late_s == [0.0] * 101
    assert run.loop.by_replies
    assert run.loop._confirmation.armed == (1, 3, 8)  # a third of 0.25 s
    assert run.servo.earliest[:51] == [None] * 50 + [[0, 0]]
    for earliest in run.servo.earliest[51:]:
        assert earliest[0] > run.begun_ns
        assert earliest[1] == 0  # requests wait for nothing
    assert [len(tick.sent) for tick in run.ticks] == [1] * 50 + [2] * 51
    stamps = [tick.sent["t_host_ns"].tolist() for tick in run.ticks]
    assert all(set(stamp) == {stamp[0]} for stamp in stamps)
    assert np.all(np.diff([stamp[0] for stamp in stamps]) > 0)
    assert [tick.tick for tick in run.ticks] == list(range(101))
    assert run.ticks[7].time_s == 0.07
    assert not run.ticks[0].received
    assert len(run.ticks[60].received[0]) == 2
    assert len(run.gate._gait.readings.angle) == 1


def test_where_nothing_was_measured_a_reply_is_expected_in_each_tick():
    run = drive(listen_s=0.0)
    assert run.loop._confirmation.armed == (1, 3, 8)
    assert (run.gate.run_from, run.gate.outcome.how) == (1, DriveEnding.COMPLETE)


def test_the_servo_is_where_it_was_commanded_to_be():
    run = drive()
    given = [tick.step.command[0] for tick in run.ticks if tick.step.command is not None]
    np.testing.assert_allclose(given, 0.2 * np.sin(5.0 * np.arange(51) / 100), atol=1e-12)
    assert run.servo.degrees == pytest.approx(np.degrees(given[-1]), abs=0.006)
    assert run.gate.cuts == dict.fromkeys(run.gate.cuts, 0)


def test_a_servo_that_stops_answering_is_asked_but_not_commanded():
    run = drive(silent_s=(0.8, 3600.0), duration_s=60.0)
    assert run.gate.outcome.fault.kind is FaultKind.SILENT
    after_ms = [
        (round((at_ns - run.begun_ns) / 1e6), word)
        for at_ns, word in run.servo.taken
        if at_ns >= run.begun_ns + 0.8e9
    ]
    commands = [at_ms for at_ms, word in after_ms if word == 0xA4]
    requests = [at_ms for at_ms, word in after_ms if word == 0x92]
    assert commands == [800, 810, 820]
    assert requests[:6] == [800, 810, 830, 870, 950, 1110]  # less and less often
    assert np.diff(requests).max() == 500
    assert run.loop.tally.late_s == [0.0] * len(run.ticks)


def test_a_reply_that_is_lost_makes_requests_pause_and_is_no_silence():
    run = drive(silent_s=(0.6, 0.605))
    assert run.gate.outcome.how is DriveEnding.COMPLETE
    assert (run.gate.held_ticks, run.loop.by_replies) == (0, True)
    asked = {(at_ns - run.begun_ns) // PERIOD_NS for at_ns, word in run.servo.taken if word == 0x92}
    # Sixteen rounds later it is clear; in twice three ticks no reply is late any more.
    assert set(range(101)) - asked == set(range(77, 83))


def test_joints_that_report_unasked_confirm_nothing_by_replies():
    run = drive(unasked_at=70)
    assert run.loop.by_replies is False
    assert run.gate.outcome.how is DriveEnding.COMPLETE


@pytest.mark.parametrize("first", [True, False])
def test_trouble_on_the_bus_is_found_in_whatever_came(first):
    error, usual = (empty_frames(1) for _ in range(2))
    error["id_flags"], usual["id_flags"] = ERROR_FLAG | BUS_OFF, 0x7FF
    time = SimulatedClock()

    class Bus:
        place = "can:bus"

        def receive(self):
            return [error, usual] if first else [usual, error]

    gate = Gate(Swing(), LIMITS, duration_s=0.5, place="can:bus", listen_s=0.5)
    pace = WallPace(Bus(), time.clock)
    loop = ControlLoop(gate, ROBOT, Bus(), pace, spacing=None, confirmation=None)
    assert loop.by_replies is False
    with pytest.raises(SourceError, match="can:bus: no command was sent: bus-off: "):
        loop.run(StopRequest(), list)
    assert loop.tally.received == 2


def test_what_the_bus_loses_before_the_first_command_is_raised_and_later_the_outcome():
    early = drive(lost_after=20)
    assert isinstance(early.error, SourceError)
    assert early.gate.outcome is None
    late = drive(lost_after=80)
    assert not hasattr(late, "error")
    assert (late.gate.outcome.how, late.gate.outcome.why) == (
        DriveEnding.FAULT,
        "can:arm: the bus is lost",
    )


@pytest.mark.parametrize(("at_tick", "untold"), [(10, 0), (60, None)])
def test_a_session_that_can_not_be_written_ends_it_as_a_fault_does(at_tick, untold):
    def full(tick):
        if tick.tick == at_tick:
            raise LogWriteError("a.mcap", "no space left")

    run = drive(on_tick=full, duration_s=60.0)
    assert isinstance(run.error, LogWriteError)
    if untold == 0:  # nothing was sent
        assert (run.gate.outcome, run.loop.tally.untold) == (None, 0)
        return
    assert run.gate.outcome.fault.kind is FaultKind.LOG
    assert run.gate.outcome.why.endswith("no space left")
    assert run.ticks[-1].tick == at_tick  # it isn't tried again
    assert run.loop.tally.untold == round(run.loop.tally.loop_s * 100) - at_tick + 1
    assert run.servo.degrees == pytest.approx(0.0, abs=0.006)


def test_a_console_that_is_gone_stops_it_once_and_for_all():
    seen = iter([False] * 60 + [True])  # it isn't asked again
    console = SimpleNamespace(gone=lambda: next(seen))
    run = drive(console=console, duration_s=60.0)
    assert (run.gate.outcome.how, run.gate.outcome.why) == (
        DriveEnding.STOPPED,
        "the console is gone",
    )
    assert next(seen, None) is None
    phases = [str(tick.step.phase) for tick in run.ticks]
    assert phases.index("ending") == 60


@pytest.mark.parametrize(
    ("number", "gone", "words"),
    [
        (None, False, ""),
        (None, True, "the console is gone"),
        (signal.SIGINT, True, "stop requested (Ctrl-C)"),
        (signal.SIGTERM, False, "stop requested (SIGTERM)"),
        (signal.SIGHUP, False, "the console is gone"),
        (signal.SIGUSR1, False, "stop requested (SIGUSR1)"),
    ],
)
def test_why_it_is_to_stop(number, gone, words):
    stop = StopRequest()
    stop.signal = number
    assert stop_reason(stop, console_gone=gone) == words
    assert BusTick(250, None, (), None).time_s == 2.5


def test_a_stop_that_is_requested_again_ends_it_at_once():
    stop = StopRequest()

    def ask(tick):
        if tick.tick == 60:
            stop.signal = signal.SIGINT
        stop.again = tick.tick >= 63

    run = drive(stop=stop, on_tick=ask, duration_s=60.0)
    assert run.gate.outcome.why == "stop requested (Ctrl-C), twice"
    assert run.ticks[-1].tick == 64
    assert len(run.ticks[-1].sent) == 0
    assert run.servo.taken[-1][0] < run.begun_ns + 64 * PERIOD_NS


def test_a_terminal_is_looked_for_at_all_standard_streams(monkeypatch):
    asked = []
    monkeypatch.setattr("undulog.sim.drive.loop.os.isatty", asked.append)
    assert not ConsoleWatch().gone()
    assert asked == [0, 1, 2]


def test_a_terminal_that_hangs_up_is_gone_and_its_streams_lead_nowhere(monkeypatch):
    master, slave = pty.openpty()
    plain, other = os.pipe()
    streams = (plain, slave, os.dup(slave))
    monkeypatch.setattr("undulog.sim.drive.loop._STREAMS", streams)
    try:
        console = ConsoleWatch()
        assert not console.gone()
        os.close(master)
        assert console.gone()
        for stream in streams[1:]:
            assert os.path.samestat(os.fstat(stream), Path(os.devnull).stat())
            os.write(stream, b"no error")
        assert not os.path.samestat(os.fstat(plain), Path(os.devnull).stat())
        assert not console.gone()  # nothing is left to look at
    finally:
        for stream in (*streams, other):
            os.close(stream)
