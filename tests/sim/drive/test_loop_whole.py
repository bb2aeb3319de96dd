"""A whole drive on a clock that the test moves, over a bus whose delays and stops are inputs.

What was on the bus is decoded by cantools; the robot is where it was last commanded.
"""

import cantools
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from support.simulated_clock import SimulatedClock
from undulog.capture import load_robot
from undulog.capture.bus.encoding import BusEncoder
from undulog.capture.common.process import StopRequest
from undulog.capture.log.messages.frames import DIR_RX
from undulog.capture.robot.model import ClockDomain, Direction, Quantity
from undulog.sim.drive.feedback import Confirmation
from undulog.sim.drive.gate import Gate
from undulog.sim.drive.limits import Spacing, gate_limits
from undulog.sim.drive.loop import ControlLoop, WallPace
from undulog.sim.drive.outcome import DriveEnding, FaultKind
from undulog.sim.gait.contract import GaitTick

NS, RATE_HZ, REPORT_NS = 1_000_000_000, 100, 10_000_000
ROBOT = load_robot("snake25")
LIMITS = gate_limits(ROBOT)
DATABASE = cantools.database.load_string(dict(ROBOT.databases)["snake25.dbc"], "dbc")
STEP = np.radians(0.01)  # of a command on the bus


class Wave:
    """A gait near the rate limit: 0.5 rad at 1.2 Hz are 3.8 of 4 rad/s."""

    names = ()

    def step(self, time_s, readings):
        del readings
        angles = 0.5 * np.sin(2 * np.pi * 1.2 * time_s + np.arange(len(ROBOT.joints)))
        return GaitTick(angles, np.empty(0), "walk", ())


class Bus:
    """A robot that reports each 10 ms, and its bus.

    Attributes:
        commands: Time [ns], joint and angle [rad] of each command that it took.
        stopped: Times from and to which it reports nothing and takes nothing [ns].
    """

    place, clock = "can:simulated", ClockDomain.HOST

    def __init__(self, time, delay_s=0.0):
        self.time, self.delay_ns = time, round(delay_s * NS)
        self.commands, self.stopped = [], []
        self._encoder = BusEncoder(ROBOT, Direction.RX)
        self._values, self._taken = dict.fromkeys(self._encoder.values, 0.0), 0
        self._reported_ns = time.now_ns

    def receive(self):
        reports = []
        while self._reported_ns + self.delay_ns <= self.time.now_ns:
            at_ns = self._reported_ns
            self._reported_ns += REPORT_NS
            if any(start <= at_ns < stop for start, stop in self.stopped):
                continue
            frames = self._encoder.encode(self._state(at_ns))
            frames["dir"] = DIR_RX
            frames["t_host_ns"] = frames["t_device_ns"] = at_ns + self.delay_ns
            reports.append(frames)
        return reports

    def _state(self, at_ns):
        while self._taken < len(self.commands) and self.commands[self._taken][0] <= at_ns:
            _, joint, angle = self.commands[self._taken]
            self._values[joint, Quantity.POSITION, ""] = angle
            self._taken += 1
        return self._values

    def send(self, frames, earliest_ns=None):
        sent_ns = np.empty(len(frames), dtype=np.int64)
        for k, frame in enumerate(frames):
            if earliest_ns is not None:
                self.time.now_ns = max(self.time.now_ns, int(earliest_ns[k]))
            sent_ns[k] = self.time.now_ns
            message = DATABASE.get_message_by_frame_id(int(frame["id_flags"]))
            values = message.decode(frame["data"][: frame["dlc"]].tobytes())
            joint = message.name.removesuffix("_command")
            self.commands.append((self.time.now_ns, joint, np.radians(values["position"])))
        return sent_ns

    def close(self):
        pass


