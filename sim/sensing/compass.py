"""Magnetometers as compasses: the earth's field in their own frame.

Magnetic north is the world's +x, unless the model turns it; the field dips into the ground by the
inclination, 65 degrees in central Europe. A compass of two axes that is level tells its heading by
atan2(-B_y, B_x), counter-clockwise from north; tilted, it mixes the vertical field in: pointing
north, each degree of roll turns the heading by tan(inclination) degrees, 2.1.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from undulog.capture.common.arrays import FloatArray
from undulog.capture.robot.model import Robot, Sensor

from ..physics.steps import Steps
from ..physics.vectors import into_frames
from ..scenario.sensors import CompassModel
from .accelerometer import measured
from .contract import VectorSample
from .mount import Mounts, Schedule, quantised

STREAM = 6
"""Number of the random stream that the sensors' noise is drawn from."""


def earth_field(model: CompassModel) -> FloatArray:
    """The earth's field in the world.

    Args:
        model: Strength, inclination and direction of north.

    Returns:
        [T], shape (3,).
    """
    level = model.horizontal_field
    return level * np.array(
        [math.cos(model.north), math.sin(model.north), -math.tan(model.inclination)]
    )


class Compass:
    """A robot's compasses, mostly one."""

    def __init__(
        self, model: CompassModel, sensors: Sequence[Sensor], robot: Robot, *, dt: float, seed: int
    ) -> None:
        """Start before the first control period.

        Args:
            model: How they measure.
            sensors: The sensors.
            robot: Who carries them.
            dt: Physics step [s].
            seed: Of the noise.
        """
        self._names = [one.name for one in sensors]
        self._mounts = Mounts(sensors, robot)
        self._schedule = Schedule(1.0 / model.rate_hz, len(sensors), dt)
        self._model = model
        self._field = earth_field(model)
        self._axes = measured(sensors)
        self._dt = dt
        self._random = np.random.default_rng([seed, STREAM])

    def observe(self, steps: Steps, start: int) -> list[VectorSample]:
        """Measure what is due in one control period.

        Args:
            steps: Its physics steps, both ends included; the last instant is the next period's.
            start: Number of the first one since the start of the run.

        Returns:
            The samples, in order of time.
        """
        step, which = self._schedule.due(start + len(steps) - 1)
        if not len(step):
            return []
        _, quaternion = self._mounts.poses(steps.stacked.body, step - start, which)
        level = into_frames(quaternion, np.tile(self._field[:, None], len(which)))  # the link's
        field = (level.T[:, None] @ self._mounts.rotation[which])[:, 0]  # R^T B
        field += self._model.noise * self._random.standard_normal(field.shape)
        told = self._axes[which] * quantised(field, self._model.resolution)
        return [
            VectorSample(self._names[i], float(k * self._dt), vector)
            for k, i, vector in zip(step.tolist(), which.tolist(), told, strict=True)
        ]
