"""Decoders of a robot's bus: of registers, of a plug-in or of databases.

From packets of serial servos to the quantities of joints: a write, sync write or bulk write to a
goal register is a command. A reply holds the registers that the request before it asked for:
address and length are known from there only. What no register of the map lies in is counted.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from importlib.metadata import entry_points

import numpy as np
from numpy.typing import NDArray

from ..common.arrays import FloatArray, IntArray
from ..common.errors import DataError
from ..log.messages.frames import DIR_TX, SERIAL_MORE, SERIAL_NOISE, FrameArray
from ..robot.bus_map import SESSION_UNIT, unit_for
from ..robot.families import DECODERS, is_serial
from ..robot.model import BusSignal, Quantity, Robot
from ..robot.serial_servos import (
    ACTION,
    BROADCAST,
    BULK_READ,
    BULK_WRITE,
    PLAIN,
    READ,
    REG_WRITE,
    SERVOS,
    STATUS,
    STUFFED,
    SYNC_READ,
    SYNC_WRITE,
    WRITE,
    Register,
)
from .decoding import BusDecoder, Carrier, DecodedSignals, Decoder, FrameTally

Block = tuple[int, int, bytes, bool]
"""Registers on the line: servo, first address, bytes, whether they are written."""

_MOST_REQUESTS = 1024
_REQUESTS = (READ, SYNC_READ, BULK_READ)


class RequestMatcher:
    """Takes packets in order, and returns the registers that they carry."""

    def __init__(self, protocol: str) -> None:
        """Start without a request."""
        self._wide = protocol == "dynamixel2"  # addresses and lengths have two bytes
        self._asked: dict[int, tuple[int, int]] = {}
        self._requests: dict[bytes, dict[int, tuple[int, int]]] = {}  # a driver repeats its own
        self._staged: dict[int, Block] = {}

    def blocks(self, packet: bytes, sent: bool | None = None) -> list[Block] | None:
        """Return the registers of a packet; None for one that can carry none.

        Args:
            packet: With a valid checksum.
            sent: Whether the driver sent it; None if the line doesn't tell.
        """
        if self._wide:
            servo, instruction = packet[4], packet[7]
            if instruction == STATUS:
                return self._reply(servo, packet[8:-2].replace(STUFFED, PLAIN)[1:])
        else:
            servo, instruction = packet[2], packet[4]
            if sent is False or (sent is None and self._answers(servo, packet)):
                return self._reply(servo, packet[5:-1])
        if (asked := self._requests.get(packet)) is not None:
            self._asked = asked.copy()
            return None
        parameters = packet[8:-2].replace(STUFFED, PLAIN) if self._wide else packet[5:-1]
        if instruction not in _REQUESTS:
            return self._instruction(servo, instruction, parameters)
        self._asked = self._request(servo, instruction, parameters)
        if len(self._requests) < _MOST_REQUESTS:
            self._requests[packet] = self._asked.copy()
        return None

    def _answers(self, servo: int, packet: bytes) -> bool:
        """Whether a Feetech packet is the reply that is due: of a length that was asked for.

        A reply has its error bits where an instruction has its number; a repeated request of the
        same two bytes is distinguished by its parameters.
        """
        asked = self._asked.get(servo)
        if asked is None or packet[3] != asked[1] + 2:
            return False
        return packet[4] != READ or tuple(packet[5:-1]) != asked

    def _reply(self, servo: int, data: bytes) -> list[Block] | None:
        asked = self._asked.pop(servo, None)
        if asked is None or not data:
            return None
        return [(servo, asked[0], data, False)] if len(data) == asked[1] else None

    def _instruction(self, servo: int, instruction: int, parameters: bytes) -> list[Block] | None:
        number = self._numbers
        size = 2 if self._wide else 1
        self._asked = {}
        if instruction in (WRITE, REG_WRITE) and len(parameters) > size:
            block = (servo, number(parameters, 0), parameters[size:], True)
            if instruction == WRITE:
                return [block]
            self._staged[servo] = block
        elif instruction == ACTION:
            staged = list(self._staged) if servo == BROADCAST else [servo]
            return [self._staged.pop(key) for key in staged if key in self._staged] or None
        elif instruction == SYNC_WRITE and len(parameters) > 2 * size:
            at, length = number(parameters, 0), number(parameters, size)
            rows = _rows(parameters[2 * size :], length + 1)
            return [(row[0], at, row[1:], True) for row in rows]
        elif instruction == BULK_WRITE and self._wide:
            return list(self._bulk(parameters))
        return None

    def _bulk(self, parameters: bytes) -> Iterator[Block]:
        while len(parameters) > 5:
            length = self._numbers(parameters, 3)
            yield parameters[0], self._numbers(parameters, 1), parameters[5 : 5 + length], True
            parameters = parameters[5 + length :]

    def _request(
        self, servo: int, instruction: int, parameters: bytes
    ) -> dict[int, tuple[int, int]]:
        size = 2 if self._wide else 1
        number = self._numbers
        if instruction == BULK_READ:
            rows = _rows(parameters, 5) if self._wide else []
            return {row[0]: (number(row, 1), number(row, 3)) for row in rows}
        if len(parameters) < 2 * size:
            return {}
        asked = number(parameters, 0), number(parameters, size)
        servos = [servo] if instruction == READ else parameters[2 * size :]
        return dict.fromkeys(servos, asked)

    def _numbers(self, data: bytes, at: int) -> int:
        return int.from_bytes(data[at : at + 2], "little") if self._wide else data[at]


def _rows(data: bytes, size: int) -> list[bytes]:
    whole = len(data) // size * size
    return [data[at : at + size] for at in range(0, whole, size)]


@dataclass(eq=False)
class _Layout:
    """Blocks of one address and length, of all servos of a model.

    Attributes:
        places: First byte of each register of the map that lies in them.
        samples: Row, index of the motor and bytes of each block of this call.
    """

    places: tuple[tuple[int, Register], ...]
    samples: list[tuple[int, int, bytes]] = field(default_factory=list[tuple[int, int, bytes]])


class RegisterDecoder:
    """The :class:`.Decoder` of a line of serial servos."""

    def __init__(self, robot: Robot) -> None:
        """Compile.

        Raises:
            DataError: If the robot has no serial servos.
        """
        bus = robot.bus
        if bus is None or not is_serial(bus):
            raise DataError(f"the robot {robot.name} has no serial servos")
        self._matcher = RequestMatcher(bus.family)
        self._wide = bus.family == "dynamixel2"
        self._motors = {motor.id: (k, motor.model) for k, motor in enumerate(bus.motors)}
        self._maps = SERVOS[bus.family]
        joints = [motor.joint for motor in bus.motors]
        signals: dict[Quantity, list[BusSignal]] = {}
        for signal in bus.signals:
            signals.setdefault(signal.quantity, []).append(signal)
        self._signals = {quantity: tuple(signal) for quantity, signal in signals.items()}
        self._member: dict[Quantity, IntArray] = {}
        self._scales: dict[Quantity, FloatArray] = {}
        for quantity, group in self._signals.items():
            member = np.full(len(joints), -1)
            motor_of = [joints.index(signal.target) for signal in group]
            member[motor_of] = np.arange(len(group))
            self._member[quantity] = member
            models = [bus.motors[k].model for k in motor_of]
            pairs = [self._scale(*pair) for pair in zip(group, models, strict=True)]
            self._scales[quantity] = np.array(pairs, dtype=np.float64)
        self._layouts: dict[tuple[str, int, int, bool], _Layout] = {}
        self._begun = b""

    def _scale(self, signal: BusSignal, model: str) -> tuple[float, float]:
        """Return factor and offset from a raw number to the session's unit."""
        register = next(entry for entry in self._maps[model] if entry.name == signal.signal)
        unit = unit_for(signal.unit, signal.quantity)
        offset = signal.scale * register.offset + signal.offset
        factor = signal.scale * register.scale * unit.factor
        return factor, offset * unit.factor + unit.offset

    def carriers(self, target: str, quantity: Quantity) -> frozenset[Carrier]:
        """Return a kind of packet for each quantity: which are read together is the driver's."""
        carried = any(signal.target == target for signal in self._signals.get(quantity, ()))
        kind = (tuple(Quantity).index(quantity),)
        return frozenset({(0, (kind,))}) if carried else frozenset()

    def decode(self, frames: FrameArray) -> tuple[tuple[DecodedSignals, ...], FrameTally]:
        """Decode packets.

        Args:
            frames: Records of :data:`.FD_FRAME_DTYPE` as ``/serial/NAME`` has them, in order,
                shape (n,).
        """
        tally = FrameTally(len(frames))
        used: dict[int, _Layout] = {}
        ways = frames["dir"].tolist()
        directed = any(ways)
        plain, at = list[int](), 4 if self._wide else 2
        for row, packet in self._packets(frames, tally):
            blocks = self._matcher.blocks(packet, ways[row] == DIR_TX if directed else None)
            if not blocks:
                plain.append(packet[at])
                continue
            carries = False
            for servo, address, data, written in blocks:
                motor, model = self._motors.get(servo, (-1, ""))
                layout = self._layout(model, address, len(data), written)
                if layout.places:
                    layout.samples.append((row, motor, data))
                    used[id(layout)] = layout
                    carries = True
                else:
                    counter = tally.silent if model else tally.unknown
                    counter[f"servo {servo} register {address}"] += 1
            tally.decoded += carries
        self._count(Counter(plain), tally)
        t_ns = frames["t_host_ns"].astype(np.int64)
        return tuple(
            sample for layout in used.values() for sample in self._decoded(layout, t_ns)
        ), tally

    def _packets(self, frames: FrameArray, tally: FrameTally) -> Iterator[tuple[int, bytes]]:
        """Yield the packets, joined from their records, with the row of the last one."""
        data, width = frames["data"].tobytes(), frames["data"].shape[1]
        flags = frames["fd_flags"].tolist()
        for row, size in enumerate(frames["len"].tolist()):
            part = data[row * width : row * width + size]
            if not flags[row] and not self._begun:  # nearly always
                yield row, part
                continue
            part = self._begun + part
            self._begun = part if flags[row] & SERIAL_MORE else b""
            if self._begun:
                continue
            if flags[row] & SERIAL_NOISE:
                tally.errors += 1
            else:
                yield row, part

    def _count(self, plain: Counter[int], tally: FrameTally) -> None:
        """Count packets without registers, by servo: requests, pings, replies to nothing."""
        for servo, count in plain.items():
            expected = servo == BROADCAST or servo in self._motors
            counter = tally.silent if expected else tally.unknown
            counter["all servos" if servo == BROADCAST else f"servo {servo}"] += count

    def _layout(self, model: str, address: int, size: int, written: bool) -> _Layout:
        key = (model, address, size, written)
        layout = self._layouts.get(key)
        if layout is None:
            places = tuple(
                (at, register)
                for register in self._maps.get(model, ())
                if (register.quantity is Quantity.COMMAND) is written
                and 0 <= (at := register.address - address) <= size - register.size
            )
            layout = self._layouts[key] = _Layout(places)
        return layout

    def _decoded(self, layout: _Layout, t_ns: IntArray) -> Iterator[DecodedSignals]:
        row, motor = np.array([sample[:2] for sample in layout.samples], dtype=np.int64).T
        data = np.frombuffer(b"".join(sample[2] for sample in layout.samples), np.uint8)
        data = data.reshape(len(row), -1)
        layout.samples = []
        times = t_ns[row]
        for at, register in layout.places:
            quantity = register.quantity
            member = self._member[quantity][motor]
            factor, offset = self._scales[quantity][member].T
            values: FloatArray = raw_numbers(register, data[:, at : at + register.size])
            unit, signals = SESSION_UNIT[quantity], self._signals[quantity]
            yield DecodedSignals(signals, unit, row, member, times, values * factor + offset)


def raw_numbers(register: Register, data: NDArray[np.uint8]) -> FloatArray:
    """Return :meth:`.Register.raw` of the bytes of many samples, shape (n, size), as floats."""
    order = data[:, ::-1] if register.big_endian else data
    number = order.astype(np.int64) @ (1 << 8 * np.arange(register.size))
    if register.signed:
        number -= (number >> (8 * register.size - 1)) << 8 * register.size
    elif register.sign_bit is not None:
        magnitude = number & ((1 << register.sign_bit) - 1)
        number = np.where(number >> register.sign_bit & 1, -magnitude, number)
    return number.astype(np.float64)


def open_decoder(robot: Robot, *, directions: bool = True) -> Decoder:
    """Return the decoder of a robot's bus.

    Args:
        directions: Whether the frames' directions are known.

    Raises:
        DataError: As :class:`.BusDecoder`.
    """
    family = robot.bus.family if robot.bus is not None else ""
    if is_serial(robot.bus):
        return RegisterDecoder(robot)
    for plugin in entry_points(group=DECODERS, name=family) if family else ():
        return plugin.load()(robot)
    return BusDecoder(robot, directions=directions)
