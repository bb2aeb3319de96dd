"""What obstacles do to the gait: the head steers, the sides shrink, the tail hastens."""

from __future__ import annotations

import numpy as np

from undulog.capture.common.arrays import FloatArray
from undulog.capture.robot.model import Plane, Robot

from ..scenario.controllers import HeadSteering, SideShrinking, TailHaste
from ..scenario.sensor_layout import Layout
from .filters import LowPass, SideLatch
from .laws import amplitude, bend, frequency
from .lookout import Distances, InTheWay
from .moment import Moment
from .phase_history import TURN, PhaseHistory


class Steering:
    """The offset of the head: away from obstacles, and along the course where there are none."""

    names = ("steer.offset", "steer.distance", "steer.side")

    def __init__(self, parameters: HeadSteering) -> None:
        """Start straight.

        Args:
            parameters: How to steer.
        """
        self._law = parameters
        self._latch = SideLatch(parameters.margin_m, parameters.hold_s)
        self._filter = LowPass(parameters.filter_s, 0.0)
        self.avoiding = False
        self.offset = 0.0
        self.values = np.array([0.0, parameters.range_m, 1.0])

    def step(self, now: Moment, seen: InTheWay, course: float) -> float:
        """Steer; :attr:`avoiding` says whether an obstacle is in the way.

        Args:
            now: The tick.
            seen: What is in the way.
            course: The offset that the course wants [rad]; it fades as an obstacle comes near.

        Returns:
            The offset of the head [rad].
        """
        law, distance = self._law, seen.nearest
        side = self._latch.step(now.time_s, seen.left, seen.right)
        self.avoiding = distance < law.range_m and law.f0 > 0.0
        wanted = course
        if self.avoiding:
            away = bend(distance, side, law.f0, law.k)
            wanted = away + course * (1.0 - bend(distance, 1.0, 1.0, law.k))
        self.offset = self._filter.step(now.elapsed_s, wanted)
        self.values = np.array([self.offset, min(distance, law.range_m), side])
        return self.offset


class Shrinking:
    """The amplitude of the joints beside a wall."""

    def __init__(self, parameters: SideShrinking, layout: Layout, robot: Robot) -> None:
        """Start with full amplitude.

        Args:
            parameters: How to shrink.
            layout: Who looks where.
            robot: The robot.
        """
        self._law = parameters
        self._sides = [side.name for side in layout.sides]
        horizontal = robot.joint_indices(Plane.HORIZONTAL)
        beside = np.zeros((len(self._sides), len(robot.joints)), dtype=np.bool_)
        for row, side in zip(beside, layout.sides, strict=True):
            row[horizontal] = side.beside[horizontal]
        self._beside = beside
        self._joints = np.flatnonzero(beside.any(axis=0))
        self._past = PhaseHistory(TURN)
        self._filter = LowPass(parameters.filter_s, np.ones(len(robot.joints)))
        self.names = tuple(f"shrink.{robot.joints[i].name}" for i in self._joints)
        self.shrinking = False
        self.values = np.ones(len(self._joints))

    def step(self, now: Moment, distances: Distances) -> FloatArray:
        """Shrink; :attr:`shrinking` says whether some joint has lost a tenth of its amplitude.

        The body sweeps to and fro beside a wall, so the distance that counts is the shortest of
        the last gait period.

        Args:
            now: The tick.
            distances: What is beside the body.

        Returns:
            Factor of each joint's amplitude, shape (m,).
        """
        law = self._law
        self._past.add(now.phase, np.array([distances.nearest([name]) for name in self._sides]))
        nearest = self._past.least()
        wall = np.where(self._beside, nearest[:, None], np.inf).min(axis=0)
        factor = self._filter.step(now.elapsed_s, amplitude(wall, 1.0, law.smallest, law.k))
        self.values = factor[self._joints]
        self.shrinking = bool(self.values.min(initial=1.0) < 0.9)
        return factor


class Haste:
    """The frequency while an obstacle is near the tail."""

    names = ("haste.factor", "haste.distance")

    def __init__(self, parameters: TailHaste, layout: Layout) -> None:
        """Start without haste.

        Args:
            parameters: How to hasten.
            layout: Who looks where.
        """
        self._law = parameters
        self._layout = layout
        self._filter = LowPass(parameters.filter_s, 1.0)
        self.hastening = False
        self.values = np.array([1.0, parameters.range_m])

    def step(self, now: Moment, distances: Distances) -> float:
        """Hasten; :attr:`hastening` says whether an obstacle is near the tail.

        Args:
            now: The tick.
            distances: What is around the tail.

        Returns:
            Factor of omega.
        """
        law = self._law
        distance = distances.nearest(self._layout.tail)
        self.hastening = distance < law.range_m
        wanted = frequency(distance, law.gain, law.k) if self.hastening else 1.0
        factor = self._filter.step(now.elapsed_s, wanted)
        self.values = np.array([factor, min(distance, law.range_m)])
        return factor
