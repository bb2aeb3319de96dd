"""Joint signals and their sampling times: stamps plus offsets, on the log's clock, and breaks.

A log of a simulation may have simulated time in its headers and wall time in the container.
Windows, plots and alignment need one clock, so such stamps are shifted to the log's.

A clock that jumps (set by NTP when the network comes, or by hand) leaves a gap of hours or years in
the stamps; how the motion continues over the gap is unknown.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from ...common.arrays import NS, FloatArray, IntArray, merged_ranges
from ...common.errors import DataError
from ..columns.blocks import Window
from ..columns.layouts import stamps_of
from ..columns.topics import Topics
from ..messages.cdr import layout_of

if TYPE_CHECKING:
    import pandas as pd

MOST_JOINTS = 2000
"""Of a session; a file that claims more of them describes no robot."""

LARGEST = 1e100
"""A larger value counts as missing: no sensor sends it, and its powers are not finite."""

BREAK_S = 10.0
"""A session breaks if none of its channels has a sample for longer than this [s]; shorter gaps are
losses, which the estimators allow."""

BREAK_INTERVALS = 10
"""Shortest break in median intervals, for slow channels."""

_FAR_STAMP_NS = 3600 * NS
"""Stamps further than this from the log time are on another clock."""

_NEVER_NS = 2**62
"""A log time beyond this [Unix ns], the year 2116, is damage."""

_FAR_NS = 2.0**60


@dataclass(frozen=True)
class Signal:
    """Samples of one quantity of one joint.

    Attributes:
        t_ns: Sampling times [Unix ns], not decreasing, shape (n,).
        values: Shape (n,).
    """

    name: str
    unit: str
    t_ns: IntArray
    values: FloatArray


@dataclass(frozen=True)
class JointSignals:
    """One quantity of several joints, head to tail; each joint has its own sampling times.

    Attributes:
        topic: Where it was read from.
        field: ``position``, ``velocity`` or ``effort`` of the JointState.
        t_ns: Sampling times [Unix ns], one array of shape (n_j,) per joint. Joints sampled
            together share one array.
        values: One array of shape (n_j,) per joint; NaN samples are kept.
    """

    topic: str
    field: str
    unit: str
    names: tuple[str, ...]
    t_ns: tuple[IntArray, ...]
    values: tuple[FloatArray, ...]

    @cached_property
    def _place(self) -> dict[str, int]:
        """Name to its first place."""
        return {name: j for j, name in reversed([*enumerate(self.names)])}

    def signal(self, name: str) -> Signal:
        """Return the samples of one joint.

        Raises:
            DataError: If there is no such joint.
        """
        j = self._place.get(name)
        if j is None:
            raise DataError(f"{self.topic} has no joint {name!r}; it has {', '.join(self.names)}")
        return Signal(name, self.unit, self.t_ns[j], self.values[j])

    def select(self, names: Iterable[str]) -> JointSignals:
        """Return the same quantity of some joints, in the order of ``names``.

        Raises:
            DataError: If there is no such joint.
        """
        chosen = [self.signal(name) for name in names]
        return replace(
            self,
            names=tuple(signal.name for signal in chosen),
            t_ns=tuple(signal.t_ns for signal in chosen),
            values=tuple(signal.values for signal in chosen),
        )

    def frame(self) -> pd.DataFrame:
        """Return all samples in long form.

        Returns:
            Columns ``joint`` (categorical, in chain order), ``t_ns`` and the field's name with its
            unit, e.g. ``position [rad]``; one row per sample.
        """
        import pandas as pd

        joint = np.repeat(np.array(self.names, dtype=object), [len(t) for t in self.t_ns])
        order = pd.CategoricalDtype(categories=list(self.names), ordered=True)
        frame = pd.DataFrame(index=pd.RangeIndex(len(joint)))
        frame["joint"] = pd.Series(joint, dtype=order)
        frame["t_ns"] = np.concatenate([*self.t_ns, np.empty(0, dtype=np.int64)])
        frame[f"{self.field} [{self.unit}]"] = np.concatenate([*self.values, np.empty(0)])
        return frame


@dataclass(frozen=True)
class Unbroken:
    """The longest interval without a break.

    Attributes:
        start_ns: Its first sample [Unix ns].
        last_ns: Its last sample [Unix ns].
        others: Number of other intervals.
        left_s: Their total length without the gaps [s].
        gap_s: The longest gap between intervals [s]; 0 without gaps.
    """

    start_ns: int
    last_ns: int
    others: int = 0
    left_s: float = 0.0
    gap_s: float = 0.0

    def __str__(self) -> str:
        """Return one sentence: the part that is left out, and why."""
        stretches = "1 other stretch" if self.others == 1 else f"{self.others} other stretches"
        return (
            f"the recording has a gap of {_length(self.gap_s)}: its longest unbroken stretch, "
            f"{(self.last_ns - self.start_ns) / NS:.1f} s, is analysed, {stretches} of "
            f"{self.left_s:.1f} s altogether left out (choose with --start and --stop)"
        )


def longest_unbroken(
    times_ns: Iterable[IntArray], start_ns: int | None = None, stop_ns: int | None = None
) -> Unbroken | None:
    """Find the longest interval without a break in the samples of some channels.

    Args:
        times_ns: Sampling times of each channel [Unix ns], not decreasing.
        start_ns: First time [Unix ns], or None.
        stop_ns: One past the last time [Unix ns], or None.

    Returns:
        The interval; of equal ones the first; None without samples.
    """
    runs = [
        run
        for t_ns in {id(times): times for times in times_ns}.values()
        for run in _runs(cut(t_ns, (start_ns, stop_ns))[1])
    ]
    joined = merged_ranges(sorted(runs), BREAK_S * NS)
    if not joined:
        return None
    longest = max(joined, key=lambda run: run[1] - run[0])
    gaps = [after[0] - before[1] for before, after in pairwise(joined)]
    left = sum(last - first for first, last in joined) - (longest[1] - longest[0])
    return Unbroken(*longest, len(joined) - 1, left / NS, max(gaps, default=0) / NS)


def cut(t_ns: IntArray, window_ns: Window) -> tuple[slice, IntArray]:
    """Return the range of the samples in a window, and a view of their times.

    Args:
        t_ns: Sampling times [Unix ns], not decreasing, shape (n,).
        window_ns: Half-open window of them [Unix ns]; None for open ends.
    """
    start, stop = window_ns
    first = 0 if start is None else int(t_ns.searchsorted(start))
    last = len(t_ns) if stop is None else int(t_ns.searchsorted(stop))
    inside = slice(first, last)
    return inside, t_ns[inside]


def _runs(t_ns: IntArray) -> list[tuple[int, int]]:
    """Return the first and last time of each interval of one channel."""
    if not t_ns.size:
        return []
    step = np.diff(t_ns)
    breaks = np.flatnonzero(step > BREAK_S * NS)
    if breaks.size:
        breaks = breaks[step[breaks] > BREAK_INTERVALS * float(np.median(step))]
    firsts = t_ns[np.concatenate([[0], breaks + 1])]
    lasts = t_ns[np.concatenate([breaks, [t_ns.size - 1]])]
    return list(zip(firsts.tolist(), lasts.tolist(), strict=True))


def _length(seconds: float) -> str:
    for unit, size in (("days", 86400.0), ("h", 3600.0), ("min", 60.0)):
        if seconds >= 2 * size:
            return f"{seconds / size:.1f} {unit}"
    return f"{seconds:.1f} s"


class StampClock:
    """The shift from header stamps to the log's clock, found once per session."""

    def __init__(self, topics: Topics, warn: Callable[[str], None]) -> None:
        """Set up; ``warn`` is called with one sentence if the stamps are on another clock."""
        self._topics, self._warn = topics, warn
        self._shift_ns: int | None = None

    def shift_ns(self, topic: str) -> int:
        """Return the shift to add to the header stamps [ns]; 0 if they are on the log's clock.

        Args:
            topic: Topic whose first message determines the shift, if it isn't known yet. It holds
                for all topics and is a whole number of seconds, so that they stay aligned.

        Raises:
            MissingChannelError: If the log has no such topic.
            DataError: If the topic's type can't be read.
        """
        if self._shift_ns is None:
            self._shift_ns = self._look(topic)
        return self._shift_ns or 0

    def _look(self, topic: str) -> int | None:
        first = self._topics.first(topic)
        if first is None:
            return None
        log_ns, message, kind = first
        try:
            layout = layout_of(kind, message)
        except DataError:
            return None
        stamps = stamps_of(layout, np.frombuffer(message, np.uint8)[None])
        if stamps is None or "header.stamp.sec" not in layout.leaves:
            return None
        stamp_ns = int(stamps[0])
        if not stamp_ns or not 0 <= log_ns < _NEVER_NS:
            return None
        shift_ns = clock_shift_ns(stamp_ns, log_ns)
        if shift_ns:
            self._warn(
                f"header stamps lie {-shift_ns // NS} s from the log times (another clock, such "
                "as simulated time); they are shifted by that"
            )
        return shift_ns


