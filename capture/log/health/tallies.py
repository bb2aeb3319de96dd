"""Tallies of a stream's times and sequence numbers, and the measures of a session's health.

Each tally takes arrays as they come (a block of a file, a second of a live recording), keeps a
bounded summary, and returns a frozen result at any moment.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ...common.arrays import NS, FloatArray, IntArray
from .gaps import GapCauses, Intervals, causes_of

GAP_PERIODS = 1.5
"""An interval longer than this many median intervals is a gap: the nearest whole number of
periods in it is two or more, so at least one sample is missing."""

REGULAR_SPREAD = 0.5
"""A series is regular if the middle half of its intervals spans no more than this part of the
median. Only a regular series has a rhythm against which something can be missing."""

PAUSE_S = 1.0
"""A gap this long is a pause: it can be cut out, while losses scattered over the session can't.
For slow series it is :data:`PAUSE_PERIODS`."""

PAUSE_PERIODS = 10.0
"""Median intervals that a pause has at least."""

MIN_INTERVALS = 20
"""Fewer intervals than this have no reliable median and 99 % point."""

SEQUENCE_COUNTS = 0.5
"""Sequence numbers count the channel's messages if at least this part of the steps is one; a
constant, or a counter shared by all channels, does not."""

_BINS_PER_OCTAVE = 64
_QUANTILES = (0.25, 0.5, 0.75, 0.99)
_OCTAVES = 48  # 1 ns to 78 h
_BINS = _BINS_PER_OCTAVE * _OCTAVES
_EXACT = 256  # longest intervals that are kept as they are: a long gap's bin is wider than a period


@dataclass(frozen=True)
class Timing:
    """The rhythm of one series.

    Attributes:
        first_ns: Earliest time [Unix ns]; 0 without samples.
        last_ns: Latest time [Unix ns]; 0 without samples.
        median_s: Median interval [s], None where there is no interval forward.
        std_s: Standard deviation of the intervals that are not gaps [s].
        p99_s: 99 % point of all intervals [s].
        regular: Whether gaps can be told from the rhythm.
        gaps: Intervals longer than :data:`GAP_PERIODS` medians; 0 where irregular.
        missing: Samples that were lost in the gaps; 0 where irregular.
        scattered: Those of them that are not in pauses.
        late: Gaps in which nothing was lost, as the sender itself was late (:mod:`.gaps`).
        paused_s: All pauses together [s]; also of an irregular series.
        longest_s: Longest interval [s].
        longest_at_ns: Where the longest interval starts [Unix ns].
        duplicates: Samples with the time of the sample before.
        backward: Samples earlier than the sample before.
    """

    count: int
    first_ns: int
    last_ns: int
    median_s: float | None
    std_s: float | None
    p99_s: float | None
    regular: bool
    gaps: int
    missing: int
    scattered: int
    paused_s: float
    longest_s: float
    longest_at_ns: int
    duplicates: int
    backward: int
    late: int = 0

    @property
    def rate_hz(self) -> float | None:
        """Mean rate over the series' own span [Hz]."""
        span_s = (self.last_ns - self.first_ns) / NS
        return (self.count - 1) / span_s if span_s > 0 else None

    @property
    def missing_part(self) -> float:
        """Missing samples as a part of those expected."""
        return self.missing / (self.count + self.missing) if self.count else 0.0


