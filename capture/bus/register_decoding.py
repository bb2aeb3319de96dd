"""From packets of serial servos to the quantities of joints.

A write, sync write or bulk write to a goal register is a command. A reply holds the registers that
the request before it asked for: address and length are known from there only. What no register of
the map lies in is counted.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np

from ..common.arrays import FloatArray, IntArray
from ..common.errors import DataError
from ..log.messages.frames import DIR_TX, SERIAL_MORE, SERIAL_NOISE, FrameArray
from ..robot.bus_map import JOINT_QUANTITIES, SESSION_UNIT, Unit, unit_for
from ..robot.families import is_serial
from ..robot.model import BusSignal, Quantity, Robot
from ..robot.servo_registers import SERVOS, Register
from ..sources.servo_packets import (
    ACTION,
    BROADCAST,
    BULK_READ,
    BULK_WRITE,
    PLAIN,
    READ,
    REG_WRITE,
    STATUS,
    STUFFED,
    SYNC_READ,
    SYNC_WRITE,
    WRITE,
)
from .decoding import Carrier, DecodedSignals, FrameTally

Block = tuple[int, int, bytes, bool]
"""Registers on the line: servo, first address, bytes, whether they are written."""

_REQUESTS = (READ, SYNC_READ, BULK_READ)


class RequestMatcher:
    """Takes packets in order, and returns the registers that they carry."""

    def __init__(self, protocol: str) -> None:
        """Start without a request."""
        self._wide = protocol == "dynamixel2"  # addresses and lengths have two bytes
        self._asked: dict[int, tuple[int, int]] = {}
        self._staged: dict[int, Block] = {}

    def blocks(self, packet: bytes, sent: bool | None = None) -> list[Block] | None:
        """Return the registers of a packet; None for one that can carry none.

        Args:
            packet: With a valid checksum.
            sent: Whether the driver sent it; None if the line doesn't tell.
        """
        if self._wide:
            servo, instruction = packet[4], packet[7]
            parameters = packet[8:-2].replace(STUFFED, PLAIN)
            if instruction == STATUS:
                return self._reply(servo, parameters[1:])
        else:
            servo, instruction, parameters = packet[2], packet[4], packet[5:-1]
            if sent is False or (sent is None and self._answers(servo, packet)):
                return self._reply(servo, parameters)
        return self._instruction(servo, instruction, parameters)

    def _answers(self, servo: int, packet: bytes) -> bool:
        """Whether a Feetech packet is the reply that is due: of a length that was asked for.

        A reply has its error bits where an instruction has its number; a repeated request of the
        same two bytes is told by its parameters.
        """
        asked = self._asked.get(servo)
        if asked is None or packet[3] != asked[1] + 2:
            return False
        return not (packet[4] == READ and tuple(packet[5:-1]) == asked)

    def _reply(self, servo: int, data: bytes) -> list[Block] | None:
        asked = self._asked.pop(servo, None)
        if asked is None or not data:
            return None
        return [(servo, asked[0], data, False)] if len(data) == asked[1] else None

    def _instruction(self, servo: int, instruction: int, parameters: bytes) -> list[Block] | None:
        number = self._numbers
        size = 2 if self._wide else 1
        if instruction in _REQUESTS:
            self._asked = self._request(servo, instruction, parameters)
            return None
        self._asked = {}
        if instruction in (WRITE, REG_WRITE) and len(parameters) > size:
            block = (servo, number(parameters, 0), parameters[size:], True)
            if instruction == WRITE:
                return [block]
            self._staged[servo] = block
        elif instruction == ACTION:
            staged = list(self._staged) if servo == BROADCAST else [servo]
            return [self._staged.pop(each) for each in staged if each in self._staged] or None
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


_Place = tuple[int, int, int, Register]
"""Member, first byte, byte behind it, register."""


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
        self._registers = {
            motor.id: {one.name: one for one in SERVOS[bus.family][motor.model]}
            for motor in bus.motors
        }
        self._signals: dict[tuple[Quantity, int], BusSignal] = {}
        servo_of = {motor.joint: motor.id for motor in bus.motors}
        for signal in bus.signals:
            self._signals[signal.quantity, servo_of[signal.target]] = signal
        self._members = {
            quantity: tuple(self._members_of(quantity)) for quantity in JOINT_QUANTITIES
        }
        self._scales = {quantity: self._factors(quantity) for quantity in self._members}
        self._plans: dict[tuple[int, int, int, bool], list[_Place]] = {}
        self._begun = b""

    def _members_of(self, quantity: Quantity) -> Iterable[BusSignal]:
        return (one for (own, _), one in self._signals.items() if own is quantity)

    def carriers(self, target: str, quantity: Quantity) -> frozenset[Carrier]:
        """Return a kind of packet for each quantity: which are read together is the driver's."""
        found = any(signal.target == target for signal in self._members.get(quantity, ()))
        kind = (tuple(Quantity).index(quantity),)
        return frozenset({(0, (kind,))}) if found else frozenset()

    def decode(self, frames: FrameArray) -> tuple[tuple[DecodedSignals, ...], FrameTally]:
        """Decode packets.

        Args:
            frames: Records of :data:`.FD_FRAME_DTYPE` as ``/serial/NAME`` has them, in order,
                shape (n,).
        """
        tally = FrameTally(len(frames))
        rows: dict[Quantity, list[tuple[int, int, float]]] = {}
        data, sizes = frames["data"].tobytes(), frames["len"].tolist()
        flags, ways = frames["fd_flags"].tolist(), frames["dir"].tolist()
        width = frames["data"].shape[1] if len(frames) else 0
        known = any(ways)
        for row, size in enumerate(sizes):
            part = self._begun + data[row * width : row * width + size]
            self._begun = part if flags[row] & SERIAL_MORE else b""
            if self._begun:
                continue
            if flags[row] & SERIAL_NOISE:
                tally.errors += 1
                continue
            blocks = self._matcher.blocks(part, ways[row] == DIR_TX if known else None)
            servo = part[4 if self._wide else 2]
            carries = False
            for block in blocks or ():
                places = self._places(block)
                carries = carries or bool(places)
                self._count(block, places, tally)
                for member, start, stop, register in places:
                    sample = (row, member, register.raw(block[2][start:stop]))
                    rows.setdefault(register.quantity, []).append(sample)
            tally.decoded += carries
            if not blocks and servo != BROADCAST and servo not in self._registers:
                tally.unknown[f"servo {servo}"] += 1
            elif not blocks:
                tally.silent[f"servo {servo}" if servo != BROADCAST else "all servos"] += 1
        t_ns = frames["t_host_ns"].astype(np.int64)
        return tuple(self._decoded(quantity, own, t_ns) for quantity, own in rows.items()), tally

    def _count(self, block: Block, places: list[_Place], tally: FrameTally) -> None:
        """Count a block that no register of the map lies in."""
        if places:
            return
        servo, address, _, _ = block
        counter = tally.silent if servo in self._registers else tally.unknown
        counter[f"servo {servo} register {address}"] += 1

    def _places(self, block: Block) -> list[_Place]:
        servo, address, data, written = block
        key = (servo, address, len(data), written)
        found = self._plans.get(key)
        if found is None:
            found = self._plans[key] = [
                (self._members[one.quantity].index(signal), at, at + one.size, one)
                for one in self._registers.get(servo, {}).values()
                if (signal := self._signals.get((one.quantity, servo))) is not None
                and (one.quantity is Quantity.COMMAND) is written
                and 0 <= (at := one.address - address) <= len(data) - one.size
            ]
        return found

    def _decoded(
        self, quantity: Quantity, samples: list[tuple[int, int, float]], t_ns: IntArray
    ) -> DecodedSignals:
        members = self._members[quantity]
        row, member = np.array([one[:2] for one in samples], dtype=np.int64).T
        raw = np.array([one[2] for one in samples], dtype=np.float64)
        factors = self._scales[quantity]
        values: FloatArray = raw * factors[member, 0] + factors[member, 1]
        return DecodedSignals(members, SESSION_UNIT[quantity], row, member, t_ns[row], values)

    def _factors(self, quantity: Quantity) -> FloatArray:
        """Return factor and offset from raw number to session unit of each member, shape (m, 2)."""
        found: list[tuple[float, float]] = []
        for signal in self._members[quantity]:
            servo = next(key[1] for key, one in self._signals.items() if one is signal)
            register = self._registers[servo][signal.signal]
            unit: Unit = unit_for(signal.unit, quantity)
            factor = signal.scale * register.scale * unit.factor
            offset = signal.scale * register.offset + signal.offset
            found.append((factor, offset * unit.factor + unit.offset))
        return np.array(found, dtype=np.float64).reshape(-1, 2)
