"""A session in stretches of time, so that an hour of it needs no more memory than a minute."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from undulog.capture import SessionView
from undulog.capture.common.arrays import IntArray

from .tracks import Columns, read_columns

STRETCH_NS = 40_000_000_000
"""About how long a stretch is [ns]: at 100 Hz its rows are one chunk of the recording."""

_LEAST_STRETCHES = 200
"""A session may always have so many stretches: more than two hours have."""
_LEAST_MESSAGES = 100
"""Mean messages in a stretch, at least, where there are more."""
_READ_AGAIN = 8
"""How many stretches a chunk may be read for, in the mean, where there are more."""

_FIRST_NS, _LAST_NS = -(1 << 62), 1 << 62


@dataclass(frozen=True)
class Span:
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
        """Which rows lie in it.

        Args:
            t_ns: Their times [ns], ascending, shape (n,).

        Returns:
            The rows.
        """
        first, last = np.searchsorted(t_ns, [self.start_ns, self.stop_ns])
        return slice(int(first), int(last))


@dataclass(frozen=True)
class Stretch:
    """Samples of a span, and of a little before and after it.

    Attributes:
        span: What is drawn.
        columns: The samples.
    """

    span: Span
    columns: Columns


def stretches(
    session: SessionView, wanted: Mapping[str, Sequence[str]], context_ns: int
) -> Iterator[Stretch]:
    """Read a session stretch by stretch.

    Args:
        session: The session.
        wanted: JointState topic to fields.
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
        columns = read_columns(
            session,
            wanted,
            start_ns=None if low is None else low - context_ns,
            stop_ns=known_ns,
        )
        span = Span(_FIRST_NS if low is None else low, _LAST_NS if high is None else high, known_ns)
        session.forget()
        yield Stretch(span, columns)


def stretch_length_ns(session: SessionView, least_ns: int = 0) -> int:
    """Length of the stretches that a session is read in.

    Args:
        session: The session.
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
