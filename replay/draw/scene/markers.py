"""The joints that are plotted, marked on the body in the colours of their plots."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from undulog.capture.common.arrays import FloatArray, IntArray
from undulog.capture.robot.model import Robot

from ...content.entities import NAMED, Color, Places
from ...samples.timeline import Clock
from .body import ROUNDING, rounded_to
from .motion import Motion

MARKERS = "/world/snake/places"
LABELS = "/world/snake/place_names"

_LIFT_RADII = 4.0
_LABEL_COLOR = (255, 255, 255, 255)


def above_joints(
    robot: Robot, names: tuple[str, ...], centre: FloatArray, rotation: FloatArray
) -> FloatArray:
    """Points just above the named joints.

    Args:
        robot: The robot, m joints.
        names: Joint names, k of them.
        centre: Link centres [m], shape (n, m + 1, 3).
        rotation: Link orientations, shape (n, m + 1, 3, 3).

    Returns:
        One point a joint, four radii above its axis [m], shape (n, k, 3).
    """
    links = [robot.joint_names.index(name) for name in names]
    half = np.array([robot.links[i].length / 2 for i in links])
    lift = np.array([_LIFT_RADII * robot.links[i].radius for i in links])
    axis = centre[:, links] - half[:, None] * rotation[:, links][..., 0]
    return axis + lift[:, None] * np.array([0.0, 0.0, 1.0])


def log_markers(
    rec: rr.RecordingStream,
    clock: Clock,
    motion: Motion,
    places: Places,
    palette: Mapping[str, Color],
    *,
    named: IntArray,
) -> None:
    """Mark the joints that stand for the body.

    Args:
        rec: The recording.
        clock: Its timelines.
        motion: What moved.
        places: The joints.
        palette: Colour by joint name.
        named: At which of the motion's times the names are moved, shape (n,).
    """
    robot = motion.robot
    labels = {
        name: label
        for name, label in zip(places.names, places.labels, strict=True)
        if name in robot.joint_names
    }
    if not labels:
        return
    names = tuple(labels)
    radius = np.array([0.5 * robot.links[robot.joint_names.index(n)].radius for n in names])
    color = np.array([palette[name] for name in names], dtype=np.uint8)
    # Labels take their point's colour, and blue can't be read on black: they get white points.
    look = rr.Points3D.from_fields(
        colors=_LABEL_COLOR, radii=rr.Radius.ui_points(0.5), show_labels=True
    )
    rec.log(LABELS, look, static=True)
    for rows, times in clock.rows(motion.t_ns):
        point, count, which = _known_points(motion, names, rows)
        balls = rr.Points3D.columns(positions=point, radii=radius[which], colors=color[which])
        rec.send_columns(MARKERS, times, balls.partition(count))
    for part, times in clock.rows(motion.t_ns[named]):
        point, count, which = _known_points(motion, names, named[part])
        titles = [labels[names[i]] for i in which.tolist()]
        text = rr.Points3D.columns(positions=point, labels=titles)
        rec.send_columns(LABELS, times, text.partition(count))


def _known_points(
    motion: Motion, names: tuple[str, ...], rows: slice | IntArray
) -> tuple[NDArray[np.float32], IntArray, IntArray]:
    """Points above joints whose pose is known: where, how many a row, and of which joint."""
    point = above_joints(motion.robot, names, *motion.links(rows))
    known = np.isfinite(point).all(axis=-1)
    return rounded_to(point[known], ROUNDING), np.count_nonzero(known, axis=1), np.nonzero(known)[1]


MARKS = "/world/snake/named"


def log_marks(
    rec: rr.RecordingStream,
    clock: Clock,
    motion: Motion,
    names: Sequence[str],
    chosen: IntArray,
) -> None:
    """Mark joints with a point and their name.

    Args:
        rec: The recording.
        clock: Its timelines.
        motion: What moved.
        names: The joints; those that the robot doesn't have are left out.
        chosen: Which of its drawing times, shape (n,).
    """
    robot = motion.robot
    known = tuple(name for name in names if name in robot.joint_names)
    if not known:
        return
    look = rr.Points3D.from_fields(colors=NAMED, radii=rr.Radius.ui_points(5.0), show_labels=True)
    rec.log(MARKS, look, static=True)
    for part, times in clock.rows(motion.t_ns[chosen]):
        point = above_joints(robot, known, *motion.links(chosen[part])).astype(np.float32)
        drawn = np.isfinite(point).all(axis=-1)
        labels = [known[i] for i in np.nonzero(drawn)[1].tolist()]
        dots = rr.Points3D.columns(positions=point[drawn], labels=labels)
        rec.send_columns(MARKS, times, dots.partition(np.count_nonzero(drawn, axis=1)))
