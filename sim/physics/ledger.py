"""The twin's energy ledger: where every joule goes, booked at the physics rate.

It is the best check that a simulation is right, and the truth that energy estimates from logs are
held against. Forces and torques are constant during a step, so each is booked at mid-step
velocity, the mean of the velocities before and after: with the semi-implicit Euler rule that body
and rotors follow, what is left over is a boundary term that does not grow.

Two balances close over any stretch of time::

    mechanical_net + push_work
                   = friction_tangential + friction_normal + contact_damping
                     + obstacle_friction + obstacle_damping
                     + change of (kinetic + potential + contact_spring + obstacle_spring)
    electrical_net = mechanical_net + copper + viscous + coulomb + gear_damping
                     + change of (rotor_kinetic + gear_spring)

What the twin's steps do with energy: the flows through joints, ground, obstacles and pushes.

Forces and torques are constant during a step, so each is booked at mid-step velocity, the mean of
the velocities before and after.
"""

from __future__ import annotations

import numpy as np

from undulog.capture.common.arrays import FloatArray

from ..scenario.scenario import Kernels, Scenario
from .contact import cross, into_frames, into_link_axes
from .engine import BodyState
from .servo import COULOMB_SPEED, Servos
from .steps import Step, Steps

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

STORED_TERMS = (
    *("kinetic", "potential", "contact_spring", "obstacle_spring"),
    *("rotor_kinetic", "gear_spring"),
)
"""Energies stored at the instant [J]: those of the body and its contacts, those of the servos."""

RESIDUAL_TERMS = ("mechanical_residual", "electrical_residual")
"""Left side minus right side of the two balances since the start [J]: the ledger's own error."""

TERMS = JOINT_TERMS + GROUND_TERMS + OBSTACLE_TERMS + PUSH_TERMS + STORED_TERMS + RESIDUAL_TERMS
"""All terms, in the order of :meth:`Ledger.read`."""


def joint_flows(steps: Steps, servos: Servos, dt: float) -> FloatArray:
    """Energies that pass the joints during consecutive steps.

    Args:
        steps: k + 1 steps; the last one closes the one before it.
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


class Ledger:
    """Adds up flows and reads off stored energies."""

    def __init__(self, scenario: Scenario, servos: Servos, start: Step, kernels: Kernels) -> None:
        """Open the ledger at the state at which all flows are zero."""
        robot, world = scenario.robot, scenario.world
        self._kernels, self._servos = kernels, servos
        self._mass = np.array([link.mass for link in robot.links])
        self._inertia = np.array([link.inertia for link in robot.links]).T.copy()
        self._gravity = np.array(world.gravity)
        self._stiffness = world.ground.stiffness if world.ground is not None else 0.0
        self._obstacle_stiffness = world.obstacle_contact.stiffness
        self._dt = 1.0 / scenario.physics_rate_hz
        self._joints = np.zeros((len(JOINT_TERMS), len(robot.joints)))
        self._ground = np.zeros(len(GROUND_TERMS))
        self._obstacles = np.zeros(len(OBSTACLE_TERMS))
        self._push_work = 0.0
        self._contact_s = np.zeros(len(robot.links))
        self._start = self.stored(start)

    @property
    def joints(self) -> FloatArray:
        """Cumulative flows of each joint [J], rows as :data:`JOINT_TERMS`, shape (9, m)."""
        return self._joints.copy()

    @property
    def contact_s(self) -> FloatArray:
        """For how long each link has touched an obstacle so far [s], shape (n,)."""
        return self._contact_s.copy()

    def book(self, steps: Steps) -> None:
        """Add the flows of consecutive steps.

        Args:
            steps: k + 1 steps; the last one closes the one before it and is booked next time.
        """
        if self._kernels is Kernels.NUMBA:
            self._book_compiled(steps)
        else:
            self._joints += joint_flows(steps, self._servos, self._dt)
            self._ground += ground_flows(steps, self._stiffness, self._dt)
        self._push_work += push_flow(steps, self._dt)
        if any(len(contact.link) for contact in steps.obstacles):
            self._obstacles += obstacle_flows(steps, self._obstacle_stiffness, self._dt)
            for contact in steps.obstacles[:-1]:
                self._contact_s[np.unique(contact.link)] += self._dt

    def _book_compiled(self, steps: Steps) -> None:
        """Add the flows through joints and to the ground, by the compiled kernels."""
        from .compiled_kernels import add_ground_flows, add_joint_flows

        table, n, m = steps.table, steps.link_count, steps.joint_count
        add_joint_flows(table, n, m, self._servos.table, self._dt, self._joints)
        add_ground_flows(table, n, m, self._stiffness, self._dt, self._ground)

    def stored(self, step: Step) -> FloatArray:
        """Energies stored at one instant.

        Returns:
            Energies [J], as :data:`STORED_TERMS`, shape (6,).
        """
        body, rotors, servos = step.body, step.rotors, self._servos
        twist = servos.twist(body.angle, rotors.angle)
        depth = np.maximum(step.contact.depth, 0.0)
        dent = step.obstacles.depth
        return np.array(
            [
                self._kinetic(body),
                -(self._gravity @ body.position) @ self._mass,
                0.5 * self._stiffness * (depth @ depth),
                0.5 * self._obstacle_stiffness * (dent @ dent),
                0.5 * servos.inertia @ rotors.speed**2,
                0.5 * servos.gear_stiffness @ twist**2,
            ]
        )

    def _kinetic(self, body: BodyState) -> float:
        """Kinetic energy of the links [J]."""
        if self._kernels is Kernels.NUMBA:
            from .compiled_kernels import kinetic_energy

            return kinetic_energy(*body[1:4], self._mass, self._inertia)
        spin = into_frames(body.quaternion, body.spin)
        moving = self._mass @ (body.velocity**2).sum(axis=0)
        return 0.5 * float(moving + (self._inertia * spin**2).sum())

    def read(self, step: Step) -> FloatArray:
        """All terms at one instant.

        Args:
            step: The instant, up to which all steps are booked.

        Returns:
            Energies [J], as :data:`TERMS`, shape (23,).
        """
        joints = self._joints.sum(axis=1)
        stored = self.stored(step)
        change = stored - self._start
        net, electrical, losses = joints[0], joints[3], joints[5:].sum()
        residuals = (
            net + self._push_work - self._ground.sum() - self._obstacles.sum() - change[:4].sum(),
            electrical - net - losses - change[4:].sum(),
        )
        flows = (joints, self._ground, self._obstacles, (self._push_work,))
        return np.concatenate((*flows, stored, residuals))
