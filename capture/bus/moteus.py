"""Decoder of mjbots moteus: CAN FD frames whose bytes say which registers follow, and in what type.

Source: moteus, ``docs/protocol/can.md`` and ``registers.md``. A DBC has no words for it, so this is
a plug-in of the entry point group ``undulog.decoders``, as one of another package would be.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator

import numpy as np

from ..common.errors import DataError
from ..log.messages.frames import FrameArray, data_lengths, identifier_text
from ..robot.bus_map import SESSION_UNIT, unit_for
from ..robot.model import BusSignal, Direction, Motor, Quantity, Robot
from .decoding import Carrier, DecodedSignals, FrameTally

_REGISTERS: dict[int, tuple[Quantity, str, tuple[float, float, float]]] = {
    0x001: (Quantity.POSITION, "rev", (0.01, 1e-4, 1e-5)),
    0x002: (Quantity.VELOCITY, "rev/s", (0.1, 2.5e-4, 1e-5)),
    0x003: (Quantity.EFFORT, "N m", (0.5, 0.01, 0.001)),
    0x004: (Quantity.CURRENT, "A", (1.0, 0.1, 0.001)),
    0x00D: (Quantity.VOLTAGE, "V", (0.5, 0.1, 0.001)),
    0x00E: (Quantity.TEMPERATURE, "degC", (1.0, 0.1, 0.001)),
    0x020: (Quantity.COMMAND, "rev", (0.01, 1e-4, 1e-5)),
}
"""Register to quantity, unit, and the scale of int8, int16 and int32; floats have the unit."""

_TYPES = ("b", "h", "i", "f")
_WRITE, _REPLY, _NOP = 0x00, 0x20, 0x50
_SCALED = (Quantity.COMMAND, Quantity.POSITION, Quantity.VELOCITY)


def subframes(data: bytes) -> Iterator[tuple[bool, int, float, int]]:
    """Yield the registers of a frame that carry a number.

    Returns:
        Whether it is written (else replied), register, raw number (NaN for none), index of its
        type: int8, int16, int32, float.

    Raises:
        ValueError: If the frame is cut.
    """
    at = 0
    while at < len(data):
        head = data[at]
        at += 1
        if head == _NOP:
            continue
        if head >= 0x30:  # errors, tunnels: their contents are no registers
            return
        kind, count = head >> 2 & 3, head & 3
        if not count:
            count, at = _varuint(data, at)
        first, at = _varuint(data, at)
        if head & 0xF0 == 0x10:  # a request for registers
            continue
        size = struct.calcsize(_TYPES[kind])
        if at + size * count > len(data):
            raise ValueError("the frame is cut")
        numbers = struct.unpack_from(f"<{count}{_TYPES[kind]}", data, at)
        at += size * count
        lowest = None if kind == 3 else -(1 << (8 * size - 1))  # the number for NaN
        for k, number in enumerate(numbers):
            yield head < _REPLY, first + k, (np.nan if number == lowest else number), kind


def _varuint(data: bytes, at: int) -> tuple[int, int]:
    value = shift = 0
    while at < len(data) and shift < 35:
        value |= (data[at] & 0x7F) << shift
        at, shift = at + 1, shift + 7
        if data[at - 1] < 0x80:
            return value, at
    raise ValueError("the frame is cut")


class MoteusDecoder:
    """The :class:`.Decoder` of a bus of moteus controllers."""

    def __init__(self, robot: Robot) -> None:
        """Compile.

        Raises:
            DataError: If the robot has no motors.
        """
        if robot.bus is None or not robot.bus.motors:
            raise DataError(f"the robot {robot.name} has no motors of the family moteus")
        self._motors = robot.bus.motors
        self._index = {motor.id: k for k, motor in enumerate(self._motors)}
        self._signals = {
            quantity: tuple(_signal(motor, quantity, unit) for motor in self._motors)
            for quantity, unit, _ in _REGISTERS.values()
        }

    def carriers(self, target: str, quantity: Quantity) -> frozenset[Carrier]:
        """Return a kind of frame for each quantity: which come together is the query's."""
        carried = quantity in self._signals and any(motor.joint == target for motor in self._motors)
        kind = (tuple(Quantity).index(quantity),)
        return frozenset({(0, (kind,))}) if carried else frozenset()

    def decode(self, frames: FrameArray) -> tuple[tuple[DecodedSignals, ...], FrameTally]:
        """Decode frames, classic or FD, shape (n,)."""
        tally = FrameTally(len(frames))
        samples: dict[Quantity, list[tuple[int, int, float]]] = {}
        sizes = data_lengths(frames).tolist()
        for row, (identifier, size) in enumerate(
            zip(frames["id_flags"].tolist(), sizes, strict=True)
        ):
            source, target = identifier >> 8 & 0x7F, identifier & 0x7F
            before = sum(map(len, samples.values()))
            try:
                registers = list(subframes(frames["data"][row, :size].tobytes()))
            except ValueError:
                tally.short[f"moteus {identifier_text(identifier)}"] += 1
                continue
            for written, register, number, kind in registers:
                motor = self._index.get(target if written else source)
                meaning = _REGISTERS.get(register)
                if motor is None or meaning is None:
                    continue
                quantity, unit, scales = meaning
                if (quantity is Quantity.COMMAND) is not written:
                    continue
                actuator = self._motors[motor]
                value = number * (scales[kind] if kind < 3 else 1.0)
                value = float(value) * (actuator.scale if quantity in _SCALED else 1.0)
                value *= unit_for(unit, quantity).factor
                if quantity in _SCALED[:2]:
                    value += actuator.offset
                samples.setdefault(quantity, []).append((row, motor, value))
            if sum(map(len, samples.values())) > before:
                tally.decoded += 1
            elif source in self._index or target in self._index:
                tally.silent[identifier_text(identifier)] += 1
            else:
                tally.unknown[identifier_text(identifier)] += 1
        t_ns = frames["t_host_ns"].astype(np.int64)
        decoded: list[DecodedSignals] = []
        for quantity, rows in samples.items():
            row, motor = np.array([row[:2] for row in rows], dtype=np.int64).T
            values = np.array([row[2] for row in rows])
            signals, unit = self._signals[quantity], SESSION_UNIT[quantity]
            decoded.append(DecodedSignals(signals, unit, row, motor, t_ns[row], values))
        return tuple(decoded), tally


def _signal(motor: Motor, quantity: Quantity, unit: str) -> BusSignal:
    way = Direction.TX if quantity is Quantity.COMMAND else Direction.RX
    return BusSignal(f"moteus {motor.id}", quantity, way, motor.joint, quantity, unit)
