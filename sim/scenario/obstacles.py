"""What stands on the ground: upright shapes, from z = 0 to their height; and a target.

All stand still and are rigid. A circle or a rectangle in plan view, so that distances and ray
intersections have closed forms.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

import numpy as np

from undulog.capture.common.arrays import FloatArray, frozen


@dataclass(frozen=True)
class Cylinder:
    """An upright cylinder.

    Attributes:
        position: x and y of its axis [m].
        radius: [m].
        height: [m].
    """

    position: tuple[float, float]
    radius: float
    height: float = 0.3


@dataclass(frozen=True)
class Box:
    """An upright box.

    Attributes:
        position: x and y of its centre [m].
        size: Lengths along its own x and y axes [m].
        heading: Direction of its x axis, about z [rad].
        height: [m].
    """

    position: tuple[float, float]
    size: tuple[float, float]
    heading: float = 0.0
    height: float = 0.3


@dataclass(frozen=True)
class Wall:
    """A straight wall.

    Attributes:
        start: x and y of the middle of one end [m].
        end: x and y of the middle of the other end [m].
        thickness: [m].
        height: [m].
    """

    start: tuple[float, float]
    end: tuple[float, float]
    thickness: float = 0.02
    height: float = 0.3

    @property
    def box(self) -> Box:
        """The wall as a box."""
        (x0, y0), (x1, y1) = self.start, self.end
        return Box(
            position=((x0 + x1) / 2, (y0 + y1) / 2),
            size=(math.hypot(x1 - x0, y1 - y0), self.thickness),
            heading=math.atan2(y1 - y0, x1 - x0),
            height=self.height,
        )


Obstacle: TypeAlias = Cylinder | Box | Wall


@dataclass(frozen=True)
class Target:
    """Where the robot is to go; it neither stands in the way nor is seen by range sensors.

    Attributes:
        position: x and y [m].
        radius: The target is met when the head is not farther from its centre [m].
    """

    position: tuple[float, float]
    radius: float = 0.3


@dataclass(frozen=True)
class ObstacleMaterial:
    """What obstacles are made of.

    Attributes:
        stiffness: Of the contact spring [N/m].
        damping: Of its damper [N s/m].
        mu: Friction coefficient, the same in all directions.
        slip_speed: The smoothing: at this slip speed friction reaches 1/sqrt(2) of Coulomb's [m/s].
    """

    stiffness: float = 5000.0
    damping: float = 20.0
    mu: float = 0.3
    slip_speed: float = 0.01


class Cylinders(NamedTuple):
    """Cylinders as columns.

    Attributes:
        centre: x and y [m], shape (2, c).
        radius: [m], shape (c,).
        height: [m], shape (c,).
    """

    centre: FloatArray
    radius: FloatArray
    height: FloatArray


class Boxes(NamedTuple):
    """Boxes, walls among them, as columns.

    Attributes:
        centre: x and y [m], shape (2, b).
        axis: Unit vector of the x axis, x and y, shape (2, b).
        half: Half of the size along the own axes [m], shape (2, b).
        height: [m], shape (b,).
    """

    centre: FloatArray
    axis: FloatArray
    half: FloatArray
    height: FloatArray


def columns(obstacles: Sequence[Obstacle]) -> tuple[Cylinders, Boxes]:
    """Sort obstacles by shape, into arrays.

    Args:
        obstacles: In any order.

    Returns:
        Cylinders, and boxes with the walls among them, each in the order given.
    """
    round_ones = [one for one in obstacles if isinstance(one, Cylinder)]
    boxes = [
        one.box if isinstance(one, Wall) else one
        for one in obstacles
        if not isinstance(one, Cylinder)
    ]
    heading = [box.heading for box in boxes]
    return (
        Cylinders(
            _rows([one.position for one in round_ones]),
            _row([one.radius for one in round_ones]),
            _row([one.height for one in round_ones]),
        ),
        Boxes(
            _rows([box.position for box in boxes]),
            _rows([(math.cos(angle), math.sin(angle)) for angle in heading]),
            _rows([(box.size[0] / 2, box.size[1] / 2) for box in boxes]),
            _row([box.height for box in boxes]),
        ),
    )


def into_axes(axis: FloatArray, vector: FloatArray) -> FloatArray:
    """Turn world vectors in plan view into axes of their own.

    Args:
        axis: Unit vectors of the x axes, shape (2, ...).
        vector: In the world, shape (2, ...).

    Returns:
        The same vectors in these axes, shape (2, ...).
    """
    (ax, ay), (x, y) = axis, vector
    return np.array([ax * x + ay * y, ax * y - ay * x])


def out_of_axes(axis: FloatArray, vector: FloatArray) -> FloatArray:
    """Turn vectors in axes of their own back into the world; undoes :func:`into_axes`.

    Args:
        axis: Unit vectors of the x axes, shape (2, ...).
        vector: In these axes, shape (2, ...).

    Returns:
        The same vectors in the world, shape (2, ...).
    """
    (ax, ay), (x, y) = axis, vector
    return np.array([ax * x - ay * y, ay * x + ax * y])


def _row(values: Sequence[float]) -> FloatArray:
    return frozen(np.array(values, dtype=np.float64))


def _rows(pairs: Sequence[tuple[float, float]]) -> FloatArray:
    return frozen(np.array(pairs, dtype=np.float64).reshape(-1, 2).T)
