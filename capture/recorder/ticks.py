"""How long the recorder's ticks take: what else runs on the computer must not slow them down."""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass

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
