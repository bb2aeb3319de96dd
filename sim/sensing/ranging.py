"""Infrared distance sensors and sonars: rays from moving mounts, samples at due times.

Infrared distance sensors of the Sharp GP2Y0A02 kind, as the robot's computer reads them.

Triangulation gives a voltage that falls with the distance, V = 90.05/(d + 13.46) - 0.137 with d in
cm (a fit to the data sheet's typical curve, 20 to 150 cm). Nearer than the peak the spot of light
leaves the detector and the voltage falls back; the data sheet draws that branch without numbers,
here it is a parabola from nothing at d = 0 to the peak. The sensor takes a new value every 38 ms
and holds it; an ADC reads it, and the computer turns it into a distance by inverting the falling
branch. So what is nearer than the peak is told as farther than it is: that is the sensor's physics.

Ultrasonic range finders: the nearest thing in a cone.

The cone is a bundle of rays, spread so that their directions cover it evenly. The ground is left
out: sound that grazes a smooth floor is reflected away from the sensor. Obstacles echo from
whatever angle they are struck, which flatters smooth walls seen obliquely. The flight of the sound
(23 ms for 4 m and back) is neglected.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from undulog.capture.common.arrays import FloatArray, IntArray
from undulog.capture.robot.model import Robot, Sensor

from ..physics.steps import Steps
from ..physics.vectors import out_of_frames
from ..scenario.sensors import InfraredModel, SonarModel
from .contract import RangeSample
from .mount import Mounts, Schedule, quantised
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


IR_STREAM = 3
"""Number of the random stream that the sensors' noise is drawn from."""

_SCALE, _SHIFT, _BIAS = 0.9005, 0.1346, 0.137  # V m, m, V


def voltage(distance: FloatArray, peak: float) -> FloatArray:
    """What the sensor's output is at a distance.

    Args:
        distance: [m], not negative, inf where nothing is there; any shape.
        peak: Distance of the greatest voltage [m].

    Returns:
        Voltage [V], never negative, same shape.
    """
    falling = np.maximum(_SCALE / (np.maximum(distance, peak) + _SHIFT) - _BIAS, 0.0)
    x = np.minimum(distance / peak, 1.0)
    return falling * x * (2.0 - x)


def decoded(volts: FloatArray) -> FloatArray:
    """The distance that the falling branch has at a voltage.

    Args:
        volts: Voltage [V], not negative; any shape.

    Returns:
        Distance [m], same shape.
    """
    return _SCALE / (volts + _BIAS) - _SHIFT


class Infrared:
    """A robot's infrared sensors; each measures along one ray, its x axis."""

    def __init__(
        self,
        model: InfraredModel,
        sensors: Sequence[Sensor],
        robot: Robot,
        caster: RayCaster,
        *,
        dt: float,
        seed: int,
    ) -> None:
        """Start before the first control period; the sensors' clocks are staggered evenly.

        Args:
            model: How they measure.
            sensors: The sensors.
            robot: Who carries them.
            caster: The world.
            dt: Physics step [s].
            seed: Of the noise.
        """
        count = len(sensors)
        self._ranging = Ranging(
            sensors,
            robot,
            caster,
            Schedule(model.hold_s, count, dt),
            bundles=np.tile([[1.0], [0.0], [0.0]], (count, 1, 1)),
            sees_ground=True,
            dt=dt,
        )
        self._model = model
        self._longest = np.array([one.range_max for one in sensors], dtype=np.float64)
        self._random = np.random.default_rng([seed, IR_STREAM])

    def observe(self, steps: Steps, start: int) -> list[RangeSample]:
        """Measure what is due in one control period.

        Args:
            steps: Its physics steps, both ends included.
            start: Number of the first one since the start of the run.

        Returns:
            The samples, in order of time; +inf beyond a sensor's range (REP 117).
        """
        return self._ranging.observe(steps, start, self._reported)

    def _reported(self, distance: FloatArray, which: IntArray) -> FloatArray:
        model = self._model
        volts = voltage(distance, model.peak)
        volts = volts + model.noise_v * self._random.standard_normal(len(volts))
        read = quantised(np.clip(volts, 0.0, model.adc_v), model.adc_v / (2**model.adc_bits - 1))
        told = decoded(read)
        return np.where(told > self._longest[which], np.inf, told)


SONAR_STREAM = 4
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
        self._random = np.random.default_rng([seed, SONAR_STREAM])

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
