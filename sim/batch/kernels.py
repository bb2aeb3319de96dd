"""Steps of a block of runs: servos, ground and body, compiled.

The laws are those of :mod:`.sim.physics.compiled_kernels`, the body's dynamics those of
:mod:`.sim.batch.body`, where the rows of the arrays are named.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import numpy as np
from numba import njit

from undulog.capture.common.arrays import BoolArray, FloatArray

from ..physics import compiled_kernels
from ..physics.compiled_kernels import LAWS, drive, load, resistance, rotor_friction
from . import body
from .body import (
    ACROSS,
    AI,
    ALONG,
    ANGLE,
    BIAS,
    CENTRE,
    DEPTH,
    FASTEST,
    FLAT,
    HEAD_ROWS,
    HEIGHT,
    INERTIA,
    LOAD,
    MASS,
    PITCH_ACCELERATE,
    PITCH_BACKWARD,
    PITCH_FORWARD,
    RADIUS,
    RATE,
    ROTOR,
    SERVO,
    SPEED,
    SUMS,
    TORQUE,
    UP,
    WHERE,
    WORK,
    WRENCH,
    YAW_ACCELERATE,
    YAW_BACKWARD,
    YAW_FORWARD,
    Lanes,
    V,
    W,
    accelerate_head,
    begin,
    of_lanes,
)

# Rows of the ground.
STIFFNESS, DAMPING, MU_T, MU_N, EPS, DRAG_T, DRAG_N = range(7)
GROUND_ROWS = 7

# Rows of what is kept of each joint at each tick.
SAMPLE_ROWS = 9
"""Angle, rate, effort, current, voltage; work: mechanical, absolute, electrical, its plus."""

_ZERO, _HALF, _ONE, _TINY = cast("list[float]", [np.float32(x) for x in (0.0, 0.5, 1.0, 1e-37)])

_SOURCES = [Path(str(module.__file__)).read_bytes() for module in (body, compiled_kernels)]


@njit(error_model="numpy")
def _servo(
    joint: FloatArray,
    reference: FloatArray,
    carried: FloatArray,
    number: float,
    dt: float,
    lanes: int,
) -> None:
    """Torque of a servo now, and its rotor one step later."""
    of_lanes(joint)
    of_lanes(carried)
    for r in range(lanes):
        angle, rotor, speed = joint[ANGLE, r], joint[ROTOR, r], joint[SPEED, r]
        supply, ohm, constant = joint[SERVO, r], joint[SERVO + 1, r], joint[SERVO + 2, r]
        voltage, current, torque = drive(
            *(reference[r] - angle, rotor - angle, speed, joint[RATE, r]),
            *(supply, ohm, constant, joint[SERVO + 3, r]),
            *(joint[SERVO + 7, r], joint[SERVO + 8, r], joint[SERVO + 9, r]),
        )
        joint[TORQUE, r] = torque
        joint[SUMS, r] += torque
        joint[SUMS + 1, r] += current
        joint[SUMS + 2, r] += voltage
        inertia, motor = joint[SERVO + 4, r], constant * current - joint[SERVO + 5, r] * speed
        friction, held = rotor_friction(
            *(speed, motor - torque, joint[SERVO + 6, r], joint[SERVO + 10, r]),
            *(joint[SERVO + 11, r], inertia / dt),
        )
        after = speed + dt * (motor - (friction + torque)) / inertia
        after = _ZERO if held else after
        middle = _HALF * (speed + after)
        work = dt * voltage * (voltage - constant * middle) / ohm
        joint[WORK + 2, r] += work
        joint[WORK + 3, r] += max(work, _ZERO)
        joint[SPEED, r] = after
        joint[ROTOR, r] = rotor + dt * after
        slower = abs(speed) <= carried[FASTEST, r]  # false for NaN
        carried[FASTEST, r] = carried[FASTEST, r] if slower else abs(speed)
        carried[WHERE, r] = carried[WHERE, r] if slower else number


@njit(error_model="numpy")
def _slip(
    link: FloatArray, carried: FloatArray, ground: FloatArray, number: float, lanes: int
) -> None:
    """Slip of a link's contact point along and across it, and its load."""
    of_lanes(link)
    of_lanes(carried)
    of_lanes(ground)
    for r in range(lanes):
        centre, radius = link[CENTRE, r], link[RADIUS, r]
        wx, wy, wz = carried[W, r], carried[W + 1, r], carried[W + 2, r]
        vx = carried[V, r]
        vy, vz = carried[V + 1, r] + centre * wz, carried[V + 2, r] - centre * wy
        kx, ky, kz = carried[UP, r], carried[UP + 1, r], carried[UP + 2, r]
        # Tangential t = (flat, -kx p, -kx q) and normal n = (0, q, -p), both horizontal.
        flat = math.sqrt(ky * ky + kz * kz)
        unit = _ONE / max(flat, _TINY)
        p, q = ky * unit, kz * unit
        carried[FLAT, r], carried[FLAT + 1, r], carried[FLAT + 2, r] = flat, p, q
        along = vx * flat - kx * (p * vy + q * vz) - radius * (q * wy - p * wz)
        across = q * vy - p * vz + radius * (wx * flat - kx * (p * wy + q * wz))
        depth = radius - (carried[HEIGHT, r] + centre * kx)
        rising = kx * vx + ky * vy + kz * vz
        carried[ALONG, r], carried[ACROSS, r], carried[DEPTH, r] = along, across, depth
        carried[LOAD, r] = load(depth, rising, ground[STIFFNESS, r], ground[DAMPING, r])
        square = vx * vx + vy * vy + vz * vz
        slower = square <= carried[FASTEST, r]  # false for NaN
        carried[FASTEST, r] = carried[FASTEST, r] if slower else square
        carried[WHERE, r] = carried[WHERE, r] if slower else number


