"""Ultrasonic range finders: the nearest thing in a cone.

The cone is a bundle of rays, spread so that their directions cover it evenly. The ground is left
out: sound that grazes a smooth floor is reflected away from the sensor. Obstacles echo from
whatever angle they are struck, which flatters smooth walls seen obliquely. The flight of the sound
(23 ms for 4 m and back) is neglected.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from undulog.capture.common.arrays import FloatArray, IntArray
from undulog.capture.robot.model import Robot, Sensor

from ..physics.steps import Steps
from ..scenario.sensors import SonarModel
from .contract import RangeSample
from .mount import Schedule, quantised
from .ranging import Ranging
from .rays import RayCaster

STREAM = 4
"""Number of the random stream that the sensors' noise is drawn from."""

_GOLDEN_ANGLE = math.pi * (3.0 - math.sqrt(5.0))


def cone(count: int, angle: float) -> FloatArray:
    """Directions spread evenly over a cone about x, on a sunflower spiral (Vogel 1979).

    Args:
        count: r; the first one is the axis, the last ones are on the rim.
        angle: Full angle of the cone [rad].

    Returns:
        Unit vectors, shape (3, r).
    """
    turn = _GOLDEN_ANGLE * np.arange(count)
    off = angle / 2 * np.sqrt(np.arange(count) / max(count - 1, 1))
    return np.array([np.cos(off), np.sin(off) * np.cos(turn), np.sin(off) * np.sin(turn)])


class Sonar:
    """A robot's sonars, mostly one."""

    def __init__(
        self,
        model: SonarModel,
        sensors: Sequence[Sensor],
        robot: Robot,
        caster: RayCaster,
        *,
        dt: float,
        seed: int,
    ) -> None:
        """Start before the first control period.

        Args:
            model: How they measure.
            sensors: The sensors.
            robot: Who carries them.
            caster: The world.
            dt: Physics step [s].
            seed: Of the noise.
        """
        self._ranging = Ranging(
            sensors,
            robot,
            caster,
            Schedule(1.0 / model.rate_hz, len(sensors), dt),
            bundles=np.array([cone(model.rays, one.field_of_view or 0.0) for one in sensors]),
            sees_ground=False,
            dt=dt,
        )
        self._model = model
        self._limits = np.array([(one.range_min, one.range_max) for one in sensors], np.float64)
        self._random = np.random.default_rng([seed, STREAM])

    def observe(self, steps: Steps, start: int) -> list[RangeSample]:
        """Measure what is due in one control period.

        Args:
            steps: Its physics steps, both ends included.
            start: Number of the first one since the start of the run.

        Returns:
            The samples, in order of time; +inf beyond a sensor's range (REP 117), and its least
            range for what is nearer.
        """
        return self._ranging.observe(steps, start, self._reported)

    def _reported(self, distance: FloatArray, which: IntArray) -> FloatArray:
        noise = self._model.noise * self._random.standard_normal(len(distance))
        told = quantised(distance + noise, self._model.resolution)
        shortest, longest = self._limits[which].T
        return np.where(told > longest, np.inf, np.maximum(told, shortest))
