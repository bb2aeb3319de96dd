"""Where the robot is: gravity, ground, and how it starts."""

from __future__ import annotations

from dataclasses import dataclass, field

from .ground import Ground


@dataclass(frozen=True)
class World:
    """Where the robot is.

    Attributes:
        gravity: Acceleration of gravity [m/s^2]; the ground is the plane z = 0.
        heading: Direction of the head at the start, about z [rad].
        velocity: Of the whole robot at the start, in the world [m/s].
        ground: The ground, or None: then nothing touches the robot.
    """

    gravity: tuple[float, float, float] = (0.0, 0.0, -9.81)
    heading: float = 0.0
    velocity: tuple[float, float, float] = (0.0, 0.0, 0.0)
    ground: Ground | None = field(default_factory=Ground)
