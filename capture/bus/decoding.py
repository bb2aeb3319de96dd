"""From raw CAN frames to the quantities of joints and sensors.

A :class:`BusDecoder` is compiled once from a robot's databases and bus map and then decodes whole
arrays of frames by bit slicing. No frame goes unaccounted for: what carries nothing that the map
names is counted, by reason, in a :class:`FrameTally`.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field, fields
from typing import Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ..common.arrays import BoolArray, FloatArray, IntArray
from ..log.health.bus_tally import counts_text
from ..log.messages.frames import (
    DIR_TX,
    ERROR_FLAG,
    EXTENDED_FLAG,
    ID_MASK,
    REMOTE_FLAG,
    FrameArray,
    identifier_text,
)
from ..robot.bus_map import SESSION_UNIT
from ..robot.model import BusSignal, Direction, Quantity, Robot
from .map_entry import MapEntry, bus_messages, compile_entry, frame_id

_TX_BIT = 1 << 32  # above the 32 bits of id_flags
Carrier: TypeAlias = tuple[int, tuple[tuple[int, ...], ...]]
"""One kind of frame: identifier and direction, and the multiplexer values that select a signal."""

_BODY = np.uint32(EXTENDED_FLAG | ID_MASK)

_SILENT, _UNDIRECTED = -1, -2


@dataclass(frozen=True)
class DecodedSignals:
    """The samples of map entries that lie alike in their frames, such as the angles of all joints.

    Attributes:
        signals: The entries, m of them; they have one quantity and one axis.
        unit: The session's unit of that quantity.
        rows: Rows of the frames that carry them, increasing, shape (n,).
        member: Index into ``signals`` of each sample, shape (n,).
        t_ns: Host time of these frames [Unix ns], shape (n,).
        values: In ``unit``, shape (n,).
    """

    signals: tuple[BusSignal, ...]
    unit: str
    rows: IntArray
    member: IntArray
    t_ns: IntArray
    values: FloatArray


@dataclass
class FrameTally:
    """Count of frames by result.

    Attributes:
        decoded: Frames with at least one sample.
        remote: Remote frames; they carry no data.
        unknown: Identifier to number of data frames that are in no database.
        silent: Identifier to number of data frames that the databases know and whose contents the
            map doesn't name, e.g. requests.
        short: Signal, as ``message.signal``, to number of frames too short to hold it.
        undirected: Identifier to number of frames that differ only in their direction, in a
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
        """Count further frames."""
        for item in fields(self):
            setattr(self, item.name, getattr(self, item.name) + getattr(other, item.name))

    def problems(self) -> list[str]:
        """Return a sentence for each kind of frame that is an error or lost its samples."""
        why = "they differ only in direction, which the log does not have"
        return [
            *([f"{self.errors} error frames"] if self.errors else []),
            *_counted(self.short, "values missing from frames too short for them"),
            *_counted(self.undirected, f"frames not decoded: {why}"),
        ]

    def notes(self) -> list[str]:
        """Return a sentence for each kind of frame that is valid and has no sample."""
        remote = f"{self.remote} remote frames, which carry no data"
        return [
            *([remote] if self.remote else []),
            *_counted(self.unknown, "frames with identifiers that are in no database"),
            *_counted(self.silent, "frames of known identifiers with nothing that the map names"),
        ]


def _counted(counts: Counter[str], what: str) -> list[str]:
    return [f"{counts.total()} {what}: {counts_text(counts)}"] if counts else []


@dataclass(frozen=True)
class _Family:
    """Kinds of frame with the same entries, of different targets: decoded in one go.

    Attributes:
        entries: What their frames carry, e of them.
        signals: The map entries behind them: for each entry, one a member.
        labels: The same, as ``message.signal``.
        names: Identifier of each member.
    """

    entries: tuple[MapEntry, ...]
    signals: tuple[tuple[BusSignal, ...], ...]
    labels: tuple[tuple[str, ...], ...]
    names: tuple[str, ...]


