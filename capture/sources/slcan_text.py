"""The serial line protocol of slcan adapters (Lawicel), read in bulk.

A frame is a line ended by a carriage return: ``t`` (11-bit identifier, three digits) or ``T``
(29-bit, eight), a length digit, two digits for each data byte, and, if the adapter stamps its
frames, four digits of milliseconds that start again after a minute. ``r`` and ``R`` are remote
requests. A bell character is the adapter's way to say that something went wrong.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..log.frames import EXTENDED_FLAG, REMOTE_FLAG, FrameArray, empty_frames
from .events import Tally
from .hex_text import NIBBLES, Text, cut, data_bytes, identifiers

STAMP_PERIOD_MS = 60_000
"""An adapter's time stamps start again after so many milliseconds."""

_RETURN = 0x0D
_BELL = 0x07
_LONGEST = 200  # a CAN FD frame with 64 bytes has 142
_NS_PER_MS = 1_000_000


def _kinds(letters: bytes) -> NDArray[np.bool_]:
    table = np.zeros(256, dtype=np.bool_)
    table[list(letters)] = True
    return table


_FRAME = _kinds(b"tTrRx")  # x: an extended frame in CANDapter's dialect
_EXTENDED = _kinds(b"TRx")
_REMOTE = _kinds(b"rR")
_FD = _kinds(b"dDbB")
_ANSWER = _kinds(b"zZVvNF")  # acknowledged, version, serial number, status


class SlcanText:
    """Turns what an adapter sends into frames; keeps a line's beginning until its end comes."""

    def __init__(self, *, stamps: bool) -> None:
        """Start at the beginning of a line.

        Args:
            stamps: Whether the adapter was asked to stamp its frames, so that their device time
                is taken from it.
        """
        self._stamps = _StampClock() if stamps else None
        self._rest = b""

    def feed(self, chunk: bytes, t_ns: int, tally: Tally) -> FrameArray:
        """Take what was read.

        Args:
            chunk: The bytes.
            t_ns: When they were read [Unix ns].
            tally: Where to count what is malformed.

        Returns:
            The frames whose lines have ended.
        """
        text = self._rest + chunk
        end = max(text.rfind(b"\r"), text.rfind(b"\a")) + 1
        self._rest = text[end:]
        if len(self._rest) > _LONGEST:
            self._rest = b"?"  # noise: its end, when it comes, is one malformed line
        if not end:
            return empty_frames(0)
        array = np.frombuffer(text, dtype=np.uint8, count=end)
        is_bell = array == _BELL
        ends = np.flatnonzero((array == _RETURN) | is_bell)
        starts = np.empty_like(ends)
        starts[0] = 0
        starts[1:] = ends[:-1] + 1
        tally.malformed("the adapter reports an error (bell)", int(np.count_nonzero(is_bell)))
        return self._lines(array, starts, ends - starts, t_ns, tally)

    def _lines(
        self,
        text: Text,
        starts: NDArray[np.intp],
        sizes: NDArray[np.intp],
        t_ns: int,
        tally: Tally,
    ) -> FrameArray:
        kinds = text[starts]
        is_frame = _FRAME[kinds]
        if not is_frame.all():
            others = kinds[~is_frame & (sizes > 0)]
            fd = int(np.count_nonzero(_FD[others]))
            if fd:
                tally.events.say("warn", "CAN FD frame left out", fd)
            tally.malformed("malformed line", len(others) - fd - int(_ANSWER[others].sum()))
            starts, sizes, kinds = starts[is_frame], sizes[is_frame], kinds[is_frame]
        extended = _EXTENDED[kinds]
        remote = _REMOTE[kinds]
        widths = np.where(extended, 8, 3)
        lengths = NIBBLES[text.take(starts + 1 + widths, mode="clip")].astype(np.intp)
        plain = 2 + widths + np.where(remote, 0, 2 * lengths)
        stamped = sizes == plain + 4
        ids, good = identifiers(text, starts + 1, widths)
        good &= (lengths <= 8) & (stamped | (sizes == plain))
        good &= ids <= np.where(extended, 0x1FFF_FFFF, 0x7FF)
        carried = np.where(remote | ~good, 0, lengths)
        data, digits = data_bytes(text, starts + 2 + widths, carried)
        good &= digits
        times, timed = self._times(text, starts + plain, stamped, good, t_ns)
        good &= timed
        tally.malformed("malformed line", int(np.count_nonzero(~good)))
        frames = empty_frames(len(starts))
        frames["t_device_ns"] = times
        frames["t_host_ns"] = t_ns
        frames["id_flags"] = (
            ids | extended * np.uint32(EXTENDED_FLAG) | remote * np.uint32(REMOTE_FLAG)
        )
        frames["dlc"] = lengths
        frames["data"] = data
        return frames if good.all() else frames[good]

    def _times(
        self,
        text: Text,
        starts: NDArray[np.intp],
        stamped: NDArray[np.bool_],
        good: NDArray[np.bool_],
        t_ns: int,
    ) -> tuple[NDArray[np.uint64], NDArray[np.bool_]]:
        """Device times [ns], and which of them can be read; shape (n,) both."""
        times = np.full(len(starts), t_ns, dtype=np.uint64)
        if self._stamps is None:
            return times, np.ones(len(starts), dtype=np.bool_)
        raw = NIBBLES[cut(text, starts, 4)].astype(np.int64)
        digits = (raw < 16).all(axis=1)
        raw_ms = raw @ np.array([4096, 256, 16, 1])
        timed = stamped & digits & (raw_ms < STAMP_PERIOD_MS)
        use = timed & good
        if use.any():
            times[use] = self._stamps.unwrap(raw_ms[use], t_ns)
        elif not self._stamps.started:
            return times, np.ones(len(starts), dtype=np.bool_)  # it was asked, and gives none
        return times, timed


class _StampClock:
    """Counts the minutes that an adapter's stamps leave out."""

    def __init__(self) -> None:
        self.started = False
        self._last_ms = 0
        self._last_host_ns = 0

    def unwrap(self, raw_ms: NDArray[np.int64], t_ns: int) -> NDArray[np.uint64]:
        """Device times [ns] of frames read at one time, shape (n,)."""
        half = STAMP_PERIOD_MS // 2
        first = int(raw_ms[0])
        if self.started:
            # A pause may have taken minutes: the host's clock tells how many.
            expected = self._last_ms + (t_ns - self._last_host_ns) // _NS_PER_MS
            first += STAMP_PERIOD_MS * ((expected - first + half) // STAMP_PERIOD_MS)
            first = max(first, first % STAMP_PERIOD_MS)
        steps = np.diff(raw_ms)
        steps = (steps + half) % STAMP_PERIOD_MS - half
        total = first + np.concatenate([[0], np.cumsum(steps)])
        self.started = True
        self._last_ms = int(total[-1])
        self._last_host_ns = t_ns
        return (np.maximum(total, 0) * _NS_PER_MS).astype(np.uint64)
