"""Which links are on the ground, from the torques of the joints.

Gravity, the ground's loads and its friction on the links behind a joint have a moment about its
axis that the joint's torque balances; of the whole body their sum and their moment are zero. Both
are linear in the loads N >= 0 of the links. Inertia is left out. Friction is not known: it counts
as random forces along the ground, independent from link to link, in the covariance of the
equations. A chain has more links than equations that tell their loads apart, so an even load is
the prior. What is left is non-negative least squares (Lawson & Hanson, Solving Least Squares
Problems, 1974). All scales are multiples of the mean weight W and length L of a link.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import TypeAlias

import numpy as np

from undulog.capture import SessionView
from undulog.capture.common.arrays import FloatArray
from undulog.capture.common.console import Warn
from undulog.capture.common.errors import DataError, LogError
from undulog.capture.log.read.sample_times import Signal
from undulog.capture.robot.kinematics import link_poses, rotation_from_quaternion
from undulog.capture.robot.model import Plane, Robot

from ...common.remarks import Note
from ...estimators.nonnegative import nonnegative_least_squares
from ...estimators.series import Series, clean
from ...signals.columns import Columns
from ...signals.stretch import SharedTimes, part_of
from ...signals.windows import Span
from ..body.motion import ODOMETRY_TOPIC, head_poses
from ..body.travel import GRAVITY, MIN_CYCLES, mean_step
from .result import GroundContact, LinkContact

PHASES = 32
"""Parts of a cycle, over each of which angles and torques are averaged."""

MOST_CYCLES = 8
MOST_LINKS = 128

_TORQUE = 0.7
"""Standard error of a torque [W L]."""

_FRICTION = 0.5
"""Standard deviation of a link's friction along and across [W]."""

_FORCE, _MOMENT = 0.3, 1.0
"""Standard errors of the balances of the whole body, for inertia [W], [W L]."""

_EVEN = 5.0
"""Prior standard deviation of a link's load about W [W]."""

TOUCHES = 0.35
"""A link with this load or more is on the ground [W]."""

MISFIT = 2.0
"""Root mean square of the normalised residuals from which on no loads explain the torques."""

OPPOSITE = 0.8
"""Torques of the other sign whose residuals are smaller than so much of them have a wrong sign."""


_Cycle: TypeAlias = tuple[list[Series], list[Series], FloatArray]
"""Angles, torques, and ends of the parts of one cycle."""


def link_loads(
    robot: Robot, angles: FloatArray, torques: FloatArray, up: FloatArray
) -> tuple[FloatArray, float]:
    """Return the load of each link.

    Args:
        robot: The robot, m joints.
        angles: [rad], shape (n, m).
        torques: Of the joints on their rear links [N m], shape (n, m).
        up: Unit vector against gravity in the frame of the head link, shape (n, 3).

    Returns:
        Loads over the mean weight of a link, shape (n, m + 1), and the root mean square of the
        residuals, each over its standard error.
    """
    mass = np.array([link.mass for link in robot.links])
    radius = np.array([link.radius for link in robot.links])
    weight = GRAVITY * float(mass.mean())
    length = float(np.mean([link.length for link in robot.links]))
    n, m = angles.shape
    errors = np.repeat([_TORQUE * length, _FORCE, _MOMENT * length], [m, 3, 3]) * weight
    yaw = np.array([[joint.plane is Plane.HORIZONTAL] for joint in robot.joints])
    half = np.array([[link.length / 2] for link in robot.links])
    centres, turns = link_poses(robot, np.zeros(3), np.eye(3), angles)
    middle = mass @ centres / mass.sum()
    pivot = centres[:, :-1] - half[:-1] * turns[:, :-1, :, 0]
    axis = np.where(yaw, turns[:, :-1, :, 2], turns[:, :-1, :, 1])
    ground = _moments(centres - radius[:, None] * up[:, None], pivot, axis, middle)
    lift = np.einsum("krni,ki->krn", ground, up)
    slip = (ground - lift[..., None] * up[:, None, None]).reshape(n, m + 6, -1)
    body = _moments(centres, pivot, axis, middle)
    weights = -GRAVITY * np.einsum("krni,ki,n->kr", body, up, mass)
    measured = np.concatenate([torques, np.zeros((n, 6))], axis=1) - weights
    covariance: FloatArray = np.diag(errors**2) + (_FRICTION * weight) ** 2 * (
        slip @ slip.transpose(0, 2, 1)
    )
    rows = np.concatenate([weight * lift, measured[..., None]], axis=2)
    # SciPy's triangular solver takes twenty times as long: it starts threads for so little.
    rows = np.linalg.solve(np.linalg.cholesky(covariance), rows)
    matrix, right = rows[..., :-1], rows[..., -1]
    transposed = matrix.transpose(0, 2, 1)
    loads = nonnegative_least_squares(
        transposed @ matrix + np.eye(m + 1) / _EVEN**2,
        (transposed @ right[..., None])[..., 0] + 1 / _EVEN**2,
    )
    left = right - (matrix @ loads[..., None])[..., 0]
    return loads, float(np.mean(np.square(left))) ** 0.5 if n else 0.0


