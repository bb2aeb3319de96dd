"""Rays against obstacles and ground, in closed form.

All shapes are upright prisms between z = 0 and their height, so a ray is inside one where it is
both between two heights and inside its outline in plan view: two intervals of the way along the
ray, and the hit is where their intersection begins (the slab method of Kay & Kajiya, SIGGRAPH 1986,
with a circle in place of two of the slabs).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from undulog.capture.common.arrays import FloatArray

from ..scenario.obstacles import Boxes, Cylinders, Obstacle, columns, into_axes


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
