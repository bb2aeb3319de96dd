"""The articulated body, stepped by MuJoCo: the twin's second opinion.

It stands under the same contract and the same force laws as :mod:`.sim.physics.bullet`, so for one
scenario the two must agree up to rounding. Both have the head's pose and the joint angles as their
coordinates and follow the semi-implicit Euler rule. One keeps the head's angular velocity in the
world, the other in the head's frame; as the head turns by exp(dt w) about the new w itself, both
keep the same vector.

Three things differ from MuJoCo's usual use: forces act at points of the links, so they are applied
at the centres with their moment; nothing damps, stops or touches, so no constraint is solved; and
the stages of a step are called one by one, because ``mj_step`` answers an impossible state by
starting over and by writing a file into the working directory. The twin has a check of its own.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import mujoco
import numpy as np

from undulog.capture.common.arrays import FloatArray
from undulog.capture.common.errors import UsageError
from undulog.capture.robot.model import Plane, Robot

from .contact import cross
from .engine import BodyStart, BodyState

_AXES = {Plane.HORIZONTAL: (0.0, 0.0, 1.0), Plane.VERTICAL: (0.0, 1.0, 0.0)}
_SCALAR_LAST = [1, 2, 3, 0]  # from MuJoCo's order w, x, y, z


class MujocoEngine:
    """A robot's links and joints in a physics world of their own."""

    def __init__(self, robot: Robot, start: BodyStart) -> None:
        """Build the body."""
        self._model = _model(robot, start.gravity, start.dt)
        self._data = mujoco.MjData(self._model)
        self._data.qpos[:3] = (0.0, 0.0, start.height)
        half = start.heading / 2
        self._data.qpos[3:7] = (math.cos(half), 0.0, 0.0, math.sin(half))
        self._data.qvel[:3] = start.velocity
        self._derive()

    def close(self) -> None:
        """Nothing to do: the physics world is freed with this object."""

    def read(self, into: BodyState | None = None) -> BodyState:
        """The present state."""
        data = self._data  # its first body is the world
        state = into or BodyState.empty(len(data.xipos) - 1, len(data.qpos) - 7)
        state.position[...] = data.xipos[1:].T
        state.quaternion[...] = data.xquat[1:, _SCALAR_LAST].T
        state.spin[...] = data.cvel[1:, :3].T
        # The velocity that each link, carried on, would have at the robot's centre of mass.
        carried = data.cvel[1:, 3:].T
        arm = state.position - data.subtree_com[1, :, np.newaxis]
        state.velocity[...] = carried + cross(state.spin, arm)
        state.angle[...], state.rate[...] = data.qpos[7:], data.qvel[6:]
        return state

    def push(self, force: FloatArray, point: FloatArray) -> None:
        """Apply forces to the links during the next step; calls add up."""
        data = self._data
        data.xfrc_applied[1:, :3] += force.T
        data.xfrc_applied[1:, 3:] += cross(point - data.xipos[1:].T, force).T

    def step(self, torque: FloatArray) -> None:
        """Advance by one step, semi-implicit Euler."""
        model, data = self._model, self._data
        data.qfrc_applied[6:] = torque
        mujoco.mj_fwdAcceleration(model, data)
        mujoco.mj_fwdConstraint(model, data)  # without constraints: the accelerations as they are
        mujoco.mj_Euler(model, data)
        data.xfrc_applied[:] = 0.0
        self._derive()

    def _derive(self) -> None:
        """What follows from coordinates and velocities: poses, inertias, bias forces."""
        mujoco.mj_fwdPosition(self._model, self._data)
        mujoco.mj_fwdVelocity(self._model, self._data)


def body_spec(robot: Robot, gravity: Sequence[float], dt: float) -> mujoco.MjSpec:
    """The chain of links: masses, inertias and hinges, nothing else."""
    spec = mujoco.MjSpec()
    spec.option.timestep = dt
    spec.option.gravity = gravity
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_EULER
    spec.option.disableflags = mujoco.mjtDisableBit.mjDSBL_EULERDAMP
    before, behind = spec.worldbody, 0.0  # the body in front, and where it ends
    for i, link in enumerate(robot.links):
        half = link.length / 2
        body = before.add_body(
            pos=(behind - half if i else 0.0, 0.0, 0.0),
            mass=link.mass,
            inertia=link.inertia,
            ipos=(0.0, 0.0, 0.0),
            explicitinertial=True,
        )
        if i == 0:
            body.add_freejoint()
        else:
            axis = _AXES[robot.joints[i - 1].plane]
            body.add_joint(type=mujoco.mjtJoint.mjJNT_HINGE, pos=(half, 0.0, 0.0), axis=axis)
        before, behind = body, -half
    return spec


def _model(robot: Robot, gravity: Sequence[float], dt: float) -> mujoco.MjModel:
    try:
        return body_spec(robot, gravity, dt).compile()
    except ValueError as error:  # e.g. moments of inertia that no body can have
        reason = str(error).splitlines()[0]
        raise UsageError(f"the engine cannot hold robot {robot.name}: {reason}") from error