class Decoder(Protocol):
    """What turns frames into quantities; a plug-in of :data:`.DECODERS` has these methods."""

    def carriers(self, target: str, quantity: Quantity) -> frozenset[Carrier]:
        """See :meth:`BusDecoder.carriers`."""
        ...

    def decode(self, frames: FrameArray) -> tuple[tuple[DecodedSignals, ...], FrameTally]:
        """See :meth:`BusDecoder.decode`."""
        ...


def robstride_keys(keys: IntArray) -> IntArray:
    """Return identifiers of the RobStride protocol with what names type and motor only.

    Type 2, and 24 in the same layout, has faults and mode in bits 16 to 23 and the host in bits 0
    to 7; type 1 the torque in bits 8 to 23, others the host there.

    Args:
        keys: Identifiers with the bits for extended and sent ones, shape (n,).
    """
    kind = keys >> 24 & 0x1F
    flags = keys & ~np.int64(ID_MASK)
    feedback = (kind == 2) | (kind == 24)
    return flags | np.where(feedback, 2 << 24 | keys & 0xFF00, kind << 24 | keys & 0xFF)


_KEYS = {"robstride": robstride_keys, "cybergear": robstride_keys}


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
        bus, messages = bus_messages(robot)
        self._normal = _KEYS.get(bus.family)
        self._carried: dict[int, list[tuple[BusSignal, MapEntry]]] = {}
        for signal in bus.signals:
            message = messages[signal.message]
            key = frame_id(message) | (_TX_BIT if signal.direction is Direction.TX else 0)
            self._carried.setdefault(key, []).append((signal, compile_entry(message, signal)))
        identifiers = {frame_id(message) for message in messages.values()}
        undirected: set[int] = set()
        if not directions:
            for identifier in identifiers:
                ways = [key for key in (identifier, identifier | _TX_BIT) if key in self._carried]
                if len(ways) == 1:
                    self._carried[identifier] = self._carried[ways[0]]
                elif ways:
                    undirected.add(identifier)
        self._directions = directions
        self._families, places = _families(self._carried)
        keys = sorted(identifiers | {identifier | _TX_BIT for identifier in identifiers})
        self._keys = np.array(keys, dtype=np.int64)
        pairs = [
            (_UNDIRECTED, 0) if key & ~_TX_BIT in undirected else places.get(key, (_SILENT, 0))
            for key in keys
        ]
        self._family, self._member = np.array(pairs, dtype=np.int64).reshape(-1, 2).T

    def carriers(self, target: str, quantity: Quantity) -> frozenset[Carrier]:
        """Return the kinds of frame that carry a quantity; equal sets mean the same frames.

        Args:
            target: Name of a joint or sensor.
            quantity: What it is of that target.

        Returns:
            Key of identifier and direction, with the multiplexer values that select the signal.
        """
        return frozenset(
            (key, entry.selection)
            for key, carried in self._carried.items()
            for signal, entry in carried
            if signal.target == target and signal.quantity is quantity
        )

    def decode(self, frames: FrameArray) -> tuple[tuple[DecodedSignals, ...], FrameTally]:
        """Decode frames.

        Args:
            frames: Records of :data:`.capture.log.messages.frames.FRAME_DTYPE`, or of
                :data:`.capture.log.messages.frames.FD_FRAME_DTYPE`, shape (n,).
        """
        id_flags = frames["id_flags"]
        is_error = (id_flags & np.uint32(ERROR_FLAG)) != 0
        is_remote = ~is_error & ((id_flags & np.uint32(REMOTE_FLAG)) != 0)
        tally = FrameTally(len(frames), 0, int(is_error.sum()), int(is_remote.sum()))
        rows = np.flatnonzero(~(is_error | is_remote))
        keys = (id_flags[rows] & _BODY).astype(np.int64)
        if self._directions:
            keys |= np.where(frames["dir"][rows] == DIR_TX, _TX_BIT, 0)
        if not len(self._keys):
            tally.unknown.update(map(_name, keys.tolist()))
            return (), tally
        asked = keys if self._normal is None else self._normal(keys)
        place = np.minimum(np.searchsorted(self._keys, asked), len(self._keys) - 1)
        is_known = self._keys[place] == asked
        family = np.where(is_known, self._family[place], _SILENT)
        for counter, chosen in (
            (tally.unknown, ~is_known),
            (tally.silent, is_known & (family == _SILENT)),
            (tally.undirected, family == _UNDIRECTED),
        ):
            counter.update(map(_name, keys[chosen].tolist()))
        samples: list[DecodedSignals] = []
        for number in np.flatnonzero(np.bincount(family[family >= 0])).tolist():
            chosen = family == number
            member = self._member[place[chosen]]
            samples += _decode(frames, rows[chosen], member, self._families[number], tally)
        return tuple(samples), tally


