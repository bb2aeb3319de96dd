"""How the sessions are told apart in space: the first is solid, the others are wireframes.

The first body keeps its colours of power; each of the others has one tint, which is neither on the
map along the body nor on that of power. Every head carries its session's name.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import rerun as rr
from rerun.components import FillMode

from undulog.capture.robot.model import Robot

from ..draw.scene.body import MEASURED, MESHES, meshed
from ..draw.scene.motion import HeadPath
from ..draw.scene.stage import TRAIL
from ..samples.content import Color
from ..samples.sampling import decimate
from ..samples.timeline import GAIT_CYCLE, SESSION_TIME
from .alignment import Aligned, Placement

BODY = "/world/snake"
NAME = f"{BODY}/name"

_WHITE: Color = (236, 236, 240, 255)
_TINTS: tuple[Color, ...] = (_WHITE, (240, 140, 200, 255), (176, 150, 250, 255))
_WIRES = ((FillMode.MajorWireframe, 1.0), (FillMode.DenseWireframe, 0.4))
"""Mesh and line radius [points] of the second body, the third, and so on in turn."""
_NAME_RATE_HZ = 25.0
_LIFT_RADII, _LIFT, _TIER = 5.0, 0.05, 0.08
_MESH_OPACITY = 90


def tint(place: int) -> Color:
    """The colour of a session as a whole.

    Args:
        place: 0 for the first session.
    """
    return _WHITE if place == 0 else _TINTS[(place - 1) % len(_TINTS)]


def log_look(rec: rr.RecordingStream, entity: str, place: int, robot: Robot | None) -> None:
    """Draw a body other than the first as a wireframe of one tint.

    What is static shadows the colours of each moment, which stay in the recording.

    Args:
        entity: The session's path.
        place: Which session it is, 1 for the second.
    """
    mesh, wire = _WIRES[(place - 1) % len(_WIRES)]
    look = rr.Capsules3D.from_fields(
        fill_mode=mesh, colors=tint(place), line_radii=rr.Radius.ui_points(wire)
    )
    rec.log(f"{entity}{MEASURED}", look, static=True)
    rec.log(f"{entity}{TRAIL}", rr.LineStrips3D.from_fields(colors=tint(place)), static=True)
    if robot is None:
        return
    glass = (*tint(place)[:3], _MESH_OPACITY)
    for i in np.flatnonzero(meshed(robot)).tolist():
        shape = rr.Asset3D.from_fields(albedo_factor=glass)
        rec.log(f"{entity}{MESHES}/{robot.links[i].name}", shape, static=True)


def log_placement(rec: rr.RecordingStream, entity: str, placed: Placement) -> None:
    """Move a session's world.

    Args:
        entity: The session's path.
    """
    moved = rr.Transform3D(
        translation=(placed.x, placed.y, 0.0), quaternion=rr.Quaternion(xyzw=placed.quaternion)
    )
    rec.log(f"{entity}/world", moved, static=True)


def log_name(
    rec: rr.RecordingStream, one: Aligned, place: int, head: HeadPath, robot: Robot
) -> None:
    """Write the session's name over its head.

    Args:
        place: Which session it is, 0 for the first: names of bodies at one place lie in tiers.
        head: The head's path.
    """
    entity = f"{one.side.entity}{NAME}"
    look = rr.Points3D.from_fields(
        colors=tint(place), radii=rr.Radius.ui_points(0.5), show_labels=True
    )
    rec.log(entity, look, static=True)
    span = sum(link.length for link in robot.links)
    lift = _LIFT_RADII * robot.links[0].radius + (_LIFT + _TIER * place) * span
    chosen = decimate(head.t_ns, _NAME_RATE_HZ)
    point = (head.position[chosen] + [0.0, 0.0, lift]).astype(np.float32)
    known = np.isfinite(point).sum(axis=1) == point.shape[1]  # no name where there is no body
    for rows, times in one.clock.rows(head.t_ns[chosen]):
        there = known[rows].astype(np.int64)
        text = rr.Points3D.columns(
            positions=point[rows][there > 0], labels=[one.side.name] * int(there.sum())
        )
        rec.send_columns(entity, times, text.partition(there))


def log_ends(rec: rr.RecordingStream, sessions: Sequence[Aligned]) -> None:
    """Take each body away when its session is over and others go on."""
    for timeline in (SESSION_TIME, GAIT_CYCLE):
        ends = {one.side.entity: _end(one, timeline) for one in sessions}
        known = {entity: end for entity, end in ends.items() if end is not None}
        for entity, end in known.items():
            if end < max(known.values()):
                after = np.array([end + 1], dtype="timedelta64[ns]")
                cleared = rr.Clear.columns(is_recursive=[True])
                times = [rr.TimeColumn(timeline, duration=after)]
                rec.send_columns(f"{entity}{BODY}", times, cleared)


def _end(one: Aligned, timeline: str) -> int | None:
    """A session's end on a timeline [ns], or None where it isn't on it."""
    if timeline == SESSION_TIME:
        return one.side.end_ns - one.zero_ns
    rhythm = one.clock.rhythm
    return None if rhythm is None else round(float(rhythm.cycles.max()) * 1e9)
