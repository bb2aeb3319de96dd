"""Accelerometers: the specific force at their mount, f = R^T (dv/dt - g), in their own frame.

At rest that is gravity's opposite: +9.81 m/s^2 upwards. A sample is the mean over one sampling
period and carries the time of that period's middle. The velocity is the mount point's, so spin and
lever arm are in it; within a physics step the force is turned into the sensor's frame as the mean
of the frames at its ends has it.

Magnetometers as compasses: the earth's field in their own frame.

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

from ..physics.contact import cross, into_frames, out_of_frames
from ..physics.steps import Steps
from ..scenario.sensors import AccelerometerModel, CompassModel
from .contract import Mounts, Schedule, VectorSample, quantised

ACCELEROMETER_STREAM = 5
"""Number of the random stream that the sensors' noise is drawn from."""


class Accelerometer:
    """A robot's accelerometers, mostly one."""

    def __init__(
        self,
        model: AccelerometerModel,
        sensors: Sequence[Sensor],
        robot: Robot,
        gravity: Sequence[float],
        *,
        dt: float,
        seed: int,
    ) -> None:
        """Start before the first control period.

        Args:
            gravity: Acceleration of gravity in the world [m/s^2], length 3.
            dt: Physics step [s].
        """
        self._names = [one.name for one in sensors]
        self._mounts = Mounts(sensors, robot)
        self._gravity = np.array(gravity)
        self._model = model
        self._axes = measured(sensors)
        self._dt = dt
        self._count = max(1, round(1.0 / (model.rate_hz * dt)))
        self._summed = np.zeros((len(sensors), 3))
        self._steps = 0  # in the sum
        self._random = np.random.default_rng([seed, ACCELEROMETER_STREAM])

    def observe(self, steps: Steps, start: int) -> list[VectorSample]:
        """Measure during one control period.

        Args:
            steps: Its physics steps, both ends included.
            start: Number of the first one since the start of the run.

        Returns:
            The samples whose sampling periods end with it or in it, in order of time.
        """
        samples: list[VectorSample] = []
        force = self._specific_force(steps)
        done = 0
        while done < len(force):
            taken = force[done : done + self._count - self._steps]
            self._summed += taken.sum(axis=0)
            self._steps += len(taken)
            done += len(taken)
            if self._steps == self._count:
                time_s = (start + done - self._count / 2) * self._dt
                samples += self._measured(self._summed / self._count, time_s)
                self._summed[:] = 0.0
                self._steps = 0
        return samples

    def _specific_force(self, steps: Steps) -> FloatArray:
        """Mean specific force of each step in the carrying links' frames, shape (t, k, 3)."""
        body, count = steps.stacked.body, len(steps) - 1
        means: list[FloatArray] = []
        for link, mount in zip(self._mounts.link, self._mounts.position, strict=True):
            quaternion = body.quaternion[:, :, link].T  # (4, t + 1)
            velocity = body.velocity[:, :, link].T
            if mount.any():
                arm = out_of_frames(quaternion, np.tile(mount[:, None], count + 1))
                velocity = velocity + cross(body.spin[:, :, link].T, arm)
            force = (velocity[:, 1:] - velocity[:, :-1]) / self._dt - self._gravity[:, None]
            at_ends = into_frames(
                np.concatenate([quaternion[:, :-1], quaternion[:, 1:]], axis=1),
                np.concatenate([force, force], axis=1),
            )
            means.append(0.5 * (at_ends[:, :count] + at_ends[:, count:]).T)
        return np.stack(means, axis=1)

    def _measured(self, force: FloatArray, time_s: float) -> list[VectorSample]:
        force = (force[:, None] @ self._mounts.rotation)[:, 0]  # into the sensors' frames
        force += self._model.noise * self._random.standard_normal(force.shape)
        told = self._axes * quantised(force, self._model.resolution)
        return [
            VectorSample(name, time_s, vector)
            for name, vector in zip(self._names, told, strict=True)
        ]


def measured(sensors: Sequence[Sensor]) -> FloatArray:
    """Which axes sensors measure, as factors.

    Returns:
        1 for an axis that a sensor measures and NaN for another, shape (k, 3).
    """
    return np.array([[1.0 if axis in one.axes else np.nan for axis in "xyz"] for one in sensors])


COMPASS_STREAM = 6
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
            dt: Physics step [s].
        """
        self._names = [one.name for one in sensors]
        self._mounts = Mounts(sensors, robot)
        self._schedule = Schedule(1.0 / model.rate_hz, len(sensors), dt)
        self._model = model
        self._field = earth_field(model)
        self._axes = measured(sensors)
        self._dt = dt
        self._random = np.random.default_rng([seed, COMPASS_STREAM])

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
