"""The control loop over a bus: read, step the gate, encode, send; once a control period."""

from __future__ import annotations

import os
import select
import signal
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from undulog.capture.bus.encoding import BusEncoder, BusValue, poll_frames
from undulog.capture.common.arrays import NS, FloatArray
from undulog.capture.common.clock import REAL, Clock
from undulog.capture.common.errors import SourceError, UndulogError
from undulog.capture.common.process import StopRequest
from undulog.capture.log.messages.frames import FrameArray, empty_frames
from undulog.capture.robot.model import Direction, Quantity, Robot

from ..gait.contract import CONTROL_RATE_HZ
from .feedback import BusCheck, Confirmation
from .gate import Gate
from .limits import Spacing
from .links import BusLink, BusReadings, VirtualRobotLink
from .outcome import FaultKind, GateFault, GateInput, GatePhase, GateStep

_STREAMS = (0, 1, 2)

LOST_S = 5.0
"""A robot in lockstep that doesn't come to its next tick within this time is lost [s]."""

_WORDS = {
    signal.SIGINT: "stop requested (Ctrl-C)",
    signal.SIGTERM: "stop requested (SIGTERM)",
    signal.SIGHUP: "the console is gone",
}


class ConsoleWatch:
    """Detects that a terminal hung up."""

    def __init__(self) -> None:
        """Look which of the standard streams are terminals."""
        self._terminals = [stream for stream in _STREAMS if os.isatty(stream)]
        self._poll = select.poll()
        for stream in self._terminals:
            self._poll.register(stream, 0)  # a hang-up is told in any case

    def gone(self) -> bool:
        """Whether the terminal is gone; once it is, nothing is written to it any more."""
        if not self._poll.poll(0):
            return False
        nowhere = os.open(os.devnull, os.O_RDWR)
        for stream in self._terminals:
            self._poll.unregister(stream)
            os.dup2(nowhere, stream)
        os.close(nowhere)
        self._terminals = []
        return True


class WallPace:
    """Ticks of the computer's monotonic clock, anchored at the first one.

    Attributes:
        overruns: Ticks that were left out because the one before took too long.
        late_s: How late the newest tick is, against the first one that had not been taken [s].
    """

    by_the_clock = True
    """Whether the clock sets the pace, rather than the robot."""

    def __init__(self, link: BusLink, clock: Clock = REAL) -> None:
        """The first tick is at once."""
        self._clock = clock
        self.overruns = 0
        self.late_s = 0.0
        self._link, self._period_ns = link, NS // CONTROL_RATE_HZ
        self._tick = -1
        self._start_ns = 0

    def next(self) -> tuple[int, Sequence[FrameArray]]:
        """Wait for the next tick; those that are over by then are left out.

        Returns:
            Its number, and the frames that have come by it.

        Raises:
            SourceError: If the bus is lost.
        """
        now_ns = self._clock.monotonic_ns()
        if self._tick < 0:
            self._tick, self._start_ns = 0, now_ns
            return 0, self._link.receive()
        due_ns = self._start_ns + (self._tick + 1) * self._period_ns
        while now_ns < due_ns:
            self._clock.sleep((due_ns - now_ns) * 1e-9)
            now_ns = self._clock.monotonic_ns()
        # Also where the process was stopped while it slept: what is over is left out.
        left_out = (now_ns - due_ns) // self._period_ns
        self.overruns += left_out
        self._tick += 1 + left_out
        self.late_s = (now_ns - due_ns) * 1e-9
        return self._tick, self._link.receive()


class LockstepPace:
    """The ticks of a robot that waits for the commands of each: none is late."""

    by_the_clock = False
    overruns = 0
    late_s = 0.0

    def __init__(self, link: VirtualRobotLink) -> None:
        """Take the robot's next tick as tick 0."""
        self._link = link
        self._first: int | None = None

    def next(self) -> tuple[int, Sequence[FrameArray]]:
        """Wait for the robot's next tick.

        Returns:
            Its number, and the frames that came by it.

        Raises:
            SourceError: If the robot is gone, or does not come to it.
        """
        received = self._link.wait_tick(LOST_S)
        if received is None:
            raise SourceError(
                self._link.place, f"the robot is lost: no control tick for {LOST_S:g} s"
            )
        tick, frames = received
        if self._first is None:
            self._first = tick
        return tick - self._first, frames


