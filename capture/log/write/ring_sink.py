"""The last seconds of a recording, kept in memory and written to a file on request.

This is for rare events: the robot runs for hours, and a mark stores the seconds before it.
Each mark is a complete session file, and a part file until it is whole; the latched state before
its first message (``/gait/mode``, ``/robot_description``) is copied to its start, as ``undulog log
cut --carry-state`` does.
"""

from __future__ import annotations

import json
import time
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from mcap.records import Channel, Metadata, Schema

from ...common.amounts import format_size
from ...common.errors import LogWriteError, UndulogError
from ...common.part_files import finished_path, publish_durably, unfinished_path
from ..file.parts import mark_number, mark_path
from ..mcap.batch import MessageBatch, MessageFields
from ..messages.definitions import adds_up, is_latched
from .mcap_sink import Description, McapSink, MessageSink, write_error

MARK_RECORD = "undulog.mark"
"""Metadata record of a mark: its number, time, text, and the number of messages dropped before."""

_YIELD_EVERY = 64

MAX_BYTES = 512 << 20
"""Most bytes that a ring holds by default, whatever its duration."""

MAX_WAITING = 4
"""Most marks that wait to be written: each holds the memory of a ring."""

MESSAGE_OVERHEAD = 248
"""Memory of a message beside its payload [B], measured."""


class RingMessage(NamedTuple):
    """The arguments of :meth:`MessageSink.write`."""

    channel_id: int
    log_time_ns: int
    publish_time_ns: int
    sequence: int
    payload: bytes


@dataclass(frozen=True)
class Mark:
    """One mark, written or not.

    Attributes:
        start_ns: Log time of the first message [Unix ns]; None without messages.
        stop_ns: Log time of the last message [Unix ns]; None without messages.
        error: Why the file is incomplete; None if it is complete.
    """

    path: Path
    messages: int
    start_ns: int | None
    stop_ns: int | None
    error: LogWriteError | None


