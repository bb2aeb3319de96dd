"""Protocols of serial servos: their registers, and their packets in a stream of bytes.

Registers: address, size and meaning of what a session holds, after Feetech's memory tables of
STS3215 and SCS0009 and the ROBOTIS e-Manual, control tables of XL430-W250, XL330-M288, XM430-W350
and XM540-W270.

Packets of Feetech's SCS and STS servos: ``FF FF ID LENGTH INSTRUCTION PARAMETERS CHECKSUM``; the
checksum is the inverted sum of all bytes from the ID (SCServo communication protocol manual).

Packets of Dynamixel protocol 2.0: ``FF FF FD 00 ID LENGTH(2) INSTRUCTION PARAMETERS CRC(2)``; the
CRC is CRC-16 with polynomial 0x8005, start 0, over all bytes before it, and ``FF FF FD`` inside a
packet has a ``FD`` stuffed behind it (ROBOTIS e-Manual, "DYNAMIXEL Protocol 2.0").
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple

from .model import Direction, Quantity

_TURN = 2 * math.pi
_STEP = _TURN / 4096  # 12 bits a turn
_RPM = 0.229  # rev/min, the velocity unit of the X series

_SCS_STEP = math.radians(300) / 1024

PING, READ, WRITE, REG_WRITE, ACTION = 1, 2, 3, 4, 5
STATUS, SYNC_READ, SYNC_WRITE, BULK_READ, BULK_WRITE = 0x55, 0x82, 0x83, 0x92, 0x93
BROADCAST = 0xFE
"""Instructions, and the identifier that all servos take for their own."""

STUFFED, PLAIN = b"\xff\xff\xfd\xfd", b"\xff\xff\xfd"

MORE, FAULTY = -1, 0
"""A judgement: more bytes are needed; no packet begins here."""

_LONGEST = 4096  # of a Dynamixel packet; its length field holds 65535


Judge = Callable[[bytes, int, bool], int]
"""Returns the size of the packet that begins at an offset of a buffer, or MORE, or FAULTY; with the
last argument no more bytes will come."""


@dataclass(frozen=True)
class Register:
    """One register of a servo.

    Attributes:
        size: Number of bytes.
        unit: Unit of ``scale * raw + offset``.
        sign_bit: Bit of the sign beside a magnitude; None without one.
        signed: Two's complement.
        big_endian: Most significant byte first.
    """

    name: str
    address: int
    size: int
    quantity: Quantity
    unit: str
    scale: float
    offset: float = 0.0
    sign_bit: int | None = None
    signed: bool = False
    big_endian: bool = False

    @property
    def direction(self) -> Direction:
        """To the servo for a command, else from it."""
        return Direction.TX if self.quantity is Quantity.COMMAND else Direction.RX

    def raw(self, data: bytes) -> int:
        """Return the number in a register's bytes."""
        number = int.from_bytes(data, "big" if self.big_endian else "little", signed=self.signed)
        if self.sign_bit is not None and number >> self.sign_bit & 1:
            return (1 << self.sign_bit) - number
        return number

    def bytes_of(self, value: float) -> bytes:
        """Return the bytes of a value in ``unit``, or of the nearest that they can hold."""
        number = round((value - self.offset) / self.scale)
        bits = 8 * self.size - self.signed if self.sign_bit is None else self.sign_bit
        most = (1 << bits) - 1
        negative = self.signed or self.sign_bit is not None
        number = max(-most if negative else 0, min(number, most))
        if self.sign_bit is not None and number < 0:
            number = (1 << self.sign_bit) - number
        order = "big" if self.big_endian else "little"
        return number.to_bytes(self.size, order, signed=self.signed)


