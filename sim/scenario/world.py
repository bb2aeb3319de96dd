"""The robot's world: gravity, ground, obstacles, target and start."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any

import numpy as np

from undulog.capture.common.arrays import FloatArray
from undulog.capture.common.config import (
    NonNegative,
    Positive,
    read,
    read_field,
    read_fields,
    write,
)
from undulog.capture.common.errors import UsageError
from undulog.capture.common.strict_table import StrictTable, at_least, at_most, listed
from undulog.capture.robot.model import Robot

from .obstacles import Box, Cylinder, Obstacle, ObstacleMaterial, RandomField, Target, Wall

STANDARD_GRAVITY = 9.81
"""Default acceleration of gravity [m/s^2]."""


class FrictionLaw(StrEnum):
    """How the ground resists a link that slips along it.

    The first three are Coulomb's, proportional to the normal force; they differ in how the two
    coefficients combine when a link slips obliquely. The last one is a fluid's.

    ``ellipse``: greatest dissipation on the ellipse (F_t/mu_t)^2 + (F_n/mu_n)^2 = N^2, the
    convex anisotropic Coulomb law (Goyal, Ruina & Papadopoulos, Wear 143, 1991).
    ``box``: each axis on its own, F_i = mu_i N sgn(v_i), the literal reading of Meister,
    Stepanenko & Kernbach 2011.
    ``transeth``: F_i = mu_i N v_i / |v| (Transeth, Leine, Glocker & Pettersen, IEEE Trans.
    Robotics 24, 2008).
    ``viscous``: F_i = -c_i v_i, whatever the normal force, on every link that touches the surface:
    resistive-force theory (Gray & Hancock, J. Exp. Biol. 32, 1955), for eels and for theory.
    """

    ELLIPSE = "ellipse"
    BOX = "box"
    TRANSETH = "transeth"
    VISCOUS = "viscous"


@dataclass(frozen=True)
class Ground:
    """Properties of the ground.

    Attributes:
        stiffness: k of Eq. 7 [N/m].
        damping: d of Eq. 7 [N s/m].
        mu_tangential: Friction coefficient along the body.
        mu_normal: Friction coefficient across the body.
        slip_speed: The smoothing: at this slip speed friction reaches 1/sqrt(2) of Coulomb's [m/s].
        law: How the ground resists slip.
        drag_tangential: c_t of the viscous law, a link's drag along the body [N s/m].
        drag_normal: c_n of the viscous law, a link's drag across the body [N s/m].
    """

    stiffness: Positive = 2000.0
    damping: NonNegative = 20.0
    mu_tangential: NonNegative = 0.05
    mu_normal: NonNegative = 0.5
    slip_speed: Positive = 0.01
    law: FrictionLaw = FrictionLaw.ELLIPSE
    drag_tangential: NonNegative = 1.0
    drag_normal: NonNegative = 10.0


@dataclass(frozen=True)
class Push:
    """A constant force on the centre of a link.

    Attributes:
        force: In the world [N].
        start_s: When it begins [s].
        duration_s: How long it lasts [s].
    """

    link: str
    force: tuple[float, float, float]
    start_s: NonNegative
    duration_s: Positive


def pushes_during(
    pushes: Sequence[Push], link_names: Sequence[str], times_s: FloatArray
) -> FloatArray | None:
    """Forces on all links at some times.

    Args:
        link_names: Names of the n links.
        times_s: Times of k physics steps [s], shape (k,).

    Returns:
        Forces in the world [N], shape (k, 3, n), or None where nothing pushes at any of them.
    """
    forces: FloatArray | None = None
    for push in pushes:
        acts = (times_s >= push.start_s) & (times_s < push.start_s + push.duration_s)
        if acts.any():
            if forces is None:
                forces = np.zeros((len(times_s), 3, len(link_names)))
            forces[acts, :, link_names.index(push.link)] += push.force
    return forces


def read_pushes(top: StrictTable, robot: Robot | None) -> tuple[Push, ...]:
    """Read ``[[disturbances]]`` of a scenario.

    Args:
        robot: Who is pushed; None after a fault: then names can't be checked.
    """
    return tuple(_read_push(table, robot) for table in top.tables("disturbances"))


def _read_push(table: StrictTable, robot: Robot | None) -> Push:
    push = read_fields(table, Push)
    names = [] if robot is None else [link.name for link in robot.links]
    if robot is not None and push.link and push.link not in names:
        table.fault("link", listed(names, push.link))
    table.close()
    return push


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
            seed: The scenario's, unless the field has its own.
            body_length: From the middle of the robot's head link to its tail's end [m].

        Returns:
            The world, its obstacles followed by the field's.

        Raises:
            UsageError: If there is no room for so many.
        """
        tail = -body_length * math.cos(self.heading), -body_length * math.sin(self.heading)
        cylinders = field.cylinders(
            seed, body=((0.0, 0.0), tail), target=self.target, standing=self.obstacles
        )
        if len(cylinders) < field.count:
            raise UsageError(
                f"the field of obstacles has room for {len(cylinders)} of {field.count}; lower "
                "count, radius, clear or gap, or raise size"
            )
        return dataclasses.replace(self, obstacles=(*self.obstacles, *cylinders), field=field)

    def redrawn(self, seed: int, body_length: float) -> World:
        """The same world with its field of obstacles, if it has one, drawn again.

        Args:
            seed: The scenario's, unless the field has its own.
            body_length: From the middle of the robot's head link to its tail's end [m].

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


class _Surface(StrEnum):
    FLAT = "flat"
    NONE = "none"


class _Shape(StrEnum):
    CYLINDER = "cylinder"
    BOX = "box"
    WALL = "wall"


_KINDS: dict[_Shape, type[Obstacle]] = {
    _Shape.CYLINDER: Cylinder,
    _Shape.BOX: Box,
    _Shape.WALL: Wall,
}


def read_world(table: StrictTable, robot: Robot | None, seed: int) -> World:
    """Read ``[world]``.

    Args:
        robot: Who will be in it, None after a fault.
        seed: The scenario's, that a field of obstacles is drawn with.

    Returns:
        The world, its field drawn.
    """
    surface = table.choice("surface", _Surface, _Surface.FLAT)
    if surface is _Surface.NONE and "ground" in table:
        table.fault("ground", 'leave it out: surface is "none"')
    ground = read(table.table("ground"), Ground)
    obstacles = (_obstacle(part) for part in table.tables("obstacles"))
    world = read_fields(
        table,
        World,
        gravity=lambda: _gravity(table),
        ground=lambda: None if surface is _Surface.NONE else ground,
        obstacles=lambda: tuple(obstacle for obstacle in obstacles if obstacle is not None),
        field=lambda: None,
    )
    if "field" in table:
        field = read(table.table("field"), RandomField)
        if robot is not None and not table.faults.all():  # NaN stands for what is faulty
            try:
                world = world.scattered(field, seed, body_length(robot))
            except UsageError as error:
                table.fault("field", str(error))
    table.close()
    return world


def world_table(world: World) -> dict[str, Any]:
    """A world as the table that :func:`read_world` reads; a field is written as its obstacles."""
    values = write(world)
    values.pop("field", None)
    values["surface"] = _Surface.NONE if world.ground is None else _Surface.FLAT
    if world.obstacles:
        shapes = {kind: shape for shape, kind in _KINDS.items()}
        values["obstacles"] = [{"shape": shapes[type(o)], **write(o)} for o in world.obstacles]
        return values
    del values["obstacles"]
    if world.obstacle_contact == ObstacleMaterial():
        del values["obstacle_contact"]
    return values


def body_length(robot: Robot) -> float:
    """From the middle of the head link to the tail's end [m]."""
    return math.fsum(link.length for link in robot.links) - robot.links[0].length / 2


def _gravity(table: StrictTable) -> tuple[float, float, float]:
    slope = table.number("slope", at_least(-math.pi / 2), at_most(math.pi / 2), default=0.0)
    heading = table.number("slope_heading", default=0.0)
    if "slope" not in table:
        if "slope_heading" in table:
            table.fault("slope_heading", "leave it out: there is no slope")
        return read_field(table, World, "gravity")
    if "gravity" in table:
        table.fault("gravity", "leave it out: slope gives it")
    return tilted_gravity(slope, heading)


def _obstacle(part: StrictTable) -> Obstacle | None:
    """One obstacle; None after a fault of its shape."""
    shape = part.choice("shape", _Shape)
    return None if shape is None else read(part, _KINDS[shape])
