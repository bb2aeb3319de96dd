"""Where the robot is: gravity, ground, obstacles, target, and how it starts."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass, field

from undulog.capture.common.errors import UsageError

from .field import RandomField
from .ground import Ground
from .obstacles import Obstacle, ObstacleMaterial, Target

STANDARD_GRAVITY = 9.81
"""Acceleration of gravity where nothing else is said [m/s^2]."""


@dataclass(frozen=True)
class World:
    """Where the robot is; its head starts above the origin.

    Attributes:
        gravity: Acceleration of gravity [m/s^2]; the ground is the plane z = 0.
        heading: Direction of the head at the start, about z [rad].
        velocity: Of the whole robot at the start, in the world [m/s].
        ground: The ground, or None: then there is none to touch.
        obstacles: What stands on it, or would.
        obstacle_contact: What obstacles are made of.
        target: Where the robot is to go, or None.
        field: What the last obstacles were drawn from, or None; the obstacles say it all, so that
            it does not count when worlds are compared.
    """

    gravity: tuple[float, float, float] = (0.0, 0.0, -STANDARD_GRAVITY)
    heading: float = 0.0
    velocity: tuple[float, float, float] = (0.0, 0.0, 0.0)
    ground: Ground | None = field(default_factory=Ground)
    obstacles: tuple[Obstacle, ...] = ()
    obstacle_contact: ObstacleMaterial = field(default_factory=ObstacleMaterial)
    target: Target | None = None
    field: RandomField | None = field(default=None, compare=False)

    def turned(self, angle: float) -> World:
        """The same world with the robot put down turned about the vertical.

        Args:
            angle: Counter-clockwise [rad].

        Returns:
            The world; the robot's velocity at the start turns along.
        """
        x, y, z = self.velocity
        c, s = math.cos(angle), math.sin(angle)
        velocity = (c * x - s * y, s * x + c * y, z)
        return dataclasses.replace(self, heading=self.heading + angle, velocity=velocity)

    def scattered(self, field: RandomField, seed: int, body_length: float) -> World:
        """The same world with a field of obstacles in it.

        Args:
            field: The field.
            seed: The scenario's, unless the field has its own.
            body_length: From the middle of the robot's head link to its tail's end [m].

        Returns:
            The world, its obstacles followed by the field's.

        Raises:
            UsageError: If there is no room for so many.
        """
        tail = -body_length * math.cos(self.heading), -body_length * math.sin(self.heading)
        found = field.cylinders(
            seed, body=((0.0, 0.0), tail), target=self.target, standing=self.obstacles
        )
        if len(found) < field.count:
            raise UsageError(
                f"the field of obstacles has room for {len(found)} of {field.count}; lower count, "
                "radius, clear or gap, or raise size"
            )
        return dataclasses.replace(self, obstacles=(*self.obstacles, *found), field=field)

    def redrawn(self, seed: int, body_length: float) -> World:
        """The same world with its field of obstacles, if it has one, drawn again.

        Args:
            seed: The scenario's, unless the field has its own.
            body_length: From the middle of the robot's head link to its tail's end [m].

        Returns:
            The world.

        Raises:
            UsageError: If there is no room for so many with this seed.
        """
        if self.field is None:
            return self
        standing = self.obstacles[: len(self.obstacles) - self.field.count]
        return dataclasses.replace(self, obstacles=standing).scattered(
            self.field, seed, body_length
        )


def tilted_gravity(slope: float, heading: float) -> tuple[float, float, float]:
    """Gravity on a plane that is tilted against the horizontal, in the plane's own frame.

    Args:
        slope: Angle of the plane [rad].
        heading: Which way is downhill, about z [rad].

    Returns:
        Acceleration [m/s^2].
    """
    down = STANDARD_GRAVITY * math.sin(slope)
    return (
        down * math.cos(heading),
        down * math.sin(heading),
        -STANDARD_GRAVITY * math.cos(slope),
    )
