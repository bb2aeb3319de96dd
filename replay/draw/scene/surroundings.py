"""What stands around the robot: the obstacles and the target of the scenario that a twin ran in."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import rerun as rr
from numpy.typing import NDArray
from rerun.components import FillMode

from undulog.capture import SessionView
from undulog.capture.common.arrays import FloatArray, IntArray
from undulog.capture.common.strict_table import Faults, Table, read_toml
from undulog.sim.scenario.obstacles import Box, Cylinder, Obstacle, Target, Wall
from undulog.sim.scenario.world import World
from undulog.sim.scenario.world_toml import read_world

from ...samples.sampling import decimate, gaps
from ...samples.stretches import Span
from ...samples.timeline import Clock
from .motion import HeadPath

TRAIL = "/world/trail"
TRAIL_RATE_HZ = 10.0
TRAIL_SECONDS = 20.0

_COLOR = (104, 108, 128, 255)
_WHOLE = Span()


def trail_segments(t_ns: IntArray, position: FloatArray) -> tuple[IntArray, NDArray[np.float32]]:
    """Straight pieces between successive head positions.

    Args:
        t_ns: Times [ns], ascending, shape (n,).
        position: Head positions [m], shape (n, 3).

    Returns:
        Times at which the pieces end [ns], shape (k,), and pieces, shape (k, 2, 3); none across
        a gap.
    """
    pieces = np.stack([position[:-1], position[1:]], axis=1).astype(np.float32)
    whole = ~gaps(t_ns) & np.isfinite(pieces).all(axis=(1, 2))
    return t_ns[1:][whole], pieces[whole]


def log_trail(rec: rr.RecordingStream, clock: Clock, head: HeadPath, span: Span = _WHOLE) -> None:
    """Draw the head's path; the view shows its last 20 s.

    Args:
        rec: The recording.
        clock: Its timelines.
        head: The head's path.
        span: The part that is drawn.
    """
    chosen = decimate(head.t_ns, TRAIL_RATE_HZ)
    t_ns, pieces = trail_segments(head.t_ns[chosen], head.position[chosen])
    part = span.rows(t_ns)
    t_ns, pieces = t_ns[part], pieces[part]
    look = rr.LineStrips3D.from_fields(colors=_COLOR, radii=rr.Radius.ui_points(1.0))
    rec.log(TRAIL, look, static=True)
    for rows, times in clock.rows(t_ns):
        rec.send_columns(TRAIL, times, rr.LineStrips3D.columns(strips=pieces[rows]))


CYLINDERS = "/world/obstacles/cylinders"
BOXES = "/world/obstacles/boxes"
TARGET = "/world/target"

_STONE = (120, 126, 134, 255)
_GOAL = (92, 200, 120, 255)
_RIM_SIDES = 64


def world_of(session: SessionView, warnings: list[str]) -> World | None:
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
