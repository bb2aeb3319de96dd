"""Obstacles in the way, from the echoes of one sweep of the head.

The head of a snake that undulates swings by half a radian and more, so most of the time its
sensors look past what is in the way. What each of them saw during the last gait period is kept,
as a point on the ground, while the robot moves on.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import NamedTuple

import numpy as np

from undulog.capture.common.arrays import FloatArray
from undulog.capture.robot.model import Robot

from ..gait.contract import Readings
from ..scenario.controllers import Lookout as Parameters
from ..scenario.sensors import Layout, bearing
from .dead_reckoning import Pose, turned
from .filters import NearMemory


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
            ranges: Name to distance [m]; a sensor that has not told anything yet may be missing
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

    def __init__(self, parameters: Parameters, layout: Layout, robot: Robot) -> None:
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
        beside = np.abs(left)
        chosen = (ahead > beside) & (beside < self._parameters.half_width_m)
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