def stop_reason(stop: StopRequest, *, console_gone: bool) -> str:
    """Why it is to stop.

    Args:
        console_gone: Whether the terminal hung up.

    Returns:
        A few words; empty if it is not to stop.
    """
    if stop.signal is not None:
        return _WORDS.get(stop.signal, f"stop requested ({stop.signal.name})")
    return _WORDS[signal.SIGHUP] if console_gone else ""


class BusTick(NamedTuple):
    """One tick of the loop.

    Attributes:
        tick: Its number, from 0.
        step: What the gate had done.
        received: Frames that came by then.
        sent: What was sent: commands, then requests; ``t_host_ns`` is when the bus had them.
    """

    tick: int
    step: GateStep
    received: Sequence[FrameArray]
    sent: FrameArray

    @property
    def time_s(self) -> float:
        """Time since the first tick [s]."""
        return self.tick / CONTROL_RATE_HZ


@dataclass
class LoopTally:
    """How a loop went.

    Attributes:
        loop_s: Time of the last tick, from the first [s].
        overruns: Ticks left out because the one before took too long.
        commanded: Whether a command was among them.
        untold: Ticks that could not be written to the session.
        decoded: Frames of these with something that the robot's map names.
        late_s: How late each tick was [s], where the clock sets the pace.
    """

    loop_s: float = 0.0
    overruns: int = 0
    sent: int = 0
    commanded: bool = False
    untold: int = 0
    received: int = 0
    decoded: int = 0
    late_s: list[float] = field(default_factory=list[float])


class CommandEncoder:
    """Commands as frames of a robot's bus."""

    def __init__(self, robot: Robot) -> None:
        """Compile.

        Raises:
            DataError: If it has no bus, or takes commands in frames that can't be sent.
        """
        self._encoder = BusEncoder(robot, Direction.TX)
        self._keys: list[BusValue] = [(name, Quantity.COMMAND, "") for name in robot.joint_names]

    def frames(self, command: FloatArray) -> FrameArray:
        """The frames of one tick.

        Args:
            command: Joint angles [rad], shape (m,).

        Returns:
            Records of :data:`.capture.log.messages.frames.FRAME_DTYPE`, without times.
        """
        return self._encoder.encode(dict(zip(self._keys, command.tolist(), strict=True)))


