"""Samples as the estimators take them: finite, in order, in seconds from a common origin."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from undulog.capture.common.arrays import FloatArray, IntArray, frozen
from undulog.capture.log.read.sample_times import LARGEST, Signal

GAP_FACTOR = 3.0
"""An interval longer than this many median intervals is a gap: nothing is assumed inside it."""

STILL = 1e-9
"""Range up to which a channel stands still, in rad or in its largest magnitude: hundreds of
times the rounding of a sine in an hour of a fast gait (2e-16 of a phase of 1e4 rad), hundreds of
times less than the step of a fine encoder (24 bit: 4e-7 rad)."""

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

    @cached_property
    def period_s(self) -> float:
        """Median sampling interval [s]; NaN with fewer than two samples."""
        return float(np.median(np.diff(self.t_s))) if self.count > 1 else float("nan")

    @cached_property
    def gaps(self) -> IntArray:
        """Indices of the samples that a gap follows, shape (g,)."""
        return gaps_after(np.diff(self.t_s))

    def at(self, t_s: FloatArray) -> FloatArray:
        """Return the values at other times, interpolated linearly; the ends are held.

        Args:
            t_s: Times [s], shape (k,).

        Returns:
            Values, shape (k,).
        """
        if t_s is self.t_s:
            return self.values
        return np.interp(t_s, self.t_s, self.values).astype(np.float64, copy=False)

    def between(self, start_s: float, stop_s: float) -> Series:
        """Return the samples of a half-open window.

        Args:
            start_s: First time [s].
            stop_s: End, not included [s].

        Returns:
            Views of the samples with ``start_s <= t < stop_s``; counts of dropped samples stay
            those of the whole.
        """
        i, j = self.rows_from(np.array([start_s, stop_s]))
        return Series(
            self.name, self.t_s[i:j], self.values[i:j], self.dropped_nan, self.dropped_duplicates
        )

    def rows_from(self, t_s: FloatArray) -> IntArray:
        """Return the first row at each of some times or later.

        Args:
            t_s: Times [s], shape (k,).

        Returns:
            Indices, n where no sample is so late, shape (k,).
        """
        # Times are whole ns but for rounding.
        return np.searchsorted(self.t_s, t_s - _HALF_NS, side="left")


def moves(values: FloatArray) -> bool:
    """Whether a channel moves by more than the rounding of its values.

    Args:
        values: Finite values, shape (n,).
    """
    if not values.size:
        return False
    return float(np.ptp(values)) > STILL * max(1.0, float(np.max(np.abs(values))))


def clean(name: str, t_ns: IntArray, values: FloatArray, origin_ns: int) -> Series:
    """Take raw samples into the form the estimators want.

    The origin is subtracted as an integer, so that Unix times keep their nanoseconds (a float64
    of a Unix time in seconds resolves 0.2 microseconds only).

    Args:
        t_ns: Unix times [ns], any order, shape (n,).
        values: Values, NaN where there is none, shape (n,).
        origin_ns: Unix time that becomes 0 s.

    Returns:
        The series, without samples that are not finite or above :data:`LARGEST`, and without second
        samples of one time; where there are none, its values are those that were given, not a
        copy.
    """
    finite = np.abs(values) <= LARGEST  # not so where it is NaN
    lost = values.size - int(np.count_nonzero(finite))
    if lost:
        t_ns, values = t_ns[finite], values[finite]
    step = np.diff(t_ns)
    least = int(step.min()) if step.size else 1
    if least < 0:
        order = np.argsort(t_ns, kind="stable")
        t_ns, values = t_ns[order], values[order]
        step = np.diff(t_ns)
    double = 0
    if least <= 0:
        first = np.concatenate(([True], step > 0))
        double = first.size - int(np.count_nonzero(first))
        t_ns, values = t_ns[first], values[first]
    t_s = (t_ns - np.int64(origin_ns)).astype(np.float64)
    t_s *= 1e-9
    return Series(
        name=name,
        t_s=frozen(t_s),
        values=frozen(values.view() if values.dtype == np.float64 else values.astype(np.float64)),
        dropped_nan=lost,
        dropped_duplicates=double,
    )


def clean_together(signals: Mapping[str, Signal], origin_ns: int) -> dict[str, Series]:
    """Take several signals into that form; what shares its times goes on sharing them.

    Args:
        origin_ns: Unix time that becomes 0 s.

    Returns:
        The series by key.
    """
    series: dict[str, Series] = {}
    times: dict[int, Series] = {}
    for key, signal in signals.items():
        earlier = times.get(id(signal.t_ns))
        if earlier is not None and (np.abs(signal.values) <= LARGEST).all():
            series[key] = Series(signal.name, earlier.t_s, frozen(signal.values.view()))
            continue
        series[key] = made = clean(signal.name, signal.t_ns, signal.values, origin_ns)
        if np.may_share_memory(made.values, signal.values):  # nothing was left out or moved
            times[id(signal.t_ns)] = made
    return series


def gaps_after(step_s: FloatArray) -> IntArray:
    """Which intervals between samples are gaps.

    Args:
        step_s: The intervals, all above 0 [s], shape (n,).
    """
    if step_s.size == 0 or _all_usual(step_s, float(step_s.max())):
        return np.zeros(0, dtype=np.int64)
    return np.flatnonzero(step_s > GAP_FACTOR * np.median(step_s))


def _all_usual(step_s: FloatArray, longest_s: float) -> bool:
    """Whether even the longest interval is no gap; most channels are done without a median."""
    # More than half of the intervals are this long, so their median is.
    return 2 * int(np.count_nonzero(GAP_FACTOR * step_s >= longest_s)) > step_s.size


def sample_weights(t_s: FloatArray, start_s: float, stop_s: float) -> FloatArray:
    """Return the time that each sample stands for, so that ``sum(weights * f(t))`` integrates f.

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
    if t_s.size < 2:
        return np.zeros(t_s.size)
    around_the_end = (t_s[0] - start_s) + (stop_s - t_s[-1])
    half = np.concatenate(([around_the_end], np.diff(t_s), [around_the_end])) / 2
    inner = half[1:-1]
    if not _all_usual(inner, float(max(half[0], inner.max()))):
        usual = np.median(inner)
        half[half > GAP_FACTOR * usual] = usual
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

    Returns:
        Indices into ``series``, grouped; every index once.
    """
    groups: list[list[int]] = []
    for i, channel in enumerate(series):
        for group in groups[-1:]:
            first = series[group[0]].t_s
            if first is channel.t_s or np.array_equal(first, channel.t_s):
                group.append(i)
                break
        else:
            groups.append([i])
    return groups
