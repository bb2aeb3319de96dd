"""Where the robot is and which way it goes, by its encoders alone."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from undulog.capture.common.arrays import FloatArray
from undulog.capture.robot.model import Robot

from ..gait.readings import Readings
from ..scenario.controllers import Calibration
from .odometry import SlipOdometry
from .phase_history import PathHeading


class Pose(NamedTuple):
    """The head, in the frame in which it started: x ahead, y to the left.

    Attributes:
        place: Of the head link's centre [m], shape (2,).
        heading: Of the head link [rad]; it swings with the gait.
        way: Of the path [rad]; it does not.
    """

    place: FloatArray
    heading: float
    way: float


class Reckoning:
    """Adds up what the odometry says; what it gets wrong stays wrong."""

    def __init__(self, calibration: Calibration, robot: Robot) -> None:
        """Start at the origin.

        Args:
            calibration: Of this robot's gait on this ground.
            robot: The robot.
        """
        self._odometry = SlipOdometry(robot, calibration.slip_ratio)
        self._path = PathHeading(calibration.turn_gain)
        self._place, self._heading = np.zeros(2), 0.0

    def step(self, elapsed_s: float, phase: float, offset: float, readings: Readings) -> Pose:
        """Move on.

        Args:
            elapsed_s: Since the last tick [s].
            phase: The gait's phase [rad].
            offset: Of the head, as the last tick set it [rad].
            readings: What the encoders have told by now; nothing moves until they have.

        Returns:
            The pose.
        """
        if not np.isnan(readings.angle).any():
            motion = self._odometry.velocity(readings.angle, readings.velocity) * elapsed_s
            middle = self._heading + motion[2] / 2
            self._place = self._place + turned(motion[:2], middle)
            self._heading += float(motion[2])
        return Pose(self._place, self._heading, self._path.step(phase, self._heading, offset))


def turned(vectors: FloatArray, angle: float) -> FloatArray:
    """Turn vectors to the left.

    Args:
        vectors: x and y, shape (2,) or (2, k).
        angle: By how much [rad].

    Returns:
        The turned vectors, of the same shape.
    """
    cos, sin = math.cos(angle), math.sin(angle)
    return np.array([[cos, -sin], [sin, cos]]) @ vectors
