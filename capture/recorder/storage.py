"""Storage of a recording: a session on disk, in parts if requested, or a ring in memory."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from mcap.records import Metadata

from ..common.amounts import format_size
from ..common.errors import LogWriteError, UsageError
from ..log.file.parts import part_path
from ..log.sinks.durable_sink import DurableSink
from ..log.sinks.mcap_sink import Description, MessageSink
from ..log.sinks.ring_sink import RingSink
from .health import LiveHealth
from .live_feed import LiveFeed
from .settings import RecordSettings

_NS = 1_000_000_000


class TappedSink:
    """Passes records to a sink, and those that it accepted to listeners, which never wait."""

    def __init__(self, sink: MessageSink, listeners: Sequence[LiveHealth | LiveFeed]) -> None:
        """Connect a sink with its listeners."""
        self._sink = sink
        self._write = sink.write
        self._listeners = tuple(listeners)
        self._offers = tuple(listener.offer for listener in listeners)

    def define(self, record: Description) -> None:
        """See :meth:`MessageSink.define`."""
        self._sink.define(record)
        for listener in self._listeners:
            listener.define(record)

    def write(
        self,
        channel_id: int,
        log_time_ns: int,
        publish_time_ns: int,
        sequence: int,
        payload: bytes,
    ) -> None:
        """See :meth:`MessageSink.write`."""
        self._write(channel_id, log_time_ns, publish_time_ns, sequence, payload)
        for offer in self._offers:
            offer(channel_id, log_time_ns, publish_time_ns, sequence, payload)

    def close(self, last: tuple[Metadata, ...]) -> None:
        """See :meth:`MessageSink.close`."""
        self._sink.close(last)


class RingStorage:
    """A ring in memory, written to a file when marked.

    Attributes:
        path: Output of the recording, which names the marks: ``run.mcap`` gives
            ``run_mark0001.mcap`` and so on.
        size: Bytes of all marks so far.
    """

    part: int | None = None
    shortage: LogWriteError | None = None

    def __init__(self, output: Path, ring_s: float) -> None:
        """Start with an empty ring of the last ``ring_s`` [s].

        Raises:
            LogWriteError: If the output's folder doesn't exist.
        """
        if not output.parent.is_dir():
            raise LogWriteError(output, f"the folder {output.parent} doesn't exist")
        self.path = output
        self.sink = RingSink(output, round(ring_s * _NS))
        self.size = 0
        self._dropped = 0

    @property
    def messages(self) -> int:
        """Number of messages accepted."""
        return self.sink.accepted

    @property
    def unsynced(self) -> int:
        """Number of messages that power loss would cost: all that the ring holds."""
        return self.sink.messages

    def tick(self) -> list[tuple[str, str]]:
        """Return events of the marks: level and one sentence each; called once a second."""
        events: list[tuple[str, str]] = []
        for mark in self.sink.take_marks():
            if mark.error is not None:
                events.append(("error", f"a mark is not whole: {mark.error}"))
                continue
            size = mark.path.stat().st_size if mark.path.exists() else 0
            self.size += size
            text = f"{mark.path.name} is written: {mark.messages} messages, {format_size(size)}"
            events.append(("info", text))
        if self.sink.dropped and not self._dropped:
            held_s = self.sink.span_ns / _NS
            events.append(("warn", f"the ring is full of bytes and holds only {held_s:.1f} s"))
        self._dropped = self.sink.dropped
        return events

    def mark(self, text: str = "") -> Mapping[str, Any]:
        """Write the messages of the ring.

        Returns:
            The ``file`` that is being written, its number of ``messages`` and its ``seconds``.

        Raises:
            LogWriteError: If too many marks wait already.
        """
        held_s, messages = self.sink.span_ns / _NS, self.sink.messages
        path = self.sink.mark(text)
        return {"file": str(path), "messages": messages, "seconds": round(held_s, 3)}

    def split(self) -> Mapping[str, Any]:
        """Raise a UsageError: a ring has no parts."""
        raise UsageError("a ring has no parts; 'undulog record mark' writes what it holds")

    def files(self) -> tuple[Path, ...]:
        """Return the marks that are whole, in order."""
        return tuple(mark.path for mark in self.sink.marks if mark.error is None)


class DiskStorage:
    """A session on disk, its write-ahead log beside it."""

    def __init__(self, settings: RecordSettings) -> None:
        """Create the first file.

        Raises:
            OutputExistsError: If it exists and ``force`` is not set.
            LogWriteError: If it can't be created.
        """
        split_s = settings.split_time_s
        self.sink = DurableSink(
            settings.output,
            force=settings.force,
            split_size=settings.split_size,
            split_ns=None if split_s is None else round(split_s * _NS),
        )
        self._reported = ""

    @property
    def path(self) -> Path:
        """The part that is being written."""
        return self.sink.part_path

    @property
    def size(self) -> int:
        """Bytes of MCAP so far."""
        return self.sink.bytes_written

    @property
    def messages(self) -> int:
        """Number of messages accepted."""
        return self.sink.messages

    @property
    def part(self) -> int | None:
        """Number of the part that is being written."""
        return self.sink.part

    @property
    def unsynced(self) -> int:
        """Number of messages that power loss would cost."""
        return self.sink.unsynced

    @property
    def shortage(self) -> LogWriteError | None:
        """Why recording must end soon, or has ended."""
        return self.sink.shortage

    def tick(self) -> list[tuple[str, str]]:
        """Flush old data; called once a second.

        Returns:
            Level and one sentence, once for each failure to begin a part.

        Raises:
            LogWriteError: If a part that is due can't be begun.
        """
        self.sink.tick()
        trouble = self.sink.split_trouble
        if trouble is None or str(trouble) == self._reported:
            return []
        self._reported = str(trouble)
        return [("error", f"the next part could not be begun, this one goes on: {trouble}")]

    def mark(self, text: str = "") -> Mapping[str, Any]:
        """Return no facts: the mark is in the session like every event."""
        del text
        return {}

    def split(self) -> Mapping[str, Any]:
        """Begin the next part; return its number and file.

        Raises:
            LogWriteError: If it can't be created; the recording continues in the present one.
        """
        path = self.sink.split()
        return {"part": self.sink.part, "file": str(path)}

    def files(self) -> tuple[Path, ...]:
        """Return the parts, in order."""
        first = self.sink.path
        return (first, *(part_path(first, k) for k in range(2, self.sink.part + 1)))
