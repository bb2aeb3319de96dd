"""Where a recording is kept: a session on disk, in parts if wanted, or a ring in memory."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

from mcap.records import Metadata

from ..common.amounts import format_size
from ..common.errors import LogWriteError, UsageError
from ..log.file.parts import part_path
from ..log.sinks.durable_sink import DurableSink
from ..log.sinks.mcap_sink import Description, MessageSink
from ..log.sinks.ring_sink import RingSink
from .settings import RecordSettings


class Listener(Protocol):
    """Is told of records after the sink has accepted them; must not wait and must not fail."""

    def define(self, record: Description) -> None:
        """Hear of what explains later messages."""
        ...

    def offer(
        self,
        channel_id: int,
        log_time_ns: int,
        publish_time_ns: int,
        sequence: int,
        payload: bytes,
    ) -> None:
        """Hear of a message; the arguments are those of :meth:`MessageSink.write`."""
        ...


class TappedSink:
    """Passes everything to a sink, and what that accepted to the listeners."""

    def __init__(self, sink: MessageSink, listeners: Sequence[Listener]) -> None:
        """Listen to a sink.

        Args:
            sink: Where everything goes first; what it refuses nobody hears of.
            listeners: Who hears of it then.
        """
        self._sink = sink
        self._write = sink.write
        self._listeners = tuple(listeners)
        self._offers = tuple(listener.offer for listener in listeners)

    def define(self, record: Description) -> None:
        """Take what explains later messages.

        Raises:
            LogWriteError: If the sink can't keep it.
        """
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
        """Finalise the sink.

        Args:
            last: Metadata that belong at the end.

        Raises:
            LogWriteError: If it can't be finalised.
        """
        self._sink.close(last)


_NS = 1_000_000_000


class RingStorage:
    """A ring in memory, written to a file when marked."""

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
        self.size = 0  # bytes of all marks so far
        self._dropped = 0

    @property
    def messages(self) -> int:
        """Messages accepted."""
        return self.sink.accepted

    @property
    def unsynced(self) -> int:
        """Messages that power loss would cost: all that the ring holds."""
        return self.sink.messages

    def tick(self) -> list[tuple[str, str]]:
        """Look what became of the marks; called once a second. A failed one ends nothing.

        Returns:
            What there is to say: level (``info``, ``warn``, ``error``) and one sentence each.
        """
        events: list[tuple[str, str]] = []
        for mark in self.sink.take_marks():
            if mark.error is not None:
                events.append(("error", f"a mark is not whole: {mark.error}"))
                continue
            size = mark.path.stat().st_size if mark.path.exists() else 0
            self.size += size
            said = f"{mark.path.name} is written: {mark.messages} messages, {format_size(size)}"
            events.append(("info", said))
        if self.sink.dropped and not self._dropped:
            held_s = self.sink.span_ns / _NS
            events.append(("warn", f"the ring is full of bytes and holds only {held_s:.1f} s"))
        self._dropped = self.sink.dropped
        return events

    def mark(self, text: str = "") -> Mapping[str, Any]:
        """Write what the ring holds.

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


class DiskStorage:
    """A session on disk, its write-ahead log beside it."""

    def __init__(self, settings: RecordSettings) -> None:
        """Create the first file.

        Raises:
            OutputExistsError: If it is there and ``force`` is not given.
            LogWriteError: If it can't be created.
        """
        split_s = settings.split_time_s
        self.sink = DurableSink(
            settings.output,
            force=settings.force,
            split_size=settings.split_size,
            split_ns=None if split_s is None else round(split_s * _NS),
        )
        self._told = ""

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
        """Messages accepted."""
        return self.sink.messages

    @property
    def part(self) -> int | None:
        """Number of the part that is being written."""
        return self.sink.part

    @property
    def unsynced(self) -> int:
        """Messages that power loss would cost."""
        return self.sink.unsynced

    @property
    def shortage(self) -> LogWriteError | None:
        """Why recording must end soon, or has ended."""
        return self.sink.shortage

    def tick(self) -> list[tuple[str, str]]:
        """Flush what has waited for long; called once a second.

        Returns:
            Level and one sentence for a part that could not be begun, once each.

        Raises:
            LogWriteError: If a part that is due can't be begun.
        """
        self.sink.tick()
        trouble = self.sink.split_trouble
        if trouble is None or str(trouble) == self._told:
            return []
        self._told = str(trouble)
        return [("error", f"the next part could not be begun, this one goes on: {trouble}")]

    def mark(self, text: str = "") -> Mapping[str, Any]:
        """Nothing to do: everything is written, the mark with it."""
        del text
        return {}

    def split(self) -> Mapping[str, Any]:
        """Begin the next part.

        Raises:
            LogWriteError: If it can't be created; the recording goes on in the one before.
        """
        path = self.sink.split()
        return {"part": self.sink.part, "file": str(path)}

    def files(self) -> tuple[Path, ...]:
        """The parts, in order."""
        first = self.sink.path
        return (first, *(part_path(first, k) for k in range(2, self.sink.part + 1)))


Storage = DiskStorage | RingStorage
"""Where a recording is kept."""


def open_storage(settings: RecordSettings) -> Storage:
    """Create what the settings ask for.

    Raises:
        OutputExistsError: If the output is there and ``force`` is not given.
        LogWriteError: If it can't be created.
    """
    if settings.ring_s is not None:
        return RingStorage(settings.output, settings.ring_s)
    return DiskStorage(settings)
