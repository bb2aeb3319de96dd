"""The ledger's sums, compiled: the same as :mod:`sim.physics.ledger`'s within rounding."""

from __future__ import annotations

import math

from numba import njit

from capture.arrays import FloatArray

from .servo import COULOMB_SPEED


@njit(cache=True)
def add_joint_flows(
    table: FloatArray, n: int, m: int, servos: FloatArray, dt: float, flows: FloatArray
) -> None:
    """Add the energies that pass the joints during consecutive steps.

    Args:
        table: k + 1 steps, as :class:`sim.physics.steps.Steps` has them.
        n: Number of links.
        m: Number of joints.
        servos: :attr:`sim.physics.servo.Servos.table`.
        dt: Step [s].
        flows: Added to: rows as :data:`sim.physics.ledger.JOINT_TERMS` [J], shape (9, m).
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
            flows[7, j] += dt * servos[6, j] * math.tanh(acting / COULOMB_SPEED) * speed
            flows[8, j] += dt * servos[8, j] * (acting - rates[j]) * (speed - rate)


@njit(cache=True)
def add_ground_flows(
    table: FloatArray, n: int, m: int, stiffness: float, dt: float, flows: FloatArray
) -> None:
    """Add the energies that the ground takes during consecutive steps.

    Args:
        table: k + 1 steps, as :class:`sim.physics.steps.Steps` has them.
        n: Number of links.
        m: Number of joints.
        stiffness: Of the ground [N/m].
        dt: Step [s].
        flows: Added to: as :data:`sim.physics.ledger.GROUND_TERMS` [J], shape (3,).
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
