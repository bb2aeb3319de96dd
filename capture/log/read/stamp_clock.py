"""Which clock the header stamps of a log are on.

A log recorded from a simulation may carry simulated time in its headers and wall time in the
container. Windows, plots and alignment need one clock, so such stamps are shifted to the log's.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ...common.errors import DataError
from ..columns.topics import Topics
from ..messages.cdr import layout_of

_NS = 1_000_000_000
_FAR_NS = 3600 * _NS
"""Stamps further than this from the log time are on another clock."""

_NEVER_NS = 2**62
"""No log time lies beyond this [Unix ns], the year 2116: such a one is damage."""

_STAMP = ("header.stamp.sec", "header.stamp.nanosec")


class StampClock:
    """The shift from header stamps to the log's clock, found once for a session."""

    def __init__(self, topics: Topics, warn: Callable[[str], None]) -> None:
        """Look at nothing yet.

        Args:
            topics: The log's topics.
            warn: Takes one sentence if the stamps are on another clock.
        """
        self._topics = topics
        self._warn = warn
        self._shift_ns: int | None = None

    def shift_ns(self, topic: str) -> int:
        """What must be added to the header stamps of the log [ns]; 0 on the log's own clock.

        Args:
            topic: Where to look if the shift isn't known yet: its first message decides for all
                topics, in whole seconds, so that they stay aligned.

        Returns:
            The shift [ns].

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
            leaves = layout_of(kind, message).leaves
        except DataError:
            return None
        if not all(path in leaves for path in _STAMP):
            return None
        sec, nanosec = (
            int(np.frombuffer(message, leaves[path].dtype, 1, leaves[path].offset)[0])
            for path in _STAMP
        )
        stamp_ns = sec * _NS + nanosec
        if not stamp_ns or not 0 <= log_ns < _NEVER_NS:
            return None
        if abs(log_ns - stamp_ns) <= _FAR_NS:
            return 0
        shift_s = round((log_ns - stamp_ns) / _NS)
        self._warn(
            f"header stamps lie {-shift_s} s from the log times (another clock, such as simulated "
            "time); they are shifted by that"
        )
        return shift_s * _NS
