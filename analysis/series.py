"""Samples as the estimators take them: finite, in order, in seconds from a common origin."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from capture.arrays import FloatArray, IntArray, frozen

GAP_FACTOR = 3.0
"""An interval longer than this many median intervals is a gap: nothing is assumed inside it."""

_HALF_NS = 0.5e-9


@dataclass(frozen=True)
class Series:
    """One channel on its own sampling times.

    Attributes:
        name: Channel name, e.g. a joint's.
        t_s: Times from the common origin, strictly increasing [s], shape (n,).
        values: Finite values, shape (n,).
        dropped_nan: Samples left out because they were not finite.
        dropped_duplicates: Samples left out because their time was there already.
    """

    name: str
    t_s: FloatArray
    values: FloatArray
    dropped_nan: int = 0
    dropped_duplicates: int = 0

    @property
    def count(self) -> int:
        """Number of samples."""
        return self.t_s.size

    @property
    def period_s(self) -> float:
        """Median sampling interval [s]; NaN with fewer than two samples."""
        return float(np.median(np.diff(self.t_s))) if self.count > 1 else float("nan")

    def at(self, t_s: FloatArray) -> FloatArray:
        """Values at other times, interpolated linearly; the ends are held.

        Args:
            t_s: Times [s], shape (k,).

        Returns:
            Values, shape (k,).
        """
        return np.interp(t_s, self.t_s, self.values).astype(np.float64)

    def between(self, start_s: float, stop_s: float) -> Series:
        """The samples of a half-open window.

        Args:
            start_s: First time [s].
            stop_s: End, not included [s].

        Returns:
            Views of the samples with ``start_s <= t < stop_s``; counts of dropped samples stay
            those of the whole.
        """
        limits = np.array([start_s, stop_s]) - _HALF_NS  # times are whole ns but for rounding
        i, j = np.searchsorted(self.t_s, limits, side="left")
        return Series(
            self.name,
            self.t_s[i:j],
            self.values[i:j],
            self.dropped_nan,
            self.dropped_duplicates,
        )


def clean(name: str, t_ns: IntArray, values: FloatArray, origin_ns: int) -> Series:
    """Take raw samples into the form the estimators want.

    The origin is subtracted as an integer, so that Unix times keep their nanoseconds (a float64
    of a Unix time in seconds resolves 0.2 microseconds only).

    Args:
        name: Channel name.
        t_ns: Unix times [ns], any order, shape (n,).
        values: Values, NaN where there is none, shape (n,).
        origin_ns: Unix time that becomes 0 s.

    Returns:
        The series, without samples that are not finite and without second samples of one time.
    """
    finite = np.isfinite(values)
    kept_t, kept = t_ns[finite], values[finite]
    if kept_t.size > 1 and np.any(np.diff(kept_t) < 0):
        order = np.argsort(kept_t, kind="stable")
        kept_t, kept = kept_t[order], kept[order]
    first = np.ones(kept_t.size, dtype=np.bool_)
    first[1:] = np.diff(kept_t) > 0
    t_s = (kept_t[first] - np.int64(origin_ns)).astype(np.float64) * 1e-9
    return Series(
        name=name,
        t_s=frozen(t_s),
        values=frozen(kept[first].astype(np.float64)),
        dropped_nan=int(values.size - np.count_nonzero(finite)),
        dropped_duplicates=int(first.size - np.count_nonzero(first)),
    )


def sample_weights(t_s: FloatArray, start_s: float, stop_s: float) -> FloatArray:
    """Time that each sample stands for, so that ``sum(weights * f(t))`` integrates f.

    Each sample stands for half the interval to either neighbour: the trapezoidal rule, with the
    window closed upon itself, so that over whole cycles of a periodic f it converges faster than
    any power of the step (Trefethen & Weideman, SIAM Review 56, 2014). At a gap a sample stands
    for half a median interval and no more, so that gaps are not bridged.

    Args:
        t_s: Times within the window, strictly increasing [s], shape (n,).
        start_s: Start of the window [s].
        stop_s: End of the window [s].

    Returns:
        Weights [s], shape (n,); their sum over the window's length is the coverage.
    """
    if t_s.size == 0:
        return np.zeros(0)
    if t_s.size == 1:
        return np.zeros(1)
    around_the_end = (t_s[0] - start_s) + (stop_s - t_s[-1])
    step = np.concatenate(([around_the_end], np.diff(t_s), [around_the_end]))
    usual = float(np.median(step[1:-1]))
    half = np.where(step > GAP_FACTOR * usual, usual, step) / 2
    return half[:-1] + half[1:]


def coverage(t_s: FloatArray, start_s: float, stop_s: float) -> float:
    """Fraction of a window that has samples.

    Args:
        t_s: Times within the window, strictly increasing [s], shape (n,).
        start_s: Start of the window [s].
        stop_s: End of the window [s].

    Returns:
        From 0 to 1.
    """
    if stop_s <= start_s:
        return 0.0
    return float(min(1.0, np.sum(sample_weights(t_s, start_s, stop_s)) / (stop_s - start_s)))


def shared_times(series: Sequence[Series]) -> list[list[int]]:
    """Group channels that were sampled at the same times.

    Args:
        series: Channels.

    Returns:
        Indices into ``series``, grouped; every index once.
    """
    groups: list[list[int]] = []
    for i, one in enumerate(series):
        for group in groups[-1:]:
            first = series[group[0]].t_s
            if first is one.t_s or np.array_equal(first, one.t_s):
                group.append(i)
                break
        else:
            groups.append([i])
    return groups
