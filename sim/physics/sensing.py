"""Sensor samples with their own times, released when they arrive.

The twin hands over every control period's physics steps; the sensors give back the samples that
reach the robot's computer by the end of it, and keep what is known so far for the controller. The
log and the bus take the same samples, so a run recorded in process and one recorded over the bus
hold the same columns.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, TypeAlias

import numpy as np

from undulog.capture.common.arrays import FloatArray, IntArray, frozen
from undulog.capture.robot.model import Robot, Sensor

from .contact import out_of_frames
from .engine import BodyState


def quantised(values: FloatArray, step: float) -> FloatArray:
    """Round to whole steps, halves to the even one.

    Args:
        values: Any shape.
        step: In the unit of the values; 0 leaves them as they are.

    Returns:
        The nearest multiples of the step, same shape.
    """
    return step * np.rint(values / step) if step > 0.0 else values


def rotation_from_rpy(rpy: Sequence[float]) -> FloatArray:
    """Rotation by roll, pitch and yaw about fixed axes, as URDF has it: Rz(yaw) Ry(pitch) Rx(roll).

    Args:
        rpy: Roll, pitch, yaw [rad].

    Returns:
        Shape (3, 3), columns are the turned frame's axes.
    """
    (cr, cp, cy), (sr, sp, sy) = np.cos(rpy), np.sin(rpy)
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


class Mounts:
    """Sensors on the links of a robot.

    Attributes:
        link: Number of the link that carries each, shape (k,).
        position: Mount points in the links' frames [m], shape (k, 3).
        rotation: Sensor frames in the links' frames, shape (k, 3, 3).
    """

    def __init__(self, sensors: Sequence[Sensor], robot: Robot) -> None:
        """Look the links up.

        Args:
            sensors: Some of the robot's.
        """
        numbers = {link.name: i for i, link in enumerate(robot.links)}
        self.link: IntArray = frozen(
            np.array([numbers[sensor.link] for sensor in sensors], np.int64)
        )
        self.position = frozen(np.array([sensor.position for sensor in sensors]).reshape(-1, 3))
        self.rotation = frozen(
            np.array([rotation_from_rpy(sensor.rpy) for sensor in sensors]).reshape(-1, 3, 3)
        )

    def poses(
        self, body: BodyState, step: IntArray, which: IntArray
    ) -> tuple[FloatArray, FloatArray]:
        """Where some sensors are at some steps.

        Args:
            body: The body at all steps, a leading axis of time.
            step: Steps, shape (p,).
            which: Sensors, shape (p,).

        Returns:
            Mount points in the world [m], shape (3, p), and orientations of the carrying links,
            shape (4, p).
        """
        link = self.link[which]
        quaternion = body.quaternion[step, :, link].T
        arm = out_of_frames(quaternion, self.position[which].T)
        return body.position[step, :, link].T + arm, quaternion


class Schedule:
    """Sensors that take turns: each measures once a period, in whole physics steps."""

    def __init__(self, period_s: float, count: int, dt: float) -> None:
        """Start at step zero, where the first sensor measures.

        Args:
            period_s: From one measurement of a sensor to its next [s], rounded to whole steps.
            count: k; their turns are spread evenly over the period.
            dt: Physics step [s].
        """
        self._period = max(1, round(period_s / dt))
        self._phases = [i * self._period // count for i in range(count)]
        self._done = 0

    def due(self, stop: int) -> tuple[IntArray, IntArray]:
        """Return the measurements due before a step, each once.

        Args:
            stop: The first step that is not included.

        Returns:
            Steps and sensors, in order of time, each of shape (p,).
        """
        measurements: list[tuple[int, int]] = []
        while True:
            turn, sensor = divmod(self._done, len(self._phases))
            step = turn * self._period + self._phases[sensor]
            if step >= stop:
                break
            measurements.append((step, sensor))
            self._done += 1
        steps, sensors = np.array(measurements, dtype=np.int64).reshape(-1, 2).T
        return steps, sensors


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
        time_s: When it was taken [s].
        distance: [m]; +inf where nothing is in range (REP 117).
    """

    name: str
    time_s: float
    distance: float


class VectorSample(NamedTuple):
    """One measurement of an accelerometer [m/s^2] or a compass [T].

    Attributes:
        time_s: When it was taken [s].
        vector: In the sensor's frame, NaN on an axis that it does not measure, shape (3,).
    """

    name: str
    time_s: float
    vector: FloatArray


SensorSample: TypeAlias = JointSample | RangeSample | VectorSample
