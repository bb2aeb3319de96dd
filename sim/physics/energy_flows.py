"""What the twin's steps do with energy: the flows through joints, ground, obstacles and pushes.

Forces and torques are constant during a step, so each is booked at mid-step velocity, the mean of
the velocities before and after.
"""

from __future__ import annotations

import numpy as np

from capture.arrays import FloatArray

from .contact import into_link_axes
from .servo import Servos
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
    body, _, rotors, drive, _ = steps.stacked
    rate, speed = _middle(body.rate), _middle(rotors.speed)
    acting = rotors.speed[:-1]  # friction acts with the speed at the start of the step
    mechanical = rate * drive.torque[:-1]
    voltage = drive.voltage[:-1]
    current = servos.current(voltage, speed)
    electrical = voltage * current
    powers = (
        mechanical,
        np.maximum(mechanical, 0.0),
        np.abs(mechanical),
        electrical,
        np.maximum(electrical, 0.0),
        servos.resistance * current * current,
        servos.viscous * acting * speed,
        servos.friction(acting) * speed,
        servos.gear_damping * (acting - body.rate[:-1]) * (speed - rate),
    )
    return dt * np.array(powers).sum(axis=1)


def ground_flows(steps: Steps, stiffness: float, dt: float) -> FloatArray:
    """Energies that the ground takes during consecutive steps.

    Args:
        steps: k + 1 steps; the last one closes the one before it.
        stiffness: Of the ground [N/m]; its spring stores energy, the rest is lost.
        dt: Step [s].

    Returns:
        Energies [J], as :data:`GROUND_TERMS`, shape (3,).
    """
    contact = steps.stacked.contact
    velocity = _middle(contact.velocity)
    tangent, depth, force = (part[:-1] for part in contact[1:])
    along, across = (into_link_axes(tangent, force) * into_link_axes(tangent, velocity)).sum(
        axis=(0, 2)
    )
    damping = force[:, 2] - stiffness * np.maximum(depth, 0.0)
    return -dt * np.array([along, across, (damping * velocity[:, 2]).sum()])


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


def _middle(series: FloatArray) -> FloatArray:
    """Means of neighbours in time, shape (k + 1, ...) to (k, ...)."""
    return 0.5 * (series[1:] + series[:-1])
