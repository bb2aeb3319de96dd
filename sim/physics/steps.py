"""Consecutive physics steps in one table, and the force laws of ground and servos that fill it in.

What adds the steps up works on whole columns of the table.

A row of the table is one step, everything that acts during it as it stands at its start. The fields
of :class:`Step` are views of the rows: of one row, or with a leading axis of time, of all. What
touches obstacles differs in number from step to step, so it is kept beside the table.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple, Protocol, TypeAlias, overload

import numpy as np

from undulog.capture.common.arrays import FloatArray
from undulog.capture.robot.model import Robot

from ..scenario.world import Ground
from .contact import Contact, GroundLaw
from .engine import BodyState
from .obstacle_contact import NO_CONTACT, ObstacleContact
from .servo import Drive, Rotors, Servos


class Step(NamedTuple):
    """Everything that acts during one physics step, as it stands at its start."""

    body: BodyState
    contact: Contact
    rotors: Rotors
    drive: Drive
    obstacles: ObstacleContact = NO_CONTACT


@dataclass(eq=False)
class Steps(Sequence[Step]):
    """Consecutive steps.

    Attributes:
        table: One row a step, shape (k, 22 n + 7 m).
        link_count: n.
        joint_count: m.
        obstacles: What touches obstacles, one entry a step.
        pushes: Forces on the links' centres from outside [N], shape (k, 3, n); None for none.
    """

    table: FloatArray
    link_count: int
    joint_count: int
    obstacles: list[ObstacleContact] = field(default_factory=list[ObstacleContact])
    pushes: FloatArray | None = None

    def __post_init__(self) -> None:
        """Have nothing touch an obstacle by default."""
        self.obstacles = self.obstacles or [NO_CONTACT] * len(self.table)

    @classmethod
    def empty(cls, count: int, link_count: int, joint_count: int) -> Steps:
        """Steps to be filled in.

        Args:
            count: k.
            link_count: n.
            joint_count: m.
        """
        return cls(np.zeros((count, 22 * link_count + 7 * joint_count)), link_count, joint_count)

    @cached_property
    def _views(self) -> _Parts:
        return _parts(self.table, self.link_count, self.joint_count)

    @property
    def links(self) -> FloatArray:
        """The links' fields of :class:`.sim.physics.engine.BodyState`, a view, shape (k, 13, n)."""
        return self._views[0]

    @property
    def motion(self) -> FloatArray:
        """Joint angles and rates of all steps, a view, shape (k, 2, m)."""
        return self._views[1]

    @property
    def touch(self) -> FloatArray:
        """All of :class:`.sim.physics.contact.Contact` of all steps, a view, shape (k, 9, n)."""
        return self._views[2]

    @property
    def motors(self) -> FloatArray:
        """The rotors' and then the drives' fields of all steps, a view, shape (k, 5, m)."""
        return self._views[3]

    @property
    def drives(self) -> FloatArray:
        """Voltages, currents and torques of all steps, a view, shape (k, 3, m)."""
        return self.motors[:, 2:]

    def taken(self, k: int) -> Step:
        """One step, in arrays of its own."""
        step = _fields(self.table[k].copy(), self.link_count, self.joint_count)
        return step._replace(obstacles=self.obstacles[k])

    def copy(self) -> Steps:
        """The same steps in a table of their own."""
        sizes = self.link_count, self.joint_count
        return Steps(self.table.copy(), *sizes, self.obstacles.copy(), self.pushes)

    def __len__(self) -> int:
        """Number of steps."""
        return len(self.table)

    @overload
    def __getitem__(self, index: int) -> Step: ...
    @overload
    def __getitem__(self, index: slice) -> Steps: ...
    def __getitem__(self, index: int | slice) -> Step | Steps:
        """One step, or a stretch of them; views, not copies."""
        sizes = self.link_count, self.joint_count
        if isinstance(index, slice):
            pushes = None if self.pushes is None else self.pushes[index]
            return Steps(self.table[index], *sizes, self.obstacles[index], pushes)
        return _fields(self.table[index], *sizes)._replace(obstacles=self.obstacles[index])

    @cached_property
    def stacked(self) -> Step:
        """All steps as one: each field with a leading axis of time, shape (k, ...).

        What touches obstacles is not in it.
        """
        return _fields(self.table, self.link_count, self.joint_count)


_Parts: TypeAlias = tuple[FloatArray, FloatArray, FloatArray, FloatArray]


def _parts(table: FloatArray, n: int, m: int) -> _Parts:
    """Links, joints, touch and motors of rows, shape (..., width), as views."""
    lead, acting, servos = table.shape[:-1], 13 * n + 2 * m, 22 * n + 2 * m
    return (
        table[..., : 13 * n].reshape(*lead, 13, n),
        table[..., 13 * n : acting].reshape(*lead, 2, m),
        table[..., acting:servos].reshape(*lead, 9, n),
        table[..., servos:].reshape(*lead, 5, m),
    )


def _fields(table: FloatArray, n: int, m: int) -> Step:
    """The fields of rows, shape (..., width), as views."""
    links, joints, touch, motors = _parts(table, n, m)
    return Step(
        BodyState(
            *(links[..., :3, :], links[..., 3:7, :], links[..., 7:10, :], links[..., 10:, :]),
            *(joints[..., 0, :], joints[..., 1, :]),
        ),
        Contact(touch[..., :3, :], touch[..., 3:5, :], touch[..., 5, :], touch[..., 6:, :]),
        Rotors(motors[..., 0, :], motors[..., 1, :]),
        Drive(motors[..., 2, :], motors[..., 3, :], motors[..., 4, :]),
    )


class Laws(Protocol):
    """What fills in a step once its body is there."""

    def start(self, k: int) -> None:
        """Complete a step whose body and rotors are there."""

    def follow(self, k: int) -> None:
        """Complete a step whose body is there, and which follows the row before it.

        Args:
            k: Its row, not the first.
        """

    def command(self, k: int, reference: FloatArray) -> None:
        """Give the servos a command, which they hold until the next.

        Args:
            k: Row of the step at which it comes.
            reference: Joint angles q_ref [rad], shape (m,).
        """


class NumpyLaws:
    """The laws by :mod:`.sim.physics.contact` and :mod:`.sim.physics.servo`."""

    def __init__(
        self, steps: Steps, robot: Robot, ground: Ground | None, servos: Servos, dt: float
    ) -> None:
        """Get ready for one body.

        Args:
            steps: The table that is filled in.
            ground: What carries it, if anything does.
            dt: Step [s].
        """
        radius = np.array([link.radius for link in robot.links])
        self._rows = tuple(steps)
        self._ground = tuple(GroundLaw(ground, radius, row.body, row.contact) for row in self._rows)
        self._servos, self._dt = servos, dt
        self._reference = np.zeros(steps.joint_count)

    def start(self, k: int) -> None:
        """Complete a step whose body and rotors are there."""
        self._ground[k].act()
        self.command(k, self._reference)

    def follow(self, k: int) -> None:
        """Complete a step whose body is there, and which follows the row before it."""
        before = self._rows[k - 1]
        self._servos.advance(before.rotors, before.drive, self._dt, self._rows[k].rotors)
        self.start(k)

    def command(self, k: int, reference: FloatArray) -> None:
        """Give the servos a command, which they hold until the next."""
        self._reference = reference
        row = self._rows[k]
        self._servos.drive(reference, row.body.angle, row.body.rate, row.rotors, row.drive)
