"""What a physics engine has to offer the twin: articulated-body dynamics, and nothing else.

Ground, obstacles and servos are this package's own, so that every engine runs under the same force
laws and their results can be held against each other.
"""

from __future__ import annotations

from typing import NamedTuple, Protocol

from capture.arrays import FloatArray


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


class Engine(Protocol):
    """A robot's links and joints in a physics world of their own."""

    def read(self) -> BodyState:
        """The present state.

        Returns:
            Positions and velocities of links and joints, in arrays of their own.
        """
        ...

    def push(self, force: FloatArray, point: FloatArray) -> None:
        """Apply forces to the links during the next step; calls add up.

        Args:
            force: In the world [N], shape (3, n).
            point: Points of action in the world [m], shape (3, n).
        """
        ...

    def step(self, torque: FloatArray) -> None:
        """Advance by one step, semi-implicit Euler.

        Args:
            torque: Of the joints [N m], shape (m,).
        """
        ...

    def close(self) -> None:
        """Free the physics world; safe to call twice."""
        ...
