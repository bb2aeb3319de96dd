"""The force laws of ground and servos, applied to one row of a table of steps after the other."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from undulog.capture.common.arrays import FloatArray
from undulog.capture.robot.model import Robot

from ..scenario.engines import Kernels
from ..scenario.world import Ground
from .contact import GroundContact
from .servo import Servos
from .steps import Steps


class Laws(Protocol):
    """What fills in a step once its body is there."""

    def start(self, k: int) -> None:
        """Complete a step whose body and rotors are there.

        Args:
            k: Its row.
        """
        ...

    def follow(self, k: int) -> None:
        """Complete a step whose body is there, and which follows the row before it.

        Args:
            k: Its row, not the first.
        """
        ...

    def command(self, k: int, reference: FloatArray) -> None:
        """Give the servos a command, which they hold until the next.

        Args:
            k: Row of the step at which it comes.
            reference: Joint angles q_ref [rad], shape (m,).
        """
        ...


class NumpyLaws:
    """The laws by :mod:`.sim.physics.contact` and :mod:`.sim.physics.servo`."""

    def __init__(
        self, steps: Steps, robot: Robot, ground: Ground | None, servos: Servos, dt: float
    ) -> None:
        """Get ready for one body.

        Args:
            steps: The table that is filled in.
            robot: Who.
            ground: What carries it, if anything does.
            servos: Its servos.
            dt: Step [s].
        """
        radius = np.array([link.radius for link in robot.links])
        self._rows = tuple(steps)
        self._ground = tuple(
            GroundContact(ground, radius, row.body, row.contact) for row in self._rows
        )
        self._servos = servos
        self._dt = dt
        self._reference = np.zeros(steps.joint_count)

    def start(self, k: int) -> None:
        """Complete a step whose body and rotors are there.

        Args:
            k: Its row.
        """
        self._ground[k].act()
        self.command(k, self._reference)

    def follow(self, k: int) -> None:
        """Complete a step whose body is there, and which follows the row before it.

        Args:
            k: Its row, not the first.
        """
        before = self._rows[k - 1]
        self._servos.advance(before.rotors, before.drive, self._dt, self._rows[k].rotors)
        self.start(k)

    def command(self, k: int, reference: FloatArray) -> None:
        """Give the servos a command, which they hold until the next.

        Args:
            k: Row of the step at which it comes.
            reference: Joint angles q_ref [rad], shape (m,).
        """
        self._reference = reference
        row = self._rows[k]
        self._servos.drive(reference, row.body.angle, row.body.rate, row.rotors, row.drive)


def laws_for(
    steps: Steps,
    robot: Robot,
    ground: Ground | None,
    servos: Servos,
    *,
    dt: float,
    kernels: Kernels,
) -> Laws:
    """The laws as they are to be computed.

    Args:
        steps: The table that is filled in.
        robot: Who.
        ground: What carries it, if anything does.
        servos: Its servos.
        dt: Step [s].
        kernels: By what.

    Returns:
        The laws.

    Raises:
        ImportError: If numba is asked for and not installed.
    """
    if kernels is Kernels.NUMPY:
        return NumpyLaws(steps, robot, ground, servos, dt)
    from .compiled_laws import CompiledLaws

    return CompiledLaws(steps, robot, ground, servos, dt)
