"""Shape of the body over a cycle: principal modes of the joint angles, and the nearest serpenoid.

Modes are the principal components of the angles over whole cycles. A serpenoid gives joint i of a
plane the angle offset + amplitude cos(omega t - kappa i + phase) (Hirose, Biologically Inspired
Robots, 1993). With the complex amplitudes a_i of the joints, least squares is in closed form but
for kappa: amplitude exp(j phase) = mean of a_i exp(j kappa i), and kappa maximises its size.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from undulog.capture import SessionView
from undulog.capture.common.arrays import ComplexArray, FloatArray
from undulog.capture.common.console import Warn
from undulog.capture.common.errors import DataError, LogError
from undulog.capture.robot.model import Plane, Robot

from ...common.estimate import Estimate
from ...common.formats import scaled
from ...common.remarks import Note
from ...estimators.intervals import around, t_factor
from ...estimators.series import Series
from ...response.fitting import GaitFit
from ...signals.columns import by_plane
from ...signals.windows import Span
from .motion import ODOMETRY_TOPIC, head_poses
from .oscillation import MotionFit, Oscillation, absolute, best_lag, fit_motion, wave_speed
from .result import BodyShape, BodyTravel, PlaneShape, Serpenoid, ShapeMode
from .travel import ChassisPath, GaitCycle, chassis_path, gait_cycle, mean_of_cycles, mean_step

LEAST_JOINTS = 4
"""Of a plane: fewer have no more than two modes and hardly a wave."""

MOST_MODES = 3

_STILL = 0.05
"""A plane that moves less than this share of the liveliest is held still."""

_PER_CYCLE = 64
_CYCLES = 128
"""Cycles that are held in memory at once."""

_STEP = 1e-6
"""Of a numerical derivative, as a share of the largest amplitude."""

_NEWTON = 20
"""Steps from the grid to the best wave number; five are enough."""


@dataclass(frozen=True)
class MeasuredShape:
    """Shape of a session, with what it was computed from.

    Attributes:
        cycle: One cycle of it, where the head's pose is known.
        motion: The fitted motion of its joints.
    """

    shape: BodyShape | None = None
    cycle: GaitCycle | None = None
    motion: MotionFit | None = None


def body_shape(
    session: SessionView,
    angles: Mapping[str, Series],
    sound: Mapping[str, Series],
    gait: GaitFit | None,
    *,
    span: Span,
    warn: Warn,
) -> MeasuredShape:
    """Measure the shape of a periodic motion.

    Args:
        angles: Joint angles by name, in chain order.
        sound: Those of them that no sensor falsifies.
        gait: The fitted gait.
        span: Whole cycles to look at.
        warn: Receives why travel is unknown where it could be known.

    Returns:
        The shape, None where no plane has four moving joints and no travel is known; nothing of
        joints with several frequencies.
    """
    moved = None if gait is None or gait.others else fit_motion(angles, gait)
    if moved is None or span.cycles < 1:
        return MeasuredShape(motion=moved)
    planes = plane_shapes(session.robot, moved, span, set(sound))
    travel, cycle = None, None
    try:
        if (measured := _path(session, sound, span)) is not None:
            robot, path = measured
            omega = moved.fit.omega
            cycle = gait_cycle(robot, path, sound, omega, span.start_s)
            travel = _travel(path, cycle)
            cycle = cycle if _planar(robot, moved) else None
    except (DataError, LogError) as error:
        warn(Note(f"no travel of the body: {error}"))
    shape = BodyShape(planes, travel) if planes or travel is not None else None
    return MeasuredShape(shape, cycle, moved)


def _path(
    session: SessionView, angles: Mapping[str, Series], span: Span
) -> tuple[Robot, ChassisPath] | None:
    """Return the robot and its path, None where one of them isn't recorded."""
    robot = session.robot
    if robot is None or ODOMETRY_TOPIC not in session.channels:
        return None
    if any(name not in angles or angles[name].count < 2 for name in robot.joint_names):
        return None
    return robot, chassis_path(robot, head_poses(session, robot.links[0].name, span), angles)


def _planar(robot: Robot, moved: MotionFit) -> bool:
    """Return whether only horizontal joints move."""
    plane_of = {joint.name: joint.plane for joint in robot.joints}
    power = dict.fromkeys(Plane, 0.0)
    for name, size in zip(moved.names, np.abs(moved.fit.fundamental).tolist(), strict=True):
        power[plane_of[name]] += size**2
    return power[Plane.VERTICAL] <= _STILL**2 * power[Plane.HORIZONTAL]


