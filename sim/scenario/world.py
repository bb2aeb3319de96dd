"""Where the robot is: gravity, ground, obstacles, target, and how it starts."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np

from undulog.capture.common.arrays import FloatArray
from undulog.capture.common.config import NonNegative, Positive, read_fields
from undulog.capture.common.errors import UsageError
from undulog.capture.common.strict_table import Table, listed
from undulog.capture.robot.model import Robot

from .field import RandomField
from .obstacles import Obstacle, ObstacleMaterial, Target


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
    """What the ground is made of.

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
        link: Name of the link.
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
        pushes: The pushes.
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


def read_pushes(top: Table, robot: Robot | None) -> tuple[Push, ...]:
    """Read ``[[disturbances]]`` of a scenario.

    Args:
        top: The scenario.
        robot: Who is pushed; None after a fault: then names can't be checked.

    Returns:
        The pushes.
    """
    return tuple(_read_push(table, robot) for table in top.tables("disturbances"))


def _read_push(table: Table, robot: Robot | None) -> Push:
    push = read_fields(table, Push)
    names = [] if robot is None else [link.name for link in robot.links]
    if robot is not None and push.link and push.link not in names:
        table.fault("link", listed(names, push.link))
    table.close()
    return push


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
