"""Time in the recorder: its clock, the duration of its ticks, tasks once a second.

The clock of a recording: Unix time at its start, and monotonic time from there on.

The wall clock may be set while a robot is being recorded (NTP, a user, a GPS fix); nothing of that
may change an order or a duration in the session.
"""

from __future__ import annotations

import time
from bisect import bisect_right
from collections.abc import Callable, Sequence
from dataclasses import dataclass


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


_NS = 1_000_000_000


class EachSecond:
    """Runs tasks once a second each, at most one a call.

    By the clock, not by counting calls: under load these come more often, or less.
    """

    def __init__(self, tasks: Sequence[Callable[[], object]], now_ns: int) -> None:
        """Begin in a second from now, in the order given.

        Args:
            tasks: What to do.
            now_ns: A monotonic clock [ns].
        """
        self._tasks = tuple(tasks)
        step_ns = _NS // (len(tasks) + 1)
        self._due_ns = [now_ns + (k + 1) * step_ns for k in range(len(tasks))]

    def run(self, now_ns: int) -> None:
        """Run the task that has waited for longest, if one is due.

        Args:
            now_ns: The same clock [ns].
        """
        if not self._tasks:
            return
        k = min(range(len(self._due_ns)), key=self._due_ns.__getitem__)
        if self._due_ns[k] > now_ns:
            return
        late = now_ns - self._due_ns[k] >= _NS
        self._due_ns[k] = now_ns + _NS if late else self._due_ns[k] + _NS
        self._tasks[k]()


_PER_DECADE = 40
_EDGES_NS = [round(1e3 * 10 ** (k / _PER_DECADE)) for k in range(7 * _PER_DECADE + 1)]


@dataclass(frozen=True)
class TickTimes:
    """Durations of ticks.

    Attributes:
        count: Number of ticks.
        p50_s: Median [s], 0 without ticks.
        p99_s: 99 % point [s], to 6 %.
        max_s: Longest [s].
    """

    count: int
    p50_s: float
    p99_s: float
    max_s: float


class TickTally:
    """Counts durations in bins of equal ratio, 40 a decade from 1 us to 10 s."""

    def __init__(self) -> None:
        """Start empty."""
        self._bins = [0] * (len(_EDGES_NS) + 1)
        self._count = self._longest_ns = 0

    def add(self, duration_ns: int) -> None:
        """Count one tick.

        Args:
            duration_ns: How long it took [ns].
        """
        self._bins[bisect_right(_EDGES_NS, duration_ns)] += 1
        self._count += 1
        self._longest_ns = max(self._longest_ns, duration_ns)

    def result(self) -> TickTimes:
        """What the ticks so far took."""
        return TickTimes(self._count, self._point(0.5), self._point(0.99), self._longest_ns * 1e-9)

    def _point(self, part: float) -> float:
        """Upper edge of the bin that the quantile falls into [s]."""
        wanted, seen = part * self._count, 0
        for edge, number in zip((*_EDGES_NS, self._longest_ns), self._bins, strict=True):
            seen += number
            if number and seen >= wanted:
                return min(edge, self._longest_ns) * 1e-9
        return 0.0