class RingSink:
    """Keeps the last seconds of messages; :meth:`mark` writes them to a file of their own."""

    def __init__(
        self,
        path: Path,
        duration_ns: int,
        *,
        open_file: Callable[[Path], MessageSink] = McapSink,
        max_bytes: int = MAX_BYTES,
    ) -> None:
        """Start with an empty ring; no file is made before the first mark.

        Args:
            path: Names the marks: ``run.mcap`` gives ``run_mark0001.mcap`` and so on, after those
                that are there already.
            duration_ns: How much to keep, in log time [ns].
            open_file: Creates the part file of a mark and must refuse one that exists; called in
                the thread that writes.
            max_bytes: The oldest messages go when more than this is held [B].
        """
        self._path, self._duration_ns, self._max_bytes = path, duration_ns, max_bytes
        self._definitions: list[Description] = []
        self._types: dict[int, str] = {}
        self._topics: dict[int, str] = {}
        self._latched: set[int] = set()
        self._adds_up: set[int] = set()
        self._open_file = open_file
        # Its thread is not a daemon: an interpreter that exits waits until the files are complete.
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="ring marks")
        self._marks: list[Future[Mark]] = []
        self._taken = 0
        self._state: dict[tuple[int, bytes], RingMessage] = {}
        self._messages: deque[RingMessage] = deque()
        self._newest_ns = 0
        self._number = _last_number(path)
        self._open = True
        self.size = 0
        """Memory that the messages take [B]."""
        self.accepted = 0
        """Messages accepted since the start."""
        self.dropped = 0
        """Messages dropped because of ``max_bytes``."""

    @property
    def messages(self) -> int:
        """Messages that a mark would write now."""
        return len(self._messages)

    @property
    def span_ns(self) -> int:
        """Log time from the oldest message to the newest [ns]."""
        return self._newest_ns - self._messages[0].log_time_ns if self._messages else 0

    @property
    def waiting(self) -> int:
        """Marks that are not written yet."""
        return sum(not mark.done() for mark in self._marks)

    def define(self, record: Description) -> None:
        """See :meth:`MessageSink.define`; every mark gets all definitions."""
        self._definitions.append(record)
        if isinstance(record, Schema):
            self._types[record.id] = record.name
        elif isinstance(record, Channel):
            self._topics[record.id] = record.topic
            if is_latched(self._types.get(record.schema_id, ""), record):
                self._latched.add(record.id)
            if adds_up(record):
                self._adds_up.add(record.id)

    def write(self, *message: *MessageFields) -> None:
        """See :meth:`MessageSink.write`; messages that are too old are dropped."""
        if not self._open:
            raise LogWriteError(self._path, "the ring is closed")
        messages = self._messages
        _, log_time_ns, _, _, payload = message
        messages.append(RingMessage(*message))
        self.accepted += 1
        self.size += len(payload) + MESSAGE_OVERHEAD
        if log_time_ns > self._newest_ns:  # noqa: PLR1730 - a call costs, and this is the hot path
            self._newest_ns = log_time_ns
        oldest_ns = self._newest_ns - self._duration_ns
        while messages[0].log_time_ns < oldest_ns:
            self._drop_oldest()
        while self.size > self._max_bytes and len(messages) > 1:
            self._drop_oldest()
            self.dropped += 1

    def write_batch(self, batch: MessageBatch) -> None:
        """See :meth:`MessageSink.write_batch`."""
        for message in batch.messages:
            self.write(*message)

    def mark(self, text: str = "") -> Path:
        """Write the ring's messages to a file, in a thread.

        Args:
            text: Reason, for the file's metadata.

        Returns:
            The file that is being written; :meth:`take_marks` returns its mark when it is complete.

        Raises:
            LogWriteError: If the ring is closed, or too many marks wait already.
        """
        path = self._next_path()
        if not self._open:
            raise LogWriteError(path, "the ring is closed")
        if self.waiting >= MAX_WAITING:
            raise LogWriteError(path, f"{MAX_WAITING} marks wait to be written already")
        messages = list(self._messages)
        start_ns = messages[0].log_time_ns if messages else self._newest_ns
        carried = sorted(self._state.values(), key=lambda message: message.log_time_ns)
        facts = {
            "number": str(self._number),
            "text": text,
            "ring_s": repr(self._duration_ns / 1e9),
            "stop_ns": str(self._newest_ns),
            "dropped": str(self.dropped),
            "carried": json.dumps(
                {self._topics[message.channel_id]: message.log_time_ns for message in carried}
            ),
        }
        at_start = [message._replace(log_time_ns=start_ns) for message in carried]
        definitions = [*self._definitions, Metadata(MARK_RECORD, facts)]
        self._marks.append(
            self._pool.submit(_write_mark, path, self._open_file, definitions, at_start, messages)
        )
        return path

    def take_marks(self) -> tuple[Mark, ...]:
        """Return the marks finished since the last call, also failed ones, in order."""
        done = self.marks
        fresh = done[self._taken :]
        self._taken = len(done)
        return fresh

    @property
    def marks(self) -> tuple[Mark, ...]:
        """All finished marks, also failed ones, in order."""
        return tuple(mark.result() for mark in self._marks if mark.done() and not mark.exception())

    def close(self, last: tuple[Metadata, ...]) -> None:
        """Wait for the marks that are being written; safe to call twice.

        Args:
            last: Not used: a mark has the metadata of its own time.

        Raises:
            LogWriteError: If a mark failed that :meth:`take_marks` has not returned.
        """
        del last
        if not self._open:
            return
        self._open = False
        self._pool.shutdown()
        self._messages.clear()
        self._state.clear()
        self.size = 0
        failed = [mark.error for mark in self.take_marks() if mark.error is not None]
        if failed:
            raise failed[0]
        if lost := len(self._marks) - len(self.marks):  # an error other than of the disk
            raise LogWriteError(self._path, f"{lost} marks are not written")

    # -- inside ----------------------------------------------------------------------------

    def _drop_oldest(self) -> None:
        """Drop the oldest message; a latched one is kept as state."""
        message = self._messages.popleft()
        self.size -= len(message.payload) + MESSAGE_OVERHEAD
        if message.channel_id in self._latched:
            key = message.payload if message.channel_id in self._adds_up else b""
            self._state[message.channel_id, key] = message

    def _next_path(self) -> Path:
        while True:
            self._number += 1
            path = mark_path(self._path, self._number)
            if not (path.exists() or unfinished_path(path).exists()):
                return path


