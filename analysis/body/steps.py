"""What a session moves: speed of the body and cost of transport, cycle by cycle."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from undulog.capture import SessionView
from undulog.capture.common.arrays import FloatArray
from undulog.capture.common.console import Warn
from undulog.capture.common.errors import DataError, LogError
from undulog.capture.robot.kinematics import link_poses, rotation_from_quaternion
from undulog.capture.robot.model import Robot

from ..estimators.series import Series
from ..signals.windows import Span
from .motion import ODOMETRY_TOPIC, head_poses

GRAVITY = 9.80665
"""Standard gravity [m/s^2] (3rd CGPM, 1901)."""

MIN_CYCLES = 3
_NOTHING = "no speed and no cost of transport"
_CLEAR = 3.0
"""A mean step per cycle below so many standard errors is no transport."""


@dataclass(frozen=True)
class Steps:
    """How far the centre of mass moved in each whole cycle.

    Attributes:
        forward_m: Along the net displacement, horizontally [m], shape (c,).
        cycle_s: Length of a cycle [s].
    """

    forward_m: FloatArray
    cycle_s: float
    mass_kg: float


def body_steps(
    session: SessionView, responses: Mapping[str, Series], span: Span, warn: Warn
) -> Steps | None:
    """Follow the centre of mass from cycle to cycle.

    Args:
        responses: Measured joint angles by name.
        span: Whole cycles to look at.
        warn: Told why there is no result.

    Returns:
        The steps, or None.
    """
    robot = session.robot
    if robot is None or ODOMETRY_TOPIC not in session.channels:
        warn(f"{_NOTHING}: it takes a robot description and the head's pose on {ODOMETRY_TOPIC}")
        return None
    if span.cycles < MIN_CYCLES:
        warn(f"{_NOTHING}: {span.cycles} whole cycles are too few")
        return None
    if unknown := [n for n in robot.joint_names if n not in responses or responses[n].count < 2]:
        warn(f"{_NOTHING}: no angles of {', '.join(unknown)}")
        return None
    try:
        poses = head_poses(session, robot.links[0].name, span)
    except (DataError, LogError) as error:
        warn(f"{_NOTHING}: {error}")
        return None
    edges = np.linspace(span.start_s, span.stop_s, span.cycles + 1)
    angles = np.stack([responses[name].at(edges) for name in robot.joint_names], axis=-1)
    step = np.diff(centre_of_mass(robot, edges, poses, angles), axis=0)[:, :2]
    net = step.sum(axis=0)
    way = net / max(float(np.linalg.norm(net)), np.finfo(np.float64).tiny)
    cycle_s = (span.stop_s - span.start_s) / span.cycles
    return Steps(step @ way, cycle_s, sum(link.mass for link in robot.links))


def centre_of_mass(
    robot: Robot,
    t_s: FloatArray,
    poses: tuple[FloatArray, FloatArray, FloatArray],
    angles: FloatArray,
) -> FloatArray:
    """Return the centre of mass from the head's pose and the joint angles.

    Args:
        robot: The robot, m joints.
        t_s: Times wanted [s], shape (n,).
        poses: Times [s], positions [m] and quaternions of the head; interpolated.
        angles: Joint angles at the wanted times [rad], shape (n, m).

    Returns:
        World positions [m], shape (n, 3).
    """
    known_s, position, quaternion = poses
    # q and -q are one orientation: neighbours must not differ by the sign.
    flips = np.where(np.einsum("ij,ij->i", quaternion[1:], quaternion[:-1]) < 0, -1.0, 1.0)
    turn = _at(t_s, known_s, quaternion * np.cumprod(np.append(1.0, flips))[:, None])
    turn /= np.linalg.norm(turn, axis=1, keepdims=True)
    head = _at(t_s, known_s, position)
    centres, _ = link_poses(robot, head, rotation_from_quaternion(turn), angles)
    masses = np.array([link.mass for link in robot.links])
    return np.einsum("l,nlk->nk", masses / masses.sum(), centres)


def _at(t_s: FloatArray, known_s: FloatArray, columns: FloatArray) -> FloatArray:
    """Columns, shape (n, k), at other times."""
    values: list[FloatArray] = [np.interp(t_s, known_s, column) for column in columns.T]
    return np.stack(values, axis=1)


def mean_of_cycles(per_cycle: FloatArray) -> tuple[float, float, float] | None:
    """Return the mean over cycles, its variance from their scatter, and its degrees of freedom.

    Args:
        per_cycle: Shape (c,).

    Returns:
        None for fewer than 3 cycles.
    """
    if per_cycle.size < MIN_CYCLES:
        return None
    count = per_cycle.size
    return float(per_cycle.mean()), float(per_cycle.var(ddof=1) / count), count - 1.0


def speed(steps: Steps) -> tuple[float, float, float] | None:
    """Speed of the centre of mass along its net displacement.

    Returns:
        Value [m/s], variance, degrees of freedom.
    """
    return mean_of_cycles(steps.forward_m / steps.cycle_s)


def cost_of_transport(steps: Steps, energy_j: FloatArray) -> tuple[float, float, float] | None:
    """E_abs / (m g d), a ratio of means over cycles (delta method).

    Args:
        energy_j: E_abs of all joints together in each cycle [J], shape (c,).

    Returns:
        Value, variance, degrees of freedom; None where nothing is carried anywhere: a net step per
        cycle of less than three standard errors.
    """
    known = mean_of_cycles(steps.forward_m)
    if known is None or energy_j.size != steps.forward_m.size:
        return None
    step, variance, dof = known
    if step <= _CLEAR * variance**0.5:
        return None
    weight = steps.mass_kg * GRAVITY
    value = float(energy_j.mean()) / (weight * step)
    rest = energy_j - value * weight * steps.forward_m
    return value, float(rest.var(ddof=1) / rest.size) / (weight * step) ** 2, dof
