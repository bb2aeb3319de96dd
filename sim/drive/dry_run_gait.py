"""The gate as a gait of the twin: it hears what the twin's servos tell, and commands them."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from undulog.capture.common.arrays import FloatArray
from undulog.capture.robot.model import Robot

from ..gait.contract import Gait, GaitTick, Readings
from ..gate.gate import Gate
from ..gate.limits import GateLimits
from ..gate.tick import Heard, JointStatus, Phase, Remark
from ..sensing.contract import JointSample
from ..twin.twin import Sample, Twin
from .dry_run_tally import DemandTally

_CHANGED = 1e-12  # rad; the same as the clamp's


class NotedGait:
    """A gait, and its first command, and what it had to cut itself."""

    def __init__(self, gait: Gait, robot: Robot) -> None:
        """Wrap a gait.

        Args:
            gait: Who commands.
            robot: Whose joints.
        """
        self._gait = gait
        self.first: FloatArray = np.full(len(robot.joints), np.nan)
        """Its first command [rad], shape (m,); NaN before it."""
        self._cut: dict[str, None] = {}
        self._asked = False

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the values."""
        return self._gait.names

    @property
    def cut(self) -> tuple[str, ...]:
        """Names of what it cut to the joint limits, in the order in which it came to it."""
        return tuple(self._cut)

    def step(self, time_s: float, readings: Readings) -> GaitTick:
        """Ask the gait.

        Args:
            time_s: Time since its start [s].
            readings: For the gait.

        Returns:
            What it says.
        """
        said = self._gait.step(time_s, readings)
        if not self._asked:
            self._asked, self.first = True, said.command.copy()
        self._cut.update(dict.fromkeys(said.clamped))
        return said


class GatedGait:
    """Stands between a gait and the twin's servos; :meth:`attach` it before the twin runs.

    Attributes:
        inner: The gait.
        tally: What it asks of each joint while it runs.
        remarks: What the gate had to say.
    """

    def __init__(self, gait: Gait, robot: Robot, limits: GateLimits) -> None:
        """Wrap a gait.

        Args:
            gait: Who commands.
            robot: Whose joints.
            limits: What the gate keeps to.
        """
        self.inner = NotedGait(gait, robot)
        self.tally = DemandTally(robot, limits)
        self.remarks: list[Remark] = []
        self._told = 0
        self._command = np.clip(np.zeros(len(robot.joints)), *robot.limits())
        self._unknown = np.full(len(robot.joints), np.nan)
        self._current = self._unknown
        self._values: FloatArray = np.full(len(gait.names), np.nan)
        self._tick = 0
        self._phase = Phase.POSE
        self._gate: Gate | None = None
        self._twin: Twin | None = None

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the values: the gait's own."""
        return self.inner.names

    @property
    def done(self) -> bool:
        """Whether the last command was the last."""
        return self._gate is not None and self._gate.done

    def attach(self, gate: Gate, twin: Twin) -> None:
        """Say what it is between.

        Args:
            gate: The gate, before its first tick.
            twin: The twin.
        """
        self._gate, self._twin = gate, twin

    def step(self, time_s: float, readings: Readings) -> GaitTick:  # noqa: ARG002 - ticks count
        """Ask the gate.

        Args:
            time_s: Time since the twin's start [s].
            readings: What the twin's servos told.

        Returns:
            What passes the gate; the command before it where nothing is sent.
        """
        assert self._gate is not None  # noqa: S101 - attached
        assert self._twin is not None  # noqa: S101
        for sample in self._twin.sensed:
            if isinstance(sample, JointSample):
                self._current = sample.current
        status = JointStatus(
            readings.angle,
            self._current,
            self._unknown,
            self._unknown,
            np.zeros(len(self._unknown)),
        )
        before, was = self._command, self._phase
        step = self._gate.step(self._tick, Heard(readings, status))
        self._tick += 1
        self.remarks += step.remarks
        self._phase = step.phase
        if was is Phase.RUN:
            self.tally.measured(readings.angle - before)
            self.tally.hear(self._twin.sensed)
        if step.command is not None:
            self._command = step.command
        if step.gait is None or step.wanted is None:
            return GaitTick(self._command.copy(), self._values, str(step.phase), ())
        changed = ~(np.abs(self._command - step.wanted) <= _CHANGED)
        self.tally.command(step.wanted, changed)
        self._values = step.gait.values
        return step.gait._replace(command=self._command.copy())

    def book(self, sample: Sample) -> None:
        """Take where the energies stand.

        Args:
            sample: What the twin made of the last step.
        """
        if self._phase is Phase.RUN:
            self.tally.energy(sample.joint_energy)

    def fresh_remarks(self) -> Iterator[Remark]:
        """What the gate said since this was asked before."""
        told, self._told = self._told, len(self.remarks)
        yield from self.remarks[told:]
