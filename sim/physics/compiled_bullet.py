"""The articulated body in PyBullet with kinematics of our own, compiled.

Half of what :mod:`.sim.physics.bullet` costs goes into reading poses and velocities link by link
and into pushing link by link. Here the engine is asked for its coordinates alone, and forces on the
links reach it as the generalised force that does the same (:mod:`.sim.physics.compiled_bullet`).
Importing it needs the extra ``numba``.

Kinematics of the chain, compiled.

From the body's coordinates, the head's pose and the joint angles, come poses and velocities of all
links. The other way go forces: a force f at a point p of a link does the same to the whole body as
the generalised force J^T f, J being the Jacobian of p (Featherstone, Rigid Body Dynamics
Algorithms, 2008, Section 2.7): a wrench on the head and torques of the joints in front of the link.
"""

from __future__ import annotations

import math
import struct

import numpy as np
from numba import njit

from undulog.capture.common.arrays import BoolArray, FloatArray
from undulog.capture.robot.model import Plane, Robot

from .bullet import ANGLE, RATE, BulletEngine, pybullet
from .engine import BodyStart, BodyState


@njit(cache=True)
def spread(
    coordinates: FloatArray,
    half: FloatArray,
    vertical: BoolArray,
    position: FloatArray,
    quaternion: FloatArray,
    velocity: FloatArray,
    spin: FloatArray,
    angle: FloatArray,
    rate: FloatArray,
    hinges: FloatArray,
) -> None:
    """Poses and velocities of all links, from head to tail.

    Args:
        coordinates: The head's centre, orientation (x, y, z, w), velocity and angular velocity,
            then all joints' angles and all joints' rates, shape (13 + 2 m,).
        half: Half of the links' lengths [m], shape (n,).
        vertical: Whether a joint turns about y rather than z, shape (m,).
        position: Filled in: centres of the links [m], shape (3, n).
        quaternion: Filled in: their orientations, shape (4, n).
        velocity: Filled in: velocities of the centres [m/s], shape (3, n).
        spin: Filled in: angular velocities [rad/s], shape (3, n).
        angle: Filled in: joint angles [rad], shape (m,).
        rate: Filled in: joint rates [rad/s], shape (m,).
        hinges: Filled in: places of the joints [m] and directions of their axes, shape (6, m).
    """
    m = len(angle)
    angle[:], rate[:] = coordinates[13 : 13 + m], coordinates[13 + m :]
    px, py, pz = coordinates[0], coordinates[1], coordinates[2]
    x, y, z, w = coordinates[3], coordinates[4], coordinates[5], coordinates[6]
    vx, vy, vz = coordinates[7], coordinates[8], coordinates[9]
    sx, sy, sz = coordinates[10], coordinates[11], coordinates[12]
    for i in range(len(half)):
        if i > 0:
            # From the centre of the link in front to the joint, a = -half e_x.
            bx, by, bz = 1 - 2 * (y * y + z * z), 2 * (x * y + z * w), 2 * (x * z - y * w)
            ax, ay, az = -half[i - 1] * bx, -half[i - 1] * by, -half[i - 1] * bz
            px, py, pz = px + ax, py + ay, pz + az
            vx, vy, vz = vx + sy * az - sz * ay, vy + sz * ax - sx * az, vz + sx * ay - sy * ax
            # The joint turns about an axis that both links share.
            s, c = math.sin(0.5 * angle[i - 1]), math.cos(0.5 * angle[i - 1])
            if vertical[i - 1]:
                ax, ay, az = 2 * (x * y - z * w), 1 - 2 * (x * x + z * z), 2 * (y * z + x * w)
                x, y, z, w = x * c - z * s, y * c + w * s, z * c + x * s, w * c - y * s
            else:
                ax, ay, az = 2 * (x * z + y * w), 2 * (y * z - x * w), 1 - 2 * (x * x + y * y)
                x, y, z, w = x * c + y * s, y * c - x * s, z * c + w * s, w * c - z * s
            hinges[0, i - 1], hinges[1, i - 1], hinges[2, i - 1] = px, py, pz
            hinges[3, i - 1], hinges[4, i - 1], hinges[5, i - 1] = ax, ay, az
            sx, sy, sz = sx + rate[i - 1] * ax, sy + rate[i - 1] * ay, sz + rate[i - 1] * az
            # From the joint to the centre.
            bx, by, bz = 1 - 2 * (y * y + z * z), 2 * (x * y + z * w), 2 * (x * z - y * w)
            ax, ay, az = -half[i] * bx, -half[i] * by, -half[i] * bz
            px, py, pz = px + ax, py + ay, pz + az
            vx, vy, vz = vx + sy * az - sz * ay, vy + sz * ax - sx * az, vz + sx * ay - sy * ax
        position[0, i], position[1, i], position[2, i] = px, py, pz
        quaternion[0, i], quaternion[1, i], quaternion[2, i], quaternion[3, i] = x, y, z, w
        velocity[0, i], velocity[1, i], velocity[2, i] = vx, vy, vz
        spin[0, i], spin[1, i], spin[2, i] = sx, sy, sz


