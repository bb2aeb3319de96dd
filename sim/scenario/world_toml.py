"""The ``[world]`` table of a scenario."""

from __future__ import annotations

import math
from enum import StrEnum
from typing import Any

from undulog.capture.common.config import read, read_field, read_fields, write
from undulog.capture.common.errors import UsageError
from undulog.capture.common.strict_table import Table, at_least, at_most
from undulog.capture.robot.model import Robot

from .field import RandomField
from .obstacles import Box, Cylinder, Obstacle, ObstacleMaterial, Wall
from .world import Ground, World, tilted_gravity


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


def read_world(table: Table, robot: Robot | None, seed: int) -> World:
    """Read ``[world]``.

    Args:
        table: The table.
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
        obstacles=lambda: tuple(one for one in obstacles if one is not None),
        field=lambda: None,
    )
    if "field" in table:
        field = read(table.table("field"), RandomField)
        faultless = not table.faults.all()
        if robot is not None and faultless:  # NaN stands for what is faulty
            try:
                world = world.scattered(field, seed, body_length(robot))
            except UsageError as error:
                table.fault("field", str(error))
    table.close()
    return world


def world_table(world: World) -> dict[str, Any]:
    """A world as the table that :func:`read_world` reads; a field is written as its obstacles.

    Args:
        world: The world.

    Returns:
        Values for TOML.
    """
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
    """From the middle of the head link to the tail's end [m].

    Args:
        robot: The robot.

    Returns:
        The length.
    """
    return math.fsum(link.length for link in robot.links) - robot.links[0].length / 2


def _gravity(table: Table) -> tuple[float, float, float]:
    slope = table.number("slope", at_least(-math.pi / 2), at_most(math.pi / 2), default=0.0)
    heading = table.number("slope_heading", default=0.0)
    if "slope" not in table:
        if "slope_heading" in table:
            table.fault("slope_heading", "leave it out: there is no slope")
        return read_field(table, World, "gravity")
    if "gravity" in table:
        table.fault("gravity", "leave it out: slope says it")
    return tilted_gravity(slope, heading)


def _obstacle(part: Table) -> Obstacle | None:
    """One obstacle; None after a fault of its shape."""
    shape = part.choice("shape", _Shape)
    return None if shape is None else read(part, _KINDS[shape])