class Drive:
    """A drive of 1 s; ``late`` has how long a tick takes, by its number [s]."""

    def __init__(self, *, late_s=(), late=None, delay_s=0.0, stopped=()):
        time = SimulatedClock()
        self.bus = Bus(time, delay_s)
        self.bus.stopped = [(time.now_ns + a * NS, time.now_ns + b * NS) for a, b in stopped]
        self.gate = Gate(Wave(), LIMITS, duration_s=1.0, place="can:simulated", listen_s=0.5)
        now_ns = time.clock.monotonic_ns
        self.loop = ControlLoop(
            self.gate,
            ROBOT,
            self.bus,
            WallPace(self.bus, time.clock),
            spacing=Spacing(LIMITS.rate, now_ns),
            confirmation=Confirmation(LIMITS.rate, 1.0 / RATE_HZ, now_ns),
        )
        self.ticks, self.begun_ns = [], time.now_ns
        time.late_s = list(late_s)

        def on_tick(tick):
            self.ticks.append(tick.tick)
            assert time.now_ns - self.begun_ns >= tick.tick * NS // RATE_HZ  # none is early
            time.pass_s((late or {}).get(len(self.ticks), 0.0))

        self.loop.run(StopRequest(), on_tick)
        self.outcome = self.gate.outcome

    def check(self):
        """All on the bus is within the limits, and each tick is accounted for."""
        for joint, lower, upper, rate in zip(
            ROBOT.joint_names, LIMITS.lower, LIMITS.upper, LIMITS.rate, strict=True
        ):
            sent = np.array([(t, angle) for t, name, angle in self.bus.commands if name == joint])
            assert lower - STEP <= sent[:, 1].min() <= sent[:, 1].max() <= upper + STEP
            steps, spans_s = np.abs(np.diff(sent[:, 1])), np.diff(sent[:, 0]) / NS
            assert np.all(steps <= rate * spans_s + STEP)
        assert np.all(np.diff(self.ticks) >= 1)
        assert self.ticks[-1] + 1 == len(self.ticks) + self.loop.tally.overruns


def test_on_time_it_is_complete_and_no_tick_is_left_out():
    drive = Drive()
    drive.check()
    assert drive.outcome.how is DriveEnding.COMPLETE
    assert drive.loop.tally.overruns == 0
    assert max(drive.loop.tally.late_s) == 0.0
    assert drive.gate.run_s == 1.0


@settings(max_examples=3, deadline=None)
@given(late_s=st.lists(st.floats(0.0, 0.19), max_size=80), delay_s=st.sampled_from([0.0, 0.004]))
def test_late_ticks_below_the_limit_are_borne_and_nothing_is_beyond_a_limit(late_s, delay_s):
    drive = Drive(late_s=late_s, delay_s=delay_s)
    drive.check()
    assert drive.outcome.how is DriveEnding.COMPLETE
    assert max(drive.loop.tally.late_s) <= 0.2


@pytest.mark.parametrize("seconds", [0.25, 1.0])
def test_a_tick_later_than_the_limit_ends_the_drive_by_a_ramp(seconds):
    drive = Drive(late={120: seconds})
    drive.check()
    assert drive.outcome.how is DriveEnding.FAULT
    assert drive.outcome.fault.kind is FaultKind.LATE
    last = {joint: angle for _, joint, angle in drive.bus.commands}
    assert np.allclose(list(last.values()), 0.0, atol=STEP)  # the robot's rest


@pytest.mark.parametrize("silent_s", [0.15, 3600.0])
def test_nothing_is_sent_to_a_silent_bus_and_the_drive_ends(silent_s):
    drive = Drive(stopped=[(2.0, 2.0 + silent_s)])
    drive.check()
    assert (drive.outcome.how, drive.outcome.fault.kind) == (DriveEnding.FAULT, FaultKind.SILENT)
    sent_s = (np.unique([t_ns for t_ns, *_ in drive.bus.commands]) - drive.begun_ns) / NS
    assert not np.any((sent_s > 2.04) & (sent_s < 2.0 + silent_s))
    heard_again = silent_s < 1.0
    assert (sent_s.max() > 2.0 + silent_s) == heard_again
    last = {joint: angle for _, joint, angle in drive.bus.commands}
    assert np.allclose(list(last.values()), 0.0, atol=STEP) == heard_again  # by its ramp
