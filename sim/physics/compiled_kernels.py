"""The twin's force laws, compiled: as :class:`.sim.physics.steps.NumpyLaws`, within rounding.

The same equations as :mod:`.sim.physics.contact` and :mod:`.sim.physics.servo`, which say what they
mean, and are what these are held against.

First the laws of one link and of one joint, as functions of numbers: one run calls them link by
link, a batch (:mod:`.sim.batch`) run by run. They compute in the precision of their arguments, so
constants are float32 where float32 holds them exactly, and else of the argument's type. They hold
no call that a compiler can't turn into instructions on several numbers at a time: tanh and exp are
series, within 4 units of the last place.

Importing it needs the extra ``numba``. The first import on a machine compiles, which takes some
seconds; later ones load what was compiled.
"""

from __future__ import annotations

import math
from typing import cast

import numpy as np
from numba import njit

from undulog.capture.common.arrays import FloatArray
from undulog.capture.robot.model import Robot

from ..scenario.world import FrictionLaw, Ground
from .servo import COULOMB_SPEED, Servos
from .steps import Steps

inlined = njit(error_model="numpy", forceinline=True)
"""Compile a function of numbers, which becomes part of the loop that calls it."""

LAWS = tuple(FrictionLaw)
"""A friction law's number is its place here."""

_BOX, _TRANSETH, _VISCOUS = (
    LAWS.index(law) for law in (FrictionLaw.BOX, FrictionLaw.TRANSETH, FrictionLaw.VISCOUS)
)
_ZERO, _HALF, _ONE, _TWO = cast("list[float]", [np.float32(x) for x in (0.0, 0.5, 1.0, 2.0)])
# exp(-40) + 1 = 1 in double precision; expm1 begins at a share of x; 1e-37 makes 0/0 a zero.
_FARTHEST, _SHARE, _SLOPE, _TINY = cast(
    "list[float]", [np.float32(x) for x in (-40.0, 1 / 128, 1 / COULOMB_SPEED, 1e-37)]
)
_DOUBLINGS = 7


@inlined
def expm1(x: float) -> float:
    """exp(x) - 1 for x <= 0, by its series at x/128 and 7 doublings, e -> e (e + 2)."""
    real = type(x)
    z = max(x, _FARTHEST) * _SHARE
    e = _ONE + z * real(1 / 11)
    e = _ONE + z * real(1 / 10) * e
    e = _ONE + z * real(1 / 9) * e
    e = _ONE + z * real(1 / 8) * e
    e = _ONE + z * real(1 / 7) * e
    e = _ONE + z * real(1 / 6) * e
    e = _ONE + z * real(1 / 5) * e
    e = _ONE + z * real(1 / 4) * e
    e = _ONE + z * real(1 / 3) * e
    e = z * (_ONE + z * _HALF * e)
    for _ in range(_DOUBLINGS):
        e *= e + _TWO
    return e


@inlined
def tanh(x: float) -> float:
    """Hyperbolic tangent."""
    e = expm1(-_TWO * abs(x))
    return math.copysign(e / (e + _TWO), x)


@inlined
def load(depth: float, rate: float, stiffness: float, damping: float) -> float:
    """Normal force of the ground, Eq. 7 [N].

    Args:
        depth: Of the contact point below the surface [m].
        rate: Its velocity upwards [m/s].
    """
    force = max(stiffness * depth - damping * rate, _ZERO)
    return force if depth > _ZERO else _ZERO


@inlined
def resistance(
    law: int,
    along: float,
    across: float,
    normal: float,
    mu_t: float,
    mu_n: float,
    eps: float,
    drag_t: float,
    drag_n: float,
) -> tuple[float, float]:
    """Force along (tangential, normal) against slip at a link that touches the ground [N]."""
    if law == _VISCOUS:
        return -drag_t * along, -drag_n * across
    if law == _BOX:
        return (
            -mu_t * along / math.sqrt(along * along + eps * eps) * normal,
            -mu_n * across / math.sqrt(across * across + eps * eps) * normal,
        )
    if law == _TRANSETH:
        speed = math.sqrt(along * along + across * across + eps * eps)
        return -mu_t * along / speed * normal, -mu_n * across / speed * normal
    weighted_t, weighted_n = mu_t * along, mu_n * across
    squares = weighted_t * weighted_t + weighted_n * weighted_n
    floor_t, floor_n = mu_t * eps, mu_n * eps
    return (
        -mu_t * weighted_t / math.sqrt(squares + (floor_t * floor_t + _TINY)) * normal,
        -mu_n * weighted_n / math.sqrt(squares + (floor_n * floor_n + _TINY)) * normal,
    )