_STS = (
    Register("goal_position", 42, 2, Quantity.COMMAND, "rad", _STEP, -math.pi, 15),
    Register("present_position", 56, 2, Quantity.POSITION, "rad", _STEP, -math.pi, 15),
    Register("present_velocity", 58, 2, Quantity.VELOCITY, "rad/s", _STEP, 0.0, 15),
    Register("present_voltage", 62, 1, Quantity.VOLTAGE, "V", 0.1),
    Register("present_temperature", 63, 1, Quantity.TEMPERATURE, "degC", 1.0),
    Register("present_current", 69, 2, Quantity.CURRENT, "mA", 6.5, 0.0, 15),
)
_SCS = tuple(
    replace(register, big_endian=True, scale=_SCS_STEP, offset=-512 * _SCS_STEP)
    if register.unit == "rad"
    else replace(register, big_endian=True, scale=_SCS_STEP)
    if register.unit == "rad/s"
    else register
    for register in _STS
    if register.quantity is not Quantity.CURRENT
)
_X = (
    Register("goal_position", 116, 4, Quantity.COMMAND, "rad", _STEP, -math.pi, signed=True),
    Register("present_velocity", 128, 4, Quantity.VELOCITY, "rpm", _RPM, signed=True),
    Register("present_position", 132, 4, Quantity.POSITION, "rad", _STEP, -math.pi, signed=True),
    Register("present_input_voltage", 144, 2, Quantity.VOLTAGE, "V", 0.1),
    Register("present_temperature", 146, 1, Quantity.TEMPERATURE, "degC", 1.0),
)


def _x_with_current(milliampere: float) -> tuple[Register, ...]:
    current = Register("present_current", 126, 2, Quantity.CURRENT, "mA", milliampere, signed=True)
    return (*_X, current)


SERVOS: Mapping[str, Mapping[str, tuple[Register, ...]]] = {
    "feetech": {"sts3215": _STS, "sts3250": _STS, "scs0009": _SCS},
    "dynamixel2": {
        "xl430": _X,  # its address 126 is a load, in per mille of no stated torque
        "xc430": _X,
        "xl330": _x_with_current(1.0),
        "xm430": _x_with_current(2.69),
        "xm540": _x_with_current(2.69),
        "xh430": _x_with_current(2.69),
    },
}
"""Protocol to model to registers. Angle 0 is the middle of the range, as the servos have it."""


def _crc_table() -> tuple[int, ...]:
    table: list[int] = []
    for byte in range(256):
        value = byte << 8
        for _ in range(8):
            value = (value << 1) ^ (0x8005 if value & 0x8000 else 0)
        table.append(value & 0xFFFF)
    return tuple(table)


_TABLE = _crc_table()


def crc16(data: bytes) -> int:
    """Return the CRC of a Dynamixel 2.0 packet without its last two bytes."""
    value = 0
    for byte in data:
        value = (value << 8 & 0xFF00) ^ _TABLE[value >> 8 ^ byte]
    return value


def feetech_packet(servo: int, instruction: int, parameters: bytes = b"") -> bytes:
    """Build a Feetech packet; of a reply, ``instruction`` is its error byte."""
    body = bytes((servo, len(parameters) + 2, instruction)) + parameters
    return b"\xff\xff" + body + bytes((~sum(body) & 0xFF,))


def dynamixel_packet(servo: int, instruction: int, parameters: bytes = b"") -> bytes:
    """Build a Dynamixel 2.0 packet; a reply's parameters begin with its error byte."""
    body = (bytes((instruction,)) + parameters).replace(PLAIN, STUFFED)
    whole = b"\xff\xff\xfd\x00" + bytes((servo,)) + (len(body) + 2).to_bytes(2, "little") + body
    return whole + crc16(whole).to_bytes(2, "little")


def _judge_feetech(data: bytes, at: int, ended: bool) -> int:
    return _feetech(data, at, ended, {})