def _travel(path: ChassisPath, cycle: GaitCycle) -> BodyTravel:
    length, width = np.sqrt(np.mean(path.semi_axes**2, axis=0)).tolist()
    forward, left, turn = map(mean_step, cycle.steps.T)
    return BodyTravel(forward, left, turn, length, width)


def plane_shapes(
    robot: Robot | None, moved: MotionFit, span: Span, sound: set[str]
) -> tuple[PlaneShape, ...]:
    """Measure the shape of each plane with at least four moving joints.

    Args:
        sound: Names of the joints whose angles no sensor falsifies.
    """
    rows_of: dict[str, list[int]] = {}
    members_of = by_plane(robot, moved.chain)
    for plane, members in members_of.items():
        rows_of[plane] = [moved.names.index(n) for n in members if n in moved.names and n in sound]
    size = np.abs(moved.fit.fundamental)
    power = {plane: float(np.sum(size[rows] ** 2)) for plane, rows in rows_of.items()}
    lively = _STILL**2 * max(power.values(), default=0.0)
    shapes: list[PlaneShape] = []
    for plane, rows in rows_of.items():
        if len(rows) < LEAST_JOINTS or power[plane] <= lively:
            continue
        names = tuple(moved.names[row] for row in rows)
        number = [members_of[plane].index(name) for name in names]
        place = np.array(number, dtype=np.float64) - number[0]
        series = [moved.series[row] for row in rows]
        modes, offset = _modes(series, span)
        serpenoid = _serpenoid(
            moved, rows, place, metres=_metres(robot, names), start_s=span.start_s, offset=offset
        )
        shapes.append(PlaneShape(None if robot is None else plane, names, modes, serpenoid))
    return tuple(shapes)


def _metres(robot: Robot | None, names: Sequence[str]) -> float | None:
    """Return the mean distance of neighbours among the joints' numbers [m]."""
    if robot is None:
        return None
    along = np.cumsum([link.length for link in robot.links])
    places = along[[robot.joint_names.index(name) for name in names]]
    return float(places[-1] - places[0]) / (len(names) - 1)


def _modes(series: Sequence[Series], span: Span) -> tuple[tuple[ShapeMode, ...], Estimate]:
    """Return the principal modes over whole cycles, and the mean of all angles."""
    count = len(series)
    total, second = np.zeros(count), np.zeros((count, count))
    for angles in _cycles(series, span):
        total += angles.sum(axis=(0, 1))
        second += np.einsum("cni,cnj->ij", angles, angles)
    samples = span.cycles * _PER_CYCLE
    mean = total / samples
    _, vectors = np.linalg.eigh(second / samples - np.outer(mean, mean))
    modes = vectors[:, ::-1][:, :MOST_MODES]
    largest = np.argmax(np.abs(modes), axis=0)
    modes = modes * np.sign(modes[largest, np.arange(modes.shape[1])])
    parts: list[FloatArray] = []
    offsets: list[FloatArray] = []
    for angles in _cycles(series, span):
        off = angles - mean
        every = np.mean(np.sum(off**2, axis=2), axis=1)
        parts.append(np.column_stack([np.mean((off @ modes) ** 2, axis=1), every]))
        offsets.append(angles.mean(axis=(1, 2)))
    power = np.concatenate(parts)
    shares = [_share(power[:, k], power[:, -1]) for k in range(modes.shape[1])]
    shape_modes = tuple(
        ShapeMode(share, tuple(mode.tolist())) for share, mode in zip(shares, modes.T, strict=True)
    )
    return shape_modes, mean_step(np.concatenate(offsets))


def _cycles(series: Sequence[Series], span: Span) -> Iterator[FloatArray]:
    """Yield the angles at even times of whole cycles, shape (cycles, times, joints)."""
    period = (span.stop_s - span.start_s) / span.cycles
    phase = np.arange(_PER_CYCLE) / _PER_CYCLE
    for first in range(0, span.cycles, _CYCLES):
        number = np.arange(first, min(first + _CYCLES, span.cycles))
        t_s = span.start_s + period * (number[:, None] + phase)
        yield np.stack([channel.at(t_s.ravel()).reshape(t_s.shape) for channel in series], axis=-1)


def _share(part: FloatArray, whole: FloatArray) -> Estimate:
    """Return a ratio of means over cycles (delta method)."""
    if not whole.sum() > 0:
        return Estimate()
    value = float(part.sum() / whole.sum())
    mean = mean_of_cycles((part - value * whole) / whole.mean())
    if mean is None:
        return Estimate(value)
    _, variance, dof = mean
    low, high = around(value, t_factor(dof) * variance**0.5)
    return Estimate(value, (max(0.0, low), min(1.0, high)))


