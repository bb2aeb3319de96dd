"""One entry of a bus map, compiled: where a quantity lies in its frame and what its bits mean.

One signal in the data bytes of many CAN frames at once.

Bit numbering is that of DBC files: bit ``n`` is bit ``n % 8`` (0 the least significant) of byte
``n // 8``. An Intel (little-endian) signal starts at its least significant bit and runs upwards;
a Motorola (big-endian) one starts at its most significant bit and runs downwards through each byte
and on to the next.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ..common.arrays import FloatArray
from ..common.errors import DataError
from ..common.strict_table import Faults
from ..log.messages.frames import EXTENDED_FLAG
from ..robot.bus_map import Unit, database_messages, unit_for
from ..robot.description import check_bus
from ..robot.model import Bus, BusSignal, Quantity, Robot

if TYPE_CHECKING:
    from cantools.database.can import Message
    from cantools.database.can.signal import Signal


_FLOATS: dict[int, type[np.floating[Any]]] = {16: np.float16, 32: np.float32, 64: np.float64}
_UNSIGNED: dict[int, type[np.unsignedinteger[Any]]] = {16: np.uint16, 32: np.uint32, 64: np.uint64}


@dataclass(frozen=True)
class BitField:
    """Where a signal lies and what its bits mean.

    Attributes:
        length: Number of bits, 1 to 64.
        signed: Two's complement.
        is_float: IEEE 754 of 16, 32 or 64 bits.
    """

    start: int
    length: int
    little_endian: bool = True
    signed: bool = False
    is_float: bool = False
    scale: float = 1.0
    offset: float = 0.0

    @classmethod
    def of(cls, signal: Signal) -> BitField:
        """Return the field of a DBC signal."""
        return cls(
            start=signal.start,
            length=signal.length,
            little_endian=signal.byte_order == "little_endian",
            signed=signal.is_signed,
            is_float=signal.is_float,
            scale=float(signal.scale),
            offset=float(signal.offset),
        )

    @property
    def size(self) -> int:
        """Number of data bytes that a frame must have to hold it."""
        first = self.start if self.little_endian else self._from_top
        return (first + self.length - 1) // 8 + 1

    @property
    def _from_top(self) -> int:
        """Position of a Motorola start bit, counted from the top bit of byte 0."""
        return 8 * (self.start // 8) + 7 - self.start % 8

    def raw(self, data: NDArray[np.uint8]) -> NDArray[Any]:
        """Return the bits as numbers, not yet scaled.

        Args:
            data: Data bytes, shape (n, k) with k of 8 or more, C-contiguous; ``size`` is at most k.

        Returns:
            Shape (n,), of type uint64, int64 or the field's floating type.
        """
        unused = 64 - self.length
        # The field goes to the top of the word, so that one shift down drops the bits above it
        # and, arithmetic for signed fields, extends the sign.
        if data.shape[1] == 8:
            words: NDArray[np.uint64] = data.view("<u8" if self.little_endian else ">u8")[:, 0]
            words = words.astype(np.uint64)
            up = unused - self.start if self.little_endian else self._from_top
            top = words << np.uint64(up)
        else:
            top = self._at_top(data, unused)
        if self.is_float:
            bits = (top >> np.uint64(unused)).astype(_UNSIGNED[self.length])
            return bits.view(_FLOATS[self.length])
        if self.signed:
            return top.view(np.int64) >> np.int64(unused)
        return top >> np.uint64(unused)

    def _at_top(self, data: NDArray[np.uint8], unused: int) -> NDArray[np.uint64]:
        """Return the field at the top of words, out of more than 8 bytes.

        A word is taken where the field begins; one that doesn't begin with a byte may reach into a
        ninth.
        """
        position = self.start if self.little_endian else self._from_top
        first = min(position // 8, data.shape[1] - 8)
        shift = position - 8 * first
        window = np.ascontiguousarray(data[:, first : first + 8])
        words = window.view("<u8" if self.little_endian else ">u8")[:, 0].astype(np.uint64)
        over = shift + self.length - 64
        if not self.little_endian:
            words <<= np.uint64(shift)
            if over > 0:
                words |= data[:, first + 8].astype(np.uint64) >> np.uint64(8 - shift)
            return words
        if over <= 0:
            return words << np.uint64(unused - shift)
        words >>= np.uint64(shift)
        words |= data[:, first + 8].astype(np.uint64) << np.uint64(64 - shift)
        return words << np.uint64(unused)

    def values(self, data: NDArray[np.uint8]) -> FloatArray:
        """Return the physical values.

        Args:
            data: Data bytes, shape (n, k) with k of 8 or more, C-contiguous; ``size`` is at most k.

        Returns:
            ``scale * raw + offset``, shape (n,).
        """
        with np.errstate(invalid="ignore"):  # a NaN in the frame is a NaN in the log
            return self.raw(data).astype(np.float64) * self.scale + self.offset

    def raw_range(self, lower: float = -math.inf, upper: float = math.inf) -> tuple[float, float]:
        """Return the least and the greatest raw number of a range of physical values.

        Returns:
            Whole numbers that the field can hold; of a floating field any numbers.
        """
        least, greatest = -math.inf, math.inf
        if not self.is_float:
            least = -(1 << (self.length - 1)) if self.signed else 0
            greatest = least + (1 << self.length) - 1
        first, last = sorted((bound - self.offset) / self.scale for bound in (lower, upper))
        if not self.is_float:
            first, last = (round(x) if math.isfinite(x) else x for x in (first, last))
        return max(least, first), min(greatest, last)

    def raw_bits(self, value: float, within: tuple[float, float] | None = None) -> int:
        """Return the bits of a physical value, the inverse of :meth:`values`.

        Args:
            value: Not NaN; what the field can't hold becomes the nearest that it can.
            within: From :meth:`raw_range`; all that the field can hold if None.

        Returns:
            ``length`` bits, two's complement or IEEE 754.
        """
        least, greatest = within or self.raw_range()
        raw = (value - self.offset) / self.scale
        raw = least if raw < least else min(raw, greatest)
        if not self.is_float:
            return round(raw) & ((1 << self.length) - 1)
        with np.errstate(over="ignore"):  # beyond a narrow float's range is infinite
            number = np.array(raw, dtype=_FLOATS[self.length])
        return int(number.view(_UNSIGNED[self.length]))

    def placed(self, bits: int, size: int) -> int:
        """Return bits at their place in a frame's data.

        Returns:
            The data as one little-endian number, zero elsewhere: those of several fields are
            joined by "or".
        """
        if self.little_endian:
            return bits << self.start
        number = bits << (8 * size - self._from_top - self.length)
        return int.from_bytes(number.to_bytes(size, "big"), "little")


Conditions: TypeAlias = tuple[tuple[BitField, tuple[int, ...]], ...]
"""The multiplexers that select a signal, each with the values that do."""


@dataclass(frozen=True)
class MapEntry:
    """Where a map entry lies in its frame and what its bits mean.

    Attributes:
        quantity: What it is of its target.
        axis: Axis of a vector quantity, else empty.
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
        """Return values in the session's unit.

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
        """Return the DBC's physical value of a value: the inverse of :meth:`values`."""
        return ((value - self.unit.offset) / self.unit.factor - self.offset) / self.scale


