"""Obstacles in the way, and how the gait reacts: steering, amplitude reduction, tail speed-up.

The head of a snake that undulates swings by half a radian and more, so most of the time its
sensors look past what is in the way. What each of them saw during the last gait period is kept,
as a point on the ground, while the robot moves on.

The reactions are the adaptive control laws of Meister, Stepanenko & Kernbach 2011: distance in,
gait out. Each takes the distance d >= 0 to an obstacle [m]; +inf, nothing in range, changes
nothing. ``docs/explanation/control.md`` says where they depart from the printed form, and why.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import NamedTuple

import numpy as np

from undulog.capture.common.arrays import FloatArray
from undulog.capture.robot.model import Plane, Robot

from ..gait.contract import Readings
from ..scenario.motion import HeadSteering, SideShrinking, TailHaste
from ..scenario.motion import Lookout as Parameters
from ..scenario.sensors import SensorLayout, bearing
from .filters import LowPass, NearMemory, PhaseHistory, Pose, SideLatch, turned


class ControlInput(NamedTuple):
    """One control tick.

    Attributes:
        time_s: Since the start [s].
        elapsed_s: Since the tick before [s].
        phase: The gait's phase, of the horizontal plane's first joint [rad].
        pose: Where the robot reckons it is.
        readings: Newest readings.
    """

    time_s: float
    elapsed_s: float
    phase: float
    pose: Pose
    readings: Readings


class Distances:
    """The range sensors with a memory of what came too near for them."""

    FOLD_MARGIN = 1.1
    """A reading within this factor of the fold is near it: noise, and the speed of approach."""

    def __init__(self, fold_m: Mapping[str, float], hold_s: float) -> None:
        """Start with nothing in range.

        Args:
            fold_m: Name of each sensor to the distance below which it folds back [m], 0 if it
                does not.
            hold_s: How long a near reading is believed [s].
        """
        self._names = tuple(fold_m)
        self._memory = NearMemory(self.FOLD_MARGIN * np.array(list(fold_m.values())), hold_s)
        self._believed: dict[str, float] = {}

    def step(self, time_s: float, ranges: Mapping[str, float]) -> None:
        """Take in the newest readings.

        Args:
            time_s: Now [s].
            ranges: Name to distance [m]; one without a reading yet may be missing
                or NaN, and is taken to see nothing; -inf is too near to tell (REP 117).
        """
        read = np.array([ranges.get(name, math.inf) for name in self._names])
        read = np.maximum(np.where(np.isnan(read), math.inf, read), 0.0)
        believed = self._memory.step(time_s, read)
        self._believed = dict(zip(self._names, believed.tolist(), strict=True))

    def nearest(self, names: Iterable[str]) -> float:
        """The nearest obstacle of some sensors.

        Returns:
            Distance [m]; +inf where none of them sees anything.
        """
        return min((self._believed[name] for name in names), default=math.inf)


class InTheWay(NamedTuple):
    """Obstacles ahead, as far as they are from the nose.

    Attributes:
        nearest: The nearest one in the robot's way [m]; +inf where there is none.
        left: The nearest one left of the middle of the way [m], likewise.
        right: Right of it [m], likewise.
    """

    nearest: float
    left: float
    right: float


class ObstacleMonitor:
    """Keeps echoes while the robot moves on."""

    def __init__(self, parameters: Parameters, layout: SensorLayout, robot: Robot) -> None:
        """Start with nothing seen.

        Args:
            parameters: How wide the way is, and how long echoes are kept.
            layout: Who looks where.
        """
        self._parameters = parameters
        self._mounts = [
            (s.name, np.array(s.position[:2]), bearing(s))
            for s in robot.sensors
            if s.name in layout.head
        ]
        self._nose_m = robot.links[0].length / 2
        self._last: dict[str, float] = {}
        self._seen: list[tuple[float, FloatArray]] = []

    def step(self, now: ControlInput) -> InTheWay:
        """Add new echoes and remove old ones.

        Returns:
            What is in the way: echoes within 45 degrees of it and not beside it.
        """
        self._look(now)
        kept_s = now.time_s - self._parameters.memory_s
        self._seen = [(time_s, point) for time_s, point in self._seen if time_s > kept_s]
        points = np.array([point for _, point in self._seen]).reshape(-1, 2) - now.pose.place
        ahead, left = turned(points.T, -now.pose.way)
        aside = np.abs(left)
        chosen = (ahead > aside) & (aside < self._parameters.half_width_m)
        distance = np.maximum(np.hypot(ahead, left)[chosen] - self._nose_m, 0.0)
        left = left[chosen]
        return InTheWay(
            nearest=float(distance.min(initial=math.inf)),
            left=float(distance[left > 0.0].min(initial=math.inf)),
            right=float(distance[left <= 0.0].min(initial=math.inf)),
        )

    def _look(self, now: ControlInput) -> None:
        """Add the echoes that are new."""
        pose = now.pose
        for name, mount, angle in self._mounts:
            read = now.readings.ranges.get(name, math.nan)
            if read == self._last.get(name):
                continue  # the sensor has not measured anew
            self._last[name] = read
            if read < math.inf:  # false for NaN; -inf is too near to tell (REP 117)
                ray = np.array([math.cos(angle), math.sin(angle)])
                point = pose.place + turned(mount + max(read, 0.0) * ray, pose.heading)
                self._seen.append((now.time_s, point))


def bend(distance: float, side: float, f0: float, k: float) -> float:
    """Offset Y that bends the body away from an obstacle, f(d) = sgn f0 exp(-k d), Y ~ f(d).

    Args:
        distance: d, to the nearest obstacle [m].
        side: sgn, +1 turns right and -1 turns left.
        f0: Offset at contact [rad].
        k: How fast the law fades with distance [1/m].

    Returns:
        f(d) [rad].
    """
    return side * f0 * math.exp(-k * distance)


def amplitude(distance: FloatArray, largest: float, smallest: float, k: float) -> FloatArray:
    """Amplitude that shrinks near a wall, A~(d) = A_max - (A_max - A_min) exp(-k d).

    The paper prints A~(d) = exp(k d) - A_max, which grows without bound; its stated intent, an
    amplitude that falls smoothly near a wall, is kept: A_min at contact, A_max far away.

    Args:
        distance: d, to the wall beside each joint [m], any shape.
        largest: A_max, far from walls.
        smallest: A_min, at contact; in the unit of ``largest``.
        k: How fast the law fades with distance [1/m].

    Returns:
        A~(d), in the unit of ``largest``, the shape of ``distance``.
    """
    return largest - (largest - smallest) * np.exp(-k * distance)


def frequency(distance: float, gain: float, k: float) -> float:
    """Factor of omega that pulls the tail away from an obstacle, omega~(d)/omega.

    omega~(d) = omega (1 + g exp(-k d)), bounded by omega (1 + g).

    Args:
        distance: d, from the tail to the obstacle [m].
        gain: g > 0, the share added at contact.
        k: How fast the law fades with distance [1/m].

    Returns:
        The factor, 1 to 1 + g.
    """
    return 1.0 + gain * math.exp(-k * distance)


class Steering:
    """The offset of the head: away from obstacles, and along the course where there are none."""

    names = ("steer.offset", "steer.distance", "steer.side")

    def __init__(self, parameters: HeadSteering) -> None:
        """Start straight."""
        self._law = parameters
        self._latch = SideLatch(parameters.margin_m, parameters.hold_s)
        self._filter = LowPass(parameters.filter_s, 0.0)
        self.avoiding = False
        self.offset = 0.0
        self.values = np.array([0.0, parameters.range_m, 1.0])

    def step(self, now: ControlInput, seen: InTheWay, course: float) -> float:
        """Steer; sets :attr:`avoiding` if an obstacle is in the way.

        Args:
            seen: What is in the way.
            course: The offset of the course [rad]; it fades as an obstacle comes near.

        Returns:
            The offset of the head [rad].
        """
        law, distance = self._law, seen.nearest
        side = self._latch.step(now.time_s, seen.left, seen.right)
        self.avoiding = distance < law.range_m and law.f0 > 0.0
        offset = course
        if self.avoiding:
            away = bend(distance, side, law.f0, law.k)
            offset = away + course * (1.0 - bend(distance, 1.0, 1.0, law.k))
        self.offset = self._filter.step(now.elapsed_s, offset)
        self.values = np.array([self.offset, min(distance, law.range_m), side])
        return self.offset


class AmplitudeReduction:
    """The amplitude of the joints beside a wall."""

    def __init__(self, parameters: SideShrinking, layout: SensorLayout, robot: Robot) -> None:
        """Start with full amplitude.

        Args:
            layout: Who looks where.
        """
        self._law = parameters
        self._sides = [side.name for side in layout.sides]
        horizontal = robot.joint_indices(Plane.HORIZONTAL)
        beside = np.zeros((len(self._sides), len(robot.joints)), dtype=np.bool_)
        for row, side in zip(beside, layout.sides, strict=True):
            row[horizontal] = side.beside[horizontal]
        self._beside = beside
        self._joints = np.flatnonzero(beside.any(axis=0))
        self._past = PhaseHistory(math.tau)
        self._filter = LowPass(parameters.filter_s, np.ones(len(robot.joints)))
        self.names = tuple(f"shrink.{robot.joints[i].name}" for i in self._joints)
        self.shrinking = False
        self.values = np.ones(len(self._joints))

    def step(self, now: ControlInput, distances: Distances) -> FloatArray:
        """Shrink; sets :attr:`shrinking` if a joint has lost a tenth of its amplitude.

        The body sweeps to and fro beside a wall, so the distance that counts is the shortest of
        the last gait period.

        Args:
            distances: What is beside the body.

        Returns:
            Factor of each joint's amplitude, shape (m,).
        """
        law = self._law
        self._past.add(now.phase, np.array([distances.nearest([name]) for name in self._sides]))
        wall = np.where(self._beside, self._past.least()[:, None], np.inf).min(axis=0)
        factor = self._filter.step(now.elapsed_s, amplitude(wall, 1.0, law.smallest, law.k))
        self.values = factor[self._joints]
        self.shrinking = bool(self.values.min(initial=1.0) < 0.9)
        return factor


class TailSpeedUp:
    """The frequency while an obstacle is near the tail."""

    names = ("haste.factor", "haste.distance")

    def __init__(self, parameters: TailHaste, layout: SensorLayout) -> None:
        """Start with the gait's own frequency.

        Args:
            layout: Who looks where.
        """
        self._law, self._layout = parameters, layout
        self._filter = LowPass(parameters.filter_s, 1.0)
        self.hastening = False
        self.values = np.array([1.0, parameters.range_m])

    def step(self, now: ControlInput, distances: Distances) -> float:
        """Speed up; sets :attr:`hastening` if an obstacle is near the tail.

        Args:
            distances: What is around the tail.
        """
        law = self._law
        distance = distances.nearest(self._layout.tail)
        self.hastening = distance < law.range_m
        target = frequency(distance, law.gain, law.k) if self.hastening else 1.0
        factor = self._filter.step(now.elapsed_s, target)
        self.values = np.array([factor, min(distance, law.range_m)])
        return factor