@inlined
def drive(
    error: float,
    twist: float,
    speed: float,
    rate: float,
    supply: float,
    resistance: float,
    torque_constant: float,
    gain: float,
    gear_stiffness: float,
    gear_damping: float,
    play: float,
) -> tuple[float, float, float]:
    """Voltage [V], current [A] and gear torque [N m] of a servo.

    Args:
        error: q_ref - q [rad].
        twist: th - q [rad].
        speed: Rotor speed om [rad/s].
        rate: Joint rate q' [rad/s].
    """
    voltage = supply * min(max(gain * error, -_ONE), _ONE)
    slack = _HALF * play
    twist -= min(max(twist, -slack), slack)
    torque = gear_stiffness * twist + gear_damping * (speed - rate)
    return voltage, (voltage - torque_constant * speed) / resistance, torque


@inlined
def rotor_friction(
    speed: float, torque: float, kinetic: float, static: float, stribeck: float, per_step: float
) -> tuple[float, bool]:
    """Friction of one rotor [N m], and whether it is at rest after the step.

    As :meth:`.sim.physics.servo.Servos.friction`.

    Args:
        speed: Rotor speed om at the step's start [rad/s].
        torque: Kt i - b om - t_g, all else that acts on the rotor [N m].
        per_step: Its inertia over the step [kg m^2/s].
    """
    smooth = kinetic * tanh(speed * _SLOPE)
    share = speed / stribeck
    most = kinetic + (static - kinetic) * (_ONE + expm1(-share * share))
    stopping = per_step * speed + torque
    rests = static > _ZERO
    friction = min(max(stopping, -most), most) if rests else smooth
    return friction, rests & (abs(stopping) <= most)  # branches cost more than both


@njit(cache=True, error_model="numpy")
def touch_ground(
    row: FloatArray, n: int, m: int, radius: FloatArray, ground: FloatArray, law: int
) -> None:
    """Fill in the ground's action.

    Args:
        row: A step, as :class:`.sim.physics.steps.Steps` has it; its body is there.
        radius: Of the links [m], shape (n,).
        ground: k, d, mu_t, mu_n, eps, c_t, c_n, shape (7,).
        law: Number of the friction law in :data:`LAWS`.
    """
    position, quaternion = row[: 3 * n].reshape(3, n), row[3 * n : 7 * n].reshape(4, n)
    velocity, spin = row[7 * n : 10 * n].reshape(3, n), row[10 * n : 13 * n].reshape(3, n)
    start = 13 * n + 2 * m
    at_point = row[start : start + 3 * n].reshape(3, n)
    tangent = row[start + 3 * n : start + 5 * n].reshape(2, n)
    depth = row[start + 5 * n : start + 6 * n]
    force = row[start + 6 * n : start + 9 * n].reshape(3, n)
    for i in range(n):
        x, y, z, w = quaternion[0, i], quaternion[1, i], quaternion[2, i], quaternion[3, i]
        tx, ty = 0.5 - (y * y + z * z), x * y + z * w
        length = max(math.sqrt(tx * tx + ty * ty), _TINY)
        tx, ty = tx / length, ty / length
        vx = velocity[0, i] - radius[i] * spin[1, i]
        vy = velocity[1, i] + radius[i] * spin[0, i]
        vz = velocity[2, i]
        deep = radius[i] - position[2, i]
        at_point[0, i], at_point[1, i], at_point[2, i] = vx, vy, vz
        tangent[0, i], tangent[1, i] = tx, ty
        depth[i] = deep
        if deep > 0.0:
            normal = load(deep, vz, ground[0], ground[1])
            along, across = resistance(
                *(law, tx * vx + ty * vy, tx * vy - ty * vx, normal),
                *(ground[2], ground[3], ground[4], ground[5], ground[6]),
            )
            force[0, i] = tx * along - ty * across
            force[1, i] = ty * along + tx * across
            force[2, i] = normal
        else:
            force[0, i] = force[1, i] = force[2, i] = 0.0


@njit(cache=True, error_model="numpy")
def drive_joints(
    row: FloatArray, n: int, m: int, reference: FloatArray, servos: FloatArray
) -> None:
    """Fill in what the servos do.

    Args:
        row: A step; its body and rotors are there.
        reference: Commanded joint angles q_ref [rad], shape (m,).
        servos: :attr:`.sim.physics.servo.Servos.table`.
    """
    angle, rate = row[13 * n : 13 * n + m], row[13 * n + m : 13 * n + 2 * m]
    start = 22 * n + 2 * m
    rotor, speed = row[start : start + m], row[start + m : start + 2 * m]
    voltage, current = row[start + 2 * m : start + 3 * m], row[start + 3 * m : start + 4 * m]
    torque = row[start + 4 * m : start + 5 * m]
    for j in range(m):
        voltage[j], current[j], torque[j] = drive(
            *(reference[j] - angle[j], rotor[j] - angle[j], speed[j], rate[j]),
            *(servos[0, j], servos[1, j], servos[2, j], servos[3, j]),
            *(servos[7, j], servos[8, j], servos[9, j]),
        )


