"""The force laws compiled: as :class:`.sim.physics.laws.NumpyLaws`, within rounding.

Importing it needs the extra ``numba``. The first import on a machine compiles, which takes some
seconds; later ones load what was compiled.
"""

from __future__ import annotations

import numpy as np

from undulog.capture.common.arrays import FloatArray
from undulog.capture.robot.model import Robot

from ..scenario.world import Ground
from . import kernels
from .servo import Servos
from .steps import Steps


class CompiledLaws:
    """The laws by :mod:`.sim.physics.kernels`."""

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
        surface = ground or Ground(stiffness=0.0, damping=0.0, drag_tangential=0.0, drag_normal=0.0)
        self._rows = tuple(steps.table)
        self._sizes = steps.link_count, steps.joint_count
        self._radius = np.array([link.radius for link in robot.links])
        self._ground = np.array(
            [
                *(surface.stiffness, surface.damping, surface.mu_tangential, surface.mu_normal),
                *(surface.slip_speed, surface.drag_tangential, surface.drag_normal),
            ]
        )
        self._law = kernels.LAWS.index(surface.law)
        self._servos = servos.table
        self._dt = dt
        self._reference = np.zeros(steps.joint_count)

    def start(self, k: int) -> None:
        """Complete a step whose body and rotors are there.

        Args:
            k: Its row.
        """
        kernels.touch_ground(self._rows[k], *self._sizes, self._radius, self._ground, self._law)
        self.command(k, self._reference)

    def follow(self, k: int) -> None:
        """Complete a step whose body is there, and which follows the row before it.

        Args:
            k: Its row, not the first.
        """
        kernels.act(
            self._rows[k - 1],
            self._rows[k],
            *self._sizes,
            self._radius,
            self._ground,
            self._law,
            self._reference,
            self._servos,
            self._dt,
        )

    def command(self, k: int, reference: FloatArray) -> None:
        """Give the servos a command, which they hold until the next.

        Args:
            k: Row of the step at which it comes.
            reference: Joint angles q_ref [rad], shape (m,).
        """
        self._reference = np.ascontiguousarray(reference)
        kernels.drive_joints(self._rows[k], *self._sizes, self._reference, self._servos)
