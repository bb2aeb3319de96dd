"""The articulated body: PyBullet steps it, and nothing else.

Contact (:mod:`.sim.physics.contact`) and servos (:mod:`.sim.physics.servo`) are ours, because the
engine's anisotropic friction depends on the heading and its position motors have no electrical or
elastic side. So the body has no collision shapes here and its motors are off; forces and torques
come in from outside, once a step. It has no mechanical end stops: commands are kept within the
joint limits, and the twin says when a joint passes its limit all the same.

The base of the engine's body is the head link, so joint and link i of the engine are
``robot.joints[i]`` and ``robot.links[i + 1]``.
"""

from __future__ import annotations

import contextlib
import os
import struct
import sys
from collections import deque
from collections.abc import Generator
from itertools import repeat
from operator import itemgetter

import numpy as np

from undulog.capture.common.arrays import FloatArray
from undulog.capture.common.errors import UsageError
from undulog.capture.robot.model import Plane, Robot

from .engine import BodyStart, BodyState

MAX_JOINTS = 127
"""Links beside the base that the engine can hold."""

_AXES = {Plane.HORIZONTAL: (0.0, 0.0, 1.0), Plane.VERTICAL: (0.0, 1.0, 0.0)}
_NO_SHAPE = -1
_UNTURNED = (0.0, 0.0, 0.0, 1.0)


# Packing is the fastest way from the engine's nested tuples to an array, by a factor of two.
_pack_link = struct.Struct("13d").pack  # centre, orientation, velocity, angular velocity
ANGLE, RATE = itemgetter(0), itemgetter(1)
"""Of one of the engine's states of a joint [rad], [rad/s]."""


@contextlib.contextmanager
def _quiet_stderr() -> Generator[None]:
    """Drop what C code prints on stderr: the engine greets with its build time on import."""
    sys.stderr.flush()
    saved = os.dup(2)
    try:
        with open(os.devnull, "wb") as sink:  # noqa: PTH123 - a device, needed as a descriptor
            os.dup2(sink.fileno(), 2)
        yield
    finally:
        os.dup2(saved, 2)
        os.close(saved)


with _quiet_stderr():
    import pybullet


class BulletEngine:
    """A robot's links and joints in a physics world of their own; :meth:`close` it after use."""

    def __init__(self, robot: Robot, start: BodyStart) -> None:
        """Build the body; at most :data:`MAX_JOINTS` joints."""
        joints, links = robot.joints, robot.links
        if len(joints) > MAX_JOINTS:
            raise UsageError(
                f"robot {robot.name} has {len(joints)} joints; the twin takes at most {MAX_JOINTS}"
            )
        self._client = pybullet.connect(pybullet.DIRECT)
        heading = start.heading
        half = [link.length / 2 for link in links]
        # The engine wants each joint relative to the joint before it (to the centre for the base).
        joint_positions = [
            (-half[0] if i == 0 else -2 * half[i], 0.0, 0.0) for i in range(len(joints))
        ]
        self._body = pybullet.createMultiBody(
            baseMass=links[0].mass,
            baseCollisionShapeIndex=_NO_SHAPE,
            baseVisualShapeIndex=_NO_SHAPE,
            basePosition=(0.0, 0.0, start.height),
            baseOrientation=(0.0, 0.0, np.sin(heading / 2), np.cos(heading / 2)),
            linkMasses=[link.mass for link in links[1:]],
            linkCollisionShapeIndices=[_NO_SHAPE] * len(joints),
            linkVisualShapeIndices=[_NO_SHAPE] * len(joints),
            linkPositions=joint_positions,
            linkOrientations=[_UNTURNED] * len(joints),
            linkInertialFramePositions=[(-h, 0.0, 0.0) for h in half[1:]],
            linkInertialFrameOrientations=[_UNTURNED] * len(joints),
            linkParentIndices=list(range(len(joints))),
            linkJointTypes=[pybullet.JOINT_REVOLUTE] * len(joints),
            linkJointAxis=[_AXES[joint.plane] for joint in joints],
            physicsClientId=self._client,
        )
        for i, link in enumerate(links, start=-1):
            # Two calls: together with damping the engine silently drops the inertia.
            pybullet.changeDynamics(
                self._body, i, localInertiaDiagonal=link.inertia, physicsClientId=self._client
            )
            pybullet.changeDynamics(
                self._body,
                i,
                linearDamping=0.0,
                angularDamping=0.0,
                jointDamping=0.0,
                physicsClientId=self._client,
            )
        self._joints = list(range(len(joints)))
        pybullet.setJointMotorControlArray(
            self._body,
            self._joints,
            pybullet.VELOCITY_CONTROL,
            forces=[0.0] * len(joints),
            physicsClientId=self._client,
        )
        pybullet.resetBaseVelocity(
            self._body, start.velocity, (0.0, 0.0, 0.0), physicsClientId=self._client
        )
        pybullet.setGravity(*start.gravity, physicsClientId=self._client)
        pybullet.setTimeStep(start.dt, physicsClientId=self._client)

    def close(self) -> None:
        """Free the physics world; safe to call twice."""
        if self._client >= 0:
            pybullet.disconnect(physicsClientId=self._client)
            self._client = -1

    def read(self, into: BodyState | None = None) -> BodyState:
        """The present state."""
        state = into or BodyState.empty(len(self._joints) + 1, len(self._joints))
        client = self._client
        position, turn = pybullet.getBasePositionAndOrientation(self._body, client)
        velocity, spin = pybullet.getBaseVelocity(self._body, client)
        # Without the forward kinematics the poses would be one step old, here and in push().
        links = pybullet.getLinkStates(self._body, self._joints, 1, 1, client)
        rows = [_pack_link(*link[0], *link[1], *link[6], *link[7]) for link in links]
        rows.insert(0, _pack_link(*position, *turn, *velocity, *spin))
        fields = np.frombuffer(b"".join(rows)).reshape(-1, 13).T
        state.position[...], state.quaternion[...] = fields[:3], fields[3:7]
        state.velocity[...], state.spin[...] = fields[7:10], fields[10:]
        joints = pybullet.getJointStates(self._body, self._joints, client)
        state.angle[...], state.rate[...] = list(map(ANGLE, joints)), list(map(RATE, joints))
        return state

    def push(self, force: FloatArray, point: FloatArray) -> None:
        """Apply forces to the links during the next step; calls add up."""
        n = force.shape[1]
        calls = map(
            pybullet.applyExternalForce,
            *(repeat(self._body, n), range(-1, n - 1), force.T.tolist(), point.T.tolist()),
            *(repeat(pybullet.WORLD_FRAME), repeat(self._client)),
        )
        deque(calls, maxlen=0)  # runs them all, without a loop of ours

    def step(self, torque: FloatArray) -> None:
        """Advance the body by one step."""
        self._advance(torque.tolist())

    def _advance(self, torque: list[float]) -> None:
        pybullet.setJointMotorControlArray(
            self._body,
            self._joints,
            pybullet.TORQUE_CONTROL,
            forces=torque,
            physicsClientId=self._client,
        )
        pybullet.stepSimulation(self._client)
