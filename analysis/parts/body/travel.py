"""How the body travels, cycle by cycle: its centre of mass, and its virtual chassis.

The virtual chassis is a frame of the body that follows from where its links are. Its origin is the
mean of the link centres, its axes are the principal axes of the centres about it (Rollinson, Buchan
& Choset, Advanced Robotics 26, 2012, doi 10.1080/01691864.2012.728696: the singular value
decomposition of the positions), here of their places on the ground. In the plane, with z = x + j y
from the origin, the long axis is at arg(sum z^2) / 2, and the squared semi-axes are
(mean |z|^2 +- |mean z^2|) / 2. It points the way the head does.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from undulog.capture import SessionView
from undulog.capture.common.arrays import ComplexArray, FloatArray
from undulog.capture.common.console import Warn
from undulog.capture.common.errors import DataError, LogError
from undulog.capture.robot.kinematics import link_positions, rotation_from_quaternion
from undulog.capture.robot.model import Plane, Robot

from ...common.estimate import Estimate
from ...estimators.harmonic import HarmonicModel, fit_at
from ...estimators.intervals import around, t_factor
from ...estimators.series import Series
from ...response.rhythm import NYQUIST_SHARE
from ...signals.windows import Span
from .motion import ODOMETRY_TOPIC, Poses, head_poses, link_centres
from .null import SAMPLES, travel

GRAVITY = 9.80665
"""Standard gravity [m/s^2] (3rd CGPM, 1901)."""

MIN_CYCLES = 3
_NOTHING = "no speed and no cost of transport"
_CLEAR = 3.0
"""A mean step per cycle below so many standard errors is no transport."""

ROUND = 0.7
"""Beyond this ratio of the short to the long semi-axis the axes are not those of a long body."""

HARMONICS = 6
"""Of shape and velocity within a cycle."""

PHASES: FloatArray = 2 * np.pi * np.arange(SAMPLES) / SAMPLES
"""Of one cycle, at which velocities are integrated [rad]."""


@dataclass(frozen=True)
class CycleSteps:
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
) -> CycleSteps | None:
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
        poses = head_poses(session, robot.links[0].name, span, beyond=1)
    except (DataError, LogError) as error:
        warn(f"{_NOTHING}: {error}")
        return None
    edges = np.linspace(span.start_s, span.stop_s, span.cycles + 1)
    angles = np.stack([responses[name].at(edges) for name in robot.joint_names], axis=-1)
    step = np.diff(centre_of_mass(robot, edges, poses, angles), axis=0)[:, :2]
    net = step.sum(axis=0)
    way = net / max(float(np.linalg.norm(net)), np.finfo(np.float64).tiny)
    cycle_s = (span.stop_s - span.start_s) / span.cycles
    return CycleSteps(step @ way, cycle_s, sum(link.mass for link in robot.links))


def centre_of_mass(robot: Robot, t_s: FloatArray, poses: Poses, angles: FloatArray) -> FloatArray:
    """Return the centre of mass from the head's pose and the joint angles.

    Args:
        robot: The robot, m joints.
        t_s: Times wanted [s], shape (n,).
        poses: Of the head; interpolated.
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
    centres = link_positions(robot, head, rotation_from_quaternion(turn), angles)
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


def mean_step(steps: FloatArray, least: float = -np.inf, most: float = np.inf) -> Estimate:
    """Return the mean of a quantity of each cycle, its interval from their scatter.

    Args:
        least: Where the interval ends at the latest.
        most: The same of its other end.
    """
    mean = mean_of_cycles(steps)
    if mean is None:
        return Estimate(float(steps.mean()) if steps.size else None)
    value, variance, dof = mean
    low, high = around(value, t_factor(dof) * variance**0.5)
    return Estimate(value, (max(least, low), min(most, high)))


def speed(steps: CycleSteps) -> tuple[float, float, float] | None:
    """Speed of the centre of mass along its net displacement.

    Returns:
        Value [m/s], variance, degrees of freedom.
    """
    return mean_of_cycles(steps.forward_m / steps.cycle_s)