def _resisting(law: int) -> Lanes:
    """Compile the loop of one friction law: from slip to force, in place."""

    @njit(error_model="numpy")
    def resist(carried: FloatArray, ground: FloatArray, lanes: int) -> None:
        of_lanes(carried)
        of_lanes(ground)
        for r in range(lanes):
            touches = _ONE if carried[DEPTH, r] > _ZERO else _ZERO
            along, across = resistance(
                *(law, carried[ALONG, r], carried[ACROSS, r], carried[LOAD, r]),
                *(ground[MU_T, r], ground[MU_N, r], ground[EPS, r]),
                *(ground[DRAG_T, r], ground[DRAG_N, r]),
            )
            carried[ALONG, r], carried[ACROSS, r] = touches * along, touches * across

    return resist


_ELLIPSE, _BOX, _TRANSETH, _VISCOUS = (_resisting(law) for law in range(len(LAWS)))


@njit(error_model="numpy")
def _resist(carried: FloatArray, ground: FloatArray, law: int, lanes: int) -> None:
    """Turn slip into force by a law of that number."""
    if law == 0:
        _ELLIPSE(carried, ground, lanes)
    elif law == 1:
        _BOX(carried, ground, lanes)
    elif law == 2:
        _TRANSETH(carried, ground, lanes)
    else:
        _VISCOUS(carried, ground, lanes)


@njit(error_model="numpy")
def _bias(link: FloatArray, carried: FloatArray, lanes: int) -> None:
    """The wrench about the front joint that velocities and the ground ask for."""
    of_lanes(link)
    of_lanes(carried)
    for r in range(lanes):
        mass, centre, radius = link[MASS, r], link[CENTRE, r], link[RADIUS, r]
        ix, iy, iz = link[INERTIA, r], link[INERTIA + 1, r], link[INERTIA + 2, r]
        wx, wy, wz = carried[W, r], carried[W + 1, r], carried[W + 2, r]
        kx, ky, kz = carried[UP, r], carried[UP + 1, r], carried[UP + 2, r]
        flat, p, q = carried[FLAT, r], carried[FLAT + 1, r], carried[FLAT + 2, r]
        along, across, normal = carried[ALONG, r], carried[ACROSS, r], carried[LOAD, r]
        static = mass * centre
        fx = -static * (wy * wy + wz * wz) - (normal * kx + along * flat)
        fy = static * wx * wy - (normal * ky - along * kx * p + across * q)
        fz = static * wx * wz - (normal * kz - along * kx * q - across * p)
        # Less the moment (-r k) x F about the centre.
        link[BIAS, r] = wy * wz * (iz - iy) - radius * across * flat
        ny = wz * wx * (ix - iz) + radius * (along * q + across * kx * p)
        nz = wx * wy * (iy - ix) + radius * (across * kx * q - along * p)
        link[BIAS + 1, r], link[BIAS + 2, r] = ny - centre * fz, nz + centre * fy
        link[BIAS + 3, r], link[BIAS + 4, r], link[BIAS + 5, r] = fx, fy, fz


@njit(error_model="numpy")
def _note(
    carried: FloatArray, failure: FloatArray, step: int, limit: float, bound: float, lanes: int
) -> None:
    """Note the first step at which a run is too fast, once, and start the next comparison."""
    of_lanes(carried)
    of_lanes(failure)
    for r in range(lanes):
        if not carried[FASTEST, r] <= limit and failure[0, r] < _ZERO:
            failure[0, r], failure[1, r] = step, bound
            failure[2, r], failure[3, r] = carried[WHERE, r], carried[FASTEST, r]
        carried[FASTEST, r] = _ZERO


@njit(error_model="numpy")
def _forward(
    links: FloatArray,
    head: FloatArray,
    carried: FloatArray,
    ground: FloatArray,
    vertical: BoolArray,
    law: int,
    lanes: int,
) -> None:
    """Motion of all links, and what the ground does to them."""
    begin(head, carried, lanes)
    for i in range(len(links)):
        link = links[i]
        if i > 0:
            if vertical[i - 1]:
                PITCH_FORWARD(links[i - 1], link, carried, lanes)
            else:
                YAW_FORWARD(links[i - 1], link, carried, lanes)
        _slip(link, carried, ground, i, lanes)
        _resist(carried, ground, law, lanes)
        _bias(link, carried, lanes)


