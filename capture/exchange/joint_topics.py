"""JointState topics of a table: which quantities share one, and its rows as messages."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise

import numpy as np

from ..bus.decoded_topics import JOINT_TOPIC
from ..common.arrays import BoolArray, FloatArray, IntArray
from ..log.write.channels import JointStateChannel
from ..log.write.writer import SessionWriter
from ..robot.bus_map import SESSION_UNIT
from ..robot.model import Quantity

_WITH_POSITION = (Quantity.VELOCITY, Quantity.EFFORT)
"""What stands beside a position of the same row."""

_MOST_PARTS = 100
"""Sets of joints that have a value together; in further ones the others have NaN."""


def topics_of(present: set[Quantity]) -> Iterator[tuple[Quantity, ...]]:
    """Yield the quantities of each topic; a row's velocity and effort belong to its position."""
    together = [q for q in _WITH_POSITION if q in present and Quantity.POSITION in present]
    for quantity in JOINT_TOPIC:
        if quantity is Quantity.POSITION and quantity in present:
            yield (quantity, *together)
        elif quantity in present and quantity not in together:
            yield (quantity,)


class JointTopic:
    """One JointState topic of a table, with the joints that have a column for it."""

    def __init__(
        self,
        writer: SessionWriter,
        columns: Sequence[tuple[str, Quantity]],
        quantities: Sequence[Quantity],
    ) -> None:
        """Open the topic.

        Args:
            columns: Joint and quantity of each column, the joints in their order in a message.
            quantities: One of :func:`topics_of`.
        """
        self._joints = list(dict.fromkeys(joint for joint, each in columns if each in quantities))
        self._fields = (quantities[0], *(q for q in _WITH_POSITION if q in quantities[1:]))
        self._rest = [q in quantities[1:] for q in _WITH_POSITION]
        self.name = JOINT_TOPIC[quantities[0]]
        velocity, effort = self._rest
        self._channel = writer.joint_state(
            self.name, self._joints, unit=SESSION_UNIT[quantities[0]],
            velocity=velocity, effort=effort,
        )  # fmt: skip
        self._parts: dict[bytes, JointStateChannel] = {}

    def write(self, t_ns: IntArray, values: Mapping[tuple[str, Quantity], FloatArray]) -> int:
        """Write the rows that have any value; a joint without any value in a row has no sample.

        Args:
            t_ns: Times of the rows [Unix ns], shape (n,).
            values: Joint and quantity to cells, (n,).

        Returns:
            Number of rows written.
        """
        fields = np.full((len(self._fields), len(t_ns), len(self._joints)), np.nan)
        for field, quantity in zip(fields, self._fields, strict=True):
            for k, joint in enumerate(self._joints):
                if (cells := values.get((joint, quantity))) is not None:
                    field[:, k] = cells
        absent = np.isnan(fields)
        if not absent.any():
            self._write_part(t_ns, fields, np.ones(len(self._joints), dtype=bool))
            return len(t_ns)
        sampled: BoolArray = ~np.all(absent, axis=0)
        filled = np.any(sampled, axis=1)
        if not filled.all():
            t_ns, fields, sampled = t_ns[filled], fields[:, filled], sampled[filled]
        if not len(t_ns):
            return 0
        changes = np.flatnonzero(np.any(sampled[1:] != sampled[:-1], axis=1)) + 1
        edges = [0, *changes.tolist(), len(t_ns)]
        for start, stop in pairwise(edges):
            self._write_part(t_ns[start:stop], fields[:, start:stop], sampled[start])
        return len(t_ns)

    def _write_part(self, t_ns: IntArray, fields: FloatArray, sampled: BoolArray) -> None:
        """Write rows, of shape (fields, n, joints), that all have samples of the same joints."""
        channel, which = self._part(sampled)
        rows = iter(fields if which.all() else fields[:, :, which])
        none = np.empty((len(t_ns), 0))
        position = next(rows)
        velocity, effort = (next(rows) if present else none for present in self._rest)
        channel.write_rows(t_ns, position, velocity, effort)

    def _part(self, sampled: BoolArray) -> tuple[JointStateChannel, BoolArray]:
        """Return the channel of some joints, and which they are; all if there are too many sets."""
        key = sampled.tobytes()
        if key not in self._parts and not sampled.all() and len(self._parts) < _MOST_PARTS:
            names = [name for name, is_in in zip(self._joints, sampled, strict=True) if is_in]
            self._parts[key] = self._channel.part(names)
        if key not in self._parts:
            return self._channel, np.ones_like(sampled)
        return self._parts[key], sampled
