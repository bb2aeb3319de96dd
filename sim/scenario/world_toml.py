"""The ``[world]`` table of a scenario."""

from __future__ import annotations

import dataclasses
import math
from enum import StrEnum
from typing import Any

from undulog.capture.common.errors import UsageError
from undulog.capture.common.strict_table import Table
from undulog.capture.robot.model import Robot

from .field import RandomField
from .obstacles import Box, Cylinder, Obstacle, ObstacleMaterial, Target, Wall
from .world import FrictionLaw, Ground, World, tilted_gravity


class _Surface(StrEnum):
    FLAT = "flat"
    NONE = "none"


class _Shape(StrEnum):
    CYLINDER = "cylinder"
    BOX = "box"
    WALL = "wall"


def read_world(table: Table, robot: Robot | None, seed: int) -> World:
    """Read ``[world]``.

    Args:
        table: The table.
        robot: Who will be in it, None after a fault.
        seed: The scenario's, that a field of obstacles is drawn with.

    Returns:
        The world, its field drawn.
    """
    surface = table.choice("surface", _Surface) if "surface" in table else _Surface.FLAT
    if surface is _Surface.NONE and "ground" in table:
        table.fault("ground", 'leave it out: surface is "none"')
    ground = _ground(table.table("ground"))
    world = World(
        gravity=_gravity(table),
        heading=table.number("heading", default=World.heading),
        velocity=table.triple("velocity", default=World.velocity),
        ground=None if surface is _Surface.NONE else ground,
        obstacles=tuple(
            one
            for values, where in table.tables("obstacles")
            if (one := _obstacle(Table(values, where, table.faults))) is not None
        ),
        obstacle_contact=_material(table.table("obstacle_contact")),
        target=_target(table.table("target")) if "target" in table else None,
    )
    if "field" in table:
        field = _field(table.table("field"))
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
    values: dict[str, Any] = {
        "gravity": list(world.gravity),
        "heading": world.heading,
        "velocity": list(world.velocity),
        "surface": _Surface.FLAT if world.ground is not None else _Surface.NONE,
    }
    if world.ground is not None:
        values["ground"] = dataclasses.asdict(world.ground)
    if world.obstacles:
        values["obstacles"] = [_as_table(one) for one in world.obstacles]
    if world.obstacles or world.obstacle_contact != ObstacleMaterial():
        values["obstacle_contact"] = dataclasses.asdict(world.obstacle_contact)
    if world.target is not None:
        values["target"] = dataclasses.asdict(world.target)
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
    slope = table.number("slope", default=0.0, at_least=-math.pi / 2, at_most=math.pi / 2)
    heading = table.number("slope_heading", default=0.0)
    if "slope" not in table:
        if "slope_heading" in table:
            table.fault("slope_heading", "leave it out: there is no slope")
        return table.triple("gravity", default=World.gravity)
    if "gravity" in table:
        table.fault("gravity", "leave it out: slope says it")
    return tilted_gravity(slope, heading)


def _ground(part: Table) -> Ground:
    law = part.choice("law", FrictionLaw) if "law" in part else None
    ground = Ground(
        stiffness=part.number("stiffness", default=Ground.stiffness, above=0.0),
        damping=part.number("damping", default=Ground.damping, at_least=0.0),
        mu_tangential=part.number("mu_tangential", default=Ground.mu_tangential, at_least=0.0),
        mu_normal=part.number("mu_normal", default=Ground.mu_normal, at_least=0.0),
        slip_speed=part.number("slip_speed", default=Ground.slip_speed, above=0.0),
        law=law or Ground.law,
        drag_tangential=part.number(
            "drag_tangential", default=Ground.drag_tangential, at_least=0.0
        ),
        drag_normal=part.number("drag_normal", default=Ground.drag_normal, at_least=0.0),
    )
    part.close()
    return ground


def _obstacle(part: Table) -> Obstacle | None:
    """One obstacle; None after a fault of its shape."""
    shape = part.choice("shape", _Shape)
    if shape is None:
        return None
    height = part.number("height", default=Cylinder.height, above=0.0)
    one: Obstacle
    if shape is _Shape.CYLINDER:
        one = Cylinder(part.pair("position"), part.number("radius", above=0.0), height)
    elif shape is _Shape.BOX:
        heading = part.number("heading", default=Box.heading)
        one = Box(part.pair("position"), part.pair("size", above=0.0), heading, height)
    else:
        start, end = part.pair("from"), part.pair("to")
        if start == end:
            part.fault("to", "another point than from")
        thickness = part.number("thickness", default=Wall.thickness, above=0.0)
        one = Wall(start, end, thickness, height)
    part.close()
    return one


def _as_table(one: Obstacle) -> dict[str, Any]:
    if isinstance(one, Wall):
        ends = {"from": list(one.start), "to": list(one.end)}
        return {
            "shape": _Shape.WALL,
            **ends,
            "thickness": one.thickness,
            "height": one.height,
        }
    shape = _Shape.CYLINDER if isinstance(one, Cylinder) else _Shape.BOX
    return {"shape": shape, **dataclasses.asdict(one)}


def _material(part: Table) -> ObstacleMaterial:
    default = ObstacleMaterial
    material = ObstacleMaterial(
        stiffness=part.number("stiffness", default=default.stiffness, above=0.0),
        damping=part.number("damping", default=default.damping, at_least=0.0),
        mu=part.number("mu", default=default.mu, at_least=0.0),
        slip_speed=part.number("slip_speed", default=default.slip_speed, above=0.0),
    )
    part.close()
    return material


def _target(part: Table) -> Target:
    target = Target(part.pair("position"), part.number("radius", default=Target.radius, above=0.0))
    part.close()
    return target


def _field(part: Table) -> RandomField:
    radius = part.pair("radius", default=RandomField.radius, above=0.0)
    if radius[0] > radius[1]:
        part.fault("radius", "[least, greatest]")
    field = RandomField(
        count=part.integer("count", at_least=1),
        size=part.pair("size", above=0.0),
        centre=part.pair("centre", default=RandomField.centre),
        radius=radius,
        height=part.number("height", default=RandomField.height, above=0.0),
        clear=part.number("clear", default=RandomField.clear, at_least=0.0),
        gap=part.number("gap", default=RandomField.gap, at_least=0.0),
        seed=part.integer("seed", at_least=0) if "seed" in part else None,
    )
    part.close()
    return field
