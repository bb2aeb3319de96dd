"""Recorded commands, given again at their own times: each joint's by zero-order hold.

The time of the first command is time zero. A joint holds its newest command; before its first one
(a bus gives the joints their commands in turn) it holds that first one, for a jump from straight
joints would be nobody's command. Of a session of the twin every tick finds exactly the command that
was given then, bit by bit.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from dataclasses import dataclass
from typing import Self

import numpy as np

from undulog.capture import Session
from undulog.capture.common.arrays import FloatArray, IntArray
from undulog.capture.common.errors import DataError, JointSetError
from undulog.capture.log.read.signals import JointSignals
from undulog.capture.robot.model import Robot

from ..gait.contract import GaitTick, Readings
from ..scenario.scenario import CONTROL_RATE_HZ

COMMANDS = "/joint_commands"
REPLAY = "replay"
"""The mode of commands whose session names none."""

_NS = 1_000_000_000


class _Held:
    """Values of several names, each by zero-order hold; NaN is a value unless ``known`` only."""

    def __init__(self, signals: JointSignals, *, known: bool = False) -> None:
        self.names = signals.names
        self._series: list[tuple[IntArray, FloatArray]] = []
        for t_ns, values in zip(signals.t_ns, signals.values, strict=True):
            kept = ~np.isnan(values) if known else slice(None)
            self._series.append((t_ns[kept], values[kept]))

    @property
    def given(self) -> bool:
        """Whether there is any value."""
        return any(len(t_ns) for t_ns, _ in self._series)

    def span(self) -> tuple[int, int]:
        """Time of the first and of the last value [Unix ns]."""
        times = [t_ns for t_ns, _ in self._series if len(t_ns)]
        return int(min(t[0] for t in times)), int(max(t[-1] for t in times))

    def at(self, t_ns: int) -> FloatArray:
        """The values in force at a time; NaN of what has none."""
        found = np.full(len(self._series), np.nan)
        for i, (times, values) in enumerate(self._series):
            if len(times):
                k = int(np.searchsorted(times, t_ns, side="right")) - 1
                found[i] = values[max(k, 0)]
        return found


@dataclass(frozen=True)
class RecordedCommands:
    """What a session tells of its commands.

    Attributes:
        commands: Joint angles [rad], of some or all of a robot's joints.
        gait: What the controller meant by them, None where it was not recorded.
        modes: Its modes, with the times from which they were in force [Unix ns], in order.
    """

    commands: JointSignals
    gait: JointSignals | None = None
    modes: tuple[tuple[int, str], ...] = ()

    @classmethod
    def read(cls, session: Session) -> Self:
        """Read a session.

        Args:
            session: Open; it is not needed afterwards.

        Returns:
            Its commands.

        Raises:
            MissingChannelError: If it has none.
        """
        commands = session.joints(COMMANDS)
        gait = session.joints("/gait") if "/gait" in session.channels else None
        told = session.messages("/gait/mode") if "/gait/mode" in session.channels else ()
        return cls(commands, gait, tuple((t_ns, str(message.data)) for t_ns, message in told))


class CommandReplay:
    """The commands of a session as a gait; it does not look at the readings."""

    def __init__(self, recorded: RecordedCommands, robot: Robot) -> None:
        """Wrap recorded commands.

        Args:
            recorded: The commands; joints without one are held straight.
            robot: Who is to do it.

        Raises:
            JointSetError: If the robot lacks one of the joints.
            DataError: If there is no command.
        """
        held = _Held(recorded.commands, known=True)
        strange = [name for name in held.names if name not in robot.joint_names]
        if strange:
            raise JointSetError(
                f"{COMMANDS} has joints that {robot.name} lacks: {', '.join(strange)}; it commands "
                f"{', '.join(held.names)}; {robot.name} has {', '.join(robot.joint_names)}"
            )
        if not held.given:
            raise DataError(f"{COMMANDS} holds no command")
        self._commands = held
        self._joints = [robot.joint_names.index(name) for name in held.names]
        self._joint_names = robot.joint_names
        self._lower, self._upper = robot.limits()
        self._rest = np.clip(np.zeros(len(robot.joints)), self._lower, self._upper)
        self._gait = _Held(recorded.gait) if recorded.gait is not None else None
        self._since_ns = [t_ns for t_ns, _ in recorded.modes]
        self._modes = [REPLAY, *(mode for _, mode in recorded.modes)]
        self._start_ns, self._end_ns = held.span()

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the values: those that the session's controller meant, perhaps none."""
        return self._gait.names if self._gait is not None else ()

    @property
    def duration_s(self) -> float:
        """From the first command to the last, up to a whole control period [s]."""
        periods = (self._end_ns - self._start_ns) * CONTROL_RATE_HZ / _NS
        return max(math.ceil(periods - 1e-6), 1) / CONTROL_RATE_HZ

    def step(self, time_s: float, readings: Readings) -> GaitTick:  # noqa: ARG002 - recorded
        """Say which commands were in force.

        Args:
            time_s: Time since the start [s].
            readings: Not looked at.

        Returns:
            Commands, cut to the joint limits, and what was meant by them.
        """
        t_ns = self._start_ns + round(time_s * _NS)
        wanted = self._rest.copy()
        given = self._commands.at(t_ns)
        wanted[self._joints] = np.where(np.isnan(given), self._rest[self._joints], given)
        command = np.clip(wanted, self._lower, self._upper)
        cut = np.flatnonzero(command != wanted)
        clamped = tuple(self._joint_names[i] for i in cut)
        values = self._gait.at(t_ns) if self._gait is not None else np.empty(0)
        mode = self._modes[bisect_right(self._since_ns, t_ns)]
        return GaitTick(command, values, mode, clamped)