@njit(cache=True, error_model="numpy")
def advance_rotors(
    before: FloatArray, here: FloatArray, n: int, m: int, servos: FloatArray, dt: float
) -> None:
    """Fill in the rotors one step later.

    Args:
        here: The step after it.
        servos: :attr:`.sim.physics.servo.Servos.table`.
        dt: Step [s].
    """
    start = 22 * n + 2 * m
    for j in range(m):
        speed = before[start + m + j]
        current, torque = before[start + 3 * m + j], before[start + 4 * m + j]
        motor = servos[2, j] * current - servos[5, j] * speed
        drag, held = rotor_friction(
            *(speed, motor - torque, servos[6, j], servos[10, j], servos[11, j]), servos[4, j] / dt
        )
        total = motor - (drag + torque)
        after = 0.0 if held else speed + dt * total / servos[4, j]
        here[start + j] = before[start + j] + dt * after
        here[start + m + j] = after


@njit(cache=True, error_model="numpy")
def act(
    before: FloatArray,
    here: FloatArray,
    n: int,
    m: int,
    radius: FloatArray,
    ground: FloatArray,
    law: int,
    reference: FloatArray,
    servos: FloatArray,
    dt: float,
) -> None:
    """Complete a step whose body is there: rotors, ground, servos.

    Args:
        before: The step before it, complete.
        radius: Of the links [m], shape (n,).
        ground: k, d, mu_t, mu_n, eps, c_t, c_n, shape (7,).
        law: Number of the friction law in :data:`LAWS`.
        reference: Commanded joint angles q_ref [rad], shape (m,).
        servos: :attr:`.sim.physics.servo.Servos.table`.
        dt: Step [s].
    """
    advance_rotors(before, here, n, m, servos, dt)
    touch_ground(here, n, m, radius, ground, law)
    drive_joints(here, n, m, reference, servos)


@njit(cache=True, error_model="numpy")
def add_joint_flows(
    table: FloatArray, n: int, m: int, servos: FloatArray, dt: float, flows: FloatArray
) -> None:
    """Add the energies that pass the joints during consecutive steps.

    Args:
        table: k + 1 steps, as :class:`.sim.physics.steps.Steps` has them.
        servos: :attr:`.sim.physics.servo.Servos.table`.
        dt: Step [s].
        flows: Added to: rows as :data:`.sim.physics.ledger.JOINT_TERMS` [J], shape (9, m).
    """
    for k in range(len(table) - 1):
        rates, rates_after = table[k, 13 * n + m :], table[k + 1, 13 * n + m :]
        drive, after = table[k, 22 * n + 2 * m :], table[k + 1, 22 * n + 2 * m :]
        for j in range(m):
            acting = drive[m + j]  # friction acts with the speed at the start of the step
            speed = 0.5 * (after[m + j] + acting)
            rate = 0.5 * (rates_after[j] + rates[j])
            voltage, torque = drive[2 * m + j], drive[4 * m + j]
            mechanical = rate * torque
            current = (voltage - servos[2, j] * speed) / servos[1, j]
            electrical = voltage * current
            flows[0, j] += dt * mechanical
            flows[1, j] += dt * max(mechanical, 0.0)
            flows[2, j] += dt * abs(mechanical)
            flows[3, j] += dt * electrical
            flows[4, j] += dt * max(electrical, 0.0)
            flows[5, j] += dt * servos[1, j] * current * current
            flows[6, j] += dt * servos[5, j] * acting * speed
            motor = servos[2, j] * drive[3 * m + j] - servos[5, j] * acting
            friction, _ = rotor_friction(
                *(acting, motor - torque, servos[6, j], servos[10, j], servos[11, j]),
                servos[4, j] / dt,
            )
            flows[7, j] += dt * friction * speed
            flows[8, j] += dt * servos[8, j] * (acting - rates[j]) * (speed - rate)


