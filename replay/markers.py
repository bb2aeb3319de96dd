"""The joints that are plotted, marked on the body in the colours of their plots."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import rerun as rr

from capture.arrays import FloatArray
from capture.robot import Robot

from .joints import Color, Places
from .motion import Motion
from .timeline import Clock

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
) -> None:
    """Mark the joints that stand for the body.

    Args:
        rec: The recording.
        clock: Its timelines.
        motion: What moved.
        places: The joints.
        palette: Colour by joint name.
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
        point = above_joints(robot, names, *motion.links(rows)).astype(np.float32)
        known = np.isfinite(point).all(axis=-1)
        count = np.count_nonzero(known, axis=1)
        which = np.nonzero(known)[1]
        balls = rr.Points3D.columns(
            positions=point[known], radii=radius[which], colors=color[which]
        )
        rec.send_columns(MARKERS, times, balls.partition(count))
        text = rr.Points3D.columns(
            positions=point[known], labels=[labels[names[i]] for i in which.tolist()]
        )
        rec.send_columns(LABELS, times, text.partition(count))
