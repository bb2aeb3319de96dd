"""What stands on the ground: upright shapes, from z = 0 to their height; and a target.

All stand still and are rigid. A circle or a rectangle in plan view, so that distances and ray
intersections have closed forms.

Closest points of straight segments to circles and rectangles in plan view, in closed form.

A segment is given by its middle and half of its length as a vector: its points are middle + s half,
s from -1 to 1. All arrays are over p pairs of a segment and a shape, the component first.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Annotated, NamedTuple, TypeAlias

import numpy as np

from undulog.capture.common.arrays import FloatArray, frozen
from undulog.capture.common.config import Count, Key, NonNegative, Positive
from undulog.capture.common.strict_table import above, at_least

_TINY = 1e-300  # makes 0/0 a zero

PositivePair: TypeAlias = Annotated[tuple[float, float], above(0.0)]

STREAM = 2
"""Number of the random stream that places and radii are drawn from."""

_TRIES = 1000  # places tried for each cylinder


Seed: TypeAlias = Annotated[int, at_least(0)]


class Closest(NamedTuple):
    """Where a segment and a shape are nearest.

    Attributes:
        s: Place on the segment, -1 to 1, shape (p,).
        distance: From the shape's outline [m], negative inside, shape (p,).
        normal: Unit vector from the shape towards the segment, x and y, shape (2, p); zero where a
            segment goes exactly through a circle's centre.
    """

    s: FloatArray
    distance: FloatArray
    normal: FloatArray


def to_circles(
    middle: FloatArray, half: FloatArray, centre: FloatArray, radius: FloatArray
) -> Closest:
    """Closest points to circles.

    Args:
        middle: Of the segments [m], shape (2, p).
        half: Half of the segments [m], shape (2, p).
        centre: Of the circles [m], shape (2, p).
        radius: Of the circles [m], shape (p,).
    """
    s = _place(middle, half, centre)
    away = middle + s * half - centre
    distance = _length(away)
    return Closest(s, distance - radius, away / np.maximum(distance, _TINY))


def to_rectangles(middle: FloatArray, half: FloatArray, size: FloatArray) -> Closest:
    """Closest points to rectangles, each about the origin along its own axes.

    Apart, the nearest point of the segment is one of its ends, or the foot of a corner. Where they
    meet, the way out is the shortest translation that parts them, along one of the rectangle's
    axes or across the segment (the separating axes), so that depth and normal go on smoothly from
    a touch at an end or at a corner.

    Args:
        middle: Of the segments, in the rectangles' axes [m], shape (2, p).
        half: Half of the segments, in these axes [m], shape (2, p).
        size: Half of the rectangles' lengths [m], shape (2, p).

    Returns:
        The closest points, normals in the rectangles' axes.
    """
    gaps = rectangle_gaps(middle, half, size)
    meet = gaps.max(axis=0) < 0.0
    apart = _apart(middle, half, size)
    if not meet.any():
        return apart
    inside = _overlapping(middle, half, size, gaps)
    return Closest(*(np.where(meet, b, a) for a, b in zip(apart, inside, strict=True)))


def rectangle_gaps(middle: FloatArray, half: FloatArray, size: FloatArray) -> FloatArray:
    """Gaps between segments and rectangles along the axes that may separate them.

    Args:
        middle: As in :func:`to_rectangles`.

    Returns:
        Along the rectangle's axes and across the segment [m], negative where they overlap, shape
        (3, p): the greatest one is never more than the distance, and negative where they meet.
    """
    along_axes = np.abs(middle) - np.abs(half) - size
    length = _length(half)
    reach = np.abs(half[1]) * size[0] + np.abs(half[0]) * size[1]
    offset = np.abs(half[0] * middle[1] - half[1] * middle[0])
    across = np.where(length > 0.0, (offset - reach) / np.maximum(length, _TINY), -np.inf)
    return np.concatenate([along_axes, across[None]])  # a point has no side


def _apart(middle: FloatArray, half: FloatArray, size: FloatArray) -> Closest:
    """Closest points where segment and rectangle do not meet."""
    ends = np.array([-1.0, 1.0])[:, None] * np.ones(middle.shape[1])
    signs = np.array([[-1.0, -1.0, 1.0, 1.0], [-1.0, 1.0, -1.0, 1.0]])
    corners = signs[:, :, None] * size[:, None]  # (2, 4, p)
    s = np.concatenate([ends, _place(middle[:, None], half[:, None], corners)])  # (6, p)
    point = middle[:, None] + s * half[:, None]
    limit = size[:, None]
    # The rectangle's nearest point to any point is found by clipping; for a corner's foot that is
    # never farther than the corner itself.
    away = point - np.minimum(np.maximum(point, -limit), limit)
    distance = _length(away)
    nearest = np.argmin(distance, axis=0)
    pair = np.arange(len(nearest))
    shortest = distance[nearest, pair]
    return Closest(s[nearest, pair], shortest, away[:, nearest, pair] / np.maximum(shortest, _TINY))


def _overlapping(
    middle: FloatArray, half: FloatArray, size: FloatArray, gaps: FloatArray
) -> Closest:
    """The shortest way out where segment and rectangle meet."""
    across = np.array([-half[1], half[0]]) / np.maximum(_length(half), _TINY)
    axis = np.argmax(gaps, axis=0)
    pair = np.arange(len(axis))
    zero = np.zeros(len(axis))
    normals = np.array(
        [
            [_side(middle[0]), zero],
            [zero, _side(middle[1])],
            across * _side((across * middle).sum(axis=0)),
        ]
    )  # (3, 2, p)
    normal = normals[axis, :, pair].T
    deepest_end = -_side((half * normal).sum(axis=0))
    s = np.where(axis == 2, _place(middle, half, np.copysign(size, normal)), deepest_end)
    return Closest(s, gaps[axis, pair], normal)


def _place(middle: FloatArray, half: FloatArray, point: FloatArray) -> FloatArray:
    """Place on a segment that is nearest to a point."""
    s = ((point - middle) * half).sum(axis=0) / np.maximum((half * half).sum(axis=0), _TINY)
    return np.minimum(np.maximum(s, -1.0), 1.0)


def _side(value: FloatArray) -> FloatArray:
    """The sign, 1 for zero."""
    return np.where(value < 0.0, -1.0, 1.0)


def _length(vector: FloatArray) -> FloatArray:
    """Length of vectors, component first."""
    return np.sqrt((vector * vector).sum(axis=0))


@dataclass(frozen=True)
class Cylinder:
    """An upright cylinder.

    Attributes:
        position: x and y of its axis [m].
        radius: [m].
        height: [m].
    """

    position: tuple[float, float]
    radius: Positive
    height: Positive = 0.3


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
    size: PositivePair
    heading: float = 0.0
    height: Positive = 0.3


@dataclass(frozen=True)
class Wall:
    """A straight wall.

    Attributes:
        start: x and y of the middle of one end [m].
        end: x and y of the middle of the other end [m].
        thickness: [m].
        height: [m].
    """

    start: Annotated[tuple[float, float], Key("from")]
    end: Annotated[tuple[float, float], Key("to")]
    thickness: Positive = 0.02
    height: Positive = 0.3

    def contradictions(self) -> Iterator[tuple[str, str]]:
        """The wall has a length."""
        if self.start == self.end:
            yield "to", "another point than from"

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
    radius: Positive = 0.3


@dataclass(frozen=True)
class ObstacleMaterial:
    """Properties of the obstacles' surfaces.

    Attributes:
        stiffness: Of the contact spring [N/m].
        damping: Of its damper [N s/m].
        mu: Friction coefficient, the same in all directions.
        slip_speed: The smoothing: at this slip speed friction reaches 1/sqrt(2) of Coulomb's [m/s].
    """

    stiffness: Positive = 5000.0
    damping: NonNegative = 20.0
    mu: NonNegative = 0.3
    slip_speed: Positive = 0.01


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

    Returns:
        Cylinders, and boxes with the walls among them, each in the order given.
    """
    round_ones = [obstacle for obstacle in obstacles if isinstance(obstacle, Cylinder)]
    boxes = [
        obstacle.box if isinstance(obstacle, Wall) else obstacle
        for obstacle in obstacles
        if not isinstance(obstacle, Cylinder)
    ]
    heading = [box.heading for box in boxes]
    return (
        Cylinders(
            _rows([round_one.position for round_one in round_ones]),
            _row([round_one.radius for round_one in round_ones]),
            _row([round_one.height for round_one in round_ones]),
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


@dataclass(frozen=True)
class RandomField:
    """Cylinders at random places in a rectangle, apart from each other.

    Attributes:
        size: Lengths of the rectangle along x and y [m].
        centre: Its centre, x and y [m].
        radius: Least and greatest radius [m].
        height: [m].
        clear: No cylinder is nearer than this to the robot's axis at its start or to the target's
            edge [m].
        gap: Nor nearer than this to another obstacle [m].
        seed: Of places and radii; the scenario's if None.
    """

    count: Count
    size: PositivePair
    centre: tuple[float, float] = (0.0, 0.0)
    radius: PositivePair = (0.05, 0.15)
    height: Positive = 0.3
    clear: NonNegative = 0.3
    gap: NonNegative = 0.2
    seed: Seed | None = None

    def contradictions(self) -> Iterator[tuple[str, str]]:
        """The least radius is no greater than the greatest one."""
        least, greatest = self.radius
        if least > greatest:
            yield "radius", "[least, greatest]"

    def cylinders(
        self,
        seed: int,
        *,
        body: tuple[tuple[float, float], tuple[float, float]],
        target: Target | None,
        standing: Sequence[Obstacle],
    ) -> tuple[Cylinder, ...]:
        """Draw the field.

        Args:
            seed: The scenario's.
            body: Head and tail of the robot at its start, x and y [m].
            standing: Obstacles that are there already.

        Returns:
            The cylinders; fewer than asked for where no place was found for more.
        """
        random = np.random.default_rng([seed if self.seed is None else self.seed, STREAM])
        head, tail = np.array(body)

        def free(cylinder: Cylinder, others: Sequence[Obstacle]) -> bool:
            at = np.array(cylinder.position)
            return (
                _distance([cylinder], (head + tail) / 2, (head - tail) / 2) >= self.clear
                and _distance(others, at, np.zeros(2)) >= cylinder.radius + self.gap
                and (
                    target is None
                    or np.hypot(*(at - target.position))
                    >= target.radius + cylinder.radius + self.clear
                )
            )

        placed: list[Cylinder] = []
        for _ in range(self.count):
            radius = random.uniform(*self.radius)
            tries = (self._drawn(random, radius) for _ in range(_TRIES))
            chosen = next(
                (candidate for candidate in tries if free(candidate, [*standing, *placed])), None
            )
            if chosen is None:
                break
            placed.append(chosen)
        return tuple(placed)

    def _drawn(self, random: np.random.Generator, radius: float) -> Cylinder:
        """A cylinder of some radius somewhere."""
        x, y = np.array(self.centre) + random.uniform(-0.5, 0.5, 2) * self.size
        return Cylinder((float(x), float(y)), radius, self.height)


def _distance(obstacles: Sequence[Obstacle], middle: FloatArray, half: FloatArray) -> float:
    """From a segment to the nearest of some obstacles in plan view; inf without any."""
    cylinders, boxes = columns(obstacles)
    at = middle[:, None]
    to_round = to_circles(at, half[:, None], cylinders.centre, cylinders.radius)
    to_box = to_rectangles(
        into_axes(boxes.axis, at - boxes.centre),
        into_axes(boxes.axis, half[:, None]),
        boxes.half,
    )
    return float(min(to_round.distance.min(initial=np.inf), to_box.distance.min(initial=np.inf)))