@njit(cache=True)
def gather(
    force: FloatArray,
    point: FloatArray,
    position: FloatArray,
    hinges: FloatArray,
    generalised: FloatArray,
) -> None:
    """Add the generalised force of forces on the links, from tail to head.

    Args:
        force: In the world [N], shape (3, n).
        point: Points of action [m], shape (3, n).
        position: Centres of the links [m], shape (3, n).
        hinges: Places of the joints [m] and directions of their axes, shape (6, m).
        generalised: Added to: force on the head, moment about its centre, torque of each joint,
            shape (6 + m,).
    """
    fx = fy = fz = mx = my = mz = 0.0  # of all links from here to the tail, about the origin
    for i in range(force.shape[1] - 1, -1, -1):
        gx, gy, gz = force[0, i], force[1, i], force[2, i]
        x, y, z = point[0, i], point[1, i], point[2, i]
        fx, fy, fz = fx + gx, fy + gy, fz + gz
        mx, my, mz = mx + y * gz - z * gy, my + z * gx - x * gz, mz + x * gy - y * gx
        if i > 0:
            x, y, z = hinges[0, i - 1], hinges[1, i - 1], hinges[2, i - 1]
            generalised[5 + i] += (
                hinges[3, i - 1] * (mx - (y * fz - z * fy))
                + hinges[4, i - 1] * (my - (z * fx - x * fz))
                + hinges[5, i - 1] * (mz - (x * fy - y * fx))
            )
    x, y, z = position[0, 0], position[1, 0], position[2, 0]
    generalised[0] += fx
    generalised[1] += fy
    generalised[2] += fz
    generalised[3] += mx - (y * fz - z * fy)
    generalised[4] += my - (z * fx - x * fz)
    generalised[5] += mz - (x * fy - y * fx)


class CompiledBulletEngine(BulletEngine):
    """A robot's links and joints in a physics world of their own; :meth:`close` it after use."""

    def __init__(self, robot: Robot, start: BodyStart) -> None:
        """Build the body; at most :data:`.sim.physics.bullet.MAX_JOINTS` joints."""
        super().__init__(robot, start)
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
        """The present state."""
        state = into or BodyState.empty(len(self._half), len(self._joints))
        body, client = self._body, self._client
        self._place, turn = pybullet.getBasePositionAndOrientation(body, client)
        velocity, spin = pybullet.getBaseVelocity(body, client)
        joints = pybullet.getJointStates(body, self._joints, client)
        head = *self._place, *turn, *velocity, *spin
        self._pack(self._buffer, 0, *head, *map(ANGLE, joints), *map(RATE, joints))
        spread(self._coordinates, self._half, self._vertical, *state, self._hinges)
        self._position = state.position
        return state

    def push(self, force: FloatArray, point: FloatArray) -> None:
        """Apply forces to the links during the next step; calls add up."""
        gather(force, point, self._position, self._hinges, self._generalised)

    def step(self, torque: FloatArray) -> None:
        """Advance the body by one step."""
        self._drive += torque
        load = self._generalised.tolist()
        self._generalised.fill(0.0)
        body, world, client = self._body, pybullet.WORLD_FRAME, self._client
        pybullet.applyExternalForce(body, -1, load[:3], self._place, world, client)
        pybullet.applyExternalTorque(body, -1, load[3:6], world, client)
        self._advance(load[6:])