def clock_shift_ns(stamp_ns: int, log_ns: int) -> int:
    """Return the shift to add to a stamp [ns], in whole seconds; 0 on the same clock."""
    apart_ns = log_ns - stamp_ns
    return round(apart_ns / NS) * NS if abs(apart_ns) > _FAR_STAMP_NS else 0


@dataclass(frozen=True)
class JointSeries:
    """Samples of some joints.

    Attributes:
        t_ns: Message stamps [Unix ns], not decreasing, one array per joint; joints that were
            sampled together share one array.
        values: One array of shape (n_j,) per joint.
    """

    names: tuple[str, ...]
    t_ns: Sequence[IntArray]
    values: Sequence[FloatArray]


def own_times(stamped: Sequence[JointSeries], offsets: JointSeries) -> list[list[IntArray]]:
    """Return the sampling times of several series whose joints have the same offsets.

    Args:
        offsets: Sample time minus stamp [s]. Its memory may be overwritten by the times.

    Returns:
        For each series one array per joint [Unix ns]: its stamps plus the offset that was logged
        with each stamp, or last before it (the first offset for earlier stamps). Series with equal
        stamps share them, and so do joints without offsets. Joints that are not in ``offsets`` keep
        their stamps.
    """
    if all(_stamped_alike(series, offsets) for series in stamped):  # the usual case
        shifted = [
            np.add(t_ns, _steps(values), out=values.view(np.int64))
            for t_ns, values in zip(offsets.t_ns, offsets.values, strict=True)
        ]
        return [shifted for _ in stamped]
    times: list[list[IntArray]] = []
    for i, series in enumerate(stamped):
        for earlier, placed in zip(stamped[:i], times, strict=True):
            if _stamped_alike(series, earlier):
                times.append(placed)
                break
        else:
            times.append(_each_own(series, offsets))
    return times