def _moments(
    point: FloatArray, pivot: FloatArray, axis: FloatArray, middle: FloatArray
) -> FloatArray:
    """Return the joints' torques against unit forces on the links, and the body's balances.

    Args:
        point: Where the forces act, one a link [m], shape (n, m + 1, 3).
        pivot: Of the joints [m], shape (n, m, 3).
        axis: Of the joints, shape (n, m, 3).
        middle: Point of the body's moments [m], shape (n, 3).

    Returns:
        Torques [m], sum [1] and moment [m] per unit force, shape (n, m + 6, m + 1, 3).
    """
    links: int = point.shape[1]
    behind = np.arange(links) > np.arange(links - 1)[:, None]
    arms = point[:, None] - pivot[:, :, None]
    torques: FloatArray = np.cross(axis[:, :, None], arms)
    about: FloatArray = np.where(behind[..., None], torques, 0.0)
    whole = np.cross(np.eye(3)[:, None], (point - middle[:, None])[:, None])
    force = np.broadcast_to(np.eye(3)[:, None], whole.shape)
    return np.concatenate([-about, force, whole], axis=1)


def means_between(t_s: FloatArray, values: FloatArray, edges_s: FloatArray) -> FloatArray:
    """Return the means of a sampled course, linear between samples, over successive intervals.

    Args:
        t_s: Times [s], shape (n,).
        values: Shape (n,).
        edges_s: Ends of the intervals [s], shape (k + 1,).

    Returns:
        Shape (k,).
    """
    inside = (t_s > edges_s[0]) & (t_s < edges_s[-1])
    times = np.unique(np.concatenate([edges_s, t_s[inside]]))
    course = np.interp(times, t_s, values)
    area = np.concatenate([[0.0], np.cumsum(np.diff(times) * (course[1:] + course[:-1]) / 2)])
    return np.diff(area[np.searchsorted(times, edges_s)]) / np.diff(edges_s)


def cycle_loads(
    robot: Robot,
    angles: Sequence[Series],
    torques: Sequence[Series],
    up: Sequence[Series],
    edges_s: FloatArray,
) -> tuple[FloatArray, float]:
    """Return the loads of the links in successive parts of a cycle, as :func:`link_loads`.

    Args:
        angles: Of the m joints [rad].
        torques: Of the m joints [N m].
        up: Components of the unit vector against gravity in the frame of the head link.
        edges_s: Ends of the parts [s], shape (n + 1,).
    """

    def averaged(series: Sequence[Series]) -> FloatArray:
        return np.stack(
            [means_between(channel.t_s, channel.values, edges_s) for channel in series], axis=-1
        )

    vertical = averaged(up)
    vertical /= np.linalg.norm(vertical, axis=1, keepdims=True)
    return link_loads(robot, averaged(angles), averaged(torques), vertical)


