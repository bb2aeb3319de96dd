"""The clock of a recording: Unix time at its start, and monotonic time from there on.

The wall clock may be set while a robot is being recorded (NTP, a user, a GPS fix); nothing of that
may change an order or a duration in the session.
"""

from __future__ import annotations

import time


class SessionClock:
    """Unix time at the start plus monotonic time since."""

    def __init__(self) -> None:
        """Start now."""
        before = time.monotonic_ns()
        self.epoch_ns = time.time_ns()
        self._zero = self.epoch_ns - (before + time.monotonic_ns()) // 2

    def now_ns(self) -> int:
        """The present time of the session [Unix ns]; never goes back."""
        return self._zero + time.monotonic_ns()

    def from_monotonic_ns(self, monotonic_ns: int) -> int:
        """The session's time at a moment of the monotonic clock.

        Args:
            monotonic_ns: As ``time.monotonic_ns`` gives it.

        Returns:
            Session time [Unix ns].
        """
        return self._zero + monotonic_ns
