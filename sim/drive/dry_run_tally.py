"""What a drive asks of each joint, added up tick by tick: ranges, rates, torques, energies.

Torques and currents are those that the servos report, means over a control period: it is them that
the gate watches on a bus. Energies are the twin's own ledger, at the physics rate.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from undulog.capture.common.arrays import BoolArray, FloatArray
from undulog.capture.robot.model import Robot

from ..gate.limits import GateLimits
from ..physics.energy_flows import JOINT_TERMS
from ..scenario.scenario import CONTROL_RATE_HZ
from ..sensing.contract import JointSample, SensorSample

_ENERGIES = tuple(
    JOINT_TERMS.index(term) for term in ("mechanical_net", "mechanical_abs", "electrical_net")
)


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
    """What is asked of one joint.

    Attributes:
        name: The joint.
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
        return min(self.greatest_room, self.least_room)

    @property
    def greatest_room(self) -> float:
        """From the greatest command to the upper limit [rad]."""
        return self.upper - self.greatest

    @property
    def least_room(self) -> float:
        """From the lower limit to the least command [rad]."""
        return self.least - self.lower

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
    """Adds up; :meth:`joints` says what came of it."""

    def __init__(self, robot: Robot, limits: GateLimits) -> None:
        """Nothing is asked yet.

        Args:
            robot: Whose joints they are.
            limits: What the gate keeps to; infinite where there is no limit.
        """
        count = len(robot.joints)
        self._robot, self._limits = robot, limits
        self._ticks = 0
        self._wanted: list[FloatArray] = []  # the last two, for rates and accelerations
        self._least = np.full(count, np.inf)
        self._greatest = np.full(count, -np.inf)
        self._rate, self._acceleration, self._clamped = np.zeros((3, count))
        self._torque, self._current, self._error = np.full((3, count), np.nan)
        self._torque_squares, self._torque_count = np.zeros((2, count))
        self._energy = self._energy_before = np.zeros((len(JOINT_TERMS), count))
        self._begun = False

    def command(self, wanted: FloatArray, clamped: BoolArray) -> None:
        """Take the commands of one tick; before the first one the joints rest in that pose.

        Args:
            wanted: What the gait wants [rad], shape (m,).
            clamped: Whether the gate changes it, shape (m,).
        """
        past = self._wanted or [wanted, wanted]
        newest, older = past[-1], past[0]
        self._least = np.fmin(self._least, wanted)
        self._greatest = np.fmax(self._greatest, wanted)
        self._rate = np.fmax(self._rate, CONTROL_RATE_HZ * np.abs(wanted - newest))
        bend = CONTROL_RATE_HZ**2 * np.abs(wanted - 2.0 * newest + older)
        self._acceleration = np.fmax(self._acceleration, bend)
        self._wanted = [newest, wanted]
        self._clamped += clamped
        self._ticks += 1

    def measured(self, error: FloatArray) -> None:
        """Take how far the joints are from their commands.

        Args:
            error: [rad], NaN where it isn't known, shape (m,).
        """
        self._error = np.fmax(self._error, np.abs(error))

    def hear(self, samples: Sequence[SensorSample]) -> None:
        """Take what the servos report.

        Args:
            samples: What has arrived in this tick.
        """
        for sample in samples:
            if isinstance(sample, JointSample):
                self._torque = np.fmax(self._torque, np.abs(sample.effort))
                self._current = np.fmax(self._current, np.abs(sample.current))
                self._torque_squares += sample.effort**2
                self._torque_count += 1

    def energy(self, flows: FloatArray) -> None:
        """Take where the ledger stands; the first time is what is counted from.

        Args:
            flows: Of each joint [J], as :attr:`.sim.twin.twin.Sample.joint_energy`, shape (9, m).
        """
        if not self._begun:
            self._begun, self._energy_before = True, flows
        self._energy = flows

    def joints(self) -> tuple[JointDemand, ...]:
        """What was asked of each joint, head to tail."""
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
        return tuple(
            JointDemand(
                name=joint.name,
                lower=joint.lower,
                upper=joint.upper,
                least=float(self._least[i]),
                greatest=float(self._greatest[i]),
                rate=float(self._rate[i]),
                max_rate=float(rate[i]),
                acceleration=float(self._acceleration[i]),
                torque_peak=float(self._torque[i]),
                torque_rms=float(np.sqrt(squares[i])),
                stall_torque=joint.servo.stall_torque,
                current_peak=float(self._current[i]),
                max_current=float(current[i]),
                tracking_error=float(self._error[i]),
                max_tracking_error=float(error[i]),
                energy_net_j=float(energies[0, i]),
                energy_abs_j=float(energies[1, i]),
                energy_el_j=float(energies[2, i]),
                clamped=float(self._clamped[i]) / max(self._ticks, 1),
            )
            for i, joint in enumerate(robot.joints)
        )
