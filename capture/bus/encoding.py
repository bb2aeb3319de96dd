"""From the quantities of joints and sensors to raw CAN frames: the inverse of the decoder.

A :class:`BusEncoder` is compiled once from a robot's databases and bus map. A controller encodes
commands with it (direction tx), a virtual robot what its servos and sensors report (rx).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from ..common.errors import DataError
from ..log.messages.frames import DIR_RX, DIR_TX, FrameArray, empty_frames
from ..robot.model import BusSignal, Direction, Quantity, Robot
from .map_entry import (
    BitField,
    Conditions,
    MapEntry,
    bus_messages,
    compile_entry,
    conditions_of,
    frame_id,
)

if TYPE_CHECKING:
    from cantools.database.can import Message
    from cantools.database.can.signal import Signal


_MOST_BYTES = 8


BusValue: TypeAlias = tuple[str, Quantity, str]
"""What a value is: name of a joint or sensor, quantity, and axis of a vector quantity, else ""."""


def poll_frames(robot: Robot) -> FrameArray:
    """Return the frames that request the robot's state.

    Returns:
        Records of :data:`.FRAME_DTYPE`, without times, in the order of the map;
        none where no request is needed.

    Raises:
        DataError: If the robot has no bus, or a request that is no classic CAN frame.
    """
    bus, messages = bus_messages(robot)
    frames = empty_frames(len(bus.polls))
    frames["dir"] = DIR_TX
    for frame, poll in zip(frames, bus.polls, strict=True):
        message = _classic(messages, poll.message, robot)
        fields = {signal.name: BitField.of(signal) for signal in message.signals}
        word = 0
        for name, number in poll.signals:
            word |= fields[name].placed(number, message.length)
        frame["id_flags"], frame["dlc"] = frame_id(message), message.length
        data = word.to_bytes(message.length, "little").ljust(_MOST_BYTES, b"\0")
        frame["data"] = np.frombuffer(data, np.uint8)
    return frames


@dataclass(frozen=True)
class _Slot:
    """A value's place in a frame, and what the DBC allows it to be."""

    entry: MapEntry
    within: tuple[float, float]

    def placed(self, value: float, size: int) -> int:
        if value == math.inf and self.entry.out_of_range is not None:
            return self.code(self.entry.out_of_range, size)
        bits = self.entry.bits.raw_bits(self.entry.physical(value), self.within)
        return self.entry.bits.placed(bits, size)

    def code(self, raw: int, size: int) -> int:
        """Return a raw number at its place."""
        bits = self.entry.bits
        return bits.placed(raw & ((1 << bits.length) - 1), size)


@dataclass
class _Frame:
    """One kind of frame in the making.

    Attributes:
        fixed: Multiplexers and initial values of what the map doesn't name, at their places.
        slots: The values that it carries.
        default: Bits of each if it is not given, at its place: those for an unknown value, else
            those sent last.
    """

    id_flags: int
    size: int
    fixed: int
    slots: dict[BusValue, _Slot]
    default: dict[BusValue, int]

    def data(self, values: Mapping[BusValue, float]) -> bytes | None:
        """Return its bytes, None if no value is of this frame."""
        given = False
        word = self.fixed
        for key, slot in self.slots.items():
            value = values.get(key, math.nan)
            if math.isnan(value):
                word |= self.default[key]
                continue
            given = True
            bits = slot.placed(value, self.size)
            word |= bits
            if slot.entry.unknown is None:
                self.default[key] = bits
        return word.to_bytes(self.size, "little") if given else None


