"""The articulated body in PyBullet with kinematics of our own, compiled.

Half of what :mod:`.sim.physics.bullet` costs goes into reading poses and velocities link by link
and into pushing link by link. Here the engine is asked for its coordinates alone, and forces on the
links reach it as the generalised force that does the same (:mod:`.sim.physics.chain_kernels`).
Importing it needs the extra ``numba``.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from operator import itemgetter

import numpy as np

from undulog.capture.common.arrays import FloatArray
from undulog.capture.robot.model import Plane, Robot

from . import chain_kernels
from .bullet import BulletEngine, pybullet
from .engine import BodyState

_angle, _rate = itemgetter(0), itemgetter(1)


class CompiledBulletEngine(BulletEngine):
    """A robot's links and joints in a physics world of their own; :meth:`close` it after use."""

    def __init__(
        self,
        robot: Robot,
        *,
        gravity: Sequence[float],
        height: float,
        heading: float,
        velocity: Sequence[float],
        dt: float,
    ) -> None:
        """Build the body, straight, its head above the origin.

        Args:
            robot: The robot, at most :data:`.sim.physics.bullet.MAX_JOINTS` joints.
            gravity: Acceleration of gravity in the world [m/s^2], length 3.
            height: Height of the links' centres [m].
            heading: Direction of the head's x axis, about z [rad].
            velocity: Of the whole body [m/s], length 3.
            dt: Step [s].

        Raises:
            UsageError: If the engine cannot hold the robot.
        """
        super().__init__(
            robot, gravity=gravity, height=height, heading=heading, velocity=velocity, dt=dt
        )
        self._half = np.array([link.length / 2 for link in robot.links])
        self._vertical = np.array([joint.plane is Plane.VERTICAL for joint in robot.joints])
        self._hinges = np.zeros((6, len(robot.joints)))
        self._generalised = np.zeros(6 + len(robot.joints))
        self._drive = self._generalised[6:]  # of the joints
        self._coordinates = np.zeros(13 + 2 * len(robot.joints))
        self._buffer = self._coordinates.data  # the same memory
        self._pack = struct.Struct(f"{len(self._coordinates)}d").pack_into
        self.read()

    def read(self, into: BodyState | None = None) -> BodyState:
        """The present state.

        Args:
            into: Arrays to be filled in; new ones by default.

        Returns:
            Positions and velocities of links and joints, in these arrays.
        """
        state = into or BodyState.empty(len(self._half), len(self._joints))
        body, client = self._body, self._client
        self._place, turn = pybullet.getBasePositionAndOrientation(body, client)
        velocity, spin = pybullet.getBaseVelocity(body, client)
        joints = pybullet.getJointStates(body, self._joints, client)
        head = *self._place, *turn, *velocity, *spin
        self._pack(self._buffer, 0, *head, *map(_angle, joints), *map(_rate, joints))
        chain_kernels.spread(self._coordinates, self._half, self._vertical, *state, self._hinges)
        self._position = state.position
        return state

    def push(self, force: FloatArray, point: FloatArray) -> None:
        """Apply forces to the links during the next step; calls add up.

        Args:
            force: In the world [N], shape (3, n).
            point: Points of action in the world [m], shape (3, n).
        """
        chain_kernels.gather(force, point, self._position, self._hinges, self._generalised)

    def step(self, torque: FloatArray) -> None:
        """Advance the body by one step.

        Args:
            torque: Of the joints [N m], shape (m,).
        """
        self._drive += torque
        load = self._generalised.tolist()
        self._generalised.fill(0.0)
        body, world, client = self._body, pybullet.WORLD_FRAME, self._client
        pybullet.applyExternalForce(body, -1, load[:3], self._place, world, client)
        pybullet.applyExternalTorque(body, -1, load[3:6], world, client)
        self._advance(load[6:])
