"""A session in stretches of time, so that an hour of it needs no more memory than a minute."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from capture import Session
from capture.arrays import IntArray

from .tracks import Columns, read_columns

STRETCH_NS = 40_000_000_000
"""About how long a stretch is [ns]: at 100 Hz its rows are one chunk of the recording."""

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
    session: Session, wanted: Mapping[str, Sequence[str]], context_ns: int
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
    length_ns = max(STRETCH_NS, 4 * context_ns)
    count = max(1, round((session.end_ns - start_ns) / length_ns))
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