class ControlLoop:
    """One drive: a gate between a gait and a bus."""

    def __init__(
        self,
        gate: Gate,
        robot: Robot,
        link: BusLink,
        pace: WallPace | LockstepPace,
        *,
        spacing: Spacing | None,
        confirmation: Confirmation | None,
    ) -> None:
        """Put it together.

        Args:
            gate: Decides what is sent.
            spacing: How closely commands may follow each other; None where the robot sets the
                pace, and all ticks are a period apart.
            confirmation: Commands confirmed by replies; None where the robot sets the pace.

        Raises:
            DataError: If the robot has no bus.
        """
        self.tally = LoopTally()
        self._gate, self._link, self._pace, self._spacing = gate, link, pace, spacing
        self._encoder, self._readings = CommandEncoder(robot), BusReadings(robot)
        self._presence = BusCheck(robot)
        self._polls = poll_frames(robot)
        self._confirmation = confirmation if len(self._polls) else None
        timeout_s = robot.safety.reply_timeout_s if robot.safety is not None else None
        self._longest_pause = int((timeout_s or 0.0) * CONTROL_RATE_HZ / 3)

    @property
    def by_replies(self) -> bool:
        """Whether commands are confirmed by replies to requests."""
        return self._confirmation is not None and self._confirmation.by_replies

    def run(
        self,
        stop: StopRequest,
        on_tick: Callable[[BusTick], None],
        console: ConsoleWatch | None = None,
    ) -> None:
        """Run until the gate is done; a bus that is lost after the first command is its fault.

        A gait that fails, or a session that can't be written, ends the drive as a fault does, and
        what it raised is raised again when the robot is at rest.

        Args:
            stop: Looked at in each tick.
            on_tick: Called with each tick after the commands are sent.
            console: The terminal whose loss ends the drive, if it has one.

        Raises:
            SourceError: If the bus is lost, or the robot isn't there, before anything was sent.
            UsageError: If another robot is there.
            LogWriteError: If the session can't be written.
            Exception: What the gait raised.
        """
        gone = False
        unwritten: UndulogError | None = None
        while self._gate.phase is not GatePhase.DONE:
            try:
                tick, received = self._pace.next()
                inputs = self._receive(tick, received)
                gone = gone or (console is not None and console.gone())
                step = self._gate.step(
                    tick, inputs, stop_reason(stop, console_gone=gone), at_once=stop.again
                )
                sent = self._send(step, inputs)
            except SourceError as error:
                if not self.tally.commanded:
                    raise
                self._gate.lost(str(error))
                return
            self.tally.loop_s, self.tally.overruns = tick / CONTROL_RATE_HZ, self._pace.overruns
            if unwritten is None:
                try:
                    on_tick(BusTick(tick, step, received, sent))
                except UndulogError as error:
                    if not self.tally.commanded:
                        raise
                    unwritten = error
                    self._gate.report(GateFault(FaultKind.LOG, str(error)))
            self.tally.untold += unwritten is not None
        if failed := unwritten or self._gate.gait_error:
            raise failed

    def _receive(self, tick: int, received: Sequence[FrameArray]) -> GateInput:
        time_s, trouble, before = tick / CONTROL_RATE_HZ, None, self._readings.angles.copy()
        for frames in received:
            self._readings.add(frames, time_s)
            trouble = trouble or self._presence.add(frames)
            self.tally.received += len(frames)
        self.tally.decoded = self._readings.tally.decoded
        if self._pace.by_the_clock:
            self.tally.late_s.append(self._pace.late_s)
        fresh, bounds = self._readings.angles - before, None
        if self._confirmation is not None:
            last_ns = max((int(frames["t_host_ns"][-1]) for frames in received), default=0)
            self._confirmation.receive(fresh, last_ns)
            bounds = self._confirmation.bounds()
        return GateInput(
            readings=self._readings.readings(time_s),
            status=self._readings.status(time_s),
            trouble=trouble,
            another_robot=self._presence.another_robot(),
            late_s=self._pace.late_s,
            received=bool(fresh.any()),
            expected=self._confirmation is None or not self._confirmation.pausing,
            bounds=bounds,
        )

    def _send(self, step: GateStep, inputs: GateInput) -> FrameArray:
        """Send the commands, then the requests where the robot reports only on request.

        The requests follow the commands, so that a reply confirms these.
        """
        if self._gate.phase is GatePhase.DONE and step.command is None:
            return empty_frames(0)
        frames, earliest_ns = empty_frames(0), None
        if step.command is not None:
            frames = self._encoder.frames(step.command)
            if self._spacing is not None:
                earliest_ns = self._spacing.earliest_ns(step.command, len(frames))
            if self._confirmation is not None:
                if not self.tally.commanded:
                    silence = self._gate.silence
                    self._confirmation.arm(
                        silence.interval or 1, silence.limit, self._longest_pause
                    )
                self._confirmation.send(step.command, inputs.status.angle)
            self.tally.commanded = True
        commands = len(frames)
        if self._confirmation is None or self._confirmation.ask():
            frames = np.concatenate([frames, self._polls])
        if not len(frames):
            return frames
        if earliest_ns is not None:
            earliest_ns = np.pad(earliest_ns, (0, len(frames) - commands))
        sent_ns = self._link.send(frames, earliest_ns)
        self.tally.sent += len(frames)
        if step.command is not None and self._spacing is not None:
            self._spacing.sent(step.command, sent_ns[:commands])
        stamped = frames.copy()
        stamped["t_host_ns"] = sent_ns
        return stamped
