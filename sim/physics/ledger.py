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
"""

from __future__ import annotations

import numpy as np

from undulog.capture.common.arrays import FloatArray
from undulog.capture.robot.model import Robot

from ..scenario.engines import Kernels
from .energy_flows import (
    GROUND_TERMS,
    JOINT_TERMS,
    OBSTACLE_TERMS,
    PUSH_TERMS,
    ground_flows,
    joint_flows,
    obstacle_flows,
    push_flow,
)
from .engine import BodyState
from .servo import Servos
from .steps import Step, Steps
from .vectors import into_frames

STORED_TERMS = (
    *("kinetic", "potential", "contact_spring", "obstacle_spring"),
    *("rotor_kinetic", "gear_spring"),
)
"""Energies stored at the instant [J]: those of the body and its contacts, those of the servos."""

RESIDUAL_TERMS = ("mechanical_residual", "electrical_residual")
"""Left side minus right side of the two balances since the start [J]: the ledger's own error."""

TERMS = JOINT_TERMS + GROUND_TERMS + OBSTACLE_TERMS + PUSH_TERMS + STORED_TERMS + RESIDUAL_TERMS
"""All terms, in the order of :meth:`Ledger.read`."""


class Ledger:
    """Adds up flows and reads off stored energies."""

    def __init__(
        self,
        robot: Robot,
        servos: Servos,
        *,
        gravity: FloatArray,
        stiffness: float,
        obstacle_stiffness: float,
        dt: float,
        start: Step,
        kernels: Kernels = Kernels.NUMPY,
    ) -> None:
        """Open the ledger.

        Args:
            robot: The robot.
            servos: Its servos.
            gravity: Acceleration of gravity in the world [m/s^2], shape (3,).
            stiffness: Of the ground [N/m], 0 where there is none.
            obstacle_stiffness: Of the obstacles [N/m].
            dt: Step [s].
            start: The state at which all flows are zero.
            kernels: What adds up.
        """
        self._kernels = kernels
        self._servos = servos
        self._mass = np.array([link.mass for link in robot.links])
        self._inertia = np.array([link.inertia for link in robot.links]).T.copy()
        self._gravity = gravity
        self._stiffness = stiffness
        self._obstacle_stiffness = obstacle_stiffness
        self._dt = dt
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
        from .kernels import add_ground_flows, add_joint_flows

        table, n, m = steps.table, steps.link_count, steps.joint_count
        add_joint_flows(table, n, m, self._servos.table, self._dt, self._joints)
        add_ground_flows(table, n, m, self._stiffness, self._dt, self._ground)

    def stored(self, step: Step) -> FloatArray:
        """Energies stored at one instant.

        Args:
            step: The instant.

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
            from .kernels import kinetic_energy

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
