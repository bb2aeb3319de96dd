"""What the twin's steps do with energy: the flows through joints, ground, obstacles and pushes.

Forces and torques are constant during a step, so each is booked at mid-step velocity, the mean of
the velocities before and after.
"""

from __future__ import annotations

import numpy as np

from undulog.capture.common.arrays import FloatArray

from .contact import into_link_axes
from .servo import COULOMB_SPEED, Servos
from .steps import Steps
from .vectors import cross

JOINT_TERMS = (
    "mechanical_net",
    "mechanical_plus",
    "mechanical_abs",
    "electrical_net",
    "electrical_plus",
    "copper",
    "viscous",
    "coulomb",
    "gear_damping",
)
"""Flows at the joints [J], cumulative: work on the joints (signed, its positive part, absolute),
electrical work at the motors (signed, its positive part), and the four losses of the servos."""

GROUND_TERMS = ("friction_tangential", "friction_normal", "contact_damping")
"""What the ground takes [J], cumulative."""

OBSTACLE_TERMS = ("obstacle_friction", "obstacle_damping")
"""What the obstacles take [J], cumulative."""

PUSH_TERMS = ("push_work",)
"""What disturbances do to the robot [J], cumulative."""


def joint_flows(steps: Steps, servos: Servos, dt: float) -> FloatArray:
    """Energies that pass the joints during consecutive steps.

    Args:
        steps: k + 1 steps; the last one closes the one before it.
        servos: The servos.
        dt: Step [s].

    Returns:
        Energies [J], rows as :data:`JOINT_TERMS`, shape (9, m).
    """
    rate_at = _by_field(steps.motion)[1]
    _, speed_at, voltage_at, _, torque_at = _by_field(steps.motors)
    rate, speed = _middle(rate_at), _middle(speed_at)
    acting, voltage, torque = speed_at[:-1], voltage_at[:-1], torque_at[:-1]
    current = servos.current(voltage, speed)
    power = np.empty((len(JOINT_TERMS), *rate.shape))
    mechanical = np.multiply(rate, torque, out=power[0])
    np.maximum(mechanical, 0.0, out=power[1])
    np.abs(mechanical, out=power[2])
    electrical = np.multiply(voltage, current, out=power[3])
    np.maximum(electrical, 0.0, out=power[4])
    # The losses, each without its coefficient; friction acts with the speed at the step's start.
    np.multiply(current, current, out=power[5])
    np.multiply(acting, speed, out=power[6])
    np.multiply(np.tanh(acting / COULOMB_SPEED), speed, out=power[7])
    np.multiply(acting - rate_at[:-1], speed - rate, out=power[8])
    flows = dt * power.sum(axis=1)
    flows[5:] *= servos.losses
    if servos.resting.size:
        step = steps.stacked
        friction = servos.friction(step.rotors, step.drive, dt)[:-1, servos.resting]
        flows[7, servos.resting] = dt * (friction * speed[:, servos.resting]).sum(axis=0)
    return flows


def ground_flows(steps: Steps, stiffness: float, dt: float) -> FloatArray:
    """Energies that the ground takes during consecutive steps.

    Args:
        steps: k + 1 steps; the last one closes the one before it.
        stiffness: Of the ground [N/m]; its spring stores energy, the rest is lost.
        dt: Step [s].

    Returns:
        Energies [J], as :data:`GROUND_TERMS`, shape (3,).
    """
    x, y, z, tx, ty, depth, force_x, force_y, force_z = _by_field(steps.touch)
    vx, vy, vz = _middle(x), _middle(y), _middle(z)
    tx, ty, depth = tx[:-1], ty[:-1], depth[:-1]
    force_x, force_y, force_z = force_x[:-1], force_y[:-1], force_z[:-1]
    along, across = into_link_axes(tx, ty, force_x, force_y)
    slip_along, slip_across = into_link_axes(tx, ty, vx, vy)
    damping = force_z - stiffness * np.maximum(depth, 0.0)
    taken = (along, slip_along), (across, slip_across), (damping, vz)
    return -dt * np.array([float(np.vdot(force, velocity)) for force, velocity in taken])


def obstacle_flows(steps: Steps, stiffness: float, dt: float) -> FloatArray:
    """Energies that the obstacles take during consecutive steps.

    Args:
        steps: k + 1 steps; the last one closes the one before it.
        stiffness: Of the obstacles [N/m]; their springs store energy, the rest is lost.
        dt: Step [s].

    Returns:
        Energies [J], as :data:`OBSTACLE_TERMS`, shape (2,).
    """
    taken = np.zeros(len(OBSTACLE_TERMS))
    for k, contact in enumerate(steps.obstacles[:-1]):
        if not len(contact.link):
            continue
        here, after = steps[k].body, steps[k + 1].body
        link, normal = contact.link, contact.normal
        arm = contact.point - here.position[:, link]
        spin = 0.5 * (here.spin + after.spin)[:, link]
        velocity = 0.5 * (here.velocity + after.velocity)[:, link] + cross(spin, arm)
        press = (contact.force * normal).sum(axis=0)
        friction = contact.force - press * normal
        parting = (normal * velocity).sum(axis=0)
        damping = (press - stiffness * contact.depth) * parting
        taken -= dt * np.array([(friction * velocity).sum(), damping.sum()])
    return taken


def push_flow(steps: Steps, dt: float) -> float:
    """Energy that disturbances bring in during consecutive steps.

    Args:
        steps: k + 1 steps; the last one closes the one before it.
        dt: Step [s].

    Returns:
        Energy [J].
    """
    if steps.pushes is None:
        return 0.0
    return dt * float((steps.pushes[:-1] * _middle(steps.stacked.body.velocity)).sum())


def _by_field(part: FloatArray) -> FloatArray:
    """The fields of steps one after the other, (k, q, w) to (q, k, w): neighbours in memory."""
    return np.ascontiguousarray(part.swapaxes(0, 1))


def _middle(series: FloatArray) -> FloatArray:
    """Means of neighbours in time, shape (k + 1, ...) to (k, ...)."""
    return 0.5 * (series[1:] + series[:-1])
