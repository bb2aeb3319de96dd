"""One entry of a bus map, compiled: where a quantity lies in its frame and what its bits mean."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ..common.arrays import FloatArray
from ..common.errors import DataError
from ..common.strict_table import Faults
from ..log.messages.frames import EXTENDED_FLAG
from ..robot.bus_map import database_messages
from ..robot.model import Bus, BusSignal, Quantity, Robot
from ..robot.units import Unit, unit_for
from .bit_field import BitField

if TYPE_CHECKING:
    from cantools.database.can import Message
    from cantools.database.can.signal import Signal


Conditions: TypeAlias = tuple[tuple[BitField, tuple[int, ...]], ...]
"""The multiplexers that select a signal, each with the values that do."""


@dataclass(frozen=True)
class MapEntry:
    """Where a map entry lies in its frame and what its bits mean.

    Attributes:
        quantity: What it is of its target.
        axis: Axis of a vector quantity, else empty.
        bits: The signal.
        unit: Unit of the decoded value.
        scale: Applied to the decoded value.
        offset: Added after ``scale``.
        conditions: The multiplexers that select it, each with the values that do.
        size: Data bytes needed, multiplexers included.
        unknown: Raw number that stands for NaN, or None.
        out_of_range: Raw number that stands for +inf, or None.
    """

    quantity: Quantity
    axis: str
    bits: BitField
    unit: Unit
    scale: float
    offset: float
    conditions: Conditions
    size: int
    unknown: int | None = None
    out_of_range: int | None = None

    @property
    def selection(self) -> tuple[tuple[int, ...], ...]:
        """The multiplexer values that select it."""
        return tuple(identifiers for _, identifiers in self.conditions)

    def values(self, data: NDArray[np.uint8]) -> FloatArray:
        """Values in the session's unit.

        Args:
            data: Data bytes, shape (n, k) with k of 8 or more, C-contiguous.

        Returns:
            Shape (n,).
        """
        values = self.unit.convert(self.scale * self.bits.values(data) + self.offset)
        if self.unknown is not None:
            values[self.bits.raw(data) == self.unknown] = np.nan
        if self.out_of_range is not None:
            values[self.bits.raw(data) == self.out_of_range] = np.inf
        return values

    def physical(self, value: float) -> float:
        """The DBC's physical value of a value: the inverse of what :meth:`values` does with it.

        Args:
            value: In the session's unit.

        Returns:
            The value that the DBC's own scale and offset apply to.
        """
        return ((value - self.unit.offset) / self.unit.factor - self.offset) / self.scale


def bus_messages(robot: Robot) -> tuple[Bus, Mapping[str, Message]]:
    """A robot's bus map and the messages of its databases.

    Args:
        robot: The robot; its databases have been checked when it was read.

    Returns:
        The map, and message name to message.

    Raises:
        DataError: If the robot has no bus, or not the databases that its map needs.
    """
    if robot.bus is None:
        raise DataError(
            f"the robot {robot.name} has no bus map; frames can't be encoded or decoded"
        )
    messages = database_messages(dict(robot.databases), Faults()) or {}
    named = {each.message for each in (*robot.bus.signals, *robot.bus.polls)}
    if missing := named - set(messages):
        raise DataError(f"no database of {robot.name} has {', '.join(sorted(missing))}")
    return robot.bus, messages


def frame_id(message: Message) -> int:
    """A message's identifier with the flags of :mod:`.capture.log.messages.frames`.

    Args:
        message: The message.

    Returns:
        The identifier.
    """
    return message.frame_id | (EXTENDED_FLAG if message.is_extended_frame else 0)


def conditions_of(signal: Signal, by_name: Mapping[str, Signal]) -> Conditions:
    """What selects a signal.

    Args:
        signal: The signal.
        by_name: All signals of its message.

    Returns:
        The multiplexers above it, the nearest first.
    """
    conditions: list[tuple[BitField, tuple[int, ...]]] = []
    while signal.multiplexer_signal is not None:
        identifiers = tuple(signal.multiplexer_ids or ())
        signal = by_name[signal.multiplexer_signal]
        conditions.append((BitField.of(signal), identifiers))
    return tuple(conditions)


def compile_entry(message: Message, signal: BusSignal) -> MapEntry:
    """Compile one entry.

    Args:
        message: The message that carries it.
        signal: The entry.

    Returns:
        The entry, compiled.
    """
    by_name = {each.name: each for each in message.signals}
    wanted = by_name[signal.signal]
    bits = BitField.of(wanted)
    conditions = conditions_of(wanted, by_name)
    return MapEntry(
        quantity=signal.quantity,
        axis=signal.axis,
        bits=bits,
        unit=unit_for(signal.unit, signal.quantity),
        scale=signal.scale,
        offset=signal.offset,
        conditions=conditions,
        size=max([bits.size, *(multiplexer.size for multiplexer, _ in conditions)]),
        unknown=signal.unknown,
        out_of_range=signal.out_of_range,
    )
