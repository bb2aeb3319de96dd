"""Interface of physics engines: articulated-body dynamics, and nothing else.

Ground, obstacles and servos are this package's own, so that every engine runs under the same force
laws and their results can be held against each other.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from importlib import import_module
from typing import NamedTuple, Protocol, TypeAlias, cast

import numpy as np

from undulog.capture.common.arrays import FloatArray
from undulog.capture.common.errors import MissingExtraError
from undulog.capture.robot.model import Robot

from ..scenario.scenario import EngineKind, Kernels

_TYPES = {
    EngineKind.BULLET: ("undulog.sim.physics.bullet", "BulletEngine"),
    EngineKind.MUJOCO: ("undulog.sim.physics.mujoco", "MujocoEngine"),
}


class BodyState(NamedTuple):
    """Where the body is and how it moves, in the world; the component comes first.

    Attributes:
        position: Centres of the n links [m], shape (3, n).
        quaternion: Their orientations x, y, z, w, shape (4, n).
        velocity: Velocities of the centres [m/s], shape (3, n).
        spin: Angular velocities [rad/s], shape (3, n).
        angle: Joint angles [rad], shape (m,).
        rate: Joint rates [rad/s], shape (m,).
    """

    position: FloatArray
    quaternion: FloatArray
    velocity: FloatArray
    spin: FloatArray
    angle: FloatArray
    rate: FloatArray

    @classmethod
    def empty(cls, link_count: int, joint_count: int) -> BodyState:
        """Arrays to be filled in.

        Args:
            link_count: n.
            joint_count: m.
        """
        position, velocity, spin = np.empty((3, 3, link_count))
        quaternion, (angle, rate) = np.empty((4, link_count)), np.empty((2, joint_count))
        return cls(position, quaternion, velocity, spin, angle, rate)


class Engine(Protocol):
    """A robot's links and joints in a physics world of their own."""

    def read(self, into: BodyState | None = None) -> BodyState:
        """The present state.

        Args:
            into: Arrays to be filled in; new ones by default.

        Returns:
            Positions and velocities of links and joints, in these arrays.
        """
        ...

    def push(self, force: FloatArray, point: FloatArray) -> None:
        """Apply forces to the links during the next step; calls add up.

        Args:
            force: In the world [N], shape (3, n).
            point: Points of action in the world [m], shape (3, n).
        """

    def step(self, torque: FloatArray) -> None:
        """Advance by one step, semi-implicit Euler.

        Args:
            torque: Of the joints [N m], shape (m,).
        """

    def close(self) -> None:
        """Free the physics world; safe to call twice."""


class BodyStart(NamedTuple):
    """The world of a body and its start: straight, its head above the origin.

    Attributes:
        gravity: Acceleration of gravity in the world [m/s^2], length 3.
        height: Height of the links' centres [m].
        heading: Direction of the head's x axis, about z [rad].
        velocity: Of the whole body [m/s], length 3.
        dt: Step [s].
    """

    gravity: Sequence[float]
    height: float
    heading: float
    velocity: Sequence[float]
    dt: float


EngineType: TypeAlias = Callable[[Robot, BodyStart], Engine]
"""Builds a body; raises UsageError if the engine can't hold the robot."""


def engine_type(kind: EngineKind, kernels: Kernels = Kernels.NUMPY) -> EngineType:
    """Import an engine.

    Args:
        kernels: What computes the body's kinematics where the engine leaves it to us.

    Raises:
        MissingExtraError: If its package is not installed.
        ImportError: If Numba is needed and not installed.
    """
    if not kind.installed:
        other = next((other for other in EngineKind if other.installed), None)
        instead = "" if other is None else f'engine = "{other}" in the scenario runs without it'
        extra = "sim" if kind is EngineKind.BULLET else "mujoco"
        raise MissingExtraError(f"the engine '{kind}'", extra, kind.package, instead)
    module, name = _TYPES[kind]
    if kind is EngineKind.BULLET and kernels is Kernels.NUMBA:
        module, name = "undulog.sim.physics.compiled_bullet", "CompiledBulletEngine"
    return cast(EngineType, getattr(import_module(module), name))
