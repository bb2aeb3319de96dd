"""How closely two commands may follow each other: rates hold in true time, not from tick to tick.

The clamp bounds a step by what the greatest rate allows in one control period. Deadlines are
anchored at the first tick, so behind a tick that came late the next one is due in less than a
period: the servos would be told to go the same way in less time. The later command waits then until
the rate allows its step. No step takes more than a period, so that no wait is longer.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from undulog.capture.common.arrays import FloatArray, IntArray

_NS = 1e9


class Spacing:
    """When the frames of a command may be sent.

    It knows when each frame of the command before was handed to the bus: a burst that was held up
    half way, e.g. as the process was stopped, holds up what follows by as much as it needs.

    Attributes:
        waits: Commands that have to wait, so far.
        longest_s: The longest of these waits [s].
    """

    def __init__(self, rate: FloatArray, now_ns: Callable[[], int]) -> None:
        """Nothing was sent yet.

        Args:
            rate: Greatest rates [rad/s], shape (m,).
            now_ns: The clock [ns].
        """
        self.waits, self.longest_s = 0, 0.0
        self._rate, self._now_ns = rate, now_ns
        self._last: FloatArray | None = None
        self._sent_ns: IntArray = np.empty(0, dtype=np.int64)

    def earliest_ns(self, command: FloatArray, count: int) -> IntArray:
        """The earliest times at which a command's frames may be sent.

        Args:
            command: Joint angles [rad], shape (m,).
            count: How many frames carry it; always in the same order.

        Returns:
            Each frame's, on the clock [ns], shape (count,); 0 where nothing was sent before.
        """
        if self._last is None:
            return np.zeros(count, dtype=np.int64)
        need_s = float(np.max(np.abs(command - self._last) / self._rate, initial=0.0))
        before = self._sent_ns
        if len(before) != count:  # not the same frames: none of them earlier than all of those
            before = np.full(count, before.max(initial=0))
        earliest = before + math.ceil(need_s * _NS)
        wait_s = (int(earliest.max()) - self._now_ns()) / _NS
        if wait_s > 0.0:
            self.waits += 1
            self.longest_s = max(self.longest_s, wait_s)
        return earliest

    def sent(self, command: FloatArray, sent_ns: IntArray) -> None:
        """A command was sent.

        Args:
            command: Joint angles [rad], shape (m,).
            sent_ns: When the bus had each of its frames, on the clock [ns], shape (n,).
        """
        self._last, self._sent_ns = command, sent_ns
