"""From a session to the motion of head, middle and tail with its perfect-tracking null."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from capture import Session
from capture.arrays import ComplexArray, FloatArray
from capture.errors import DataError, LogError
from capture.robot import Plane, Robot

from .body import observed, perfect_tracking, track
from .fitting import GaitFit
from .joints import Span
from .reading import Warn, by_plane, drag_ratio
from .result import BodyResult
from .series import Series

ODOMETRY_TOPIC = "/odom"

_NS = 1_000_000_000
_SLACK_NS = 5 * _NS
"""Tables are cut by log time; poses may be stamped this much earlier or later."""

_POSE = (
    *(f"pose.pose.position.{axis}" for axis in "xyz"),
    *(f"pose.pose.orientation.{axis}" for axis in "xyzw"),
)
_BENT_RAD = float(np.radians(2.0))
"""Joints that are not driven, but bent by more than this, make the planar null doubtful."""


def body_motion(
    session: Session, responses: Mapping[str, Series], gait: GaitFit | None, span: Span, warn: Warn
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
        poses = _poses(session, robot.links[0].name, span)
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
        warn(f"no body motion (head, middle, tail): {error}")
        return None
    bent = [
        name
        for name in robot.joint_names
        if name not in fitted.driven and abs(float(responses[name].values.mean())) > _BENT_RAD
    ]
    if bent:
        warn(f"{', '.join(bent)} are bent though not driven: the body's null takes them straight")
    return result


def _fit_for_null(
    session: Session, responses: Mapping[str, Series], gait: GaitFit | None
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
    planes = by_plane(robot, gait.driven)
    if len(planes) > 1:
        raise DataError("both planes are driven, and the null is planar")
    return robot, gait, Plane(next(iter(planes)))


def _poses(session: Session, head: str, span: Span) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Times [s], positions and quaternions of the head within the window."""
    start_ns = span.origin_ns + round(span.start_s * _NS)
    stop_ns = span.origin_ns + round(span.stop_s * _NS)
    table = session.table(
        ODOMETRY_TOPIC, start_ns=start_ns - _SLACK_NS, stop_ns=stop_ns + _SLACK_NS
    )
    if table.empty or not set(_POSE) <= set(table.columns):
        raise DataError(f"{ODOMETRY_TOPIC} has no poses within the analysed window")
    children = {str(name) for name in table["child_frame_id"].unique()} - {""}
    if children - {head}:
        raise DataError(
            f"{ODOMETRY_TOPIC} gives the pose of {', '.join(sorted(children))}, not of the head "
            f"link {head}"
        )
    t_ns = table.index.to_numpy(dtype=np.int64)
    pose = table[list(_POSE)].to_numpy(dtype=np.float64)
    inside = (t_ns >= start_ns) & (t_ns < stop_ns) & np.isfinite(pose).all(axis=1)
    inside[1:] &= np.diff(t_ns) > 0
    if np.count_nonzero(inside) < 16:
        raise DataError(f"{ODOMETRY_TOPIC} has fewer than 16 poses within the analysed window")
    chosen = pose[inside]
    length = np.linalg.norm(chosen[:, 3:], axis=1, keepdims=True)
    if np.any(length < 0.5):
        raise DataError(f"{ODOMETRY_TOPIC} holds orientations that are not unit quaternions")
    t_s = (t_ns[inside] - span.origin_ns).astype(np.float64) * 1e-9
    return t_s, chosen[:, :3], chosen[:, 3:] / length


def _commands(robot: Robot, gait: GaitFit) -> dict[int, tuple[ComplexArray, float]]:
    """Harmonics and mean of each driven joint's command, by joint index."""
    return {
        robot.joint_names.index(name): (gait.fit.amplitudes[k], float(gait.fit.trend[k, 0]))
        for k, name in enumerate(gait.driven)
    }
