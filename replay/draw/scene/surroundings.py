"""What stands around the robot: the obstacles and the target of the scenario that a twin ran in."""

from __future__ import annotations

import math
from typing import Any

import rerun as rr
from rerun.components import FillMode

from undulog.capture import Session
from undulog.capture.common.strict_table import Faults, Table, read_toml
from undulog.sim.scenario.obstacles import Box, Cylinder, Obstacle, Target, Wall
from undulog.sim.scenario.world import World
from undulog.sim.scenario.world_toml import read_world

CYLINDERS = "/world/obstacles/cylinders"
BOXES = "/world/obstacles/boxes"
TARGET = "/world/target"

_STONE = (120, 126, 134, 255)
_GOAL = (92, 200, 120, 255)
_RIM_SIDES = 64


def world_of(session: Session, warnings: list[str]) -> World | None:
    """The world that the session's scenario describes.

    Args:
        session: The session, open.
        warnings: Extended by what can't be read.

    Returns:
        The world; None where the session is of no twin, or its scenario can't be read.
    """
    data = session.attachments.get("scenario.toml")
    if data is None:
        return None
    try:
        values: dict[str, Any] = read_toml(data.decode())
    except ValueError as error:
        warnings.append(f"the attached scenario can't be read, obstacles are not drawn: {error}")
        return None
    faults = Faults()
    world = read_world(Table(values, "", faults).table("world"), None, 0)
    if found := faults.all():
        reason = "; ".join(map(str, found))
        warnings.append(f"the attached scenario has faults, obstacles are not drawn: {reason}")
        return None
    return world


def log_surroundings(rec: rr.RecordingStream, world: World) -> None:
    """Draw what does not move.

    Args:
        rec: The recording.
        world: The world.
    """
    cylinders = [one for one in world.obstacles if isinstance(one, Cylinder)]
    boxes = [_box(one) for one in world.obstacles if not isinstance(one, Cylinder)]
    if cylinders:
        shapes = rr.Cylinders3D(
            lengths=[one.height for one in cylinders],
            radii=[one.radius for one in cylinders],
            centers=[(*one.position, one.height / 2) for one in cylinders],
            colors=[_STONE],
            fill_mode=FillMode.Solid,
        )
        rec.log(CYLINDERS, shapes, static=True)
    if boxes:
        shapes = rr.Boxes3D(
            sizes=[(*one.size, one.height) for one in boxes],
            centers=[(*one.position, one.height / 2) for one in boxes],
            quaternions=[
                (0.0, 0.0, math.sin(one.heading / 2), math.cos(one.heading / 2)) for one in boxes
            ],
            colors=[_STONE],
            fill_mode=FillMode.Solid,
        )
        rec.log(BOXES, shapes, static=True)
    if world.target is not None:
        rec.log(TARGET, _rim(world.target), static=True)


def _box(obstacle: Obstacle) -> Box:
    assert not isinstance(obstacle, Cylinder)  # noqa: S101 - the caller sorted them
    return obstacle.box if isinstance(obstacle, Wall) else obstacle


def _rim(target: Target) -> rr.LineStrips3D:
    """The edge of the target on the ground."""
    (x, y), r = target.position, target.radius
    turns = [2 * math.pi * k / _RIM_SIDES for k in range(_RIM_SIDES + 1)]
    rim = [(x + r * math.cos(turn), y + r * math.sin(turn), 0.002) for turn in turns]
    return rr.LineStrips3D([rim], colors=[_GOAL], radii=[0.01], labels=["target"])