class TimingTally:
    """Intervals of one series in bins of equal ratio, 64 an octave.

    Quantiles are bin means: exact where a bin holds one value, within 1.1 % otherwise.
    """

    def __init__(self) -> None:
        """Start empty."""
        self._count = self._first = self._last = self._previous = 0
        self._duplicates = self._backward = 0
        self._longest = (0, 0)
        self._bins = np.empty(0, np.int64)  # those that have intervals, ascending
        self._sums = np.empty((3, 0))  # number, sum and sum of squares of their intervals [ns]
        self._largest = np.empty(0)  # the longest intervals [ns], ascending

    def add(self, t_ns: IntArray) -> None:
        """Take the next samples.

        Args:
            t_ns: Their times in the order they came [Unix ns], shape (n,).
        """
        if not len(t_ns):
            return
        low, high = int(t_ns.min()), int(t_ns.max())
        if self._count:
            steps = np.diff(t_ns, prepend=self._previous)
            starts = t_ns - steps
            low, high = min(low, self._first), max(high, self._last)
        else:
            steps, starts = np.diff(t_ns), t_ns[:-1]
        self._count += len(t_ns)
        self._first, self._last, self._previous = low, high, int(t_ns[-1])
        if not len(steps):  # a first sample alone
            return
        self._duplicates += int((steps == 0).sum())
        self._backward += int((steps < 0).sum())
        forward = steps > 0
        if not forward.any():
            return
        steps, starts = steps[forward], starts[forward]
        longest = int(steps.argmax())
        if int(steps[longest]) > self._longest[0]:  # of equal ones the first, as they came
            self._longest = int(steps[longest]), int(starts[longest])
        size = steps.astype(np.float64)
        self._largest = np.sort(np.concatenate([self._largest, size]))[-_EXACT:]
        bins = _bins(size)
        had = len(self._bins)
        self._bins, place = np.unique(np.concatenate([self._bins, bins]), return_inverse=True)
        sums = np.zeros((3, len(self._bins)))
        sums[:, place[:had]] = self._sums
        for k, weight in enumerate((np.ones_like(size), size, size**2)):
            sums[k] += np.bincount(place[had:], weight, sums.shape[1])
        self._sums = sums

    def result(self) -> Timing:
        """Return the rhythm of the samples so far."""
        number, total, squares = self._sums
        intervals = int(number.sum())
        median = std = p99 = None
        regular, gaps, paused, causes = False, 0, 0.0, GapCauses(0, 0, 0)
        if intervals:
            mean = total / number
            places = np.searchsorted(np.cumsum(number), np.array(_QUANTILES) * intervals)
            low, median, high, p99 = mean[places].tolist()
            regular = intervals >= MIN_INTERVALS and high - low <= REGULAR_SPREAD * median
            long = (mean > GAP_PERIODS * median) & regular
            gaps = int(number[long].sum())
            pause = mean > max(PAUSE_S * NS, PAUSE_PERIODS * median)
            paused = float(total[pause].sum())
            if gaps:
                every, place = self._intervals()
                causes = causes_of(
                    every,
                    long[place],
                    pause[place],
                    span_ns=self._last - self._first,
                    count=self._count,
                )
            n = number[~long].sum()
            centre = total[~long].sum() / n
            std = float(np.sqrt(max(squares[~long].sum() / n - centre**2, 0.0)))
        return Timing(
            count=self._count,
            first_ns=self._first,
            last_ns=self._last,
            median_s=None if median is None else median / NS,
            std_s=None if std is None else std / NS,
            p99_s=None if p99 is None else p99 / NS,
            regular=regular,
            gaps=gaps,
            missing=causes.missing,
            scattered=causes.scattered,
            late=causes.late,
            paused_s=paused / NS,
            longest_s=self._longest[0] / NS,
            longest_at_ns=self._longest[1],
            duplicates=self._duplicates,
            backward=self._backward,
        )

    def _intervals(self) -> tuple[Intervals, IntArray]:
        """Return all intervals, the longest as they are, and the bin of each, by its place."""
        number, total, _ = self._sums
        place = np.searchsorted(self._bins, _bins(self._largest))
        rest = number - np.bincount(place, minlength=len(number))
        rest_total = total - np.bincount(place, self._largest, len(number))
        kept = np.flatnonzero(rest)
        mean = np.concatenate([rest_total[kept] / rest[kept], self._largest])
        spread = np.where(rest[kept] > 1, 1.0 / _BINS_PER_OCTAVE, 0.0)
        order = np.argsort(mean, kind="stable")
        counts = np.concatenate([rest[kept], np.ones(len(place))])
        spreads = np.concatenate([spread, np.zeros(len(place))])
        every = Intervals(counts[order], mean[order], spreads[order])
        return every, np.concatenate([kept, place])[order]


def _bins(size_ns: FloatArray) -> IntArray:
    """Return the bins of intervals [ns], shape (n,)."""
    return np.minimum((np.log2(size_ns) * _BINS_PER_OCTAVE).astype(np.int64), _BINS - 1)


@dataclass(frozen=True)
class Sequence:
    """What a channel's MCAP sequence numbers prove.

    Attributes:
        kind: ``counted``; ``none`` where all are zero; ``not a count`` where they are constant or
            shared by channels; ``too few`` where one message can't tell.
        dropped: Messages missing between those present; None unless counted.
        reordered: Messages numbered before the one they follow; None unless counted.
    """

    kind: str
    dropped: int | None
    reordered: int | None


