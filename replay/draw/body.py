"""The body in space: where the links were, and a wireframe where they should have been.

Links are capsules, or meshes where they have one. Capsules are Rerun's: a cylinder along z from the
entity's origin, with a half ball on each end. Positions are rounded to 2^-10 m and quaternions to
2^-9, which moves nothing by more than 0.5 mm and a quarter of a degree, and colours have 32 shades
each way: less than a screen shows, and a third of the file.

Colour of mechanical power: who drives whom.

A joint that works on the body (torque along velocity) glows vermilion, a joint that the body
drives turns cyan, an idle one is grey. Both ends are as light as the map along the body, and
neither is on it, so power is not mistaken for place.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import rerun as rr
from numpy.typing import NDArray
from rerun.components import FillMode

from undulog.capture.common.arrays import FloatArray, IntArray
from undulog.capture.common.palette import joint_colors
from undulog.capture.robot.kinematics import mesh_type, quaternion_from_rotation
from undulog.capture.robot.model import Robot

from ..samples.content import GREY, NAMED, BodyPlaces, Color, Content
from ..samples.quantities import power_limit, segment_power
from ..samples.timeline import TimeColumns
from .motion import Motion

MESHES = "/world/snake/meshes"

_NOWHERE = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)

_DRIVEN = np.array([0, 205, 220])
_IDLE = np.array([112, 112, 120])
_DRIVES = np.array([255, 84, 48])
_UNKNOWN = np.array([70, 70, 74, 255], dtype=np.uint8)

MEASURED = "/world/snake/measured"
COMMANDED = "/world/snake/commanded"

ROUNDING = 2.0**-10
"""Of positions [m]."""
TURN_ROUNDING = 2.0**-9
"""Of quaternions."""
SHADES = 32
"""Steps of power from none to full."""

MARKERS = "/world/snake/places"
LABELS = "/world/snake/place_names"

_LIFT_RADII = 4.0
_LABEL_COLOR = (255, 255, 255, 255)

MARKS = "/world/snake/named"


@dataclass(frozen=True)
class Look:
    """How a session's body is drawn, in the scene and in its mean cycle.

    Attributes:
        robot: The robot, or None.
        places: Joints that stand for the body, or None.
        palette: Colour by joint name.
        limit_w: Power at which a segment's colour is full [W]; None where none is known.
        named: Joints of modules that a test names, which carry a mark in the scene.
    """

    robot: Robot | None
    places: BodyPlaces | None
    palette: Mapping[str, Color]
    limit_w: float | None
    named: Sequence[str] = ()


def meshed(robot: Robot) -> NDArray[np.bool_]:
    """Return which links are drawn as meshes.

    Returns:
        Whether a link's mesh is at hand, shape (number of links,).
    """
    files = dict(robot.meshes)
    return np.array([link.mesh in files for link in robot.links])


def log_shapes(rec: rr.RecordingStream, robot: Robot) -> None:
    """Write the meshes, once."""
    files = dict(robot.meshes)
    for link in robot.links:
        if link.mesh in files:
            shape = rr.Asset3D(contents=files[link.mesh], media_type=mesh_type(link.mesh))
            rec.log(f"{MESHES}/{link.name}", shape, static=True)


def log_poses(
    rec: rr.RecordingStream,
    robot: Robot,
    times: list[rr.TimeColumn],
    poses: tuple[FloatArray, FloatArray],
    colors: NDArray[np.uint8],
) -> None:
    """Write where the meshed links were and what colour they had.

    Args:
        robot: The robot, m joints.
        times: Timelines of n rows.
        poses: Link centres [m], shape (n, m + 1, 3), and orientations, shape (n, m + 1, 3, 3).
        colors: Shape (n, m + 1, 4) or one that broadcasts to it.
    """
    centre, quaternion = poses[0], quaternion_from_rotation(poses[1])
    spread = np.broadcast_to(colors, (*centre.shape[:2], 4))
    for i in np.flatnonzero(meshed(robot)):
        pose = np.concatenate([centre[:, i], quaternion[:, i]], axis=-1)
        finite = np.isfinite(pose).all(axis=-1)
        pose[~finite] = _NOWHERE
        scale = np.where(finite, robot.links[i].mesh_scale, 0.0)  # of no size where unknown
        rec.send_columns(
            f"{MESHES}/{robot.links[i].name}",
            times,
            [
                *rr.Transform3D.columns(
                    translation=pose[:, :3],
                    quaternion=pose[:, 3:],
                    scale=np.repeat(scale[:, None], 3, axis=1),
                ),
                *rr.Asset3D.columns(albedo_factor=spread[:, i]),
            ],
        )


def power_colors(power_w: FloatArray, limit_w: float) -> NDArray[np.uint8]:
    """Return colours of power, symmetric about zero.

    Args:
        power_w: Mechanical power [W], any shape; NaN where it isn't known.
        limit_w: Power at which the colour is full [W], above 0.

    Returns:
        sRGB and opacity, shape (..., 4); dark grey where the power isn't known.
    """
    finite = np.isfinite(power_w)
    share = np.clip(np.where(finite, power_w, 0.0) / limit_w, -1.0, 1.0)[..., None]
    end = np.where(share < 0.0, _DRIVEN, _DRIVES)
    colors = np.full((*power_w.shape, 4), 255, dtype=np.uint8)
    colors[..., :3] = np.round(_IDLE + np.abs(share) * (end - _IDLE))
    colors[~finite] = _UNKNOWN
    return colors


def capsule_shape(robot: Robot) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return lengths and radii of the cylinders that draw the links.

    A cylinder is one radius shorter than its link, so that neighbouring balls overlap without
    lying in each other and the segments stay countable.

    Returns:
        Lengths of the cylinders and radii [m], each of shape (number of links,).
    """
    length = [max(link.length - link.radius, 0.1 * link.length) for link in robot.links]
    radius = [link.radius for link in robot.links]
    return np.array(length, dtype=np.float32), np.array(radius, dtype=np.float32)