def _serpenoid(
    moved: MotionFit,
    rows: Sequence[int],
    place: FloatArray,
    *,
    metres: float | None,
    start_s: float,
    offset: Estimate,
) -> Serpenoid:
    """Fit a serpenoid.

    Args:
        place: Numbers of the joints in their plane from the first one's, shape (m,).
        metres: Distance of neighbours.
        start_s: When the phase is taken.
        offset: Mean of all angles.
    """
    index = np.array(rows)
    fit, omega = moved.fit, moved.fit.omega
    motion = moved.oscillation.select(index)
    bent = fit.trend[index, 0] - fit.trend[index, 0].mean()
    beside = bent**2 + 0.5 * np.sum(np.abs(fit.amplitudes[index, 1:]) ** 2, axis=1)
    beside = float(np.sum(beside + fit.rss[index] / fit.count[index]))
    kappa = best_lag(np.angle(motion.amplitudes), place, np.abs(motion.amplitudes))

    def numbers(amplitudes: ComplexArray) -> FloatArray:
        return _nearest(amplitudes, place, kappa, beside)

    value = numbers(motion.amplitudes)
    factors = _derivatives(numbers, motion)
    error = np.sqrt(np.diag(motion.covariance(factors)))
    number, size, phase, left = value.tolist()
    turn = motion.turn(-(place - place.mean()) / np.sum((place - place.mean()) ** 2))
    later = abs(start_s) * motion.omega_variance**0.5
    halves = t_factor(motion.dof) * np.hypot(error, [turn, 0.0, later, 0.0])
    wave = Estimate(number, around(number, float(halves[0])))
    turns = float(place[-1]) / (2 * np.pi)
    low, high = absolute(wave.ci95 or (0.0, 0.0))
    speed = wave_speed(wave, omega)
    phase = float(np.angle(np.exp(1j * (phase + omega * start_s))))
    return Serpenoid(
        amplitude_rad=Estimate(size, (max(0.0, size - halves[1]), size + float(halves[1]))),
        wave_number=wave,
        phase_rad=Estimate(phase, around(phase, float(halves[2])) if halves[2] < np.pi else None),
        offset_rad=offset,
        waves=Estimate(abs(number) * turns, (low * turns, high * turns)),
        speed=speed,
        speed_m_s=Estimate() if metres is None else scaled(speed, metres),
        unexplained=Estimate(left, (max(0.0, left - halves[3]), min(1.0, left + halves[3]))),
    )


def _nearest(
    amplitudes: ComplexArray, place: FloatArray, kappa: float, beside: float
) -> FloatArray:
    """Return wave number, amplitude, phase at place 0 and the unexplained share.

    Args:
        amplitudes: Of the joints [rad], shape (m,).
        kappa: Where to start [rad/joint].
        beside: Mean square of what is no fundamental, all joints together [rad^2].
    """
    x = place - place.mean()
    for _ in range(_NEWTON):
        turned = amplitudes * np.exp(1j * kappa * x)
        total, first, second = (complex(turned @ x**power) for power in range(3))
        bend = float(abs(first) ** 2 - (total.conjugate() * second).real)
        if not bend < 0:
            break
        kappa -= (total.conjugate() * 1j * first).real / bend
    mean = complex(amplitudes @ np.exp(1j * kappa * x)) / place.size
    power = 0.5 * float(np.sum(np.abs(amplitudes) ** 2))
    left = max(power - 0.5 * place.size * abs(mean) ** 2, 0.0) + beside
    whole = power + beside
    phase = float(np.angle(mean)) + kappa * float(place.mean())
    return np.array([kappa, abs(mean), phase, left / whole if whole > 0 else 0.0])


def _derivatives(
    numbers: Callable[[ComplexArray], FloatArray], motion: Oscillation
) -> ComplexArray:
    """Return the factors f of d number = Re sum_k f_k da_k, by central differences, (p, m)."""
    a = motion.amplitudes
    step = _STEP * max(float(np.abs(a).max()), 1e-12)
    columns: list[ComplexArray] = []
    for k in range(a.size):
        parts: list[FloatArray] = []
        for way in (1.0, 1j):
            off = np.zeros_like(a)
            off[k] = way * step
            parts.append((numbers(a + off) - numbers(a - off)) / (2 * step))
        columns.append(parts[0] - 1j * parts[1])
    return np.stack(columns, axis=1)
