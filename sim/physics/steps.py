"""Consecutive physics steps in one table, so that what adds them up works on whole columns.

A row of the table is one step, everything that acts during it as it stands at its start. The fields
of :class:`Step` are views of the rows: of one row, or with a leading axis of time, of all.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import NamedTuple, overload

import numpy as np

from capture.arrays import FloatArray

from .contact import Contact
from .engine import BodyState
from .servo import Drive, Rotors


class Step(NamedTuple):
    """Everything that acts during one physics step, as it stands at its start."""

    body: BodyState
    contact: Contact
    rotors: Rotors
    drive: Drive


_LINK_ROWS = (3, 4, 3, 3, 3, 2, 1, 3)  # the body's poses and velocities, then the contact
_JOINT_COUNT = 7  # angle and rate, then rotors and drive


class Steps(Sequence[Step]):
    """Consecutive steps.

    Attributes:
        table: One row a step, shape (k, 22 n + 7 m).
        link_count: n.
        joint_count: m.
    """

    def __init__(self, table: FloatArray, link_count: int, joint_count: int) -> None:
        """Wrap a table.

        Args:
            table: One row a step, shape (k, 22 n + 7 m).
            link_count: n.
            joint_count: m.
        """
        self.table = table
        self.link_count = link_count
        self.joint_count = joint_count

    @classmethod
    def empty(cls, count: int, link_count: int, joint_count: int) -> Steps:
        """Steps to be filled in.

        Args:
            count: k.
            link_count: n.
            joint_count: m.

        Returns:
            Steps of zeros.
        """
        width = sum(_LINK_ROWS) * link_count + _JOINT_COUNT * joint_count
        return cls(np.zeros((count, width)), link_count, joint_count)

    def copy(self) -> Steps:
        """The same steps in a table of their own."""
        return Steps(self.table.copy(), self.link_count, self.joint_count)

    def __len__(self) -> int:
        """Number of steps."""
        return len(self.table)

    @overload
    def __getitem__(self, index: int) -> Step: ...
    @overload
    def __getitem__(self, index: slice) -> Steps: ...
    def __getitem__(self, index: int | slice) -> Step | Steps:
        """One step, or a stretch of them; views, not copies."""
        if isinstance(index, slice):
            return Steps(self.table[index], self.link_count, self.joint_count)
        return _fields(self.table[index], self.link_count, self.joint_count)

    @cached_property
    def stacked(self) -> Step:
        """All steps as one: each field with a leading axis of time, shape (k, ...)."""
        return _fields(self.table, self.link_count, self.joint_count)


def _fields(table: FloatArray, n: int, m: int) -> Step:
    """The fields of rows, shape (..., width), as views."""
    lead = table.shape[:-1]
    views: list[FloatArray] = []
    end = 0
    for rows in _LINK_ROWS:
        start, end = end, end + rows * n
        view = table[..., start:end]
        views.append(view if rows == 1 else view.reshape(*lead, rows, n))
    for _ in range(_JOINT_COUNT):
        start, end = end, end + m
        views.append(table[..., start:end])
    position, quaternion, velocity, spin, *contact = views[:8]
    angle, rate, *servo = views[8:]
    return Step(
        BodyState(position, quaternion, velocity, spin, angle, rate),
        Contact(*contact),
        Rotors(*servo[:2]),
        Drive(*servo[2:]),
    )