def capsule_poses(
    robot: Robot, centre: FloatArray, rotation: FloatArray
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the poses of the links' capsules.

    Args:
        robot: The robot, m joints.
        centre: Link centres [m], shape (n, m + 1, 3).
        rotation: Link orientations, shape (n, m + 1, 3, 3).

    Returns:
        Capsule origins [m], shape (n, m + 1, 3), and quaternions x, y, z, w that turn z to the
        link's forward axis the shortest way, shape (n, m + 1, 4), both rounded; NaN where a pose
        is.
    """
    length, _ = capsule_shape(robot)
    forward = rotation[..., 0]
    origin = centre - 0.5 * length[:, None] * forward
    return rounded_to(origin, ROUNDING), rounded_to(_turns(forward), TURN_ROUNDING)


def _turns(forward: FloatArray) -> FloatArray:
    """Quaternions that turn z to the given directions, about an axis in the plane of x and y.

    A capsule looks the same however it is turned about its own axis.
    """
    cos = np.clip(forward[..., 2], -1.0, 1.0)
    sideways = np.hypot(forward[..., 0], forward[..., 1])
    half_sin, half_cos = np.sqrt((1.0 - cos) / 2.0), np.sqrt((1.0 + cos) / 2.0)
    share = np.divide(half_sin, sideways, out=np.zeros_like(cos), where=sideways > 0.0)
    x = np.where(sideways > 0.0, -forward[..., 1] * share, half_sin)
    return np.stack([x, forward[..., 0] * share, np.zeros_like(cos) + 0.0 * cos, half_cos], -1)


def capsule_columns(
    robot: Robot,
    poses: tuple[NDArray[np.float32], NDArray[np.float32]],
    colors: NDArray[np.uint8],
    drawn: NDArray[np.bool_] | bool = True,
) -> rr.ComponentColumnList:
    """Return rows of capsules, without those whose pose isn't known.

    Args:
        robot: The robot, m joints.
        poses: As :func:`capsule_poses` gives them, n rows.
        colors: Shape (n, m + 1, 4) or one that broadcasts to it.
        drawn: Which links are drawn as capsules, shape (m + 1,).

    Returns:
        Columns of n rows with at most m + 1 capsules each.
    """
    origin, quaternion = poses
    visible = np.isfinite(np.concatenate([origin, quaternion], axis=-1)).all(axis=-1) & drawn
    length, radius = capsule_shape(robot)
    return rr.Capsules3D.columns(
        lengths=np.broadcast_to(length, visible.shape)[visible],
        radii=np.broadcast_to(radius, visible.shape)[visible],
        translations=origin[visible],
        quaternions=quaternion[visible],
        colors=np.broadcast_to(colors, (*visible.shape, 4))[visible],
    ).partition(np.count_nonzero(visible, axis=1))


def log_body(
    rec: rr.RecordingStream, clock: TimeColumns, motion: Motion, *, limit_w: float | None = None
) -> float | None:
    """Draw the measured body, coloured by power per segment.

    Args:
        limit_w: Power at which a segment's colour is full [W]; None takes it from the motion.

    Returns:
        Power at which a segment's colour is full [W], or None where no power is known and the
        links wear the colours of their place along the body.
    """
    power = None if motion.power_w is None else segment_power(motion.power_w)
    limit = None if power is None else limit_w or power_limit(power)
    rec.log(MEASURED, rr.Capsules3D.from_fields(fill_mode=FillMode.Solid), static=True)
    solid = meshed(motion.robot)
    log_shapes(rec, motion.robot)
    for rows, times in clock.rows(motion.t_ns):
        if power is None or limit is None:
            colors = joint_colors(len(motion.robot.links))
        else:
            shade = limit / SHADES
            colors = power_colors(np.round(power[rows] / shade) * shade, limit)
        links = motion.links(rows)
        poses = capsule_poses(motion.robot, *links)
        rec.send_columns(MEASURED, times, capsule_columns(motion.robot, poses, colors, ~solid))
        log_poses(rec, motion.robot, times, links, colors)
    return limit


def log_ghost(
    rec: rr.RecordingStream, clock: TimeColumns, motion: Motion, chosen: IntArray
) -> None:
    """Draw the commanded shape on the measured head, as a grey wireframe.

    Args:
        motion: What moved; without commands nothing is drawn.
        chosen: Which of its drawing times, shape (n,).
    """
    if motion.commands is None:
        return
    look = rr.Capsules3D.from_fields(
        fill_mode=FillMode.MajorWireframe, line_radii=rr.Radius.ui_points(0.5)
    )
    rec.log(COMMANDED, look, static=True)
    grey = np.array(GREY, dtype=np.uint8)
    for part, times in clock.rows(motion.t_ns[chosen]):
        rows = chosen[part]
        poses = capsule_poses(motion.robot, *motion.links(rows, motion.commands[rows]))
        rec.send_columns(COMMANDED, times, capsule_columns(motion.robot, poses, grey))


def rounded_to(values: FloatArray, step: float) -> NDArray[np.float32]:
    """Round to multiples of a power of two.

    Args:
        values: Any shape.

    Returns:
        The same shape, in 32 bits; at most half a step from the values.
    """
    return (np.round(values / step) * step).astype(np.float32)


def body_title(content: Content) -> str:
    """Return the name of the body's view, which is also the legend of its colours."""
    if content.power_limit_w is None:
        return "Body, blue head to orange tail"
    if content.live:  # the scale may still grow
        return "Body: vermilion drives, cyan is driven"
    limit = content.power_limit_w
    value, unit = (limit * 1e3, "mW") if limit < 1.0 else (limit, "W")
    return f"Body: vermilion drives, cyan is driven, full at ±{value:.3g} {unit} a segment"


def above_joints(
    robot: Robot, names: tuple[str, ...], centre: FloatArray, rotation: FloatArray
) -> FloatArray:
    """Return points just above the named joints.

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
    clock: TimeColumns,
    motion: Motion,
    places: BodyPlaces | None,
    palette: Mapping[str, Color],
    *,
    named: IntArray,
) -> None:
    """Mark the joints that stand for the body.

    Args:
        places: These joints; nothing is drawn without them.
        palette: Colour by joint name.
        named: At which of the motion's times the names are moved, shape (n,).
    """
    robot = motion.robot
    labels = {} if places is None else places.labelled
    names = tuple(name for name in labels if name in robot.joint_names)
    if not names:
        return
    radius = np.array([0.5 * robot.links[robot.joint_names.index(n)].radius for n in names])
    color = np.array([palette[name] for name in names], dtype=np.uint8)
    # Labels take their point's colour, and blue can't be read on black: they get white points.
    look = rr.Points3D.from_fields(
        colors=_LABEL_COLOR, radii=rr.Radius.ui_points(0.5), show_labels=True
    )
    rec.log(LABELS, look, static=True)
    for rows, times in clock.rows(motion.t_ns):
        point, count, which = _known_points(motion, names, rows)
        point = rounded_to(point, ROUNDING)
        balls = rr.Points3D.columns(positions=point, radii=radius[which], colors=color[which])
        rec.send_columns(MARKERS, times, balls.partition(count))
    for part, times in clock.rows(motion.t_ns[named]):
        point, count, which = _known_points(motion, names, named[part])
        point = rounded_to(point, ROUNDING)
        titles = [labels[names[i]] for i in which.tolist()]
        text = rr.Points3D.columns(positions=point, labels=titles)
        rec.send_columns(LABELS, times, text.partition(count))


def _known_points(
    motion: Motion, names: tuple[str, ...], rows: slice | IntArray
) -> tuple[FloatArray, IntArray, IntArray]:
    """Points above joints whose pose is known: where, how many a row, and of which joint."""
    point = above_joints(motion.robot, names, *motion.links(rows))
    finite = np.isfinite(point).all(axis=-1)
    return point[finite], np.count_nonzero(finite, axis=1), np.nonzero(finite)[1]


def log_marks(
    rec: rr.RecordingStream,
    clock: TimeColumns,
    motion: Motion,
    names: Sequence[str],
    chosen: IntArray,
) -> None:
    """Mark joints with a point and their name.

    Args:
        names: The joints; those that the robot doesn't have are left out.
        chosen: Which of its drawing times, shape (n,).
    """
    joints = tuple(name for name in names if name in motion.robot.joint_names)
    if not joints:
        return
    look = rr.Points3D.from_fields(colors=NAMED, radii=rr.Radius.ui_points(5.0), show_labels=True)
    rec.log(MARKS, look, static=True)
    for part, times in clock.rows(motion.t_ns[chosen]):
        point, count, which = _known_points(motion, joints, chosen[part])
        labels: list[str] = [joints[i] for i in which.tolist()]
        dots = rr.Points3D.columns(positions=point.astype(np.float32), labels=labels)
        rec.send_columns(MARKS, times, dots.partition(count))