def _families(
    carried: dict[int, list[tuple[BusSignal, MapEntry]]],
) -> tuple[list[_Family], dict[int, tuple[int, int]]]:
    """Group frames with equal entries; return also the family and member number of each key."""
    members: dict[tuple[MapEntry, ...], list[int]] = {}
    for key, pairs in carried.items():
        members.setdefault(tuple(entry for _, entry in pairs), []).append(key)
    families: list[_Family] = []
    places: dict[int, tuple[int, int]] = {}
    for entries, keys in members.items():
        places |= {key: (len(families), k) for k, key in enumerate(keys)}
        signals = [tuple(carried[key][e][0] for key in keys) for e in range(len(entries))]
        labels = [tuple(f"{signal.message}.{signal.signal}" for signal in row) for row in signals]
        names = tuple(_name(key) for key in keys)
        families.append(_Family(entries, tuple(signals), tuple(labels), names))
    return families, places


def _decode(
    frames: FrameArray, rows: IntArray, member: IntArray, family: _Family, tally: FrameTally
) -> list[DecodedSignals]:
    """Decode the frames of one family; ``rows`` are their rows in all frames."""
    data: NDArray[np.uint8] = frames["data"][rows]
    room = data.shape[1]
    size = np.minimum(frames["len" if room > 8 else "dlc"][rows], room)
    t_ns = frames["t_host_ns"][rows].astype(np.int64)
    shortest = int(size.min())
    carries = np.zeros(len(rows), dtype=np.bool_)
    mentioned = np.zeros(len(rows), dtype=np.bool_)
    samples: list[DecodedSignals] = []
    for entry, signals, labels in zip(family.entries, family.signals, family.labels, strict=True):
        unit = SESSION_UNIT[entry.quantity]
        if not entry.conditions and shortest >= entry.size:  # nearly always
            carries[:] = mentioned[:] = True
            values = entry.values(data)
            samples.append(DecodedSignals(signals, unit, rows, member, t_ns, values))
            continue
        selected = _selected(data, size, entry)
        whole = selected & (size >= entry.size)
        mentioned |= selected
        carries |= whole
        short = selected & ~whole
        tally.short.update(labels[k] for k in _numbers(member[short]))
        if whole.any():
            values = entry.values(data[whole])
            samples.append(
                DecodedSignals(signals, unit, rows[whole], member[whole], t_ns[whole], values)
            )
    tally.decoded += int(carries.sum())
    tally.silent.update(family.names[k] for k in _numbers(member[~mentioned]))
    return samples


def _numbers(member: IntArray) -> list[int]:
    return member.tolist()


def _selected(data: NDArray[np.uint8], size: NDArray[np.uint8], entry: MapEntry) -> BoolArray:
    """Return which frames carry the entry by the multiplexers above it.

    A frame too short for a multiplexer counts as selected, hence as too short.
    """
    selected = np.ones(len(data), dtype=np.bool_)
    for multiplexer, identifiers in entry.conditions:
        if multiplexer.size <= data.shape[1]:
            chosen = np.array(identifiers, dtype=np.uint64)
            fits = np.isin(multiplexer.raw(data).astype(np.uint64), chosen)
            selected &= fits | (size < multiplexer.size)
    return selected


def _name(key: int) -> str:
    return identifier_text(key & ~_TX_BIT)
