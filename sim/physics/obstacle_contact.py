"""Links against obstacles: a one-sided spring and damper, and isotropic Coulomb friction.

A link is a capsule: it touches an obstacle where its axis, from joint to joint, is nearest to the
obstacle in plan view, if it is nearer than its radius and not wholly above the obstacle's top. The
normal is horizontal, out of the obstacle. So obstacles push sideways only: a link that gets above
an edge is not carried by the top. The friction is regularised as on the ground
(:mod:`.sim.physics.contact`): what is held by it creeps.

A robot presses against an obstacle much harder than a link lies on the ground, so that friction
smoothed over a slip speed alone would be a damper that turns the slip of a light link over at every
step: the links would tremble at half the physics rate, and samples at the control rate, which meet
one phase of it only, would show smooth speeds that no joint has. So it is smoothed besides over the
slip that it can stop within one step, mu N dt / m, m being what a free link opposes at the point of
contact (in the chain it is more). That goes to zero with the step.

As the nearest point of the axis moves along the link, the depth changes only by the motion of the
body there (the derivative along the axis is zero, or the end stops it), so the spring stores and
gives back its energy exactly, k depth^2 / 2.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from undulog.capture.common.arrays import BoolArray, FloatArray, IntArray

from ..scenario.obstacles import (
    Boxes,
    Closest,
    Cylinders,
    Obstacle,
    ObstacleMaterial,
    columns,
    into_axes,
    out_of_axes,
    rectangle_gaps,
    to_circles,
    to_rectangles,
)
from .contact import cross, normal_force

_NONE = np.empty((3, 0))


class ObstacleContact(NamedTuple):
    """All pairs of a link and an obstacle that touch, p of them, mostly none.

    Attributes:
        link: Which link it is, shape (p,).
        point: Points of action on the links' surfaces, in the world [m], shape (3, p).
        velocity: Velocities of the links there [m/s], shape (3, p).
        normal: Unit vectors out of the obstacles, horizontal, shape (3, p).
        depth: How deep the links are in, positive [m], shape (p,).
        force: On the links, in the world [N], shape (3, p).
    """

    link: IntArray
    point: FloatArray
    velocity: FloatArray
    normal: FloatArray
    depth: FloatArray
    force: FloatArray

    def layers(self, link_count: int) -> list[tuple[FloatArray, FloatArray]]:
        """The forces, at most one a link at a time, as an engine takes them.

        Args:
            link_count: n.

        Returns:
            Forces [N] and points [m], each of shape (3, n), zero where a link has none; as many as
            the most obstacles that one link touches.
        """
        left = np.arange(len(self.link))
        layers: list[tuple[FloatArray, FloatArray]] = []
        while len(left):
            links, first = np.unique(self.link[left], return_index=True)
            chosen = left[first]
            force, point = np.zeros((3, link_count)), np.zeros((3, link_count))
            force[:, links], point[:, links] = self.force[:, chosen], self.point[:, chosen]
            layers.append((force, point))
            left = np.delete(left, first)
        return layers


NO_CONTACT = ObstacleContact(np.empty(0, dtype=np.int64), _NONE, _NONE, _NONE, np.empty(0), _NONE)
"""Nothing touches."""


@dataclass(frozen=True, eq=False)
class ObstacleLaw:
    """The obstacles' law, ready for one body by :func:`obstacle_law`.

    Attributes:
        shapes: What stands in the way, by shape.
        radius: Radii of the n links [m], shape (n,).
        length: Lengths of the links, joint to joint [m], shape (n,).
        mass: Of the links [kg], shape (n,).
        inertia: Their least principal moments [kg m^2], shape (n,).
        dt: Physics step, 0 for the law without steps [s].
    """

    shapes: Sequence[_Round | _Square]
    material: ObstacleMaterial
    radius: FloatArray
    length: FloatArray
    mass: FloatArray
    inertia: FloatArray
    dt: float

    def reachable(self, position: FloatArray, way: float) -> ObstacleLaw:
        """The same law of those obstacles alone that the links can reach.

        Args:
            position: Centres of the links [m], shape (3, n).
            way: How far they move from there, at most [m].
        """
        shapes = [shape.reachable(position[:2, None, :], way) for shape in self.shapes]
        return replace(self, shapes=[shape for shape in shapes if shape is not None])

    def __call__(
        self, position: FloatArray, quaternion: FloatArray, velocity: FloatArray, spin: FloatArray
    ) -> ObstacleContact:
        """The links that touch, and the forces on them; a pure function.

        Args:
            position: Centres of the links in the world [m], shape (3, n).
            quaternion: Their orientations x, y, z, w, shape (4, n).
            velocity: Velocities of the centres [m/s], shape (3, n).
            spin: Angular velocities in the world [rad/s], shape (3, n).
        """
        touches = [
            touch
            for shape in self.shapes
            if (touch := self._touching(shape, position, quaternion)) is not None
        ]
        if not touches:
            return NO_CONTACT
        material = self.material
        link = np.concatenate([touch.link for touch in touches])
        axis = np.concatenate([touch.axis for touch in touches], axis=1)
        normal = np.concatenate([touch.normal for touch in touches], axis=1)
        depth = np.concatenate([touch.depth for touch in touches])
        arm = axis - self.radius[link] * normal
        at_point = velocity[:, link] + cross(spin[:, link], arm)
        speed = (normal * at_point).sum(axis=0)
        press = normal_force(depth, -speed, material.stiffness, material.damping)
        slip = at_point - speed * normal
        give = yielding((arm * arm).sum(axis=0), self.mass[link], self.inertia[link])
        stopped = material.mu * press * self.dt * give
        smoothed = np.sqrt((slip * slip).sum(axis=0) + material.slip_speed**2 + stopped**2)
        force = press * (normal - material.mu * slip / smoothed)
        return ObstacleContact(link, position[:, link] + arm, at_point, normal, depth, force)

    def _touching(
        self, shape: _Round | _Square, position: FloatArray, quaternion: FloatArray
    ) -> _Touch | None:
        """The pairs that touch, with the obstacles of one shape; None where none does."""
        which, link = np.nonzero(shape.near(position[:2, None, :]))
        if not len(link):
            return None
        half = self.length[link] / 2 * _forward(quaternion[:, link])
        pair, closest = shape.closest(which, position[:2, link], half[:2], self.radius[link])
        if not len(pair):
            return None
        which, link, axis = which[pair], link[pair], closest.s * half[:, pair]
        depth = self.radius[link] - closest.distance
        bottom = position[2, link] + axis[2] - self.radius[link]
        touch = (depth > 0.0) & (bottom < shape.height[which])
        if not touch.any():
            return None
        normal = np.zeros((3, int(touch.sum())))
        normal[:2] = closest.normal[:, touch]
        return _Touch(link[touch], axis[:, touch], normal, depth[touch])


def obstacle_law(
    obstacles: Sequence[Obstacle],
    material: ObstacleMaterial,
    radius: FloatArray,
    length: FloatArray,
    *,
    mass: FloatArray,
    inertia: FloatArray,
    dt: float,
) -> ObstacleLaw:
    """Get the obstacles' law ready for one body.

    Args:
        obstacles: What stands in the way.
        radius: Radii of the links [m], shape (n,).
        length: Lengths of the links, joint to joint [m], shape (n,).
        mass: Of the links [kg], shape (n,).
        inertia: Their least principal moments [kg m^2], shape (n,).
        dt: Physics step, 0 for the law without steps [s].
    """
    size = length / 2 + radius  # from the centre of a link to its farthest point
    cylinders, boxes = columns(obstacles)
    shapes = [
        *([_Round(cylinders, size)] if len(cylinders.height) else []),
        *([_Square(boxes, size)] if len(boxes.height) else []),
    ]
    return ObstacleLaw(shapes, material, radius, length, mass, inertia, dt)


def yielding(arm_squared: FloatArray, mass: FloatArray, inertia: FloatArray) -> FloatArray:
    """By how much a free link gives way where it is pushed, in the direction it gives way most.

    Args:
        arm_squared: Square of the distance from its centre [m^2], shape (p,).
        mass: [kg], shape (p,).
        inertia: Least principal moment [kg m^2], shape (p,).

    Returns:
        Velocity that an impulse gives the point, at most [1/kg], shape (p,).
    """
    return 1.0 / mass + arm_squared / inertia


class _Touch(NamedTuple):
    """Pairs that touch: the link, from its centre to the axis's nearest point, normal, depth."""

    link: IntArray
    axis: FloatArray
    normal: FloatArray
    depth: FloatArray


