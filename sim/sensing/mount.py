"""Where the sensors of a robot are, which way they look, and when each is due."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from undulog.capture.common.arrays import FloatArray, IntArray, frozen
from undulog.capture.robot.model import Robot, Sensor

from ..physics.engine import BodyState
from ..physics.vectors import out_of_frames


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
            robot: The robot.
        """
        numbers = {link.name: i for i, link in enumerate(robot.links)}
        self.link: IntArray = frozen(np.array([numbers[one.link] for one in sensors], np.int64))
        self.position = frozen(np.array([one.position for one in sensors]).reshape(-1, 3))
        self.rotation = frozen(
            np.array([rotation_from_rpy(one.rpy) for one in sensors]).reshape(-1, 3, 3)
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
        """The measurements before a step that were not asked for yet.

        Args:
            stop: The first step that is not asked for.

        Returns:
            Steps and sensors, in order of time, each of shape (p,).
        """
        found: list[tuple[int, int]] = []
        while True:
            turn, sensor = divmod(self._done, len(self._phases))
            step = turn * self._period + self._phases[sensor]
            if step >= stop:
                break
            found.append((step, sensor))
            self._done += 1
        steps, sensors = np.array(found, dtype=np.int64).reshape(-1, 2).T
        return steps, sensors
