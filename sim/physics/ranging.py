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

Rays against obstacles and ground, in closed form.

All shapes are upright prisms between z = 0 and their height, so a ray is inside one where it is
both between two heights and inside its outline in plan view: two intervals of the way along the
ray, and the hit is where their intersection begins (the slab method of Kay & Kajiya, SIGGRAPH 1986,
with a circle in place of two of the slabs).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import ClassVar, Generic, TypeVar

import numpy as np

from undulog.capture.common.arrays import FloatArray
from undulog.capture.robot.model import Robot, Sensor

from ..scenario.obstacles import Boxes, Cylinders, Obstacle, columns, into_axes
from ..scenario.sensors import InfraredModel, SonarModel
from .contact import out_of_frames
from .sensing import Mounts, RangeSample, Schedule, quantised
from .steps import Steps

_SCALE, _SHIFT, _BIAS = 0.9005, 0.1346, 0.137  # V m, m, V

_GOLDEN_ANGLE = math.pi * (3.0 - math.sqrt(5.0))


_Model = TypeVar("_Model")


class RayCaster:
    """The obstacles of a world, ready for rays."""

    def __init__(self, obstacles: Sequence[Obstacle], *, ground: bool) -> None:
        """Gather the shapes.

        Args:
            obstacles: What stands in the way.
            ground: Whether the half-space below z = 0 is solid.
        """
        self._cylinders, self._boxes = columns(obstacles)
        self._ground = ground

    def distance(
        self, origin: FloatArray, direction: FloatArray, *, ground: bool = True
    ) -> FloatArray:
        """How far each ray gets.

        Args:
            origin: Where the rays start [m], shape (3, k).
            direction: Unit vectors, shape (3, k).
            ground: False lets the rays pass the ground, if there is one.

        Returns:
            Distance to the nearest surface [m], shape (k,): inf where a ray meets nothing, 0 where
            it starts inside something.
        """
        nearest = np.full(origin.shape[1], np.inf)
        with np.errstate(divide="ignore", invalid="ignore"):  # rays along a face, or upright
            if self._ground and ground:
                nearest = _ground(origin, direction)
            if self._cylinders.radius.size:
                hits = _cylinders(self._cylinders, origin, direction)
                nearest = np.minimum(nearest, hits.min(axis=0))
            if self._boxes.height.size:
                hits = _boxes(self._boxes, origin, direction)
                nearest = np.minimum(nearest, hits.min(axis=0))
        return nearest


def _ground(origin: FloatArray, direction: FloatArray) -> FloatArray:
    """Distances to the half-space z <= 0, shape (k,)."""
    height = origin[2]
    ahead = np.where(direction[2] < 0.0, -height / direction[2], np.inf)
    return np.where(height <= 0.0, 0.0, ahead)


