"""The ledger's sums, compiled: the same as :mod:`.sim.physics.energy_flows`'s within rounding."""

from __future__ import annotations

import math

from numba import njit

from undulog.capture.common.arrays import FloatArray

from .kernels import rotor_friction
from .servo import COULOMB_SPEED


@njit(cache=True)
def add_joint_flows(
    table: FloatArray, n: int, m: int, servos: FloatArray, dt: float, flows: FloatArray
) -> None:
    """Add the energies that pass the joints during consecutive steps.

    Args:
        table: k + 1 steps, as :class:`.sim.physics.steps.Steps` has them.
        n: Number of links.
        m: Number of joints.
        servos: :attr:`.sim.physics.servo.Servos.table`.
        dt: Step [s].
        flows: Added to: rows as :data:`.sim.physics.energy_flows.JOINT_TERMS` [J], shape (9, m).
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
            if servos[10, j] == 0.0:
                flows[7, j] += dt * servos[6, j] * math.tanh(acting / COULOMB_SPEED) * speed
            else:
                motor = servos[2, j] * drive[3 * m + j] - servos[5, j] * acting
                friction, _ = rotor_friction(servos, j, acting, motor - torque, dt)
                flows[7, j] += dt * friction * speed
            flows[8, j] += dt * servos[8, j] * (acting - rates[j]) * (speed - rate)


@njit(cache=True)
def add_ground_flows(
    table: FloatArray, n: int, m: int, stiffness: float, dt: float, flows: FloatArray
) -> None:
    """Add the energies that the ground takes during consecutive steps.

    Args:
        table: k + 1 steps, as :class:`.sim.physics.steps.Steps` has them.
        n: Number of links.
        m: Number of joints.
        stiffness: Of the ground [N/m].
        dt: Step [s].
        flows: Added to: as :data:`.sim.physics.energy_flows.GROUND_TERMS` [J], shape (3,).
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


@njit(cache=True)
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