def _feetech(data: bytes, at: int, ended: bool, judged: dict[int, int]) -> int:  # noqa: PLR0911
    """Judge a packet; ``judged`` keeps the judgements of those inside, by where they begin."""
    end = len(data)
    if at + 4 > end:
        return FAULTY if data[at + 2 : at + 3] == b"\xff" else MORE
    size = data[at + 3] + 4
    if data[at + 2] == 0xFF or not 6 <= size <= 255:
        return FAULTY
    stop = at + size
    if stop > end:
        return MORE
    if sum(data[at + 2 : stop]) & 0xFF != 0xFF:  # the checksum is the inverted sum of the others
        return FAULTY
    # One in 256 packets that were cut passes with bytes of the next one: that has its own checksum.
    inside = data.find(b"\xff\xff", at + 4, stop)
    while inside >= 0:
        other = judged.get(inside)
        if other is None:  # packets in packets: without `judged` the time doubles with each
            other = judged[inside] = _feetech(data, inside, ended, judged)
        if other == MORE and not ended:
            return MORE
        if other > 0 and inside + other >= stop:
            return FAULTY
        inside = data.find(b"\xff\xff", inside + 1, stop)
    return size


def _judge_dynamixel(data: bytes, at: int, ended: bool) -> int:  # noqa: ARG001
    end = len(data)
    if at + 7 > end:
        return MORE
    size = int.from_bytes(data[at + 5 : at + 7], "little") + 7
    if not 10 <= size <= _LONGEST or data[at + 4] == 0xFF:
        return FAULTY
    if data.find(b"\xff\xff\xfd\x00", at + 4, at + size) >= 0:
        return FAULTY  # inside a packet a FD would be stuffed there
    if at + size > end:
        return MORE
    crc = int.from_bytes(data[at + size - 2 : at + size], "little")
    return size if crc16(data[at : at + size - 2]) == crc else FAULTY


@dataclass(frozen=True)
class Protocol:
    """How packets of a protocol are found in a stream, and built."""

    header: bytes
    judge: Judge
    packet: Callable[[int, int, bytes], bytes]
    id_at: int


PROTOCOLS: Mapping[str, Protocol] = {
    "feetech": Protocol(b"\xff\xff", _judge_feetech, feetech_packet, 2),
    "dynamixel2": Protocol(b"\xff\xff\xfd\x00", _judge_dynamixel, dynamixel_packet, 4),
}


class StreamPiece(NamedTuple):
    """Bytes of the stream: a packet with a valid checksum, or bytes of none.

    Attributes:
        stop: Number of bytes of the stream up to its end.
    """

    data: bytes
    stop: int
    valid: bool


class PacketSplitter:
    """Cuts a stream into packets and bytes that belong to none; nothing is dropped.

    Behind a faulty packet the search goes on at its second byte, so a cut one doesn't take the next
    with it.
    """

    def __init__(self, protocol: str) -> None:
        """Start at any place of a stream of a protocol of :data:`PROTOCOLS`."""
        self._protocol = PROTOCOLS[protocol]
        self._rest = b""
        self._done = 0

    def feed(self, chunk: bytes, *, silence: bool = False) -> list[StreamPiece]:
        """Add bytes, and return what is complete now.

        Args:
            silence: No byte has come for long: an unfinished packet was cut.
        """
        data = self._rest + chunk
        header, judge = self._protocol.header, self._protocol.judge
        pieces: list[StreamPiece] = []
        start = at = 0  # of what is not handed out yet, of the search
        while (begin := data.find(header, at)) >= 0:
            size = judge(data, begin, silence)
            if size == MORE and not silence:
                break
            if size <= 0:
                at = begin + 1
                continue
            if begin > start:
                pieces.append(StreamPiece(data[start:begin], self._done + begin, False))
            start = at = begin + size
            pieces.append(StreamPiece(data[begin:start], self._done + start, True))
        if begin < 0:
            begin = len(data) if silence else _header_begins(data, at, header)
        if begin > start:
            pieces.append(StreamPiece(data[start:begin], self._done + begin, False))
        self._done += max(begin, start)
        self._rest = data[max(begin, start) :]
        return pieces


def _header_begins(data: bytes, at: int, header: bytes) -> int:
    """Return where the beginning of a header ends the data; the data's length if nowhere."""
    for size in range(min(len(header) - 1, len(data) - at), 0, -1):
        if data.endswith(header[:size]):
            return len(data) - size
    return len(data)
