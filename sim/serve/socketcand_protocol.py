"""What a socketcand server writes and reads: messages in angle brackets, frames in hexadecimal.

Protocol: https://github.com/linux-can/socketcand, ``doc/protocol.md``. The reading side of a client
is :mod:`.capture.sources.socketcand`.
"""

from __future__ import annotations

import re
import selectors
import socket
import time
from typing import NamedTuple

from undulog.capture.log.messages.frames import (
    DIR_TX,
    ERROR_FLAG,
    EXTENDED_FLAG,
    ID_MASK,
    REMOTE_FLAG,
    FrameArray,
    data_lengths,
)
from undulog.capture.sources.contract import pack_record

_MESSAGE = re.compile(rb"<([^<>]*)>")
_SENT = re.compile(r"([0-9a-f]{1,8}) ([0-8])((?: [0-9a-f]{1,2})*)", re.ASCII | re.IGNORECASE)
_LONGEST = 400
_DIGITS_EXTENDED = 8
_HIGHEST_STANDARD, _HIGHEST_EXTENDED = 0x7FF, ID_MASK


def frame_text(frames: FrameArray) -> bytes:
    """Frames as the raw mode has them, each with its device time to the microsecond.

    Args:
        frames: Records of :data:`.capture.log.messages.frames.FRAME_DTYPE`, shape (n,).

    Returns:
        ``< frame 201 12.345678 1122 >``, ``< rtr 201 12.345678 2 >`` or ``< error 040 12.345678 >``
        for each.
    """
    text: list[str] = []
    payload = frames["data"].tobytes().hex().upper()
    columns = (frames["t_device_ns"] // 1000, frames["id_flags"], data_lengths(frames))
    for k, (t_us, flags, length) in enumerate(zip(*(c.tolist() for c in columns), strict=True)):
        digits = _DIGITS_EXTENDED if flags & EXTENDED_FLAG else 3
        head = f"{flags & ID_MASK:0{digits}X} {t_us // 1_000_000}.{t_us % 1_000_000:06d}"
        if flags & ERROR_FLAG:
            text.append(f"< error {head} >")
        elif flags & REMOTE_FLAG:
            text.append(f"< rtr {head} {length} >")
        else:
            text.append(f"< frame {head} {payload[16 * k : 16 * k + 2 * length]} >")
    return "".join(text).encode()


def sent_frame(kind: str, rest: str) -> bytes | None:
    """Read what follows ``send`` or ``sendrtr``.

    Args:
        rest: E.g. ``123 2 11 F1``; eight digits are a 29-bit identifier.

    Returns:
        The frame as :data:`.capture.sources.contract.pack_record` packs it, without times; None if
        it is malformed.
    """
    match = _SENT.fullmatch(rest)
    if match is None:
        return None
    digits, length, field = match.groups()
    identifier = int(digits, 16)
    extended = len(digits) == _DIGITS_EXTENDED
    if identifier > (_HIGHEST_EXTENDED if extended else _HIGHEST_STANDARD):
        return None
    data = bytes(int(byte, 16) for byte in field.split())
    remote = kind == "sendrtr"
    if len(data) != (0 if remote else int(length)):
        return None
    flags = identifier | extended * EXTENDED_FLAG | remote * REMOTE_FLAG
    return pack_record(0, 0, flags, int(length), DIR_TX, data)


class ClientText:
    """Cuts what a client sends into messages; keeps a message's beginning until its end comes."""

    def __init__(self) -> None:
        """Start between two messages."""
        self._rest = b""

    def feed(self, chunk: bytes) -> list[str]:
        """Take what was read.

        Returns:
            What stood in brackets, blanks around it removed, in order.

        Raises:
            ValueError: If the client sends much that is no message.
        """
        whole = self._rest + chunk
        end = whole.rfind(b">") + 1
        self._rest = whole[end:]
        if len(self._rest) > _LONGEST:
            raise ValueError(f"{len(self._rest)} bytes without an end of a message")
        return [message.decode("latin-1").strip() for message in _MESSAGE.findall(whole[:end])]


class Sent(NamedTuple):
    """A frame that a client sent.

    Attributes:
        record: As :data:`.capture.sources.contract.pack_record` packs it, without times.
    """

    client: int
    record: bytes


class BusClient:
    """One connection.

    Attributes:
        number: From 1, never used again.
        peer: What it is called in messages.
        text: Cuts what it sends into messages.
        bus_open: Whether it has opened the bus.
        raw: Whether it is in raw mode and gets all frames.
        marks: Whether it is told of control ticks.
        received_s: Time of the monotonic clock of its last message, or of its connection [s].
        held_until: Nothing is sent to it before this time of the monotonic clock [s].
        out: What waits to be sent to it.
        watched: The selector's events that it is registered for; 0: it is not.
    """

    def __init__(self, number: int, sock: socket.socket, port: int) -> None:
        """Take over a connection.

        Args:
            port: The client's own port.
        """
        self.number, self.sock = number, sock
        self.peer = f"client {number} at port {port}"
        self.text = ClientText()
        self.bus_open = self.raw = self.marks = False
        self.received_s = time.monotonic()
        self.held_until = 0.0
        self.out = bytearray()
        self.watched = selectors.EVENT_READ
