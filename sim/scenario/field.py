"""Fields of cylinders that stand at random."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Annotated, TypeAlias

import numpy as np

from undulog.capture.common.arrays import FloatArray
from undulog.capture.common.config import Count, NonNegative, Positive
from undulog.capture.common.strict_table import at_least

from .obstacles import (
    Cylinder,
    Obstacle,
    PositivePair,
    Target,
    columns,
    into_axes,
    to_circles,
    to_rectangles,
)

Seed: TypeAlias = Annotated[int, at_least(0)]

STREAM = 2
"""Number of the random stream that places and radii are drawn from."""

_TRIES = 1000  # places tried for each cylinder


@dataclass(frozen=True)
class RandomField:
    """Cylinders at random places in a rectangle, apart from each other.

    Attributes:
        count: How many.
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
            target: The target.
            standing: Obstacles that are there already.

        Returns:
            The cylinders; fewer than asked for where no place was found for more.
        """
        random = np.random.default_rng([seed if self.seed is None else self.seed, STREAM])
        head, tail = np.array(body)

        def free(one: Cylinder, others: Sequence[Obstacle]) -> bool:
            at = np.array(one.position)
            return (
                _distance([one], (head + tail) / 2, (head - tail) / 2) >= self.clear
                and _distance(others, at, np.zeros(2)) >= one.radius + self.gap
                and (
                    target is None
                    or np.hypot(*(at - target.position)) >= target.radius + one.radius + self.clear
                )
            )

        placed: list[Cylinder] = []
        for _ in range(self.count):
            radius = random.uniform(*self.radius)
            tries = (self._drawn(random, radius) for _ in range(_TRIES))
            found = next((one for one in tries if free(one, [*standing, *placed])), None)
            if found is None:
                break
            placed.append(found)
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