def cost_of_transport(steps: CycleSteps, energy_j: FloatArray) -> tuple[float, float, float] | None:
    """E_abs / (m g d), a ratio of means over cycles (delta method).

    Args:
        energy_j: E_abs of all joints together in each cycle [J], shape (c,).

    Returns:
        Value, variance, degrees of freedom; None where nothing is carried anywhere: a net step per
        cycle of less than three standard errors.
    """
    mean = mean_of_cycles(steps.forward_m)
    if mean is None or energy_j.size != steps.forward_m.size:
        return None
    step, variance, dof = mean
    if step <= _CLEAR * variance**0.5:
        return None
    weight = steps.mass_kg * GRAVITY
    value = float(energy_j.mean()) / (weight * step)
    rest = energy_j - value * weight * steps.forward_m
    return value, float(rest.var(ddof=1) / rest.size) / (weight * step) ** 2, dof


@dataclass(frozen=True)
class ChassisPath:
    """The virtual chassis over n samples.

    Attributes:
        t_s: Times [s], shape (n,).
        place: Origin x + j y on the ground [m], shape (n,).
        heading: Of the long axis towards the head, unwrapped [rad], shape (n,).
        semi_axes: Root mean square distance of the links along and across [m], shape (n, 2).
    """

    t_s: FloatArray
    place: ComplexArray
    heading: FloatArray
    semi_axes: FloatArray


@dataclass(frozen=True)
class GaitCycle:
    """One cycle of a periodic motion, the mean of many; m joints, Fourier order h.

    Shape and velocity are Re sum_k c_k exp(j k phase), with the phase 0 at the series' origin.

    Attributes:
        joints: The horizontal ones, head to tail.
        shape: Their angles [rad], shape (m, h + 1).
        velocity: Forward, left and turning of the virtual chassis in its own axes, for each radian
            of phase [m/rad, m/rad, 1], shape (3, h + 1).
        omega: Angular frequency [rad/s].
        steps: Forward and left along the mean heading and turn of each whole cycle
            [m, m, rad], shape (cycles, 3).
    """

    joints: tuple[str, ...]
    shape: ComplexArray
    velocity: ComplexArray
    omega: float
    steps: FloatArray


def virtual_chassis(centres: FloatArray) -> tuple[ComplexArray, FloatArray, FloatArray]:
    """Return origin, heading and semi-axes of the virtual chassis.

    Args:
        centres: Of the links, head first, on the ground [m], shape (n, links, 2).

    Returns:
        Origin x + j y [m], shape (n,); heading in (-pi, pi], shape (n,); semi-axes [m], shape
        (n, 2).
    """
    place: ComplexArray = centres[..., 0] + 1j * centres[..., 1]
    origin: ComplexArray = place.mean(axis=1)
    off = place - origin[:, None]
    second = np.mean(off**2, axis=1)
    power = np.mean(np.abs(off) ** 2, axis=1)
    axis = np.exp(0.5j * np.angle(second))
    axis *= np.where(np.real((off[:, 0] - off[:, -1]) * np.conj(axis)) < 0, -1.0, 1.0)
    squares = np.stack([power + np.abs(second), power - np.abs(second)], axis=-1) / 2
    return origin, np.angle(axis), np.sqrt(np.maximum(squares, 0.0))


def chassis_path(robot: Robot, poses: Poses, angles: Mapping[str, Series]) -> ChassisPath:
    """Follow the virtual chassis.

    Args:
        poses: Of the head.
        angles: Of every joint.

    Raises:
        DataError: If the body is curled, so that its long axis is not defined.
    """
    parts = [
        (t_s, *virtual_chassis(centres[..., :2]))
        for t_s, centres in link_centres(robot, poses, [angles[n] for n in robot.joint_names])
    ]
    if not parts:
        raise DataError("the head's poses and the joint angles have no common time")
    t_s, place, heading, semi_axes = map(np.concatenate, zip(*parts, strict=True))
    roundest = float(np.max(semi_axes[:, 1] / np.maximum(semi_axes[:, 0], 1e-12)))
    if roundest > ROUND:
        raise DataError(
            f"the body curls up to {roundest:.2f} as wide as long (root mean square; at most "
            f"{ROUND:g}), so it has no long axis to measure against"
        )
    return ChassisPath(t_s, place, np.unwrap(heading), semi_axes)