@njit(error_model="numpy")
def _move(
    links: FloatArray,
    head: FloatArray,
    carried: FloatArray,
    gravity: FloatArray,
    vertical: BoolArray,
    dt: float,
    lanes: int,
) -> None:
    """Advance the body by one step."""
    for row in range(AI, WRENCH + 6):
        for r in range(lanes):
            carried[row, r] = _ZERO
    for i in range(len(links) - 1, 0, -1):
        if vertical[i - 1]:
            PITCH_BACKWARD(links[i - 1], links[i], carried, lanes)
        else:
            YAW_BACKWARD(links[i - 1], links[i], carried, lanes)
    accelerate_head(links[0], head, carried, gravity, dt, lanes)
    for i in range(1, len(links)):
        if vertical[i - 1]:
            PITCH_ACCELERATE(links[i - 1], links[i], carried, dt, lanes)
        else:
            YAW_ACCELERATE(links[i - 1], links[i], carried, dt, lanes)


@njit(error_model="numpy")
def _take_sums(links: FloatArray, sample: FloatArray, lanes: int) -> None:
    """Add what was summed up to a sample."""
    for i in range(1, len(links)):
        for row in range(3):
            for r in range(lanes):
                sample[2 + row, i - 1, r] += links[i, SUMS + row, r]
                links[i, SUMS + row, r] = _ZERO


@njit(error_model="numpy")
def run_lanes(
    links: FloatArray,
    head: FloatArray,
    carried: FloatArray,
    ground: FloatArray,
    gravity: FloatArray,
    vertical: BoolArray,
    law: int,
    commands: FloatArray,
    samples: FloatArray,
    poses: FloatArray,
    failure: FloatArray,
    limits: FloatArray,
    step_s: float,
    steps: int,
    first: int,
    last: int,
    lanes: int,
) -> None:
    """Run all runs of a block through some control periods.

    Args:
        links: Parameters, state and work space, shape (n, :data:`LINK_ROWS`, lanes).
        head: State, shape (:data:`HEAD_ROWS`, lanes).
        carried: Work space, shape (:data:`CARRIED_ROWS`, lanes).
        ground: Parameters, shape (:data:`GROUND_ROWS`, lanes).
        gravity: [m/s^2], shape (3, lanes).
        vertical: Whether a joint turns about y rather than z, shape (m,).
        law: Number of the friction law.
        commands: q_ref from each tick on, or during each of p equal parts of a control period
            [rad], shape (p (last - first) + 1, m, lanes); p divides ``steps``.
        samples: Filled in but for the first tick, which is completed, shape
            (ticks, :data:`SAMPLE_ROWS`, m, lanes); effort, current and voltage are sums.
        poses: Filled in, but for the first: the head, shape (ticks, :data:`HEAD_ROWS`, lanes).
        failure: Step, kind, place and value of the first impossible state of a run; the step is
            negative as long as there is none. Shape (4, lanes).
        limits: Of a rotor's speed, and of the square of a link's.
        step_s: Physics step [s].
        steps: Of a control period, an even number.
        first: The first period.
        last: The period after the last one; its tick is filled in.
    """
    dt = links.dtype.type(step_s)
    parts = (len(commands) - 1) // (last - first)
    for tick in range(last - first):
        samples[tick + 1, 2:5] = _ZERO
        for part in range(2):
            for k in range(steps // 2):
                within = part * (steps // 2) + k
                step = (first + tick) * steps + within
                row = tick * parts + within * parts // steps
                for i in range(1, len(links)):
                    _servo(links[i], commands[row, i - 1], carried, i - 1, dt, lanes)
                _note(carried, failure, step, limits[0], 0, lanes)
                _forward(links, head, carried, ground, vertical, law, lanes)
                _note(carried, failure, step, limits[1], 1, lanes)
                _move(links, head, carried, gravity, vertical, dt, lanes)
            _take_sums(links, samples[tick + part], lanes)
        for i in range(1, len(links)):
            for r in range(lanes):
                samples[tick + 1, 0, i - 1, r] = links[i, ANGLE, r]
                samples[tick + 1, 1, i - 1, r] = links[i, RATE, r]
                for row in range(4):
                    samples[tick + 1, 5 + row, i - 1, r] = links[i, WORK + row, r]
        for row in range(HEAD_ROWS):
            for r in range(lanes):
                poses[tick + 1, row, r] = head[row, r]
    _forward(links, head, carried, ground, vertical, law, lanes)
    _note(carried, failure, last * steps, limits[1], 1, lanes)


def _entry(sources: str) -> Callable[..., None]:
    """Compile the entry, or load what was compiled from these sources: numba checks one file."""

    @njit(cache=True, error_model="numpy")
    def run_block(*arguments: Any) -> None:
        assert sources  # noqa: S101 - part of what is compiled
        run_lanes(*arguments)

    return run_block


run_block = _entry(hashlib.sha256(b"".join(_SOURCES)).hexdigest())
"""Run all runs of a block through some control periods: :func:`run_lanes`, on a CPU."""
