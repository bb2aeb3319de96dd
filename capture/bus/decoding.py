"""From raw CAN frames to the quantities of joints and sensors.

A :class:`BusDecoder` is compiled once from a robot's databases and bus map and then decodes whole
arrays of frames by bit slicing. No frame goes unaccounted for: what carries nothing that the map
names is counted, by reason, in a :class:`FrameTally`.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ..arrays import BoolArray, FloatArray, IntArray
from ..errors import DataError
from ..log.frames import (
    DIR_RX,
    DIR_TX,
    ERROR_FLAG,
    EXTENDED_FLAG,
    ID_MASK,
    REMOTE_FLAG,
    FrameArray,
)
from ..robot import BusSignal, Direction, Quantity, Robot
from ..robot.bus_map import database_messages
from ..strict_table import Faults
from ..units import SESSION_UNIT, Unit, unit_for
from .bit_field import BitField

if TYPE_CHECKING:
    from cantools.database.can import Message

_WAY = {Direction.RX: DIR_RX, Direction.TX: DIR_TX}
_TX_BIT = 1 << 32  # above the 32 bits of id_flags
Carrier: TypeAlias = tuple[int, tuple[tuple[int, ...], ...]]
"""One kind of frame: identifier and direction, and the multiplexer values that select a signal."""

_BODY = np.uint32(EXTENDED_FLAG | ID_MASK)


@dataclass(frozen=True)
class DecodedSignal:
    """The samples of one entry of the bus map.

    Attributes:
        signal: The entry.
        unit: The session's unit of its quantity.
        rows: Rows of the frames that carry it, increasing, shape (n,).
        t_ns: Host time of these frames [Unix ns], shape (n,).
        values: In ``unit``, shape (n,).
    """

    signal: BusSignal
    unit: str
    rows: IntArray
    t_ns: IntArray
    values: FloatArray


@dataclass
class FrameTally:
    """What became of the frames.

    Attributes:
        frames: All frames.
        decoded: Frames with at least one sample.
        errors: Error frames.
        remote: Remote frames; they carry no data.
        unknown: Identifier to number of data frames that no database knows.
        silent: Identifier to number of data frames that the databases know and whose contents the
            map doesn't name, e.g. requests.
        short: Signal, as ``message.signal``, to number of frames too short to hold it.
        undirected: Identifier to number of frames that only their direction could tell apart, in a
            log without directions.
    """

    frames: int = 0
    decoded: int = 0
    errors: int = 0
    remote: int = 0
    unknown: Counter[str] = field(default_factory=Counter[str])
    silent: Counter[str] = field(default_factory=Counter[str])
    short: Counter[str] = field(default_factory=Counter[str])
    undirected: Counter[str] = field(default_factory=Counter[str])

    def add(self, other: FrameTally) -> None:
        """Count further frames.

        Args:
            other: Their tally.
        """
        self.frames += other.frames
        self.decoded += other.decoded
        self.errors += other.errors
        self.remote += other.remote
        self.unknown += other.unknown
        self.silent += other.silent
        self.short += other.short
        self.undirected += other.undirected

    def problems(self) -> list[str]:
        """One sentence for each kind of frame that should not be there or lost its samples."""
        lines: list[str] = []
        if self.errors:
            lines.append(f"{self.errors} error frames")
        if self.short:
            lines.append(
                f"{self.short.total()} values missing from frames too short for them: "
                f"{_counts(self.short)}"
            )
        if self.undirected:
            lines.append(
                f"{self.undirected.total()} frames not decoded, since only their direction tells "
                f"what they are and the log has none: {_counts(self.undirected)}"
            )
        return lines

    def notes(self) -> list[str]:
        """One sentence for each kind of frame that is in order and brings no sample."""
        lines: list[str] = []
        if self.remote:
            lines.append(f"{self.remote} remote frames, which carry no data")
        if self.unknown:
            lines.append(
                f"{self.unknown.total()} frames of identifiers that no database knows: "
                f"{_counts(self.unknown)}"
            )
        if self.silent:
            lines.append(
                f"{self.silent.total()} frames of known identifiers with nothing that the map "
                f"names: {_counts(self.silent)}"
            )
        return lines


def _counts(counter: Counter[str], most: int = 8) -> str:
    parts = [f"{name} ({count})" for name, count in counter.most_common(most)]
    more = len(counter) - len(parts)
    return ", ".join(parts) + (f" and {more} more" if more else "")


def identifier_text(id_flags: int) -> str:
    """An identifier as candump writes it: three hexadecimal digits, or eight if extended.

    Args:
        id_flags: Identifier with flags.

    Returns:
        E.g. ``14B`` or ``18FEF100``.
    """
    return f"{id_flags & ID_MASK:0{8 if id_flags & EXTENDED_FLAG else 3}X}"


@dataclass(frozen=True)
class _Entry:
    """A map entry, compiled."""

    signal: BusSignal
    label: str
    bits: BitField
    unit: Unit
    conditions: tuple[tuple[BitField, NDArray[np.uint64]], ...]  # multiplexers that select it
    size: int  # data bytes needed, multiplexers included

    @property
    def selection(self) -> tuple[tuple[int, ...], ...]:
        return tuple(tuple(identifiers.tolist()) for _, identifiers in self.conditions)


class BusDecoder:
    """The databases and the bus map of a robot, compiled."""

    def __init__(self, robot: Robot, *, directions: bool = True) -> None:
        """Compile.

        Args:
            robot: The robot; its databases have been checked when it was read.
            directions: Whether the frames' directions are known. If not, an identifier that the
                map uses in one direction only is decoded whichever way its frames are marked.

        Raises:
            DataError: If the robot has no bus, or not the databases that its map needs.
        """
        if robot.bus is None:
            raise DataError(f"the robot {robot.name} has no bus map; frames can't be decoded")
        messages = database_messages(dict(robot.databases), Faults()) or {}
        if missing := {signal.message for signal in robot.bus.signals} - set(messages):
            raise DataError(f"no database of {robot.name} has {', '.join(sorted(missing))}")
        self._entries: dict[int, list[_Entry]] = {}
        for signal in robot.bus.signals:
            message = messages[signal.message]
            key = _key(message) | (_TX_BIT if signal.direction is Direction.TX else 0)
            self._entries.setdefault(key, []).append(_compile(message, signal))
        self._known = {_key(message) for message in messages.values()}
        self._undirected: set[int] = set()
        if not directions:
            for identifier in self._known:
                ways = [key for key in (identifier, identifier | _TX_BIT) if key in self._entries]
                if len(ways) == 1:
                    self._entries[identifier] = self._entries[ways[0]]
                elif ways:
                    self._undirected.add(identifier)
        self._directions = directions

    def carriers(self, target: str, quantity: Quantity) -> frozenset[Carrier]:
        """What kinds of frame bring a quantity; equal sets mean the same frames.

        Args:
            target: Name of a joint or sensor.
            quantity: What it is of that target.

        Returns:
            Key of identifier and direction, with the multiplexer values that select the signal.
        """
        return frozenset(
            (key, entry.selection)
            for key, entries in self._entries.items()
            for entry in entries
            if entry.signal.target == target and entry.signal.quantity is quantity
        )

    def decode(self, frames: FrameArray) -> tuple[tuple[DecodedSignal, ...], FrameTally]:
        """Decode frames.

        Args:
            frames: Records of :data:`capture.log.frames.FRAME_DTYPE`, shape (n,).

        Returns:
            The samples of each map entry that occurs, and what became of the frames.
        """
        id_flags = frames["id_flags"]
        is_error = (id_flags & np.uint32(ERROR_FLAG)) != 0
        is_remote = ~is_error & ((id_flags & np.uint32(REMOTE_FLAG)) != 0)
        tally = FrameTally(len(frames), 0, int(is_error.sum()), int(is_remote.sum()))
        data_rows = np.flatnonzero(~is_error & ~is_remote)
        keys = (id_flags[data_rows] & _BODY).astype(np.int64)
        if self._directions:
            keys |= np.where(frames["dir"][data_rows] == DIR_TX, _TX_BIT, 0)
        order = np.argsort(keys, kind="stable")
        keys, first = np.unique(keys[order], return_index=True)
        samples: list[DecodedSignal] = []
        for key, rows in zip(keys.tolist(), np.split(data_rows[order], first[1:]), strict=True):
            identifier = key & ~_TX_BIT
            name = identifier_text(identifier)
            if identifier in self._undirected:
                tally.undirected[name] += len(rows)
            elif key in self._entries:
                samples += self._decode_group(frames[rows], rows, self._entries[key], tally, name)
            elif identifier in self._known:
                tally.silent[name] += len(rows)
            else:
                tally.unknown[name] += len(rows)
        return tuple(samples), tally

    @staticmethod
    def _decode_group(
        frames: FrameArray, rows: IntArray, entries: list[_Entry], tally: FrameTally, name: str
    ) -> list[DecodedSignal]:
        """Decode the frames of one identifier and direction; ``rows`` are their rows in all."""
        data: NDArray[np.uint8] = np.ascontiguousarray(frames["data"])
        size = np.minimum(frames["dlc"], 8)
        t_ns = frames["t_host_ns"].astype(np.int64)
        carries = np.zeros(len(frames), dtype=np.bool_)
        mentioned = np.zeros(len(frames), dtype=np.bool_)
        samples: list[DecodedSignal] = []
        for entry in entries:
            selected = _selected(data, size, entry)
            whole = selected & (size >= entry.size)
            mentioned |= selected
            carries |= whole
            if missing := int(selected.sum() - whole.sum()):
                tally.short[entry.label] += missing
            if whole.any():
                decoded = entry.bits.values(data[whole])
                values = entry.unit.convert(entry.signal.scale * decoded + entry.signal.offset)
                unit = SESSION_UNIT[entry.signal.quantity]
                samples.append(DecodedSignal(entry.signal, unit, rows[whole], t_ns[whole], values))
        tally.decoded += int(carries.sum())
        if silent := int((~mentioned).sum()):
            tally.silent[name] += silent
        return samples


def _selected(data: NDArray[np.uint8], size: NDArray[np.uint8], entry: _Entry) -> BoolArray:
    """Frames that are meant to carry the entry: every multiplexer above it selects it.

    A frame too short for a multiplexer counts as selected, hence as too short.
    """
    selected = np.ones(len(data), dtype=np.bool_)
    for multiplexer, identifiers in entry.conditions:
        if multiplexer.size <= data.shape[1]:
            fits = np.isin(multiplexer.raw(data).astype(np.uint64), identifiers)
            selected &= fits | (size < multiplexer.size)
    return selected


def _key(message: Message) -> int:
    return message.frame_id | (EXTENDED_FLAG if message.is_extended_frame else 0)


def _compile(message: Message, signal: BusSignal) -> _Entry:
    by_name = {each.name: each for each in message.signals}
    wanted = by_name[signal.signal]
    bits = BitField.of(wanted)
    size = bits.size
    conditions: list[tuple[BitField, NDArray[np.uint64]]] = []
    while wanted.multiplexer_signal is not None:
        identifiers = np.array(wanted.multiplexer_ids or [], dtype=np.uint64)
        wanted = by_name[wanted.multiplexer_signal]
        multiplexer = BitField.of(wanted)
        conditions.append((multiplexer, identifiers))
        size = max(size, multiplexer.size)
    return _Entry(
        signal=signal,
        label=f"{signal.message}.{signal.signal}",
        bits=bits,
        unit=unit_for(signal.unit, signal.quantity),
        conditions=tuple(conditions),
        size=size,
    )