def _each_own(series: JointSeries, offsets: JointSeries) -> list[IntArray]:
    place = {name: j for j, name in enumerate(offsets.names)}
    return [
        moved(t_ns, offsets.t_ns[j], offsets.values[j])
        if (j := place.get(name)) is not None and len(offsets.t_ns[j])
        else t_ns
        for name, t_ns in zip(series.names, series.t_ns, strict=True)
    ]


def moved(t_ns: IntArray, stamp_ns: IntArray, offset_s: FloatArray) -> IntArray:
    """Return times plus the offset that was logged with each, or last before it.

    Args:
        t_ns: Times [ns], shape (n,).
        stamp_ns: When the offsets were logged [ns], not decreasing, shape (k,), at least one.
        offset_s: The offsets [s], shape (k,).

    Returns:
        Shape (n,) [ns]; before the first offset, it is used.
    """
    last = np.searchsorted(stamp_ns, t_ns, side="right") - 1
    return t_ns + _steps(offset_s[np.maximum(last, 0)])


def _steps(offset_s: FloatArray) -> IntArray:
    """Return offsets in ns; those that are not finite or far too large are zero."""
    with np.errstate(over="ignore", invalid="ignore"):
        steps = offset_s * NS
        np.rint(steps, out=steps)
        usable = np.abs(steps) < _FAR_NS
    if not usable.all():
        steps[~usable] = 0.0
    return steps.astype(np.int64)


def _stamped_alike(series: JointSeries, other: JointSeries) -> bool:
    if series.names != other.names or len({id(t_ns) for t_ns in (*series.t_ns, *other.t_ns)}) > 2:
        return False
    return all(
        a is b or np.array_equal(a, b) for a, b in zip(series.t_ns[:1], other.t_ns[:1], strict=True)
    )
