"""The rulers of a replay: time since the session's start, cycles of its gait, and one mean cycle.

``session_time`` counts from the first sample. ``gait_cycle`` is the gait's cumulative phase over
2 pi, so that two runs at different frequencies can be scrubbed in step; Rerun has no timeline
of real numbers, so one cycle is drawn as one second: ``+3.25s`` there reads 3.25 cycles.
``ensemble_cycle`` counts the degrees of a mean cycle (:mod:`.replay.draw.mean_cycle`), which
is computed; samples are never folded into one cycle.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import rerun as rr

from undulog.capture import SessionView
from undulog.capture.common.arrays import BoolArray, FloatArray, IntArray

from .tracks import Columns, interpolate, read_columns

STRETCH_NS = 40_000_000_000
"""About how long a stretch is [ns]: at 100 Hz its rows are one chunk of the recording."""

_LEAST_STRETCHES = 200  # a session may always have so many stretches: more than two hours have
_LEAST_MESSAGES = 100  # mean messages in a stretch, at least, where there are more
_READ_AGAIN = 8  # how many stretches a chunk may be read for, in the mean, where there are more

_FIRST_NS, _LAST_NS = np.iinfo(np.int64).min, np.iinfo(np.int64).max

SESSION_TIME = "session_time"
GAIT_CYCLE = "gait_cycle"
ENSEMBLE_CYCLE = "ensemble_cycle"

ROWS_PER_CHUNK = 4096
"""Rows sent at once: small enough to page through an hour, large enough to be columns."""


@dataclass(frozen=True)
class DrawnSpan:
    """The part of a session that is drawn at a time, half-open.

    Attributes:
        start_ns: Its first time [ns].
        stop_ns: One past its last [ns].
        known_ns: Until when samples are at hand [ns]; None where nothing comes after them.
    """

    start_ns: int = _FIRST_NS
    stop_ns: int = _LAST_NS
    known_ns: int | None = None

    def rows(self, t_ns: IntArray) -> slice:
        """Return the rows within the span.

        Args:
            t_ns: Their times [ns], ascending, shape (n,).
        """
        first, last = np.searchsorted(t_ns, [self.start_ns, self.stop_ns])
        return slice(int(first), int(last))


@dataclass(frozen=True)
class SpanSamples:
    """Samples of a span, and of a little before and after it."""

    span: DrawnSpan
    columns: Columns


def stretches(
    session: SessionView, topics: Mapping[str, Sequence[str]], context_ns: int
) -> Iterator[SpanSamples]:
    """Read a session stretch by stretch.

    Args:
        context_ns: How much is read before and after each stretch [ns]: what a line between two
            samples, a held command and the search for gaps need.

    Yields:
        The stretches in order; every sample is in the span of exactly one.
    """
    start_ns = session.start_ns
    length_ns = stretch_length_ns(session, 4 * context_ns)
    count = _count(session, length_ns)
    for i in range(count):
        low = start_ns + i * length_ns if i else None
        high = start_ns + (i + 1) * length_ns if i + 1 < count else None
        known_ns = None if high is None else high + context_ns
        begin_ns = None if low is None else low - context_ns
        columns = read_columns(session, topics, start_ns=begin_ns, stop_ns=known_ns)
        span = DrawnSpan(
            _FIRST_NS if low is None else low, _LAST_NS if high is None else high, known_ns
        )
        session.forget()
        yield SpanSamples(span, columns)


def stretch_length_ns(session: SessionView, least_ns: int = 0) -> int:
    """Length of the stretches that a session is read in.

    Args:
        least_ns: Shortest length wanted [ns].

    Returns:
        :data:`STRETCH_NS` or more [ns]: with shorter ones, a session whose clock jumps would have
        millions of empty stretches.
    """
    length_ns = max(STRETCH_NS, least_ns)
    while _laborious(session, length_ns):
        length_ns *= 2
    return length_ns


def _count(session: SessionView, length_ns: int) -> int:
    return max(1, round((session.end_ns - session.start_ns) / length_ns))


def _laborious(session: SessionView, length_ns: int) -> bool:
    """Whether most stretches are empty, or chunks are read again for many of them.

    So it is where the clock jumps in the session.
    """
    count = _count(session, length_ns)
    messages = sum(channel.count for channel in session.channels.values())
    if count > max(_LEAST_STRETCHES, messages // _LEAST_MESSAGES):
        return True
    first_ns, last_ns = session.chunk_times_ns
    length = np.uint64(length_ns)
    read = int((last_ns // length - np.minimum(first_ns, last_ns) // length).sum()) + len(last_ns)
    return count > 1 and read > _LEAST_STRETCHES + _READ_AGAIN * len(last_ns)


@dataclass(frozen=True)
class LoggedRhythm:
    """The gait's phase as it was logged.

    Attributes:
        t_ns: Sampling times [ns], ascending, shape (n,).
        cycles: Cumulative phase over 2 pi, shape (n,).
    """

    t_ns: IntArray
    cycles: FloatArray

    @classmethod
    def from_phase(cls, t_ns: IntArray, phase_rad: FloatArray) -> LoggedRhythm:
        """Count cycles from a phase that may be wrapped.

        Args:
            t_ns: Sampling times [ns], ascending, shape (n,).
            phase_rad: Phase [rad], wrapped to any interval of 2 pi or cumulative, shape (n,).

        Returns:
            The rhythm; samples without a phase are left out.
        """
        finite = np.isfinite(phase_rad)
        return cls(t_ns[finite], np.unwrap(phase_rad[finite]) / (2.0 * np.pi))


@dataclass(frozen=True)
class TimeColumns:
    """Turns sampling times into Rerun's time columns.

    Attributes:
        start_ns: Unix time of the session's first sample [ns].
        rhythm: The gait's phase, or None where the session has no gait.
    """

    start_ns: int
    rhythm: LoggedRhythm | None = None

    def rows(self, t_ns: IntArray) -> Iterator[tuple[slice, list[rr.TimeColumn]]]:
        """Cut rows into chunks that share their timelines.

        Rows whose gait phase isn't known (before the gait starts, in a gap) have no place on
        ``gait_cycle``, and Rerun requires the same timelines in all rows of a chunk.

        Args:
            t_ns: Sampling times of the rows [ns], shape (n,).

        Yields:
            Runs of at most ``ROWS_PER_CHUNK`` rows, with their time columns.
        """
        cycles = self._cycles(t_ns)
        finite = np.isfinite(cycles)
        for part in _runs(finite):
            since = (t_ns[part] - self.start_ns).astype("timedelta64[ns]")
            columns = [rr.TimeColumn(SESSION_TIME, duration=since)]
            if finite[part.start]:
                beat = np.round(cycles[part] * 1e9).astype("timedelta64[ns]")
                columns.append(rr.TimeColumn(GAIT_CYCLE, duration=beat))
            yield part, columns

    def _cycles(self, t_ns: IntArray) -> FloatArray:
        if self.rhythm is None:
            return np.full(t_ns.size, np.nan)
        return interpolate(self.rhythm.t_ns, self.rhythm.cycles, t_ns)


def _runs(mask: BoolArray) -> Iterator[slice]:
    """Runs of equal value in ``mask``, each cut into chunks."""
    edges = np.flatnonzero(np.diff(mask)) + 1
    for start, stop in zip([0, *edges], [*edges, mask.size], strict=True):
        for low in range(int(start), int(stop), ROWS_PER_CHUNK):
            yield slice(low, min(low + ROWS_PER_CHUNK, int(stop)))