class _Round:
    """Cylinders, against links of some size (from the centre to the farthest point)."""

    def __init__(self, shapes: Cylinders, size: FloatArray) -> None:
        self.height = shapes.height
        self._shapes, self._size = shapes, size
        self._centre = shapes.centre[:, :, None]
        self._reach = shapes.radius[:, None] + size

    def near(self, position: FloatArray, way: float = 0.0) -> BoolArray:
        """Whether a circle about the link, which moves so far, meets the obstacle, shape (o, n)."""
        x, y = position - self._centre
        return x * x + y * y < (self._reach + way) ** 2

    def reachable(self, position: FloatArray, way: float) -> _Round | None:
        """Those that some link can reach on its way; None for none."""
        near = np.flatnonzero(self.near(position, way).any(axis=1))
        return _Round(Cylinders(*_chosen(self._shapes, near)), self._size) if len(near) else None

    def closest(
        self, which: IntArray, middle: FloatArray, half: FloatArray, reach: FloatArray
    ) -> tuple[IntArray, Closest]:
        """Closest points of those pairs that may be within a reach of each other."""
        circles = to_circles(
            middle, half, self._shapes.centre[:, which], self._shapes.radius[which]
        )
        pair = np.flatnonzero(circles.distance < reach)
        return pair, Closest(circles.s[pair], circles.distance[pair], circles.normal[:, pair])


