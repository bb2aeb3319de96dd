"""When to try again: soon at first, then ever more seldom."""

from __future__ import annotations

FIRST_NS = 100_000_000
"""Pause before the first new attempt [ns]."""
LONGEST_NS = 5_000_000_000
"""Longest pause between two attempts [ns]."""
_STEADY_NS = 1_000_000_000


class Backoff:
    """Doubling pauses; a connection that held for a second starts them anew.

    One that breaks down at once doesn't, so that a device that comes and goes is not hammered.
    """

    def __init__(self) -> None:
        """Start so that the first attempt is due at once."""
        self._pause_ns = FIRST_NS
        self._due_ns = 0
        self._opened_ns: int | None = None

    def due(self, now_ns: int) -> bool:
        """Whether an attempt may be made.

        Args:
            now_ns: The session's clock [ns].

        Returns:
            True from the end of the pause on.
        """
        return now_ns >= self._due_ns

    def opened(self, now_ns: int) -> None:
        """Note that an attempt succeeded.

        Args:
            now_ns: The session's clock [ns].
        """
        self._opened_ns = now_ns

    def failed(self, now_ns: int) -> None:
        """Note that an attempt failed or a connection was lost.

        Args:
            now_ns: The session's clock [ns].
        """
        if self._opened_ns is not None and now_ns - self._opened_ns >= _STEADY_NS:
            self._pause_ns = FIRST_NS
        self._opened_ns = None
        self._due_ns = now_ns + self._pause_ns
        self._pause_ns = min(2 * self._pause_ns, LONGEST_NS)
