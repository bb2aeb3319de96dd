"""What happened to a source, told without flooding: one text at most once a second."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass, field

from .contract import SourceCounts, SourceEvent

ODD_TIME = "device time out of range, another is estimated"
"""The event of a frame whose device time is impossible."""

_PAUSE_NS = 1_000_000_000


@dataclass
class _Repeats:
    told_ns: int
    level: str
    held: int = 0


class EventLog:
    """Collects the events of one source, from any of its threads.

    The first of its kind is told at once. Those that follow within a second are counted, and told
    together when it is over.
    """

    def __init__(self, now_ns: Callable[[], int]) -> None:
        """Start with none.

        Args:
            now_ns: The session's clock [Unix ns].
        """
        self._now_ns = now_ns
        self._lock = threading.Lock()
        self._repeats: dict[str, _Repeats] = {}
        self._events: list[SourceEvent] = []

    def say(self, level: str, text: str, count: int = 1) -> None:
        """Note an event.

        Args:
            level: ``info``, ``warn`` or ``error``.
            text: One sentence, the same for the same kind of event: no numbers that change.
            count: How often it happened.
        """
        now = self._now_ns()
        with self._lock:
            repeats = self._repeats.get(text)
            if repeats is None:
                self._repeats[text] = _Repeats(now, level)
                self._tell(now, level, text, count)
            else:
                repeats.held += count

    def take(self) -> tuple[SourceEvent, ...]:
        """Hand out the events that are due.

        Returns:
            In the order they happened; each is handed out once.
        """
        if not self._repeats:
            return ()
        now = self._now_ns()
        with self._lock:
            for text, repeats in list(self._repeats.items()):
                if now - repeats.told_ns < _PAUSE_NS:
                    continue
                if repeats.held:
                    self._tell(now, repeats.level, text, repeats.held)
                    repeats.told_ns, repeats.held = now, 0
                else:
                    del self._repeats[text]
            return self._drain()

    def flush(self) -> tuple[SourceEvent, ...]:
        """Hand out all events, those held back for their second too.

        Returns:
            In the order they happened.
        """
        with self._lock:
            for text, repeats in self._repeats.items():
                if repeats.held:
                    self._tell(self._now_ns(), repeats.level, text, repeats.held)
                    repeats.held = 0
            return self._drain()

    def _drain(self) -> tuple[SourceEvent, ...]:
        events, self._events = tuple(self._events), []
        return events

    def _tell(self, now_ns: int, level: str, text: str, count: int) -> None:
        times = f" ({count} times)" if count > 1 else ""
        self._events.append(SourceEvent(now_ns, level, text + times))


@dataclass
class Tally:
    """What a connection reports to: the source's counts, its events and the session's clock.

    Attributes:
        now_ns: The session's clock [Unix ns].
        counts: What became of the frames.
        events: What happened.
    """

    now_ns: Callable[[], int]
    counts: SourceCounts = field(default_factory=SourceCounts)
    events: EventLog = field(init=False)

    def __post_init__(self) -> None:
        """Give the events the same clock."""
        self.events = EventLog(self.now_ns)

    def malformed(self, text: str, count: int) -> None:
        """Count what could not be read, and say so.

        Args:
            text: What it was.
            count: How many; nothing happens for none.
        """
        if count:
            self.counts.malformed += count
            self.events.say("warn", text, count)
