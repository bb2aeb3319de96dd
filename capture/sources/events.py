"""Events of a source, one text at most once a second, and the meaning of error frames.

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


@dataclass
class _Repeats:
    logged_ns: int
    level: str
    held: int = 0


class EventLog:
    """Collects the events of one source, from any of its threads.

    The first of its kind is reported at once. Those that follow within a second are counted, and
    reported together at its end.
    """

    def __init__(self, now_ns: Callable[[], int]) -> None:
        """Start without events; ``now_ns`` is the session's clock [Unix ns]."""
        self._now_ns = now_ns
        self._lock = threading.Lock()
        self._repeats: dict[str, _Repeats] = {}
        self._events: list[SourceEvent] = []

    def log_event(self, level: str, text: str, count: int = 1) -> None:
        """Log an event.

        Args:
            level: ``info``, ``warn`` or ``error``.
            text: One sentence, the same for all events of a kind: no numbers that change.
        """
        now = self._now_ns()
        with self._lock:
            repeats = self._repeats.get(text)
            if repeats is None:
                self._repeats[text] = _Repeats(now, level)
                self._append(now, level, text, count)
            else:
                repeats.held += count

    def take(self) -> tuple[SourceEvent, ...]:
        """Remove and return the events that are due, in order."""
        if not self._repeats:
            return ()
        now = self._now_ns()
        with self._lock:
            for text, repeats in list(self._repeats.items()):
                if now - repeats.logged_ns < _PAUSE_NS:
                    continue
                if repeats.held:
                    self._append(now, repeats.level, text, repeats.held)
                    repeats.logged_ns, repeats.held = now, 0
                else:
                    del self._repeats[text]
            return self._drain()

    def flush(self) -> tuple[SourceEvent, ...]:
        """Remove and return all events in order, with those held back."""
        with self._lock:
            for text, repeats in self._repeats.items():
                if repeats.held:
                    self._append(self._now_ns(), repeats.level, text, repeats.held)
                    repeats.held = 0
            return self._drain()

    def _drain(self) -> tuple[SourceEvent, ...]:
        events, self._events = tuple(self._events), []
        return events

    def _append(self, now_ns: int, level: str, text: str, count: int) -> None:
        times = f" ({count} times)" if count > 1 else ""
        self._events.append(SourceEvent(now_ns, level, text + times))


@dataclass
class Tally:
    """Counts and events of a source, and the session's clock, ``now_ns`` [Unix ns]."""

    now_ns: Callable[[], int]
    counts: SourceCounts = field(default_factory=SourceCounts)
    events: EventLog = field(init=False)

    def __post_init__(self) -> None:
        """Set up the events with the same clock."""
        self.events = EventLog(self.now_ns)

    def lost(self, text: str, count: int, level: str = "warn") -> None:
        """Count dropped frames, and log the text unless there are none."""
        self.counts.dropped = (self.counts.dropped or 0) + count
        if count:
            self.events.log_event(level, text, count)

    def malformed(self, text: str, count: int) -> None:
        """Count and log malformed data, if any."""
        if count:
            self.counts.malformed += count
            self.events.log_event("warn", text, count)


class BusWatch:
    """Counts and logs error frames and impossible device times."""

    def __init__(self) -> None:
        """Start with a controller on the bus."""
        self._off = False

    def look(self, frames: FrameArray, tally: Tally) -> None:
        """Check new frames, in order."""
        t_ns = frames["t_device_ns"]
        if t_ns.max(initial=0) >= DEVICE_TIMES_END_NS:
            tally.malformed(IMPLAUSIBLE_TIME, int((t_ns >= np.uint64(DEVICE_TIMES_END_NS)).sum()))
        ids = frames["id_flags"]
        if not np.bitwise_or.reduce(ids) & ERROR_FLAG:
            if len(ids):
                self._end_bus_off(tally)
            return
        errors = np.flatnonzero(ids & ERROR_FLAG).tolist()
        tally.counts.error_frames += len(errors)
        before = -1
        for k in errors:
            if k > before + 1:  # an ordinary frame in between
                self._end_bus_off(tally)
            self._log_error(int(ids[k]) & ID_MASK, frames["data"][k].tolist(), tally)
            before = k
        if len(frames) > before + 1:
            self._end_bus_off(tally)

    def _log_error(self, classes: int, data: list[int], tally: Tally) -> None:
        if classes & RESTARTED:
            self._off = True  # even if its bus-off frame was missed
            self._end_bus_off(tally)
        if classes & BUS_OFF and not self._off:
            self._off = True
            tally.events.log_event("error", "bus-off: the controller left the bus")
        names = [text for bit, text in _CLASSES.items() if classes & bit]
        if classes & _CONTROLLER:
            names += [text for bit, text in _CONTROLLER_STATES.items() if data[1] & bit]
        if names or not classes & (RESTARTED | BUS_OFF):
            tally.events.log_event("warn", f"error frame: {', '.join(names) or 'no class given'}")

    def _end_bus_off(self, tally: Tally) -> None:
        if self._off:
            self._off = False
            tally.events.log_event("info", "the controller is back on the bus")