def _write_mark(
    path: Path,
    open_file: Callable[[Path], MessageSink],
    definitions: Sequence[Description],
    carried: Sequence[RingMessage],
    messages: Sequence[RingMessage],
) -> Mark:
    error: LogWriteError | None = None
    part = unfinished_path(path)
    try:
        sink = open_file(part)
        try:
            for record in definitions:
                sink.define(record)
            for k, message in enumerate((*carried, *messages)):
                sink.write(*message)
                if k % _YIELD_EVERY == 0:
                    time.sleep(0)  # or the recorder's thread waits for a whole switch interval
        finally:
            sink.close(())
        publish_durably(part, path, replace=False)
    except OSError as failure:
        error = write_error(path, failure)
    except UndulogError as failure:
        error = LogWriteError(path, str(failure))
    times = [message.log_time_ns for message in messages]
    return Mark(
        path=path,
        messages=len(carried) + len(messages),
        start_ns=min(times, default=None),
        stop_ns=max(times, default=None),
        error=error,
    )


def _last_number(path: Path) -> int:
    """Return the highest number of an existing mark."""
    try:
        names = [finished_path(entry) for entry in path.parent.iterdir()]
    except OSError:  # the folder may not exist: the first mark reports it
        return 0
    return max((mark_number(path, name) for name in names), default=0)


class RingStorage:
    """A ring in memory, written to a file when marked.

    Attributes:
        part_path: Output of the recording, which names the marks: ``run.mcap`` gives
            ``run_mark0001.mcap`` and so on.
        size: Bytes of all marks so far.
    """

    part: int | None = None
    shortage: LogWriteError | None = None
    must_end: str = ""
    rescued: tuple[Path, ...] = ()

    def __init__(self, output: Path, ring_s: float) -> None:
        """Start with an empty ring of the last ``ring_s`` [s].

        Raises:
            LogWriteError: If the output's folder doesn't exist.
        """
        if not output.parent.is_dir():
            raise LogWriteError(output, f"the folder {output.parent} doesn't exist")
        self.part_path = output
        self.sink = RingSink(output, round(ring_s * 1e9))
        self.size = self._dropped = 0
        self._is_there = True

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
        there, self._is_there = self._is_there, self.part_path.parent.is_dir()
        if there and not self._is_there:
            gone = f"the folder {self.part_path.parent} is gone: no mark can be written"
            events.append(("error", gone))
        if self.sink.dropped and not self._dropped:
            held_s = self.sink.span_ns / 1e9
            events.append(("warn", f"the ring is full of bytes and holds only {held_s:.1f} s"))
        self._dropped = self.sink.dropped
        return events

    def mark(self, text: str) -> dict[str, Any]:
        """Write the messages of the ring.

        Returns:
            The ``file`` that is being written, its number of ``messages`` and its ``seconds``.

        Raises:
            LogWriteError: If too many marks wait already.
        """
        held_s, messages = self.sink.span_ns / 1e9, self.sink.messages
        path = self.sink.mark(text)
        return {"file": str(path), "messages": messages, "seconds": round(held_s, 3)}

    def files(self) -> tuple[Path, ...]:
        """Return the marks that are whole, in order."""
        return tuple(mark.path for mark in self.sink.marks if mark.error is None)
