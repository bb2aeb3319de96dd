"""A recording that is kept in memory: the last seconds, written when marked."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ..common.amounts import format_size
from ..common.errors import LogWriteError, UsageError
from ..log.sinks.ring_sink import RingSink

_NS = 1_000_000_000


class RingStorage:
    """The :class:`~.capture.recorder.storage.Storage` of a ring."""

    part: int | None = None
    shortage: LogWriteError | None = None

    def __init__(self, output: Path, ring_s: float) -> None:
        """Start with an empty ring.

        Args:
            output: Names the marks: ``run.mcap`` gives ``run_mark0001.mcap`` and so on.
            ring_s: How much to keep [s].

        Raises:
            LogWriteError: If its folder isn't there.
        """
        if not output.parent.is_dir():
            raise LogWriteError(output, f"the folder {output.parent} doesn't exist")
        self.path = output
        self.sink = RingSink(output, round(ring_s * _NS))
        self._events: list[tuple[str, str]] = []
        self._size = 0
        self._dropped = 0

    @property
    def size(self) -> int:
        """Bytes of all marks so far."""
        return self._size

    @property
    def messages(self) -> int:
        """Messages accepted."""
        return self.sink.accepted

    @property
    def unsynced(self) -> int:
        """Messages that power loss would cost: all that the ring holds."""
        return self.sink.messages

    def tick(self) -> None:
        """Look what became of the marks; called once a second. A failed one ends nothing."""
        for mark in self.sink.take_marks():
            if mark.error is not None:
                self._events.append(("error", f"a mark is not whole: {mark.error}"))
                continue
            size = mark.path.stat().st_size if mark.path.exists() else 0
            self._size += size
            said = f"{mark.path.name} is written: {mark.messages} messages, {format_size(size)}"
            self._events.append(("info", said))
        if self.sink.dropped and not self._dropped:
            held_s = self.sink.span_ns / _NS
            said = f"the ring is full of bytes and holds only {held_s:.1f} s"
            self._events.append(("warn", said))
        self._dropped = self.sink.dropped

    def take_events(self) -> tuple[tuple[str, str], ...]:
        """What there is to say since the last call.

        Returns:
            Level (``info``, ``warn``, ``error``) and one sentence each.
        """
        events, self._events = tuple(self._events), []
        return events

    def mark(self, text: str = "") -> Mapping[str, Any]:
        """Write what the ring holds.

        Args:
            text: Why.

        Returns:
            The file that is being written, and how much is in it.

        Raises:
            LogWriteError: If too many marks wait already.
        """
        held_s, messages = self.sink.span_ns / _NS, self.sink.messages
        path = self.sink.mark(text)
        return {"file": str(path), "messages": messages, "seconds": round(held_s, 3)}

    def split(self) -> Mapping[str, Any]:
        """A ring has no parts.

        Raises:
            UsageError: Always.
        """
        raise UsageError("a ring has no parts; 'undulog record mark' writes what it holds")

    def files(self) -> tuple[Path, ...]:
        """The marks that are whole, in order."""
        return tuple(mark.path for mark in self.sink.marks if mark.error is None)
