"""From a session to the motion of head, middle and tail with its perfect-tracking null."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from undulog.capture import SessionView
from undulog.capture.common.arrays import BoolArray, ComplexArray, FloatArray, IntArray
from undulog.capture.common.console import Warn
from undulog.capture.common.errors import DataError, LogError
from undulog.capture.robot.model import Plane, Robot

from ..estimators.series import Series
from ..response.fitting import GaitFit
from ..results.analysis import BodyResult
from ..results.remarks import Note
from ..signals.reading import by_plane, drag_ratio
from ..signals.windows import Span
from .places import observed, perfect_tracking, track

ODOMETRY_TOPIC = "/odom"

_NS = 1_000_000_000
_CHILD = "child_frame_id"
_POSE = (
    *(f"pose.pose.position.{axis}" for axis in "xyz"),
    *(f"pose.pose.orientation.{axis}" for axis in "xyzw"),
)
_BENT_RAD = float(np.radians(2.0))
"""Joints that are not driven, but bent by more than this, make the planar null doubtful."""


def body_motion(
    session: SessionView,
    responses: Mapping[str, Series],
    gait: GaitFit | None,
    span: Span,
    warn: Warn,
) -> BodyResult | None:
    """Head, middle and tail across the mean heading, beside their null.

    Args:
        session: An open session.
        responses: Measured joint angles by name, on the analysed stretch.
        gait: The fitted gait, or None.
        span: Whole cycles to look at.
        warn: Told why there is no result, or what makes it doubtful.

    Returns:
        The result, or None.
    """
    try:
        robot, fitted, plane = _fit_for_null(session, responses, gait)
        poses = head_poses(session, robot.links[0].name, span)
        seen = track(robot, *poses, [responses[name] for name in robot.joint_names])
        commands = _commands(robot, fitted)
        omega = fitted.fit.omega
        result = BodyResult(
            plane=plane.value,
            observed=observed(robot, plane, seen, omega),
            null=perfect_tracking(
                robot,
                plane,
                commands,
                omega=omega,
                cycles=span.cycles,
                drag_ratio=drag_ratio(session),
            ),
        )
    except (DataError, LogError) as error:
        warn(Note(f"no body motion (head, middle, tail): {error}"))
        return None
    bent = [
        name
        for name in robot.joint_names
        if name not in fitted.driven and abs(float(responses[name].values.mean())) > _BENT_RAD
    ]
    if bent:
        told = f"{', '.join(bent)} are bent though not driven: the body's null takes them straight"
        warn(Note(told))
    return result


def _fit_for_null(
    session: SessionView, responses: Mapping[str, Series], gait: GaitFit | None
) -> tuple[Robot, GaitFit, Plane]:
    robot = session.robot
    if robot is None:
        raise DataError("the session has no robot description")
    if ODOMETRY_TOPIC not in session.channels:
        raise DataError(f"the session has no head pose on {ODOMETRY_TOPIC}")
    if gait is None or not gait.driven:
        raise DataError("no gait drives the joints")
    unknown = [n for n in robot.joint_names if n not in responses or responses[n].count < 2]
    if unknown:
        raise DataError(f"no angles of {', '.join(unknown)}")
    if gait.others:
        raise DataError("joints have several frequencies, and the null has one")
    planes = by_plane(robot, gait.driven)
    if len(planes) > 1:
        raise DataError("both planes are driven, and the null is planar")
    return robot, gait, Plane(next(iter(planes)))


def head_poses(
    session: SessionView, head: str, span: Span
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """The head's poses within a window.

    Args:
        session: An open session.
        head: Name of the head link.
        span: The window.

    Returns:
        Times from the window's origin [s], shape (n,), positions [m], shape (n, 3), and unit
        quaternions x, y, z, w, shape (n, 4).

    Raises:
        DataError: If there are none, too few, of another link, or without an orientation.
    """
    start_ns = span.origin_ns + round(span.start_s * _NS)
    stop_ns = span.origin_ns + round(span.stop_s * _NS)
    _, tables = session.columns({}, {ODOMETRY_TOPIC: [_CHILD, *_POSE]})
    table = tables[ODOMETRY_TOPIC]
    at_ns: IntArray = table.index.to_numpy(dtype=np.int64)
    i, j = np.searchsorted(at_ns, (start_ns, stop_ns))
    table, t_ns = table.iloc[i:j], at_ns[i:j]
    if table.empty or not set(_POSE) <= set(table.columns):
        raise DataError(f"{ODOMETRY_TOPIC} has no poses within the analysed window")
    children = {str(name) for name in table[_CHILD].unique()} - {""}
    if children - {head}:
        raise DataError(
            f"{ODOMETRY_TOPIC} gives the pose of {', '.join(sorted(children))}, not of the head "
            f"link {head}"
        )
    pose = np.stack([table[name].to_numpy(dtype=np.float64) for name in _POSE])
    inside: BoolArray = np.all(np.isfinite(pose), axis=0)
    inside[1:] &= np.diff(t_ns) > 0
    if np.count_nonzero(inside) < 16:
        raise DataError(f"{ODOMETRY_TOPIC} has fewer than 16 poses within the analysed window")
    if not np.all(inside):
        pose, t_ns = pose[:, inside], t_ns[inside]
    length = np.sqrt(np.einsum("ij,ij->j", pose[3:], pose[3:]))
    if np.any(length < 0.5):
        raise DataError(f"{ODOMETRY_TOPIC} holds orientations that are not unit quaternions")
    t_s = (t_ns - span.origin_ns).astype(np.float64) * 1e-9
    return t_s, pose[:3].T, (pose[3:] / length).T


def _commands(robot: Robot, gait: GaitFit) -> dict[int, tuple[ComplexArray, float]]:
    """Harmonics and mean of each driven joint's command, by joint index."""
    return {
        robot.joint_names.index(name): (gait.fit.amplitudes[k], float(gait.fit.trend[k, 0]))
        for k, name in enumerate(gait.driven)
    }
