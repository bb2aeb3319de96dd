"""The gate as a gait of the twin: it reads the twin's servos and commands them.

Demands on each joint over a drive: ranges, rates, torques, energies.

Torques and currents are those that the servos report, means over a control period: it is them that
the gate watches on a bus. Energies are the twin's own ledger, at the physics rate.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from undulog.capture.common.arrays import BoolArray, FloatArray
from undulog.capture.robot.model import Robot

from ..gait.contract import CONTROL_RATE_HZ, Gait, GaitTick, Readings
from ..physics.ledger import JOINT_TERMS
from ..physics.sensing import JointSample, SensorSample
from ..twin.twin import Sample, Twin
from .gate import Gate
from .limits import GateLimits
from .outcome import GateEvent, GateInput, GatePhase, JointStatus

_ENERGIES = tuple(
    JOINT_TERMS.index(term) for term in ("mechanical_net", "mechanical_abs", "electrical_net")
)

_CHANGED = 1e-12  # rad; the same as the clamp's


@dataclass(frozen=True)
class Demand:
    """One quantity of one joint against its limit.

    Attributes:
        name: What it is: ``range``, ``rate``, ``tracking error``, ``current`` or ``torque``.
        value: The greatest magnitude that was met, SI; NaN if it was never told. Of a range the
            distance from its middle.
        limit: The limit, NaN where there is none. Of a range half its width.
    """

    name: str
    value: float
    limit: float

    @property
    def share(self) -> float:
        """Value over limit: 1 is at the limit; NaN where either is unknown."""
        return self.value / self.limit


@dataclass(frozen=True)
class JointDemand:
    """Demands on one joint.

    Attributes:
        lower: Its lower limit [rad].
        upper: Its upper limit [rad].
        least: Least command, before the gate [rad].
        greatest: Greatest command, before the gate [rad].
        rate: Greatest rate of the command, before the gate [rad/s].
        max_rate: Its limit [rad/s], that of the file or that of the servo.
        acceleration: Greatest acceleration of the command, before the gate [rad/s^2]; nothing
            limits it.
        torque_peak: Greatest torque [N m].
        torque_rms: Root mean square of the torque [N m].
        stall_torque: What its servo has at standstill [N m].
        current_peak: Greatest current [A].
        max_current: Its limit [A], NaN where there is none.
        tracking_error: Greatest distance of the measured angle from its command [rad].
        max_tracking_error: Its limit [rad], NaN where there is none.
        energy_net_j: Mechanical work on the joint, signed [J].
        energy_abs_j: The same, its magnitude integrated [J].
        energy_el_j: Electrical work at its motor [J].
        clamped: Share of ticks in which the gate changes its command.
    """

    name: str
    lower: float
    upper: float
    least: float
    greatest: float
    rate: float
    max_rate: float
    acceleration: float
    torque_peak: float
    torque_rms: float
    stall_torque: float
    current_peak: float
    max_current: float
    tracking_error: float
    max_tracking_error: float
    energy_net_j: float
    energy_abs_j: float
    energy_el_j: float
    clamped: float

    @property
    def margin(self) -> float:
        """Least distance of the command from a limit [rad]; negative beyond it."""
        return min(self.upper - self.greatest, self.least - self.lower)

    @property
    def demands(self) -> tuple[Demand, ...]:
        """Everything that has a limit, against it."""
        half = 0.5 * (self.upper - self.lower)
        return (
            Demand("range", half - self.margin, half),
            Demand("rate", self.rate, self.max_rate),
            Demand("tracking error", self.tracking_error, self.max_tracking_error),
            Demand("current", self.current_peak, self.max_current),
            Demand("torque", self.torque_peak, self.stall_torque),
        )


class DemandTally:
    """Accumulates the demands; :meth:`joints` returns them."""

    def __init__(self, robot: Robot, limits: GateLimits) -> None:
        """Start without demands.

        Args:
            limits: Limits of the gate; infinite where there is none.
        """
        count = len(robot.joints)
        self._robot, self._limits = robot, limits
        self._ticks = 0
        self._past: list[FloatArray] = []  # the last two, for rates and accelerations
        self._least = np.full(count, np.inf)
        self._greatest = np.full(count, -np.inf)
        self._rate, self._acceleration, self._clamped = np.zeros((3, count))
        self._torque, self._current, self._error = np.full((3, count), np.nan)
        self._torque_squares, self._torque_count = np.zeros((2, count))
        self._energy = self._energy_before = np.zeros((len(JOINT_TERMS), count))
        self._begun = False

    def command(self, angles: FloatArray, clamped: BoolArray) -> None:
        """Add the commands of one tick; before the first one the joints rest in that pose.

        Args:
            angles: Commands of the gait [rad], shape (m,).
            clamped: Whether the gate changes it, shape (m,).
        """
        past = self._past or [angles, angles]
        newest, older = past[-1], past[0]
        self._least = np.fmin(self._least, angles)
        self._greatest = np.fmax(self._greatest, angles)
        self._rate = np.fmax(self._rate, CONTROL_RATE_HZ * np.abs(angles - newest))
        bend = CONTROL_RATE_HZ**2 * np.abs(angles - 2.0 * newest + older)
        self._acceleration = np.fmax(self._acceleration, bend)
        self._past = [newest, angles]
        self._clamped += clamped
        self._ticks += 1

    def measured(self, error: FloatArray) -> None:
        """Add the tracking errors.

        Args:
            error: [rad], NaN where it isn't known, shape (m,).
        """
        self._error = np.fmax(self._error, np.abs(error))

    def receive(self, samples: Sequence[SensorSample]) -> None:
        """Add the servos' reports.

        Args:
            samples: Samples that arrived in this tick.
        """
        for sample in samples:
            if isinstance(sample, JointSample):
                self._torque = np.fmax(self._torque, np.abs(sample.effort))
                self._current = np.fmax(self._current, np.abs(sample.current))
                self._torque_squares += sample.effort**2
                self._torque_count += 1

    def energy(self, flows: FloatArray) -> None:
        """Take the ledger's state; energies count from the first call.

        Args:
            flows: Of each joint [J], as :attr:`.sim.twin.twin.Sample.joint_energy`, shape (9, m).
        """
        if not self._begun:
            self._begun, self._energy_before = True, flows
        self._energy = flows

    def joints(self) -> tuple[JointDemand, ...]:
        """Return the demands on each joint, head to tail."""
        robot, limits = self._robot, self._limits
        rate, error, current = (
            np.where(np.isfinite(limit), limit, np.nan)
            for limit in (limits.rate, limits.tracking_error, limits.current)
        )
        squares = np.full(len(robot.joints), np.nan)
        np.divide(
            self._torque_squares, self._torque_count, out=squares, where=self._torque_count > 0
        )
        energies = (self._energy - self._energy_before)[list(_ENERGIES)]
        columns = {
            "least": self._least,
            "greatest": self._greatest,
            "rate": self._rate,
            "max_rate": rate,
            "acceleration": self._acceleration,
            "torque_peak": self._torque,
            "torque_rms": np.sqrt(squares),
            "current_peak": self._current,
            "max_current": current,
            "tracking_error": self._error,
            "max_tracking_error": error,
            **dict(zip(("energy_net_j", "energy_abs_j", "energy_el_j"), energies, strict=True)),
            "clamped": self._clamped / max(self._ticks, 1),
        }
        return tuple(
            JointDemand(
                name=joint.name,
                lower=joint.lower,
                upper=joint.upper,
                stall_torque=joint.servo.stall_torque,
                **{key: float(values[i]) for key, values in columns.items()},
            )
            for i, joint in enumerate(robot.joints)
        )


class NotedGait:
    """Wraps a gait and keeps its first command and the names of clamped values.

    Attributes:
        first: Its first command [rad], shape (m,); NaN before it.
    """

    def __init__(self, gait: Gait, robot: Robot) -> None:
        """Wrap a gait."""
        self._gait, self.names = gait, gait.names
        self.first: FloatArray = np.full(len(robot.joints), np.nan)
        self._cut: dict[str, None] = {}
        self._asked = False

    @property
    def cut(self) -> tuple[str, ...]:
        """Names of values that it clamped to the joint limits, in order of occurrence."""
        return tuple(self._cut)

    def step(self, time_s: float, readings: Readings) -> GaitTick:
        """Ask the gait."""
        result = self._gait.step(time_s, readings)
        if not self._asked:
            self._asked, self.first = True, result.command.copy()
        self._cut.update(dict.fromkeys(result.clamped))
        return result


class GatedGait:
    """The gate between a gait and the twin's servos.

    Attributes:
        twin: Whose servos they are; to be set before it runs.
        tally: Demands on each joint while it runs.
        remarks: Events of the gate.
    """

    def __init__(self, gait: NotedGait, gate: Gate, robot: Robot, limits: GateLimits) -> None:
        """Wrap a gait.

        Args:
            gate: Its gate, before the first tick.
            limits: Limits of the gate.
        """
        self.names = gait.names
        self.twin: Twin | None = None
        self._gate = gate
        self.tally = DemandTally(robot, limits)
        self.remarks: list[GateEvent] = []
        self._yielded = 0
        self._command = np.clip(np.zeros(len(robot.joints)), *robot.limits())
        self._unknown = np.full(len(robot.joints), np.nan)
        self._current = self._unknown
        self._values: FloatArray = np.full(len(gait.names), np.nan)
        self._tick = 0
        self._phase = GatePhase.POSE

    def step(self, time_s: float, readings: Readings) -> GaitTick:  # noqa: ARG002 - ticks count
        """Ask the gate."""
        assert self.twin is not None  # noqa: S101 - it steps this
        for sample in self.twin.sensed:
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
        step = self._gate.step(self._tick, GateInput(readings, status))
        self._tick += 1
        self.remarks += step.remarks
        self._phase = step.phase
        if was is GatePhase.RUN:
            self.tally.measured(readings.angle - before)
            self.tally.receive(self.twin.sensed)
        if step.command is not None:
            self._command = step.command
        if step.gait is None or step.requested is None:
            return GaitTick(self._command.copy(), self._values, str(step.phase), ())
        self.tally.command(step.requested, ~(np.abs(self._command - step.requested) <= _CHANGED))
        self._values = step.gait.values
        return step.gait._replace(command=self._command.copy())

    def book(self, sample: Sample) -> None:
        """Take where the energies stand.

        Args:
            sample: What the twin made of the last step.
        """
        if self._phase is GatePhase.RUN:
            self.tally.energy(sample.joint_energy)

    def fresh_remarks(self) -> Iterator[GateEvent]:
        """Return the events of the gate since the last call."""
        shown, self._yielded = self._yielded, len(self.remarks)
        yield from self.remarks[shown:]