class SequenceTally:
    """Sequence numbers of one channel; they wrap at 2^32."""

    def __init__(self) -> None:
        """Start empty."""
        self._previous = self._count = self._ones = self._repeated = self._reordered = 0
        self._at = self._low = self._high = 0  # unwrapped, relative to the first
        self._nonzero = False

    def add(self, sequence: IntArray) -> None:
        """Take the numbers of the next messages.

        Args:
            sequence: In the order of the file, shape (n,).
        """
        if not len(sequence):
            return
        if not self._count and len(sequence) == 1:
            self._previous, self._count = int(sequence[0]), 1
            self._nonzero = self._previous != 0
            return
        before = self._previous if self._count else int(sequence[0])
        steps = np.diff(sequence, prepend=before)
        steps = (steps + 2**31) % 2**32 - 2**31  # the shorter way round
        place = self._at + np.cumsum(steps)
        steps = steps if self._count else steps[1:]
        self._low = min(self._low, int(place.min()))
        self._high = max(self._high, int(place.max()))
        self._at, self._previous = int(place[-1]), int(sequence[-1])
        self._nonzero = self._nonzero or bool(sequence.any())
        self._count += len(sequence)
        self._ones += int((steps == 1).sum())
        self._repeated += int((steps == 0).sum())
        self._reordered += int((steps < 0).sum())

    def result(self) -> Sequence:
        """Return what the numbers so far prove."""
        if self._count < 2:
            return Sequence("too few", None, None)
        if not self._nonzero:
            return Sequence("none", None, None)
        if self._ones < SEQUENCE_COUNTS * (self._count - 1):
            return Sequence("not a count", None, None)
        span = self._high - self._low + 1
        return Sequence("counted", max(span - (self._count - self._repeated), 0), self._reordered)


@dataclass(frozen=True)
class SeriesHealth:
    """Messages of one channel that carry the same names.

    Attributes:
        topic: The channel's topic.
        names: Joints or values; empty for other types.
        timing: Its rhythm, by header.stamp where there is one, else by log time.
        first_log_ns: First log time [Unix ns].
        last_log_ns: Last log time [Unix ns].
        numbers: How many numbers were checked.
        nan: How many of them are NaN.
    """

    topic: str
    type_name: str
    names: tuple[str, ...]
    timing: Timing
    first_log_ns: int
    last_log_ns: int
    numbers: int
    nan: int

    @property
    def label(self) -> str:
        """The topic, and the name if it carries only one."""
        return f"{self.topic} ({self.names[0]})" if len(self.names) == 1 else self.topic


@dataclass(frozen=True)
class ChannelHealth:
    """One channel.

    Attributes:
        unread: Messages that can't be decoded.
        sequence: What its sequence numbers prove.
    """

    topic: str
    type_name: str
    count: int
    unread: int
    sequence: Sequence


@dataclass(frozen=True)
class JointHealth:
    """One joint of one JointState topic.

    Attributes:
        at_limit: Part of the angles at or beyond the robot's limits; None without limits.
        frozen_s: Longest time that it stood while its command moved [s]; None without command.
        frozen_at_ns: When that began [Unix ns].
    """

    topic: str
    name: str
    samples: int
    nan: int
    at_limit: float | None
    frozen_s: int | None
    frozen_at_ns: int

    def with_more(self, other: JointHealth) -> JointHealth:
        """Add the counts of the same joint in other messages; keep the longer freeze."""
        held = [(j.at_limit, j.samples) for j in (self, other) if j.at_limit is not None]
        frozen = max(self, other, key=lambda joint: joint.frozen_s or 0)
        return replace(
            self,
            samples=self.samples + other.samples,
            nan=self.nan + other.nan,
            at_limit=sum(part * n for part, n in held) / sum(n for _, n in held) if held else None,
            frozen_s=frozen.frozen_s,
            frozen_at_ns=frozen.frozen_at_ns,
        )


@dataclass(frozen=True)
class BusHealth:
    """One bus of raw CAN frames.

    Attributes:
        topic: E.g. ``/can/can0``.
        rate_hz: Mean rate [Hz].
        error_frames: Frames that report an error.
        longest_s: Longest time without a frame [s].
        longest_at_ns: When it began [Unix ns].
        load: Mean part of the bitrate, without and with the most stuff bits; None without bitrate.
        peak_load: The same of the busiest second.
    """

    topic: str
    frames: int
    rate_hz: float | None
    error_frames: int
    longest_s: float
    longest_at_ns: int
    load: tuple[float, float] | None
    peak_load: tuple[float, float] | None


@dataclass(frozen=True)
class FileHealth:
    """The container.

    Attributes:
        chunks: Chunks found in the file.
        checked: Chunks whose CRC was computed and fits.
        without_crc: Chunks that carry no CRC.
        damage: What is corrupt, one sentence each.
        truncated: Whether the end is missing.
        indexed: Whether it has the summary and the chunk index.
        notes: Warnings of the reader when it opened the file.
        unfinished: What was recovered of a session that was not finalised; empty if it was.
        running: Whether its recorder is still writing.
    """

    chunks: int
    checked: int
    without_crc: int
    damage: tuple[str, ...]
    truncated: bool
    indexed: bool
    notes: tuple[str, ...]
    unfinished: str = ""
    running: bool = False