def _slab(
    origin: FloatArray, direction: FloatArray, low: FloatArray | float, high: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Where rays enter and leave the room between two parallel planes.

    A ray along the planes divides by zero: it gets -inf and inf where it runs between them, and
    inf and inf, or -inf and -inf, where it does not; in a plane itself it counts as outside.
    """
    first, second = (low - origin) / direction, (high - origin) / direction
    enter, leave = np.minimum(first, second), np.maximum(first, second)
    return np.where(np.isnan(enter), np.inf, enter), np.where(np.isnan(leave), -np.inf, leave)


def _hit(enter: FloatArray, leave: FloatArray) -> FloatArray:
    """Distance at which a ray enters a shape; 0 from inside, inf where it does not."""
    return np.where((enter <= leave) & (leave >= 0.0), np.maximum(enter, 0.0), np.inf)


def _cylinders(shapes: Cylinders, origin: FloatArray, direction: FloatArray) -> FloatArray:
    """Distances to each cylinder, shape (c, k)."""
    x = origin[0] - shapes.centre[0][:, None]
    y = origin[1] - shapes.centre[1][:, None]
    dx, dy, dz = direction
    # |p + t d|^2 = r^2 in plan view: a t^2 + 2 b t + c = 0
    a, b = dx * dx + dy * dy, x * dx + y * dy
    c = x * x + y * y - (shapes.radius * shapes.radius)[:, None]
    root = np.sqrt(b * b - a * c)  # NaN where the ray passes by
    upright = a == 0.0
    inside = np.where(c <= 0.0, -np.inf, np.inf)
    enter = np.where(upright, inside, (-b - root) / a)
    leave = np.where(upright, -inside, (-b + root) / a)
    low, high = _slab(origin[2], dz, 0.0, shapes.height[:, None])
    return np.where(np.isnan(enter), np.inf, _hit(np.maximum(enter, low), np.minimum(leave, high)))


def _boxes(shapes: Boxes, origin: FloatArray, direction: FloatArray) -> FloatArray:
    """Distances to each box, shape (b, k)."""
    axis = shapes.axis[:, :, None]
    x, y = into_axes(axis, origin[:2, None] - shapes.centre[:, :, None])
    dx, dy = into_axes(axis, direction[:2, None])
    half_x, half_y = shapes.half[:, :, None]
    slabs = (
        _slab(x, dx, -half_x, half_x),
        _slab(y, dy, -half_y, half_y),
        _slab(origin[2], direction[2], 0.0, shapes.height[:, None]),
    )
    enter = np.maximum.reduce([np.broadcast_to(slab[0], x.shape) for slab in slabs])
    leave = np.minimum.reduce([np.broadcast_to(slab[1], x.shape) for slab in slabs])
    return _hit(enter, leave)


class Ranging(Generic[_Model]):
    """A robot's sensors of one kind, which measure the distance along bundles of rays.

    Attributes:
        stream: Number of the random stream that the sensors' noise is drawn from.
        sees_ground: Whether the ground stops the rays.
    """

    stream: ClassVar[int]
    sees_ground: ClassVar[bool]

    def __init__(
        self,
        model: _Model,
        sensors: Sequence[Sensor],
        robot: Robot,
        caster: RayCaster,
        *,
        dt: float,
        seed: int,
    ) -> None:
        """Start before the first control period; the sensors take turns, staggered evenly.

        Args:
            dt: Physics step [s].
            seed: Of the run.
        """
        self._model = model
        period_s, bundles = self._rays(sensors)
        self._names = [sensor.name for sensor in sensors]
        self._mounts = Mounts(sensors, robot)
        self._caster = caster
        self._schedule = Schedule(period_s, len(sensors), dt)
        self._bundles = (self._mounts.rotation @ bundles).transpose(1, 0, 2)  # (3, k, r)
        self._dt = dt
        self._limits = np.array(
            [(sensor.range_min, sensor.range_max) for sensor in sensors], np.float64
        )
        self._random = np.random.default_rng([seed, self.stream])

    def observe(self, steps: Steps, start: int) -> list[RangeSample]:
        """Measure what is due in one control period.

        Args:
            steps: Its physics steps, both ends included; the last instant is the next period's.
            start: Number of the first one since the start of the run.

        Returns:
            The samples, in order of time; +inf beyond a sensor's range (REP 117).
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
            ground=self.sees_ground,
        )
        shortest, longest = self._limits[which].T
        distance = self._measured(way.reshape(-1, count).min(axis=1), shortest)
        reported = np.where(distance > longest, np.inf, distance).tolist()
        return [
            RangeSample(self._names[i], float(k * self._dt), reading)
            for k, i, reading in zip(step.tolist(), which.tolist(), reported, strict=True)
        ]

    def _rays(self, sensors: Sequence[Sensor]) -> tuple[float, FloatArray]:
        """Return how the sensors measure.

        Returns:
            From one measurement of a sensor to its next [s]; unit vectors of each sensor's rays in
            its frame, shape (k, 3, r).
        """
        raise NotImplementedError

    def _measured(self, distance: FloatArray, shortest: FloatArray) -> FloatArray:
        """Return what sensors of some shortest ranges measure at true distances [m], (p,)."""
        raise NotImplementedError


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


class Infrared(Ranging[InfraredModel]):
    """Infrared sensors; each measures along one ray, its x axis."""

    stream = 3
    sees_ground = True

    def _rays(self, sensors: Sequence[Sensor]) -> tuple[float, FloatArray]:
        return self._model.hold_s, np.tile([[1.0], [0.0], [0.0]], (len(sensors), 1, 1))

    def _measured(self, distance: FloatArray, shortest: FloatArray) -> FloatArray:  # noqa: ARG002
        model = self._model
        volts = voltage(distance, model.peak)
        volts = volts + model.noise_v * self._random.standard_normal(len(volts))
        return decoded(
            quantised(np.clip(volts, 0.0, model.adc_v), model.adc_v / (2**model.adc_bits - 1))
        )


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


class Sonar(Ranging[SonarModel]):
    """Sonars, mostly one; what is nearer than the least range reads as that."""

    stream = 4
    sees_ground = False

    def _rays(self, sensors: Sequence[Sensor]) -> tuple[float, FloatArray]:
        cones = [cone(self._model.rays, sensor.field_of_view or 0.0) for sensor in sensors]
        return 1.0 / self._model.rate_hz, np.array(cones)

    def _measured(self, distance: FloatArray, shortest: FloatArray) -> FloatArray:
        noise = self._model.noise * self._random.standard_normal(len(distance))
        return np.maximum(quantised(distance + noise, self._model.resolution), shortest)