def ground_contact(
    session: SessionView, columns: Columns, angles: Mapping[str, Series], *, span: Span, warn: Warn
) -> GroundContact | None:
    """Find which links are on the ground, cycle by cycle.

    Args:
        angles: Joint angles by name, of joints whose sensors are sound.
        span: Whole cycles to look at.
        warn: Receives why there is no result where the torques are known.

    Returns:
        The contact; None where torques, angles, the head's orientation or the robot are unknown.
    """
    robot = session.robot
    if robot is None or ODOMETRY_TOPIC not in session.channels or span.cycles < MIN_CYCLES:
        return None
    names = robot.joint_names
    source, torques, factors = _torques(session, robot, columns)
    if not torques or len(names) >= MOST_LINKS or any(name not in angles for name in names):
        return None
    try:
        t_s, _, quaternion = head_poses(session, robot.links[0].name, span)
        vertical = rotation_from_quaternion(quaternion)[:, 2]  # world's z in the head's frame
        up = [
            Series(axis, t_s, component) for axis, component in zip("xyz", vertical.T, strict=True)
        ]
        parts = _cycles([angles[n] for n in names], [torques[n] for n in names], factors, span)
        loads = _explained(robot, up, list(parts))
    except (DataError, LogError) as error:
        warn(Note(f"no ground contact: {error}"))
        return None
    return None if len(loads) < MIN_CYCLES else GroundContact(source, _links(robot, loads))


def _cycles(
    angles: Sequence[Series], torques: Sequence[Signal], factors: FloatArray, span: Span
) -> Iterator[_Cycle]:
    """Yield some of the cycles, those without samples left out."""
    ends = np.linspace(span.start_s, span.stop_s, span.cycles + 1)
    for k in np.unique(np.linspace(0, span.cycles - 1, MOST_CYCLES).astype(np.int64)).tolist():
        edges = np.linspace(ends[k], ends[k + 1], PHASES + 1)
        start_ns, stop_ns = (span.origin_ns + round(t * 1e9) for t in edges[[0, -1]].tolist())
        shared: SharedTimes = {}
        acting: list[Series] = []
        for signal, factor in zip(torques, factors.tolist(), strict=True):
            part = part_of(signal, start_ns, stop_ns, shared)
            torque = clean(part.name, part.t_ns, part.values, span.origin_ns)
            acting.append(replace(torque, values=factor * torque.values))
        bent = [angle.between(edges[0], edges[-1]) for angle in angles]
        sampled = min(channel.count for channel in (*acting, *bent)) >= PHASES // 2
        # A driver without torques fills in a constant.
        if sampled and any(np.ptp(torque.values) > 0 for torque in acting):
            yield bent, acting, edges


def _explained(robot: Robot, up: Sequence[Series], cycles: Sequence[_Cycle]) -> FloatArray:
    """Return the loads, shape (cycles, phases, links).

    Raises:
        DataError: If no loads explain the torques, or the opposite torques fit better.
    """
    fits = [cycle_loads(robot, bent, acting, up, edges) for bent, acting, edges in cycles]
    if not fits:
        return np.zeros((0, PHASES, len(robot.links)))
    misfit = float(np.median([residual for _, residual in fits]))
    if misfit > MISFIT:
        raise DataError(
            f"no loads of links explain the joints' torques (residuals of {misfit:.1f} times what "
            f"is expected, at most {MISFIT:g}); are they in N m, and is nothing but the ground "
            "touched?"
        )
    bent, acting, edges = cycles[0]
    turned = [replace(torque, values=-torque.values) for torque in acting]
    if cycle_loads(robot, bent, turned, up, edges)[1] < OPPOSITE * fits[0][1]:
        raise DataError("the joints' torques seem to have the other sign than their angles")
    return np.stack([loads for loads, _ in fits])


def _torques(
    session: SessionView, robot: Robot, columns: Columns
) -> tuple[str, Mapping[str, Signal], FloatArray]:
    """Return where all joints' torques are from, their signals and the factors that make [N m]."""
    if all(name in columns.effort for name in robot.joint_names):
        return "effort", columns.effort, np.ones(len(robot.joints))
    described = session.run is not None or "servo" not in robot.assumed
    if described and all(name in columns.current for name in robot.joint_names):
        constants = np.array([joint.servo.torque_constant for joint in robot.joints])
        return "current", columns.current, constants
    return "", {}, np.zeros(0)


def _links(robot: Robot, loads: FloatArray) -> tuple[LinkContact, ...]:
    """Return the links' contact from their loads, shape (cycles, phases, links)."""
    touching = loads >= TOUCHES
    contacts: list[LinkContact] = []
    for k, link in enumerate(robot.links):
        share = mean_step(touching[..., k].mean(axis=1), 0.0, 1.0)
        by_phase = tuple(touching[..., k].mean(axis=0).tolist())
        contacts.append(LinkContact(link.name, share, float(loads[..., k].mean()), by_phase))
    return tuple(contacts)
