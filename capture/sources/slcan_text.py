"""The serial line protocol of slcan adapters (Lawicel).

A frame is a line ended by a carriage return: ``t`` (11-bit identifier, three digits) or ``T``
(29-bit, eight), a length digit, two digits for each data byte, and, if the adapter stamps its
frames, four digits of milliseconds that start again after a minute. ``r`` and ``R`` are remote
requests; ``d`` and ``D`` CAN FD frames, ``b`` and ``B`` such whose data have the second bit rate,
all four with a length code up to ``F``. A bell character is the adapter's way to say that something
went wrong.

One expression finds all frames of a chunk; a chunk with anything else in it is read line by line.
"""

from __future__ import annotations

import re

from ..log.messages.frames import (
    EXTENDED_FLAG,
    FD_BRS,
    FRAME_DTYPE,
    REMOTE_FLAG,
    FrameArray,
    empty_fd_frames,
)
from .events import Tally
from .records import fd_records, pack_fd_record, pack_record, records

STAMP_PERIOD_MS = 60_000
"""An adapter's time stamps start again after so many milliseconds."""

_FRAME = (  # x: CANDapter's T
    r"([tr][0-9A-Fa-f]{3}(?=[0-8])|[TRx][0-9A-Fa-f]{8}(?=[0-8])"
    r"|[db][0-9A-Fa-f]{3}|[DB][0-9A-Fa-f]{8})([0-9A-Fa-f])([0-9A-Fa-f]*)"
)
_FRAMES = re.compile(rf"(?<![^\r]){_FRAME}\r")
_ONE = re.compile(_FRAME)
_END = re.compile(r"[\r\a]")
_FD_LENGTHS = (0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64)
_ANSWERS = "zZVvNF"  # acknowledged, version, serial number, status
_LONGEST = 200  # a CAN FD frame with 64 bytes has 142
_HIGHEST_STANDARD = 0x7FF
_HIGHEST_EXTENDED = 0x1FFF_FFFF
_NS_PER_MS = 1_000_000


class SlcanText:
    """Turns what an adapter sends into frames; keeps a line's beginning until its end comes."""

    def __init__(self, *, stamps: bool) -> None:
        """Start at the beginning of a line.

        Args:
            stamps: Whether the adapter was asked to stamp its frames, so that their device time
                is taken from it.
        """
        self._stamps = StampClock() if stamps else None
        self._rest = b""
        self._has_fd = False

    def feed(self, chunk: bytes, t_ns: int, tally: Tally) -> tuple[FrameArray, FrameArray]:
        """Take what was read.

        Args:
            chunk: The bytes.
            t_ns: When they were read [Unix ns].
            tally: Where to count what is malformed.

        Returns:
            The frames whose lines have ended, classic ones and CAN FD ones.
        """
        whole = self._rest + chunk
        end = max(whole.rfind(b"\r"), whole.rfind(b"\a")) + 1
        self._rest = whole[end:]
        if len(self._rest) > _LONGEST:
            self._rest = b"?"  # noise: its end, when it comes, is one malformed line
        text = whole[:end].decode("latin-1")  # any byte is some character
        found: list[tuple[str, str, str]] = _FRAMES.findall(text)
        if len(found) != text.count("\r") or "\a" in text:
            found = _line_by_line(text, tally)
        packed = [record for fields in found if (record := self._record(*fields, t_ns))]
        tally.malformed("malformed line", len(found) - len(packed))
        if not self._has_fd:  # the usual case: nothing to pick
            return records(packed), empty_fd_frames(0)
        size = FRAME_DTYPE.itemsize
        fd = [record for record in packed if len(record) != size]
        return records(record for record in packed if len(record) == size), fd_records(fd)

    def _record(self, head: str, digit: str, rest: str, t_ns: int) -> bytes | None:
        """A frame's record; None if its line is malformed."""
        kind = head[0]
        flags = int(head[1:], 16)
        length = _FD_LENGTHS[int(digit, 16)]
        digits = 2 * length
        if kind in "TRxDB":
            if flags > _HIGHEST_EXTENDED:
                return None
            flags |= EXTENDED_FLAG
        elif flags > _HIGHEST_STANDARD:
            return None
        if kind in "rR":
            flags |= REMOTE_FLAG
            digits = 0
        extra = len(rest) - digits
        if extra not in (0, 4):
            return None
        device_ns: int | None = t_ns
        if self._stamps is not None:
            device_ns = self._stamps.time_ns(rest[digits:], t_ns)
            if device_ns is None:
                return None
        data = bytes.fromhex(rest[:digits])
        if kind in "dDbB":
            self._has_fd = True
            brs = FD_BRS if kind in "bB" else 0
            return pack_fd_record(device_ns, t_ns, flags, length, 0, brs, data)
        return pack_record(device_ns, t_ns, flags, length, 0, data)


class StampClock:
    """Counts the minutes that an adapter's stamps leave out."""

    def __init__(self) -> None:
        """Start before the first stamp."""
        self._last_ms: int | None = None
        self._last_host_ns = 0

    def time_ns(self, stamp: str, host_ns: int) -> int | None:
        """The device's time of a frame.

        Args:
            stamp: Four digits of milliseconds; empty if the adapter gave none.
            host_ns: When the frame was read [Unix ns]: it tells how many minutes a pause took.

        Returns:
            Time on the adapter's clock [ns]; the host's if it never gave a stamp; None if it did,
            but not now, or if the stamp is beyond a minute.
        """
        if not stamp:
            return host_ns if self._last_ms is None else None
        time_ms = int(stamp, 16)
        if time_ms >= STAMP_PERIOD_MS:
            return None
        if self._last_ms is not None:
            half = STAMP_PERIOD_MS // 2
            expected = self._last_ms + (host_ns - self._last_host_ns) // _NS_PER_MS
            minutes = (expected - time_ms + half) // STAMP_PERIOD_MS
            time_ms += STAMP_PERIOD_MS * max(0, minutes)
        self._last_ms, self._last_host_ns = time_ms, host_ns
        return time_ms * _NS_PER_MS


def _line_by_line(text: str, tally: Tally) -> list[tuple[str, str, str]]:
    """The fields of the frames in a chunk that has other things in it too."""
    tally.malformed("the adapter reports an error (bell)", text.count("\a"))
    found: list[tuple[str, str, str]] = []
    malformed = 0
    for line in _END.split(text):
        frame = _ONE.fullmatch(line)
        if frame is not None:
            found.append((frame[1], frame[2], frame[3]))
        elif line and line[0] not in _ANSWERS:
            malformed += 1
    tally.malformed("malformed line", malformed)
    return found
