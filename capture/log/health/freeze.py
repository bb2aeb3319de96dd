"""Joints whose angle is exactly constant while their command moves, per second."""

from __future__ import annotations

from typing import NamedTuple, cast

import numpy as np

from ...common.arrays import NS, BoolArray, FloatArray, IntArray

FROZEN_COMMAND_RAD = 0.05
"""A joint is frozen in a second if its angle is exactly constant while its command moves by more
than this: ten steps of the coarsest common servo (0.29 degrees)."""

FROZEN_SAMPLES = 5
"""A second with fewer samples is not judged."""

KEPT_S = 600
"""Most seconds that a live tally keeps for another series whose stamps lag behind."""


class Ranges(NamedTuple):
    """Smallest and largest value of each joint in each second.

    Attributes:
        second: Unix seconds, increasing, shape (s,).
        samples: Samples in each, shape (s,).
        low: Shape (s, k); NaN for a second without other values.
        high: Shape (s, k).
    """

    second: IntArray
    samples: IntArray
    low: FloatArray
    high: FloatArray


class RangeTally:
    """Smallest and largest values per second, in 16 bytes per joint and second."""

    def __init__(self, horizon_s: int | None = None) -> None:
        """Start empty.

        Args:
            horizon_s: Leave out samples older than this before the newest one [s], so that earlier
                seconds are complete and can be dropped; None for never.
        """
        self._horizon_s = horizon_s
        self._newest: int | None = None
        self._parts: list[Ranges] = []

    def add(self, t_ns: IntArray, values: FloatArray) -> None:
        """Add the next samples.

        Args:
            t_ns: Their times [Unix ns], shape (n,).
            values: Shape (n, k).
        """
        if not len(t_ns):
            return
        second = t_ns // NS
        if self._horizon_s is not None:
            newest = np.maximum.accumulate(second)
            if self._newest is not None:
                newest = np.maximum(newest, self._newest)
            kept = second >= newest - self._horizon_s
            self._newest = int(newest[-1])
            if not kept.all():
                second, values = second[kept], values[kept]
        if len(second):
            self._parts.append(_by_second(second, np.ones(len(second), int), values, values))

    def result(self, width: int) -> Ranges:
        """Return the ranges of all seconds that have samples and were not dropped.

        Args:
            width: Number of joints k, for a stream without samples.
        """
        if not self._parts:
            none = np.empty((0, width))
            return Ranges(np.empty(0, np.int64), np.empty(0, np.int64), none, none)
        if len(self._parts) > 1:
            self._parts = [_by_second(*map(np.concatenate, zip(*self._parts, strict=True)))]
        return self._parts[0]

    @property
    def closed(self) -> int | None:
        """Seconds before this one are complete; None without a horizon or a sample."""
        if self._horizon_s is None or self._newest is None:
            return None
        return self._newest - self._horizon_s

    def forget(self, before: int | None) -> None:
        """Drop complete seconds that are no longer needed.

        Args:
            before: The first second to keep; None to keep all but the oldest of a live tally.
        """
        if self._newest is None or not self._parts:
            return
        oldest = self._newest - KEPT_S
        first = oldest if before is None else max(before, oldest)
        whole = self.result(self._parts[0].low.shape[1])
        kept = whole.second >= first
        if not kept.all():
            self._parts = [Ranges._make(column[kept] for column in whole)]


def _by_second(second: IntArray, count: IntArray, low: FloatArray, high: FloatArray) -> Ranges:
    if (np.diff(second) < 0).any():
        order = np.argsort(second, kind="stable")
        second, count, low, high = second[order], count[order], low[order], high[order]
    first = np.flatnonzero(np.diff(second, prepend=second[:1] - 1))
    return Ranges(
        second[first],
        np.add.reduceat(count, first),
        np.fmin.reduceat(low, first, axis=0),
        np.fmax.reduceat(high, first, axis=0),
    )


class FreezeTally:
    """The longest time that joints of one series were frozen while their commands moved."""

    def __init__(self, names: tuple[str, ...], commanded: tuple[str, ...]) -> None:
        """Start empty."""
        place = {name: k for k, name in reversed([*enumerate(commanded)])}
        self.columns = tuple(k for k, name in enumerate(names) if name in place)
        """Indices in ``names`` of the joints of both, m of them."""
        self._measured = list(self.columns)
        self._commanded = [place[names[k]] for k in self.columns]
        self._runs = _Runs(-(2**62), *np.zeros((3, len(self.columns)), np.int64))

    def result(
        self, measured: Ranges, command: Ranges, closed: int | None
    ) -> tuple[IntArray, IntArray]:
        """Add the next seconds and return the longest runs.

        Args:
            measured: Ranges of the angles [rad], with every second since ``closed`` of the last
                call.
            command: Ranges of the commands [rad], likewise.
            closed: Seconds before this one will not change; None if any may.

        Returns:
            Longest run of frozen seconds [s] and its first second [Unix s], each of shape (m,);
            0 for a joint that never froze.
        """
        matched = np.intersect1d(
            measured.second, command.second, assume_unique=True, return_indices=True
        )
        # numpy's types don't say that there are three
        seconds, here, there = cast("tuple[IntArray, IntArray, IntArray]", matched)
        stood = measured.high[here][:, self._measured]
        stood = stood == measured.low[here][:, self._measured]
        stood &= (measured.samples[here] >= FROZEN_SAMPLES)[:, None]
        span = command.high[there][:, self._commanded]
        span = span - command.low[there][:, self._commanded]
        frozen = stood & (span > FROZEN_COMMAND_RAD)
        fresh = seconds > self._runs.second
        seconds, frozen = seconds[fresh], frozen[fresh]
        split = 0 if closed is None else int(np.searchsorted(seconds, closed))
        self._runs = self._runs.after(seconds[:split], frozen[:split])
        ahead = self._runs.after(seconds[split:], frozen[split:])
        return ahead.longest, ahead.longest_at


class _Runs(NamedTuple):
    """Runs of flagged, consecutive seconds: the current and the longest one."""

    second: int
    run: IntArray
    longest: IntArray
    longest_at: IntArray

    def after(self, seconds: IntArray, flags: BoolArray) -> _Runs:
        """Return the runs with more seconds, shape (s,), and flags, shape (s, m)."""
        if not len(seconds):
            return self
        before, run, longest, longest_at = self
        quiet = not run.any()
        some: list[bool] = np.asarray(flags.any(axis=1)).tolist()
        numbers: list[int] = seconds.tolist()
        for k, second in enumerate(numbers):
            if some[k] or not quiet:
                run = np.where(flags[k], (run if second == before + 1 else 0) + 1, 0)
                more = run > longest
                longest = np.where(more, run, longest)
                longest_at = np.where(more, second + 1 - run, longest_at)
                quiet = not some[k]
            before = second
        return _Runs(before, run, longest, longest_at)