def bus_messages(robot: Robot) -> tuple[Bus, Mapping[str, Message]]:
    """Return a robot's bus map, and the messages of its databases by name.

    Raises:
        DataError: If the robot has no bus, or not the databases that its map needs.
        RobotFileError: If the map or the databases have faults.
    """
    if robot.bus is None:
        raise DataError(
            f"the robot {robot.name} has no bus map; frames can't be encoded or decoded"
        )
    check_bus(robot)
    messages = database_messages(dict(robot.databases), Faults()) or {}
    named = {signal.message for signal in (*robot.bus.signals, *robot.bus.polls)}
    if missing := named - set(messages):
        raise DataError(f"no database of {robot.name} has {', '.join(sorted(missing))}")
    return robot.bus, messages


def frame_id(message: Message) -> int:
    """Return a message's identifier with the flags of :mod:`.capture.log.messages.frames`."""
    return message.frame_id | (EXTENDED_FLAG if message.is_extended_frame else 0)


def conditions_of(signal: Signal, by_name: Mapping[str, Signal]) -> Conditions:
    """Return the multiplexers that select a signal of a message, the nearest first."""
    conditions: list[tuple[BitField, tuple[int, ...]]] = []
    while signal.multiplexer_signal is not None:
        identifiers = tuple(signal.multiplexer_ids or ())
        signal = by_name[signal.multiplexer_signal]
        conditions.append((BitField.of(signal), identifiers))
    return tuple(conditions)


def compile_entry(message: Message, signal: BusSignal) -> MapEntry:
    """Compile one entry."""
    by_name = {signal.name: signal for signal in message.signals}
    dbc_signal = by_name[signal.signal]
    bits = BitField.of(dbc_signal)
    conditions = conditions_of(dbc_signal, by_name)
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
