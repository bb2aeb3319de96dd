"""What the robot's sensors deliver: samples with their own times, released when they arrive.

The twin hands over every control period's physics steps; the sensors give back the samples that
reach the robot's computer by the end of it, and keep what is known so far for the controller. The
log and the bus take the same samples, so a run recorded in process and one recorded over the bus
hold the same columns.
"""

from __future__ import annotations

from typing import NamedTuple, Protocol, TypeAlias

from undulog.capture.common.arrays import FloatArray

from ..gait.contract import Readings
from ..physics.steps import Steps


class JointSample(NamedTuple):
    """One polling cycle of all servos.

    Attributes:
        cycle: Number of the control period in which it was taken, from 0.
        offset_s: Each joint's sampling time after the start of that period [s], shape (m,).
        position: Angles that the encoders report [rad], shape (m,).
        velocity: Rates [rad/s], shape (m,).
        effort: Gear torques, means over one control period around the sampling time [N m], (m,).
        current: Winding currents, such means [A], shape (m,).
        voltage: Motor voltages, such means [V], shape (m,).
    """

    cycle: int
    offset_s: FloatArray
    position: FloatArray
    velocity: FloatArray
    effort: FloatArray
    current: FloatArray
    voltage: FloatArray


class RangeSample(NamedTuple):
    """One measurement of an infrared sensor or a sonar.

    Attributes:
        name: The sensor.
        time_s: When it was taken [s].
        distance: [m]; +inf where nothing is in range (REP 117).
    """

    name: str
    time_s: float
    distance: float


class VectorSample(NamedTuple):
    """One measurement of an accelerometer [m/s^2] or a compass [T].

    Attributes:
        name: The sensor.
        time_s: When it was taken [s].
        vector: In the sensor's frame, NaN on an axis that it does not measure, shape (3,).
    """

    name: str
    time_s: float
    vector: FloatArray


SensorSample: TypeAlias = JointSample | RangeSample | VectorSample


class Sensing(Protocol):
    """All sensors of a robot in its world."""

    @property
    def readings(self) -> Readings:
        """What the robot's computer knows by now."""
        ...

    def observe(self, steps: Steps) -> list[SensorSample]:
        """Take in one control period.

        Args:
            steps: Its physics steps from its start to its end, both included; the last one of a
                period is the first one of the next.

        Returns:
            The samples that arrive by the end of the period, in the order of their arrival.
        """
        ...

    def flush(self) -> list[SensorSample]:
        """End the run: samples that were taken and have not arrived yet.

        Returns:
            These samples; a mean over a period that the run does not cover to its end is taken
            over the part that it does.
        """
        ...
