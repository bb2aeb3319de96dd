"""The virtual robot: the twin, commanded over its bus and reporting there.

At each control tick what the sensors have reported by then is sent first, and then the newest
commands are latched. In lockstep a controller thus closes its loop within the tick, as one in
process does; in real time its answer counts from the next tick on. The frames of a tick go out in
one burst; their device times are the sampling times.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import compress

import numpy as np

from undulog.capture.bus.decoding import BusDecoder
from undulog.capture.common.arrays import NS, BoolArray, FloatArray, frozen
from undulog.capture.common.errors import some_names
from undulog.capture.common.process import StopRequest
from undulog.capture.log.messages.frames import FrameArray
from undulog.capture.robot.model import Direction, Quantity, Robot
from undulog.capture.sources.contract import records

from ..gait.contract import CONTROL_RATE_HZ, GaitTick, Readings
from ..physics.sensing import SensorSample
from ..scenario.bus_faults import BusFault
from ..scenario.scenario import Scenario
from ..twin.recording import quick_collections
from ..twin.twin import Twin
from .pacing import Pacer, PaceTally
from .reply_frames import FaultLine, ReplyEncoder
from .socketcand_protocol import Sent
from .socketcand_server import VirtualBus

WATCHDOG_S = 0.5
"""Time without commands after which a warning is logged [s]; the servo holds its angle."""

_SLACK = 1e-9  # rad; a limit of 30 degrees and 30 degrees from the bus differ in the last bit

PERIOD_NS = NS // CONTROL_RATE_HZ
"""Control period [ns]."""

_BEFORE_NS = 1_000_000  # the last pose that is sent before tick 0
_JUST_BEFORE_NS = 1000  # the one sent after it: times on the bus are rounded to this
_NAMED = 8
_PATIENCE_S = 1.0  # in lockstep, until it is said for whom the robot waits


class CommandLatch:
    """The last command of each servo, which it holds until the next one comes.

    Attributes:
        frames: Frames with at least one command.
        cut: Names of joints that were commanded beyond their limits.
    """

    def __init__(self, robot: Robot) -> None:
        """Start without a command: straight joints, or as near to that as the limits allow.

        Raises:
            DataError: If it has no bus.
        """
        self._decoder = BusDecoder(robot)
        self._names = robot.joint_names
        self._index = {name: i for i, name in enumerate(self._names)}
        self._lower, self._upper = robot.limits()
        self._angle = np.clip(np.zeros(len(robot.joints)), self._lower, self._upper)
        self._time_ns = np.full(len(robot.joints), -1, dtype=np.int64)
        signals = robot.bus.signals if robot.bus is not None else ()
        commanded = {
            signal.target
            for signal in signals
            if signal.quantity is Quantity.COMMAND and signal.direction is Direction.TX
        }
        self.commanded: BoolArray = frozen(np.array([n in commanded for n in robot.joint_names]))
        self.frames = 0
        self.cut: set[str] = set()

    @property
    def angle(self) -> FloatArray:
        """The angles to be reached [rad], shape (m,)."""
        return self._angle.copy()

    def take(self, frames: FrameArray, *, received: bool = True) -> BoolArray:
        """Take frames.

        Args:
            frames: What was sent on the bus, marked as sent by the computer, with device times;
                what carries no command is passed over, shape (n,).
            received: Whether the servos receive them.

        Returns:
            Joints that were commanded, shape (m,).
        """
        commanded = np.zeros(len(self._index), dtype=np.bool_)
        samples, tally = self._decoder.decode(frames)
        self.frames += tally.decoded
        for decoded in samples:
            if decoded.signals[0].quantity is not Quantity.COMMAND:
                continue
            joint = np.array([self._index[signal.target] for signal in decoded.signals])
            joints, values = joint[decoded.member], decoded.values
            finite = ~np.isnan(values)
            joints, values = joints[finite], values[finite]
            commanded[joints] = True
            if received:
                cut = np.clip(values, self._lower[joints], self._upper[joints])
                self.cut |= {self._names[i] for i in joints[np.abs(cut - values) > _SLACK].tolist()}
                self._angle[joints] = cut  # of several commands the last one stays
                self._time_ns[joints] = frames["t_device_ns"][decoded.rows[finite]]
        return commanded

    def silent(self, now_ns: int, longest_ns: int) -> BoolArray:
        """Joints that had commands and have not had one for long.

        Args:
            now_ns: The robot's clock [ns].
            longest_ns: How long a silence may be [ns].

        Returns:
            Shape (m,).
        """
        return (self._time_ns >= 0) & (now_ns - self._time_ns > longest_ns)


class _StoppedError(Exception):
    """A stop was requested while the robot waited."""


@dataclass(frozen=True)
class Served:
    """How a run went.

    Attributes:
        duration_s: Simulated time from the first tick to the last [s].
        complete: Whether it reached its planned end, rather than being stopped.
        start_ns: The robot's clock at the first tick [ns].
        pace: How well it kept up with real time.
        commands: Command frames that the servos took.
        lost: Replies that an ordered fault lost.
        hit: Transmissions that ordered noise hit.
    """

    duration_s: float
    complete: bool
    start_ns: int
    pace: PaceTally
    commands: int
    lost: int
    hit: int


class VirtualRobot:
    """A robot on a bus; as a :class:`.Gait` it hands the bus's commands to the twin."""

    def __init__(
        self,
        scenario: Scenario,
        bus: VirtualBus,
        pacer: Pacer,
        *,
        faults: Sequence[BusFault] = (),
        lockstep: bool = False,
        wait: bool = False,
        log_event: Callable[[str, str], None],
        each_tick: Callable[[], None] = lambda: None,
        stop: StopRequest | None = None,
    ) -> None:
        """Put it on its bus; :meth:`run` brings it to life.

        Args:
            scenario: The twin; its gait is not looked at.
            faults: Faults in addition to those of the scenario.
            lockstep: Wait at each tick until every servo has a command for it.
            wait: Begin with the first command; in lockstep it does so anyway.
            log_event: Called with level and text of an event.
            each_tick: Called once a tick, and while it waits.
            stop: Stops the robot, also while it waits.

        Raises:
            DataError: If the robot has no bus.
        """
        self._scenario, self._bus, self._pacer = scenario, bus, pacer
        self._lockstep, self._wait_for_commands = lockstep, wait
        self._say, self._each_tick = log_event, each_tick
        self._stop = stop or StopRequest()
        robot = self._robot = scenario.robot
        self._replies = ReplyEncoder(robot)
        self._latch = CommandLatch(robot)
        self._rest_angle = self._latch.angle
        self._line = FaultLine((*scenario.faults, *faults), robot, self._replies, scenario.seed)
        self._tick = 0
        self._silent = False
        self._logged_cuts: set[str] = set()
        self._twin: Twin | None = None
        pace = "lockstep" if lockstep else "paced"
        bus.identify(f"virtual-robot {scenario.robot.name} {pace}")
        if made_up := self._replies.made_up:
            log_event("warn", f"reads 0 on the bus, as the twin has none: {', '.join(made_up)}")

    names: tuple[str, ...] = ()
    """No values: what the controller meant is not on the bus."""

    def run(self, ready: Callable[[], None] = lambda: None) -> Served:
        """Run until the scenario ends or a stop is requested.

        Args:
            ready: Called when the twin stands on the ground and the bus can be used.

        Raises:
            SimulationError: If the twin's state becomes impossible.
            UsageError: If the engine cannot hold the robot.
        """
        last = -1
        with Twin(self._scenario, self) as self._twin, quick_collections():
            ready()
            try:
                for sample in self._twin.samples():
                    last = sample.tick
                    if self._stop.requested:
                        break
            except _StoppedError:
                pass
            if last >= 0:
                self._report(self._twin.flush(), last)
        return Served(
            duration_s=max(last, 0) / CONTROL_RATE_HZ,
            complete=last == self._scenario.tick_count - 1,
            start_ns=self._pacer.start_ns,
            pace=self._pacer.tally,
            commands=self._latch.frames,
            lost=self._line.lost,
            hit=self._line.hit,
        )

    def step(self, time_s: float, readings: Readings) -> GaitTick:
        """Wait for the tick, report, and take the newest commands."""
        tick = self._tick
        if not tick:
            # Nothing is sent before it: a controller in lockstep may speak, and knows the pose.
            self._bus.mark(0, self._at_rest(self._pacer.now_ns()))
            self._begin()
        while (wait_s := self._pacer.wait_s(tick)) > 0.0:
            (self._idle if self._lockstep else self._serve)(wait_s)
        if self._twin is not None and tick:
            sent = self._report(self._twin.sensed, tick)
            self._bus.mark(tick, sent if self._lockstep else None)
        if self._lockstep:
            self._listen_to_all(tick)
        else:
            self._serve(0.0)
            self._keep_pace(tick)
            self._watch()
        self._tick += 1
        self._log_cuts()
        command = self._line.command(self._latch.angle, readings.angle, time_s)
        return GaitTick(command, np.empty(0), "bus", ())

    # -- inside ----------------------------------------------------------------------------

    def _begin(self) -> None:
        """Fix when tick 0 is due."""
        if self._lockstep:
            while not self._bus.waiting:
                self._idle(_PATIENCE_S)
            self._pacer.start(self._pacer.now_ns())
        elif self._wait_for_commands:
            due_ns = self._pacer.now_ns()
            while not self._latch.frames:  # until then the servos report their angles
                if (late_ns := self._pacer.now_ns() - due_ns) >= 0:
                    self._bus.send(self._at_rest(self._pacer.now_ns()))
                    due_ns += PERIOD_NS * (1 + late_ns // PERIOD_NS)
                self._serve(max(0.0, (due_ns - self._pacer.now_ns()) / NS))
            # Half a period on, so that a controller of the same rate speaks between the ticks.
            start_ns = self._pacer.now_ns() + PERIOD_NS // 2
            # The first cycle of the servos is sent at tick 2. Their pose before it is sent here and
            # at tick 1: without them the bus would be silent for three control periods.
            while (left_ns := start_ns - _BEFORE_NS - self._pacer.now_ns()) > 0:
                self._serve(left_ns / NS)
            # Before tick 0 also where this process slept past it: times on the bus never go back.
            t_ns = min(self._pacer.now_ns(), start_ns - 2 * _JUST_BEFORE_NS)
            self._bus.send(self._at_rest(t_ns))
            self._pacer.start(start_ns)
        else:
            self._pacer.start(self._pacer.now_ns() + PERIOD_NS)
        self._say("info", f"starts at {self._pacer.start_ns / NS:.6f} s of its own clock")

    def _idle(self, timeout_s: float) -> None:
        """Serve the bus for a moment; frames of clients wait."""
        self._each_tick()
        if self._stop.requested:
            raise _StoppedError
        self._bus.wait(timeout_s)

    def _serve(self, timeout_s: float) -> None:
        """Serve the bus for a moment; commands are latched as they come."""
        self._idle(timeout_s)
        if sent := self._bus.pull():
            frames = self._bus.relay(sent, self._pacer.now_ns())
            self._latch.take(frames, received=self._line.is_receiving(self._tick / CONTROL_RATE_HZ))

    def _listen_to_all(self, tick: int) -> None:
        """Lockstep: take frames until every servo has a command, and no more."""
        receiving = self._line.is_receiving(tick / CONTROL_RATE_HZ)
        missing = self._latch.commanded.copy()
        pulled: list[Sent] = []
        waited_ns, warned = time.monotonic_ns(), False
        while missing.any():
            if fresh := self._bus.pull(int(missing.sum())):
                missing &= ~self._latch.take(records(s.record for s in fresh), received=receiving)
                pulled += fresh
                continue
            self._idle(_PATIENCE_S)
            if not warned and time.monotonic_ns() - waited_ns > _PATIENCE_S * NS:
                self._say("warn", f"waits for commands of {self._listed(missing)}")
                warned = True
        self._keep_pace(tick)
        self._bus.relay(pulled, self._pacer.clock_ns(tick * PERIOD_NS))

    def _keep_pace(self, tick: int) -> None:
        overruns = self._pacer.tally.overruns
        stood_still_s = self._pacer.begin(tick)
        if self._pacer.tally.overruns > overruns and not self._lockstep:
            self._say("warn", "the twin is more than a control period behind real time")
        if stood_still_s:
            why = "commands came late" if self._lockstep else "the twin can't keep up"
            self._say("warn", f"{why}: simulated time stood still, and samples have a gap there")

    def _at_rest(self, t_ns: int) -> FrameArray:
        """Return the servos' frames before tick 0."""
        return self._replies.at_rest(self._rest_angle, t_ns)

    def _report(self, samples: Sequence[SensorSample], tick: int) -> FrameArray:
        """Send the sensor samples of a tick; returns the frames."""
        time_s = tick / CONTROL_RATE_HZ
        frames = self._replies.frames(self._line.samples(samples, time_s), self._pacer.clock_ns)
        if tick == 1 and self._wait_for_commands and not self._lockstep:
            before_ns = self._pacer.start_ns - _JUST_BEFORE_NS
            frames = np.concatenate([self._at_rest(before_ns), frames])
        shown = self._line.replies(frames, self._pacer.clock_ns(tick * PERIOD_NS), time_s)
        self._bus.send(shown)
        return shown

    def _watch(self) -> None:
        """Log when servos get no commands any more."""
        now_ns, longest_ns = self._pacer.now_ns(), round(WATCHDOG_S * NS)
        silent = self._latch.silent(now_ns, longest_ns)
        if bool(silent.any()) is not self._silent:
            self._silent = bool(silent.any())
            if self._silent:
                # Those of one burst are missed together, however late some of it came.
                names = self._listed(self._latch.silent(now_ns, longest_ns // 2))
                self._say("warn", f"no command for {WATCHDOG_S:g} s: {names} hold their angles")
            else:
                self._say("info", "commands are back")

    def _log_cuts(self) -> None:
        for name in sorted(self._latch.cut - self._logged_cuts):
            self._logged_cuts.add(name)
            self._say("warn", f"{name} was commanded beyond its limits, and stops there")

    def _listed(self, chosen: BoolArray) -> str:
        return some_names(list(compress(self._robot.joint_names, chosen)), _NAMED)