@njit(cache=True, error_model="numpy")
def add_ground_flows(
    table: FloatArray, n: int, m: int, stiffness: float, dt: float, flows: FloatArray
) -> None:
    """Add the energies that the ground takes during consecutive steps.

    Args:
        table: k + 1 steps, as :class:`.sim.physics.steps.Steps` has them.
        stiffness: Of the ground [N/m].
        dt: Step [s].
        flows: Added to: as :data:`.sim.physics.ledger.GROUND_TERMS` [J], shape (3,).
    """
    start = 13 * n + 2 * m
    for k in range(len(table) - 1):
        contact, after = table[k, start:], table[k + 1, start:]
        for i in range(n):
            vx = 0.5 * (after[i] + contact[i])
            vy = 0.5 * (after[n + i] + contact[n + i])
            vz = 0.5 * (after[2 * n + i] + contact[2 * n + i])
            tx, ty, depth = contact[3 * n + i], contact[4 * n + i], contact[5 * n + i]
            fx, fy, fz = contact[6 * n + i], contact[7 * n + i], contact[8 * n + i]
            flows[0] -= dt * (tx * fx + ty * fy) * (tx * vx + ty * vy)
            flows[1] -= dt * (tx * fy - ty * fx) * (tx * vy - ty * vx)
            flows[2] -= dt * (fz - stiffness * max(depth, 0.0)) * vz


@njit(cache=True, error_model="numpy")
def kinetic_energy(
    quaternion: FloatArray,
    velocity: FloatArray,
    spin: FloatArray,
    mass: FloatArray,
    inertia: FloatArray,
) -> float:
    """Kinetic energy of all links.

    Args:
        quaternion: Orientations x, y, z, w, shape (4, n).
        velocity: Of the centres [m/s], shape (3, n).
        spin: Angular velocities in the world [rad/s], shape (3, n).
        mass: Of the links [kg], shape (n,).
        inertia: Their principal moments [kg m^2], shape (3, n).

    Returns:
        Energy [J].
    """
    twice = 0.0
    for i in range(len(mass)):
        x, y, z, w = quaternion[0, i], quaternion[1, i], quaternion[2, i], quaternion[3, i]
        sx, sy, sz = spin[0, i], spin[1, i], spin[2, i]
        # Into the link's frame: s - 2 w (u x s) + 2 u x (u x s).
        cx, cy, cz = y * sz - z * sy, z * sx - x * sz, x * sy - y * sx
        rx = sx - 2 * w * cx + 2 * (y * cz - z * cy)
        ry = sy - 2 * w * cy + 2 * (z * cx - x * cz)
        rz = sz - 2 * w * cz + 2 * (x * cy - y * cx)
        square = velocity[0, i] ** 2 + velocity[1, i] ** 2 + velocity[2, i] ** 2
        twice += mass[i] * square
        twice += inertia[0, i] * rx**2 + inertia[1, i] * ry**2 + inertia[2, i] * rz**2
    return 0.5 * twice


def ground_table(ground: Ground | None) -> FloatArray:
    """Return k, d, mu_t, mu_n, eps, c_t and c_n, shape (7,); all forces 0 without ground."""
    surface = ground or Ground(stiffness=0.0, damping=0.0, drag_tangential=0.0, drag_normal=0.0)
    return np.array(
        [
            *(surface.stiffness, surface.damping, surface.mu_tangential, surface.mu_normal),
            *(surface.slip_speed, surface.drag_tangential, surface.drag_normal),
        ]
    )


class CompiledLaws:
    """The laws by :mod:`.sim.physics.compiled_kernels`."""

    def __init__(
        self, steps: Steps, robot: Robot, ground: Ground | None, servos: Servos, dt: float
    ) -> None:
        """Get ready for one body, with the arguments of :class:`.sim.physics.steps.NumpyLaws`."""
        self._rows = tuple(steps.table)
        self._sizes = steps.link_count, steps.joint_count
        self._radius = np.array([link.radius for link in robot.links])
        self._ground = ground_table(ground)
        self._law = 0 if ground is None else LAWS.index(ground.law)
        self._servos = servos.table
        self._dt = dt
        self._reference = np.zeros(steps.joint_count)

    def start(self, k: int) -> None:
        """Complete a step whose body and rotors are there."""
        touch_ground(self._rows[k], *self._sizes, self._radius, self._ground, self._law)
        self.command(k, self._reference)

    def follow(self, k: int) -> None:
        """Complete a step whose body is there, and which follows the row before it."""
        act(
            self._rows[k - 1],
            self._rows[k],
            *self._sizes,
            self._radius,
            self._ground,
            self._law,
            self._reference,
            self._servos,
            self._dt,
        )

    def command(self, k: int, reference: FloatArray) -> None:
        """Give the servos a command, which they hold until the next."""
        self._reference = np.ascontiguousarray(reference)
        drive_joints(self._rows[k], *self._sizes, self._reference, self._servos)