class BusEncoder:
    """The frames of one direction of a robot's bus."""

    def __init__(self, robot: Robot, direction: Direction) -> None:
        """Compile.

        Args:
            robot: The robot; its databases have been checked when it was read.
            direction: Which frames, seen from the computer on the robot.

        Raises:
            DataError: If the robot has no bus, or a message that is no classic CAN frame.
        """
        bus, messages = bus_messages(robot)
        self._way = DIR_TX if direction is Direction.TX else DIR_RX
        carried: dict[str, list[BusSignal]] = {}
        for signal in bus.signals:
            if signal.direction is direction:
                carried.setdefault(signal.message, []).append(signal)
        self._frames: list[_Frame] = []
        for name, signals in carried.items():
            self._frames += _frames_of(_classic(messages, name, robot), signals)
        self._carrying: dict[BusValue, list[int]] = {}
        for number, frame in enumerate(self._frames):
            for key in frame.slots:
                self._carrying.setdefault(key, []).append(number)

    @property
    def values(self) -> frozenset[BusValue]:
        """All values that the frames carry."""
        return frozenset(self._carrying)

    def encode(self, values: Mapping[BusValue, float], t_ns: int = 0) -> FrameArray:
        """Encode values.

        Each is rounded to the nearest that its field can hold; one beyond the field's range, or
        beyond the DBC's minimum and maximum, becomes the nearest end of it (+inf: what the map
        names for out of range, or the greatest).

        Args:
            values: In the session's units (SI); NaN counts as not given. What no frame carries is
                left out.
            t_ns: Time of the frames, as host and as device time [ns].

        Returns:
            Records of :data:`.FRAME_DTYPE`, in the order of the map: every frame
            of which a value is given. Its other fields hold what the map names for unknown; else
            they are as they were sent last, at first the DBC's initial value, or zero.
        """
        touched = {number for key in values for number in self._carrying.get(key, ())}
        chosen = [self._frames[number] for number in sorted(touched)]
        ready = [(frame, data) for frame in chosen if (data := frame.data(values))]
        frames = empty_frames(len(ready))
        frames["t_device_ns"] = frames["t_host_ns"] = t_ns
        frames["id_flags"] = [frame.id_flags for frame, _ in ready]
        frames["dlc"] = [frame.size for frame, _ in ready]
        frames["dir"] = self._way
        padded = b"".join(data.ljust(_MOST_BYTES, b"\0") for _, data in ready)
        frames["data"] = np.frombuffer(padded, np.uint8).reshape(-1, _MOST_BYTES)
        return frames


def _classic(messages: Mapping[str, Message], name: str, robot: Robot) -> Message:
    if messages[name].length > _MOST_BYTES:
        raise DataError(f"{name} of {robot.name} is a CAN FD frame; only classic are sent")
    return messages[name]


def _frames_of(message: Message, signals: list[BusSignal]) -> list[_Frame]:
    """Return one frame for each combination of multiplexer values that the entries need."""
    dbc = {signal.name: signal for signal in message.signals}
    entries = {signal: compile_entry(message, signal) for signal in signals}
    # The multiplexers above each entry, with the least values that select it.
    selections = dict.fromkeys(
        tuple((bits, min(identifiers)) for bits, identifiers in entry.conditions)
        for entry in entries.values()
    )
    if len(selections) > 1:
        selections.pop((), None)  # what is in every frame needs none of its own
    frames: list[_Frame] = []
    for selection in selections:
        chosen = dict(selection)
        selected = {s: entry for s, entry in entries.items() if _selected(entry.conditions, chosen)}
        filled = {signal.signal for signal in selected} | {
            s.multiplexer_signal for s in dbc.values()
        }
        fixed = 0
        for bits, identifier in selection:
            fixed |= bits.placed(identifier, message.length)
        for dbc_signal in message.signals:
            if dbc_signal.name not in filled and _selected(conditions_of(dbc_signal, dbc), chosen):
                fixed |= _initial(dbc_signal, message.length)
        slots = {
            (signal.target, signal.quantity, signal.axis): _slot(entry, dbc[signal.signal])
            for signal, entry in selected.items()
        }
        default = {
            key: _initial(dbc[signal.signal], message.length)
            for key, signal in zip(slots, selected, strict=True)
        }
        for key, slot in slots.items():
            if slot.entry.unknown is not None:
                default[key] = slot.code(slot.entry.unknown, message.length)
        frames.append(_Frame(frame_id(message), message.length, fixed, slots, default))
    return frames


def _selected(conditions: Conditions, chosen: Mapping[BitField, int]) -> bool:
    """Return whether the multiplexers' values select a signal."""
    return all(chosen.get(bits) in valid for bits, valid in conditions)


def _slot(entry: MapEntry, signal: Signal) -> _Slot:
    lower = -math.inf if signal.minimum is None else float(signal.minimum)
    upper = math.inf if signal.maximum is None else float(signal.maximum)
    return _Slot(entry, entry.bits.raw_range(lower, upper))


def _initial(signal: Signal, size: int) -> int:
    """Return a signal's initial value at its place; zero where the DBC gives none."""
    bits = BitField.of(signal)
    if signal.initial is None or not isinstance(signal.initial, int | float):
        return 0
    return bits.placed(bits.raw_bits(float(signal.initial)), size)
