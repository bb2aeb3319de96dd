"""What infrared sensors and sonars share: rays from moving mounts, samples at due times."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from undulog.capture.common.arrays import FloatArray, IntArray
from undulog.capture.robot.model import Robot, Sensor

from ..physics.steps import Steps
from ..physics.vectors import out_of_frames
from .contract import RangeSample
from .mount import Mounts, Schedule
from .rays import RayCaster


class Ranging:
    """Sensors that measure the distance along bundles of rays."""

    def __init__(
        self,
        sensors: Sequence[Sensor],
        robot: Robot,
        caster: RayCaster,
        schedule: Schedule,
        *,
        bundles: FloatArray,
        sees_ground: bool,
        dt: float,
    ) -> None:
        """Look at a world.

        Args:
            sensors: All of a kind.
            robot: Who carries them.
            caster: The world.
            schedule: When each is due.
            bundles: Unit vectors of each sensor's rays in its frame, shape (k, 3, r).
            sees_ground: Whether the ground stops the rays.
            dt: Physics step [s].
        """
        self._names = [one.name for one in sensors]
        self._mounts = Mounts(sensors, robot)
        self._caster = caster
        self._schedule = schedule
        self._bundles = (self._mounts.rotation @ bundles).transpose(1, 0, 2)  # (3, k, r)
        self._sees_ground = sees_ground
        self._dt = dt

    def observe(
        self, steps: Steps, start: int, reported: Callable[[FloatArray, IntArray], FloatArray]
    ) -> list[RangeSample]:
        """Measure what is due in one control period.

        Args:
            steps: Its physics steps, both ends included; the last instant is the next period's.
            start: Number of the first one since the start of the run.
            reported: True distances [m] and the sensors' numbers to what the sensors tell, (p,).

        Returns:
            The samples, in order of time.
        """
        step, which = self._schedule.due(start + len(steps) - 1)
        if not len(step):
            return []
        origin, quaternion = self._mounts.poses(steps.stacked.body, step - start, which)
        count = self._bundles.shape[2]
        ray = self._bundles[:, which].reshape(3, -1)
        way = self._caster.distance(
            np.repeat(origin, count, axis=1),
            out_of_frames(np.repeat(quaternion, count, axis=1), ray),
            ground=self._sees_ground,
        )
        nearest = way.reshape(-1, count).min(axis=1)
        told = reported(nearest, which).tolist()
        return [
            RangeSample(self._names[i], float(k * self._dt), distance)
            for k, i, distance in zip(step.tolist(), which.tolist(), told, strict=True)
        ]