def gait_cycle(
    robot: Robot, path: ChassisPath, angles: Mapping[str, Series], omega: float, start_s: float
) -> GaitCycle:
    """Fit one cycle of shape and velocity.

    Between two samples the chassis is taken to move along a screw, whose velocity in its own axes
    is the logarithm of the motion.

    Args:
        angles: Of every joint, periodic.
        omega: Angular frequency [rad/s].
        start_s: Start of the whole cycles [s].

    Raises:
        DataError: If there are too few samples.
    """
    names = tuple(joint.name for joint in robot.joints if joint.plane is Plane.HORIZONTAL)
    step_s = np.diff(path.t_s)
    turn = np.diff(path.heading)
    half = 0.5 * turn
    # d turn j / (exp(j turn) - 1) = d exp(-j turn / 2) / sinc
    moved = np.diff(path.place) * np.exp(-1j * (path.heading[:-1] + half)) / np.sinc(half / np.pi)
    rates = np.stack([moved.real, moved.imag, turn]) / (omega * step_s)
    middle = path.t_s[:-1] + 0.5 * step_s
    series = [Series(name, middle, row) for name, row in zip("xyt", rates, strict=True)]
    shapes = [angles[name] for name in names]
    slowest = max(shape.period_s for shape in (*shapes, series[0]))
    highest = int(NYQUIST_SHARE * 2 * np.pi / (slowest * omega))
    model = HarmonicModel(harmonics=int(np.clip(highest, 1, HARMONICS)))
    shape, velocity = (fit_at(some, omega, model) for some in (shapes, series))
    parts = np.zeros((2, max(len(names), 3), HARMONICS + 1), dtype=np.complex128)
    for part, fit in zip(parts, (shape, velocity), strict=True):
        part[: len(fit.trend), 0] = fit.trend[:, 0]
        part[: len(fit.trend), 1 : 1 + model.harmonics] = fit.amplitudes
    shaped, moved_by = parts[0, : len(names)], parts[1, :3]
    return GaitCycle(names, shaped, moved_by, omega, _cycle_steps(path, omega, start_s))


def _cycle_steps(path: ChassisPath, omega: float, start_s: float) -> FloatArray:
    """Return displacement along the mean heading and turn of each whole cycle, shape (c, 3)."""
    period = 2 * np.pi / omega
    count = int((path.t_s[-1] - max(start_s, path.t_s[0])) / period + 1e-6)
    first = max(start_s, path.t_s[0])
    steps = np.zeros((count, 3))
    for k in range(count):
        ends = first + period * np.array([k, k + 1])
        i, j = np.searchsorted(path.t_s, ends)
        x, y, heading = (
            np.interp(ends, path.t_s, part)
            for part in (path.place.real, path.place.imag, path.heading)
        )
        mean = float(path.heading[i : max(j, i + 1)].mean())
        gone = complex(x[1] - x[0], y[1] - y[0]) * np.exp(-1j * mean)
        steps[k] = gone.real, gone.imag, heading[1] - heading[0]
    return steps


def wave_at(coefficients: ComplexArray, phase: FloatArray) -> FloatArray:
    """Return Re sum_k c_k exp(j k phase).

    Args:
        coefficients: Shape (..., h + 1).
        phase: [rad], shape (n,).

    Returns:
        Shape (..., n).
    """
    order: FloatArray = np.arange(float(coefficients.shape[-1]))
    return np.real(coefficients @ np.exp(1j * np.outer(order, phase)))


def step_of_cycle(velocity: FloatArray) -> FloatArray:
    """Return displacement along the mean heading and turn over a cycle.

    Args:
        velocity: Forward, left and turning for each radian of phase, at even phases, shape (3, n).

    Returns:
        Forward and left [m], turn [rad], shape (3,).
    """
    _, heading, displacement, turn = travel(velocity.T, 1.0)
    gone = displacement * np.exp(-1j * float(heading.mean()))
    return np.array([gone.real, gone.imag, turn])