class _Square:
    """Boxes, likewise."""

    def __init__(self, shapes: Boxes, size: FloatArray) -> None:
        self.height = shapes.height
        self._shapes, self._size = shapes, size
        self._centre = shapes.centre[:, :, None]
        self._axis = shapes.axis[:, :, None]
        self._reach = shapes.half[:, :, None] + size

    def near(self, position: FloatArray, way: float = 0.0) -> BoolArray:
        """Whether a square about the link, which moves so far, meets the obstacle, shape (o, n)."""
        x, y = np.abs(into_axes(self._axis, position - self._centre)) < self._reach + way
        return x & y

    def reachable(self, position: FloatArray, way: float) -> _Square | None:
        """Those that some link can reach on its way; None for none."""
        near = np.flatnonzero(self.near(position, way).any(axis=1))
        return _Square(Boxes(*_chosen(self._shapes, near)), self._size) if len(near) else None

    def closest(
        self, which: IntArray, middle: FloatArray, half: FloatArray, reach: FloatArray
    ) -> tuple[IntArray, Closest]:
        """Closest points of those pairs that may be within a reach of each other."""
        axis, size = self._shapes.axis[:, which], self._shapes.half[:, which]
        middle, half = (
            into_axes(axis, middle - self._shapes.centre[:, which]),
            into_axes(axis, half),
        )
        pair = np.flatnonzero(rectangle_gaps(middle, half, size).max(axis=0) < reach)
        if not len(pair):
            return pair, Closest(reach[:0], reach[:0], middle[:, :0])
        rectangles = to_rectangles(middle[:, pair], half[:, pair], size[:, pair])
        return pair, rectangles._replace(normal=out_of_axes(axis[:, pair], rectangles.normal))


def _chosen(shapes: Cylinders | Boxes, which: IntArray) -> Iterator[FloatArray]:
    """The columns of some shapes alone."""
    return (column[..., which] for column in shapes)


def _forward(quaternion: FloatArray) -> FloatArray:
    """The links' x axes in the world, shape (3, p)."""
    x, y, z, w = quaternion
    return np.array([1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + z * w), 2.0 * (x * z - y * w)])
