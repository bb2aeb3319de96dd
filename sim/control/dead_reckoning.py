"""Position and heading of the robot from its encoders alone.

A snake that undulates goes where its links slip least across the body. With the joint angles and
rates known, the motion of the head (v_x, v_y, omega) is what makes the sum over the links of
(tangential slip)^2 + K (normal slip)^2 least: the balance of forces and moments of a slender body
under viscous drag with the ratio K = c_n / c_t (after Gray & Hancock 1955). K is the one constant
of calibration: large for a robot on wheels, smaller the more its links slip sideways. It is in
plan view: joints that bend the body vertically count as straight.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from undulog.capture.common.arrays import FloatArray
from undulog.capture.robot.model import Plane, Robot

from ..gait.contract import Readings
from ..scenario.controllers import Calibration
from .filters import PathHeading


class SlipOdometry:
    """The velocity of the head from joint angles and rates."""

    def __init__(self, robot: Robot, slip_ratio: float) -> None:
        """Take the body's lengths.

        Args:
            slip_ratio: K.
        """
        self._lengths = np.array([link.length for link in robot.links])
        self._horizontal = robot.joint_indices(Plane.HORIZONTAL)
        self._slip_ratio = slip_ratio

    def velocity(self, angle: FloatArray, rate: FloatArray) -> FloatArray:
        """Velocity of the head link's centre, in its own frame, and its yaw rate.

        Args:
            angle: Joint angles [rad], shape (m,).
            rate: Joint rates [rad/s], shape (m,).

        Returns:
            Forward and to the left [m/s], and about z [rad/s], shape (3,).
        """
        turn, spin = self._from_head(angle), self._from_head(rate)
        ahead = np.array([np.cos(turn), np.sin(turn)])
        left = np.array([-ahead[1], ahead[0]])
        half = self._lengths / 2
        # Places and velocities of the links' centres, from the head and as it would see them.
        place = -_summed(half * ahead)
        moved = -_summed(half * spin * left)
        # Slip of a link: its own motion, and v + omega x r of the head's.
        lever = np.array([-place[1], place[0]])
        along = np.column_stack([ahead[0], ahead[1], (ahead * lever).sum(axis=0)])
        across = np.column_stack([left[0], left[1], (left * lever).sum(axis=0)])
        weight = math.sqrt(self._slip_ratio)
        known = np.concatenate([(ahead * moved).sum(axis=0), weight * (left * moved).sum(axis=0)])
        motion = np.linalg.lstsq(np.concatenate([along, weight * across]), -known)[0]
        return np.asarray(motion, dtype=np.float64)

    def _from_head(self, joint: FloatArray) -> FloatArray:
        """Sums over the horizontal joints before each link, shape (n,)."""
        bent = np.zeros(len(self._lengths))
        bent[self._horizontal + 1] = joint[self._horizontal]
        return np.cumsum(bent)


def _summed(half: FloatArray) -> FloatArray:
    """From half vectors of the links to sums from the head's centre to theirs, shape (2, n)."""
    return np.cumsum(half, axis=1) + np.cumsum(half, axis=1) - half - half[:, :1]


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


class DeadReckoning:
    """Integrates the odometry; errors accumulate."""

    def __init__(self, calibration: Calibration, robot: Robot) -> None:
        """Start at the origin.

        Args:
            calibration: Of this robot's gait on this ground.
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
            readings: Newest readings; nothing moves before the first angles.
        """
        if not np.isnan(readings.angle).any():
            motion = self._odometry.velocity(readings.angle, readings.velocity) * elapsed_s
            self._place = self._place + turned(motion[:2], self._heading + motion[2] / 2)
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
