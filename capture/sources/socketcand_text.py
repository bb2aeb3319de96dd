"""The raw mode of socketcand.

A frame is ``< frame 123 1700000000.123456 1122AABB >``: an identifier of three digits (11 bit) or
eight (29 bit), the server's time, the data, with some servers with blanks between the bytes. One
expression finds them all. What is rare is read one by one: remote requests
``< rtr 123 TIME LENGTH >``, error frames ``< error CLASSES TIME >``, times with another number of
decimals, and whatever is broken.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np

from ..log.frames import (
    ERROR_FLAG,
    EXTENDED_FLAG,
    ID_MASK,
    REMOTE_FLAG,
    FrameArray,
    empty_frames,
)
from .events import Tally

_FRAMES = re.compile(
    r"< frame ([0-9A-Fa-f]{1,8}) (\d{1,10})\.(\d{6}) ((?:[0-9A-Fa-f]{2} ?){0,8}) ?>", re.ASCII
)
_MESSAGE = re.compile(r"<[^<>]*>")
_ANY = re.compile(
    r"< *(frame|rtr|error) +([0-9A-Fa-f]{1,8}) +(\d{1,10})(?:\.(\d{1,9}))?"
    r"(?: +([0-9A-Fa-f ]*?))? *>",
    re.ASCII,
)
_WORD = re.compile(r"< *(hi|ok|echo) *>")
_TOLD = re.compile(r"< *(error\b[^>]*?) *>")
_LONGEST = 400  # a CAN FD frame with 64 bytes and blanks has about 220
_HIGHEST_STANDARD = 0x7FF
_HIGHEST_EXTENDED = 0x1FFF_FFFF


@dataclass(frozen=True)
class _Frame:
    """A frame that was read on its own."""

    t_ns: int
    id_flags: int
    length: int
    data: bytes


class SocketcandText:
    """Turns what a server sends into frames; keeps a message's beginning until its end comes."""

    def __init__(self) -> None:
        """Start between two messages."""
        self._rest = b""

    def feed(self, chunk: bytes, t_ns: int, tally: Tally) -> FrameArray:
        """Take what was read.

        Args:
            chunk: The bytes.
            t_ns: When they were read [Unix ns].
            tally: Where to count what is malformed.

        Returns:
            The frames whose messages have ended.
        """
        whole = self._rest + chunk
        end = whole.rfind(b">") + 1
        self._rest = whole[end:]
        if len(self._rest) > _LONGEST:
            self._rest = b"<"  # noise: its end, when it comes, is one malformed message
        text = whole[:end].decode("latin-1")  # any byte is some character
        found: list[tuple[str, str, str, str]] = _FRAMES.findall(text)
        frames = None
        if len(found) == text.count("<") == text.count(">"):
            frames = _together(found)
        if frames is None:
            frames = _one_by_one(text, tally)
        frames["t_host_ns"] = t_ns
        return frames


def _together(found: list[tuple[str, str, str, str]]) -> FrameArray | None:
    """Frames from their fields; None if an identifier is too high for its number of digits."""
    frames = empty_frames(len(found))
    if not found:
        return frames
    identifiers, seconds, micros, fields = zip(*found, strict=True)
    frames["t_device_ns"] = [
        int(whole + part) * 1000 for whole, part in zip(seconds, micros, strict=True)
    ]
    ids = np.array([int(digits, 16) for digits in identifiers], dtype=np.uint32)
    extended = np.array([len(digits) for digits in identifiers]) > 3
    if (ids > np.where(extended, _HIGHEST_EXTENDED, _HIGHEST_STANDARD)).any():
        return None
    frames["id_flags"] = ids | extended * np.uint32(EXTENDED_FLAG)
    data = [field.replace(" ", "") for field in fields]
    frames["dlc"] = [len(digits) // 2 for digits in data]
    padded = bytes.fromhex("".join([digits.ljust(16, "0") for digits in data]))
    frames["data"] = np.frombuffer(padded, dtype=np.uint8).reshape(-1, 8)
    return frames


def _one_by_one(text: str, tally: Tally) -> FrameArray:
    messages = _MESSAGE.findall(text)
    broken = text.count("<") + text.count(">") - 2 * len(messages)
    tally.malformed("malformed message", broken)
    read = [frame for message in messages if (frame := _frame(message, tally)) is not None]
    frames = empty_frames(len(read))
    if read:
        frames["t_device_ns"] = [frame.t_ns for frame in read]
        frames["id_flags"] = [frame.id_flags for frame in read]
        frames["dlc"] = [frame.length for frame in read]
        padded = b"".join(frame.data.ljust(8, b"\0") for frame in read)
        frames["data"] = np.frombuffer(padded, dtype=np.uint8).reshape(-1, 8)
    return frames


def _frame(message: str, tally: Tally) -> _Frame | None:
    """Read one message; None if it is no frame."""
    found = _ANY.fullmatch(message)
    if found is None:
        told = _TOLD.fullmatch(message)
        if told is not None:
            tally.events.say("warn", f"the server says: {told[1]!r}")
        elif not _WORD.fullmatch(message):
            tally.malformed("malformed message", 1)
        return None
    kind, digits, seconds, fraction, rest = found.groups(default="")
    t_ns = int(seconds) * 1_000_000_000 + int(fraction.ljust(9, "0"))
    identifier = int(digits, 16)
    if kind == "error":  # the server keeps the details to itself
        return _Frame(t_ns, identifier & ID_MASK | ERROR_FLAG, 0, b"")
    extended = len(digits) > 3
    flags = extended * EXTENDED_FLAG
    rest = rest.replace(" ", "")
    if kind == "rtr":
        flags |= REMOTE_FLAG
        length, data = int(rest) if rest.isdigit() else -1, b""
    else:
        data = bytes.fromhex(rest) if len(rest) % 2 == 0 else None
        length = -1 if data is None else len(data)
    if length > 8 and kind == "frame":
        tally.events.say("warn", "CAN FD frame left out")
        return None
    highest = _HIGHEST_EXTENDED if extended else _HIGHEST_STANDARD
    if data is None or not 0 <= length <= 8 or identifier > highest:
        tally.malformed("malformed message", 1)
        return None
    return _Frame(t_ns, identifier | flags, length, data)
