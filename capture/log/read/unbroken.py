"""Where a session was recorded without a break.

A clock that jumps (set by NTP when the network comes, or by hand) leaves a hole of hours or years
in the stamps, and nothing tells how the motion before it joins that after it.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from ...common.arrays import IntArray

BREAK_S = 10.0
"""A session breaks where none of its channels has a sample for longer than this [s]; shorter gaps
are losses, which the estimators stand."""

BREAK_INTERVALS = 10
"""Median intervals that a break has at least: slow channels sample less often than that."""

_NS = 1_000_000_000


@dataclass(frozen=True)
class Unbroken:
    """The longest stretch without a break.

    Attributes:
        start_ns: Its first sample [Unix ns].
        last_ns: Its last sample [Unix ns].
        others: How many stretches are left out.
        left_s: Their length together, without the gaps [s].
        gap_s: The longest gap between stretches [s]; 0 where there is none.
    """

    start_ns: int
    last_ns: int
    others: int = 0
    left_s: float = 0.0
    gap_s: float = 0.0

    def __str__(self) -> str:
        """One sentence; what is left out, and why."""
        stretches = "1 other stretch" if self.others == 1 else f"{self.others} other stretches"
        return (
            f"the recording has a gap of {_length(self.gap_s)}: its longest unbroken stretch, "
            f"{(self.last_ns - self.start_ns) / _NS:.1f} s, is analysed, {stretches} of "
            f"{self.left_s:.1f} s altogether left out (choose with --start and --stop)"
        )


def longest_unbroken(
    times_ns: Iterable[IntArray], start_ns: int | None = None, stop_ns: int | None = None
) -> Unbroken | None:
    """Find the longest stretch in which the samples of some channels follow each other.

    Args:
        times_ns: Sampling times of each channel [Unix ns], not decreasing.
        start_ns: First time to look at [Unix ns], or None.
        stop_ns: One past the last time [Unix ns], or None.

    Returns:
        The stretch; of equal ones the first; None without samples.
    """
    runs = [
        run
        for t_ns in {id(each): each for each in times_ns}.values()
        for run in _runs(_within(t_ns, start_ns, stop_ns))
    ]
    joined: list[tuple[int, int]] = []
    for first, last in sorted(runs):
        if joined and first - joined[-1][1] <= BREAK_S * _NS:
            joined[-1] = joined[-1][0], max(joined[-1][1], last)
        else:
            joined.append((first, last))
    if not joined:
        return None
    longest = max(joined, key=lambda run: run[1] - run[0])
    gaps = [after[0] - before[1] for before, after in pairwise(joined)]
    left = sum(last - first for first, last in joined) - (longest[1] - longest[0])
    return Unbroken(*longest, len(joined) - 1, left / _NS, max(gaps, default=0) / _NS)


def _within(t_ns: IntArray, start_ns: int | None, stop_ns: int | None) -> IntArray:
    first = 0 if start_ns is None else int(np.searchsorted(t_ns, start_ns))
    stop = t_ns.size if stop_ns is None else int(np.searchsorted(t_ns, stop_ns))
    return t_ns[first:stop]


def _runs(t_ns: IntArray) -> list[tuple[int, int]]:
    """First and last time of each stretch of one channel."""
    if not t_ns.size:
        return []
    step = np.diff(t_ns)
    breaks = np.flatnonzero(step > BREAK_S * _NS)
    if breaks.size:
        least = BREAK_INTERVALS * float(np.median(step))
        breaks = breaks[step[breaks] > least]
    firsts = t_ns[np.concatenate([[0], breaks + 1])]
    lasts = t_ns[np.concatenate([breaks, [t_ns.size - 1]])]
    return list(zip(firsts.tolist(), lasts.tolist(), strict=True))


def _length(seconds: float) -> str:
    for unit, size in (("days", 86400.0), ("h", 3600.0), ("min", 60.0)):
        if seconds >= 2 * size:
            return f"{seconds / size:.1f} {unit}"
    return f"{seconds:.1f} s"
