"""Heading policies on free ground: at random, or to a target."""

from __future__ import annotations

import math
from typing import TypeAlias

import numpy as np

from undulog.capture.common.arrays import FloatArray
from undulog.capture.robot.model import Robot, SensorKind

from ..scenario.controllers import RandomTurns, TargetHeading
from .dead_reckoning import turned
from .filters import TURN, LowPass
from .obstacle_monitor import ControlInput

RANDOM_STREAM = 300
"""Of the scenario's seed; random turns draw from it and nothing else does."""


class StraightOn:
    """No course: on as the body lies."""

    names: tuple[str, ...] = ()
    values: FloatArray = np.zeros(0)

    def step(self, now: ControlInput) -> float:  # noqa: ARG002 - straight whatever is known
        """Go straight on."""
        return 0.0


class RandomHeadingPolicy:
    """A random walk: bends drawn at random, each kept for a random time."""

    names = ("course.offset",)

    def __init__(self, parameters: RandomTurns, seed: int) -> None:
        """Start; the first bend is drawn at the first step."""
        self._parameters = parameters
        self._random = np.random.default_rng([seed, RANDOM_STREAM])
        self._until_s = -math.inf
        self.values: FloatArray = np.zeros(1)

    def step(self, now: ControlInput) -> float:
        """Go on, or draw anew."""
        if now.time_s >= self._until_s:
            law = self._parameters
            self.values = self._random.uniform(-law.largest, law.largest, 1)
            self._until_s = now.time_s + float(self._random.uniform(law.shortest_s, law.longest_s))
        return float(self.values[0])


class TargetHeadingPolicy:
    """Towards a target at a known position, by compass and dead reckoning.

    The target's position is given from the start; the robot's own comes from compass and encoders,
    and no sensor measures the target. The compass swings with the head and is late; so it only
    corrects, slowly, the heading from the encoders, and the heading of the path is that one.
    """

    # Heading and bearing of the target from magnetic north [rad], and the robot's position [m].
    names = ("course.heading", "course.bearing", "course.x", "course.y")

    def __init__(
        self,
        parameters: TargetHeading,
        target: tuple[float, float],
        target_radius_m: float,
        turn_radius_m: float,
        robot: Robot,
    ) -> None:
        """Start where the head is.

        Args:
            target: From the head's start, along magnetic north and to the left of it [m].
            target_radius_m: How near it must come [m].
            turn_radius_m: Of the turn with the largest offset [m].
            robot: The robot; its first compass is read, which sits on the head.
        """
        self._law = parameters
        self._target = np.array(target)
        self._target_radius_m = target_radius_m
        self._turn_radius_m = turn_radius_m
        self._compass = next(s for s in robot.sensors if s.kind is SensorKind.COMPASS)
        self._north: LowPass[FloatArray] | None = None
        self._before = np.zeros(2)
        self._place = np.zeros(2)
        self.values: FloatArray = np.full(len(self.names), math.nan)

    def step(self, now: ControlInput) -> float:
        """Steer to where the target must be."""
        start = self._start_from_north(now)
        moved, self._before = now.pose.place - self._before, now.pose.place
        if math.isnan(start):
            return 0.0
        self._place = self._place + turned(moved, start)
        way = self._target - self._place
        heading, bearing = start + now.pose.way, math.atan2(way[1], way[0])
        self.values = np.array([heading, bearing, *self._place])
        error = math.remainder(bearing - heading, TURN)
        if self._inside_turn(math.hypot(*way), abs(error)):
            return 0.0  # no turn leads there: first away from it
        return -min(max(self._law.gain * error, -self._law.largest), self._law.largest)

    def _inside_turn(self, distance: float, error: float) -> bool:
        """Whether the target lies so far inside the tightest turn that the turn misses it."""
        radius = self._turn_radius_m
        ahead, aside = distance * math.cos(error), distance * math.sin(error)
        return math.hypot(ahead, aside - radius) < radius - self._target_radius_m

    def _start_from_north(self, now: ControlInput) -> float:
        """The head's heading at the start from magnetic north, to the left [rad]; NaN at first."""
        field = now.readings.magnetic_field.get(self._compass.name)
        if field is None:
            return math.nan
        heading = math.atan2(-field[1], field[0]) - self._compass.rpy[2]
        start = heading - now.pose.heading
        told = np.array([math.cos(start), math.sin(start)])
        if self._north is None:
            self._north = LowPass(self._law.filter_s, told)
        x, y = self._north.step(now.elapsed_s, told)
        return math.atan2(y, x)


HeadingPolicy: TypeAlias = StraightOn | RandomHeadingPolicy | TargetHeadingPolicy
"""Sets the offset of the head when nothing is in the way, and logs values by name."""
