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
from undulog.capture.common.arrays import NS, FloatArray, IntArray
from undulog.capture.common.errors import DataError, JointSetError, MissingChannelError
from undulog.capture.log.read.sample_times import JointSignals
from undulog.capture.robot.model import Robot

from ..gait.contract import CONTROL_RATE_HZ, GaitTick, Readings

COMMANDS = "/joint_commands"
REPLAY = "replay"
"""The mode of commands whose session names none."""


class _Held:
    """Values of several names, each by zero-order hold; NaN is a value unless ``finite_only``."""

    def __init__(self, signals: JointSignals, *, finite_only: bool = False) -> None:
        self.names = signals.names
        self._series: list[tuple[IntArray, FloatArray]] = []
        for t_ns, values in zip(signals.t_ns, signals.values, strict=True):
            kept = ~np.isnan(values) if finite_only else slice(None)
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
        result = np.full(len(self._series), np.nan)
        for i, (times, values) in enumerate(self._series):
            if len(times):
                k = int(np.searchsorted(times, t_ns, side="right")) - 1
                result[i] = values[max(k, 0)]
        return result

    def means(self, edges_ns: IntArray) -> FloatArray:
        """Time means of the values in force; NaN of what has none.

        Args:
            edges_ns: Ends of k intervals, one after the other [Unix ns], shape (k + 1,).

        Returns:
            Shape (k, names).
        """
        means = np.full((len(edges_ns) - 1, len(self._series)), np.nan)
        for i, (times, values) in enumerate(self._series):
            if not len(times):
                continue
            newest = np.searchsorted(times, edges_ns[:-1], side="right") - 1
            means[:, i] = values[np.maximum(newest, 0)]
            # A value that comes within an interval counts for the rest of it.
            interval = np.searchsorted(edges_ns, times, side="right") - 1
            within = (interval >= 0) & (interval < len(means))
            within[within] = times[within] > edges_ns[interval[within]]
            k, t_ns = interval[within], times[within]
            share = (edges_ns[k + 1] - t_ns) / (edges_ns[k + 1] - edges_ns[k])
            np.add.at(means[:, i], k, share * np.diff(values, prepend=values[:1])[within])
        return means


@dataclass(frozen=True)
class RecordedCommands:
    """The commands of a session.

    Attributes:
        commands: Joint angles [rad], of some or all of a robot's joints.
        gait: The values of the gait, None where they were not recorded.
        modes: Its modes, with the times from which they were in force [Unix ns], in order.
    """

    commands: JointSignals
    gait: JointSignals | None = None
    modes: tuple[tuple[int, str], ...] = ()

    @classmethod
    def read(cls, session: Session, command_topic: str = COMMANDS) -> Self:
        """Read a session.

        Args:
            session: Open; it is not needed afterwards.
            command_topic: Its commands. They may move a robot, so that they are never guessed.

        Raises:
            MissingChannelError: If it has none.
        """
        if command_topic == COMMANDS not in session.channels:
            listed = sorted(session.channels)
            raise MissingChannelError(session.path, COMMANDS, listed, "choose with --command-topic")
        commands = session.joints(session.joint_topics(command_topic).command)
        gait = session.joints("/gait") if "/gait" in session.channels else None
        modes = session.messages("/gait/mode") if "/gait/mode" in session.channels else ()
        return cls(commands, gait, tuple((t_ns, str(message.data)) for t_ns, message in modes))


class CommandReplay:
    """The commands of a session as a gait; it does not look at the readings."""

    def __init__(self, recorded: RecordedCommands, robot: Robot) -> None:
        """Wrap recorded commands.

        Args:
            recorded: The commands; joints without one are held straight.
            robot: The robot that executes them.

        Raises:
            JointSetError: If the robot lacks one of the joints.
            DataError: If there is no command.
        """
        held = _Held(recorded.commands, finite_only=True)
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
        self.names: tuple[str, ...] = self._gait.names if self._gait is not None else ()
        self._since_ns = [t_ns for t_ns, _ in recorded.modes]
        self._modes = [REPLAY, *(mode for _, mode in recorded.modes)]
        self._start_ns, self._end_ns = held.span()

    @property
    def duration_s(self) -> float:
        """From the first command to the last, up to a whole control period [s]."""
        periods = (self._end_ns - self._start_ns) * CONTROL_RATE_HZ / NS
        return max(math.ceil(periods - 1e-6), 1) / CONTROL_RATE_HZ

    def step(self, time_s: float, readings: Readings) -> GaitTick:  # noqa: ARG002 - recorded
        """Return the commands in force at a time."""
        t_ns = self._start_ns + round(time_s * NS)
        recorded = self._of_robot(self._commands.at(t_ns))
        command = np.clip(recorded, self._lower, self._upper)
        cut = np.flatnonzero(command != recorded)
        clamped = tuple(self._joint_names[i] for i in cut)
        values = self._gait.at(t_ns) if self._gait is not None else np.empty(0)
        return GaitTick(command, values, self._modes[bisect_right(self._since_ns, t_ns)], clamped)

    def mean_commands(self, count: int, rate_hz: int) -> FloatArray:
        """Return the commands in force on average during equal intervals from time zero on.

        They depend continuously on the times of the commands: one that comes within an interval
        counts for the rest of it.

        Args:
            count: Number of intervals, k.
            rate_hz: Intervals a second.

        Returns:
            Joint angles [rad], shape (k, m).
        """
        edges_ns = self._start_ns + np.round(np.arange(count + 1) * (NS / rate_hz)).astype(np.int64)
        means = self._of_robot(self._commands.means(edges_ns))
        return np.clip(means, self._lower, self._upper)

    def _of_robot(self, given: FloatArray) -> FloatArray:
        """Commands of all joints of the robot, shape (..., m); those without one are straight."""
        commands = np.tile(self._rest, (*given.shape[:-1], 1))
        rest = self._rest[self._joints]
        commands[..., self._joints] = np.where(np.isnan(given), rest, given)
        return commands
