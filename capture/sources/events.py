"""What happened to a source, told without flooding: one text at most once a second.

What error frames say: a node in trouble, a controller off the bus and back.

An error frame is one with :data:`.ERROR_FLAG`; its identifier holds the classes
of error and its data the details, as in ``linux/can/error.h``.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from ..log.messages.frames import ERROR_FLAG, ID_MASK, FrameArray
from .contract import DEVICE_TIMES_END_NS, SourceCounts, SourceEvent

IMPLAUSIBLE_TIME = "device time out of range, another is estimated"
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

    def log_event(self, level: str, text: str, count: int = 1) -> None:
        """Note an event.

        Args:
            level: ``info``, ``warn`` or ``error``.
            text: One sentence, the same for the same kind of event: no numbers that change.
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
    """

    now_ns: Callable[[], int]
    counts: SourceCounts = field(default_factory=SourceCounts)
    events: EventLog = field(init=False)

    def __post_init__(self) -> None:
        """Give the events the same clock."""
        self.events = EventLog(self.now_ns)

    def lost(self, text: str, count: int, level: str = "warn") -> None:
        """Count frames that were dropped; a source that can tell has a count, if it is 0.

        Args:
            text: How one was dropped.
        """
        self.counts.dropped = (self.counts.dropped or 0) + count
        if count:
            self.events.log_event(level, text, count)

    def malformed(self, text: str, count: int) -> None:
        """Count what could not be read, and say so.

        Args:
            count: How many; nothing happens for none.
        """
        if count:
            self.counts.malformed += count
            self.events.log_event("warn", text, count)


BUS_OFF = 0x40
"""Error class: the controller left the bus."""
RESTARTED = 0x100
"""Error class: the controller is back."""

_CLASSES = {
    0x001: "transmit time-out",
    0x002: "lost arbitration",
    0x004: "controller problem",
    0x008: "protocol violation",
    0x010: "transceiver problem",
    0x020: "no acknowledgement",
    0x080: "bus error",
    0x200: "error counters changed",
}
_CONTROLLER = 0x004
_CONTROLLER_STATES = {
    0x01: "receive buffer overflow",
    0x02: "transmit buffer overflow",
    0x04: "reception warning level",
    0x08: "transmission warning level",
    0x10: "reception error passive",
    0x20: "transmission error passive",
    0x40: "error active again",
}


class BusWatch:
    """Counts error frames, and tells what they mean, and impossible device times."""

    def __init__(self) -> None:
        """Start with a bus that is well."""
        self._off = False

    def look(self, frames: FrameArray, tally: Tally) -> None:
        """Look through frames.

        Args:
            frames: What came, in order.
            tally: Where to count and tell.
        """
        t_ns = frames["t_device_ns"]
        if t_ns.max(initial=0) >= DEVICE_TIMES_END_NS:
            odd = int((t_ns >= np.uint64(DEVICE_TIMES_END_NS)).sum())
            tally.malformed(IMPLAUSIBLE_TIME, odd)
        ids = frames["id_flags"]
        if not np.bitwise_or.reduce(ids) & ERROR_FLAG:
            if self._off and len(ids):
                self._back(tally)
            return
        is_error = (ids & ERROR_FLAG) != 0
        places = np.flatnonzero(is_error).tolist()
        tally.counts.error_frames += len(places)
        before = -1
        for place in places:
            if place > before + 1:
                self._hear(tally)
            frame = frames[place]
            self._tell(int(frame["id_flags"]) & ID_MASK, frame["data"].tolist(), tally)
            before = place
        if len(frames) > before + 1:
            self._hear(tally)

    def _hear(self, tally: Tally) -> None:
        """An ordinary frame came: whoever was off the bus is on it."""
        if self._off:
            self._back(tally)

    def _tell(self, classes: int, data: list[int], tally: Tally) -> None:
        if classes & RESTARTED:
            self._off = True  # even if the frame that said so was missed
            self._back(tally)
        if classes & BUS_OFF and not self._off:
            self._off = True
            tally.events.log_event("error", "bus-off: the controller left the bus")
        said = [text for bit, text in _CLASSES.items() if classes & bit]
        if classes & _CONTROLLER:
            said += [text for bit, text in _CONTROLLER_STATES.items() if data[1] & bit]
        if said or not classes & (RESTARTED | BUS_OFF):
            tally.events.log_event("warn", f"error frame: {', '.join(said) or 'no class given'}")

    def _back(self, tally: Tally) -> None:
        self._off = False
        tally.events.log_event("info", "the controller is back on the bus")
