"""The last seconds of a recording, kept in memory and written when somebody says so.

For what happens rarely: the robot is watched for hours, and a mark keeps the seconds before it.
Each mark is a session file of its own, complete with everything that explains it; what was in force
before its first message (``/gait/mode``, ``/robot_description``) is carried to its start, as
``undulog log cut --carry-state`` does.
"""

from __future__ import annotations

import json
import os
import re
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from mcap.records import Channel, Metadata, Schema

from ...common.errors import LogWriteError, UndulogError
from ..messages.definitions import adds_up, is_latched
from .mcap_sink import Description, McapSink, MessageSink, write_error

MARK_RECORD = "undulog.mark"
"""Metadata record of a mark: which, when, why, and what it lacks."""

_YIELD_EVERY = 64


class RingMessage(NamedTuple):
    """One message, as a sink is given it."""

    channel_id: int
    log_time_ns: int
    publish_time_ns: int
    sequence: int
    payload: bytes


@dataclass(frozen=True)
class Mark:
    """One mark, written or not.

    Attributes:
        start_ns: Log time of the first one [Unix ns]; None without any.
        stop_ns: Log time of the last one [Unix ns]; None without any.
        error: Why the file is not whole; None when it is.
    """

    path: Path
    messages: int
    start_ns: int | None
    stop_ns: int | None
    error: LogWriteError | None


@dataclass(frozen=True)
class Snapshot:
    """What a mark holds.

    Attributes:
        facts: Entries of :data:`MARK_RECORD`.
        carried: What was in force before the first message.
        messages: The ring's messages.
    """

    path: Path
    definitions: list[Description]
    facts: dict[str, str]
    carried: list[RingMessage]
    messages: list[RingMessage]


class MarkWriter:
    """Writes marks one after another; its thread lives only as long as there is work."""

    def __init__(self, open_file: Callable[[Path], MessageSink]) -> None:
        """Nothing is written yet.

        Args:
            open_file: Creates a file and must refuse one that exists; called in the thread.
        """
        self._open_file = open_file
        self._lock = threading.Lock()
        self._waiting: deque[Snapshot] = deque()
        self._thread: threading.Thread | None = None
        self._done: list[Mark] = []
        self._asked = 0

    @property
    def waiting(self) -> int:
        """Marks that are not written yet."""
        return self._asked - len(self._done)

    @property
    def done(self) -> tuple[Mark, ...]:
        """Marks that are finished, the failed ones too, in order."""
        return tuple(self._done)

    def add(self, snapshot: Snapshot) -> None:
        """Have a mark written."""
        with self._lock:
            self._asked += 1
            self._waiting.append(snapshot)
            if self._thread is None or not self._thread.is_alive():
                # Not a daemon: an interpreter that ends waits until the file is whole.
                self._thread = threading.Thread(target=self._run, name="ring marks")
                self._thread.start()

    def join(self) -> None:
        """Wait until nothing is left to write."""
        with self._lock:
            thread = self._thread
        if thread is not None:
            thread.join()

    def _run(self) -> None:
        while True:
            with self._lock:
                if not self._waiting:
                    self._thread = None
                    return
                snapshot = self._waiting.popleft()
            self._done.append(_write(snapshot, self._open_file))


def _write(snapshot: Snapshot, open_file: Callable[[Path], MessageSink]) -> Mark:
    path, messages = snapshot.path, snapshot.messages
    error: LogWriteError | None = None
    try:
        sink = open_file(path)
        try:
            for record in snapshot.definitions:
                sink.define(record)
            sink.define(Metadata(MARK_RECORD, snapshot.facts))
            for k, message in enumerate(snapshot.carried + messages):
                sink.write(*message)
                if k % _YIELD_EVERY == 0:
                    time.sleep(0)  # or the recorder's thread waits for a whole switch interval
        finally:
            sink.close(())
        _sync(path)
    except OSError as failure:
        error = write_error(path, failure)
    except UndulogError as failure:
        error = LogWriteError(path, str(failure))
    times = [message.log_time_ns for message in messages]
    return Mark(
        path=path,
        messages=len(snapshot.carried) + len(messages),
        start_ns=min(times, default=None),
        stop_ns=max(times, default=None),
        error=error,
    )


def _sync(path: Path) -> None:
    """Have the file and its name on the disk itself."""
    for place, flags in ((path, os.O_RDONLY), (path.parent, os.O_RDONLY | os.O_DIRECTORY)):
        handle = os.open(place, flags)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


MAX_BYTES = 512 << 20
"""A ring holds no more than this by default [B], whatever its duration."""

MAX_WAITING = 4
"""More marks than these can't wait to be written: each holds a ring's worth of memory."""

MESSAGE_OVERHEAD = 248
"""What Python's objects add to a message in memory [B], measured."""


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
            open_file: Creates a file for a mark and must refuse one that exists; called in the
                thread that writes.
            max_bytes: The oldest messages go when more than this is held [B].
        """
        self._path = path
        self._duration_ns = duration_ns
        self._max_bytes = max_bytes
        self._definitions: list[Description] = []
        self._types: dict[int, str] = {}
        self._topics: dict[int, str] = {}
        self._latched: set[int] = set()
        self._adds_up: set[int] = set()
        self._state: dict[tuple[int, bytes], RingMessage] = {}
        self._messages: deque[RingMessage] = deque()
        self._newest_ns = 0
        self._number = _last_number(path)
        self._open = True
        self._writer = MarkWriter(open_file)
        self._told = 0
        self.size = 0
        """Memory that the messages take [B]."""
        self.accepted = 0
        """Messages taken since the start."""
        self.dropped = 0
        """Messages that went before their time because of ``max_bytes``."""

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
        return self._writer.waiting

    def define(self, record: Description) -> None:
        """Keep what explains later messages; every mark has all of it.

        Args:
            record: A schema, channel, attachment or metadata record.
        """
        self._definitions.append(record)
        if isinstance(record, Schema):
            self._types[record.id] = record.name
        elif isinstance(record, Channel):
            self._topics[record.id] = record.topic
            if is_latched(self._types.get(record.schema_id, ""), record):
                self._latched.add(record.id)
            if adds_up(record):
                self._adds_up.add(record.id)

    def write(
        self,
        channel_id: int,
        log_time_ns: int,
        publish_time_ns: int,
        sequence: int,
        payload: bytes,
    ) -> None:
        """See :meth:`MessageSink.write`; what has become too old is let go."""
        if not self._open:
            raise LogWriteError(self._path, "the ring is closed")
        messages = self._messages
        messages.append(RingMessage(channel_id, log_time_ns, publish_time_ns, sequence, payload))
        self.accepted += 1
        self.size += len(payload) + MESSAGE_OVERHEAD
        if log_time_ns > self._newest_ns:  # noqa: PLR1730 - a call costs, and this is the hot path
            self._newest_ns = log_time_ns
        oldest_ns = self._newest_ns - self._duration_ns
        while messages[0].log_time_ns < oldest_ns:
            self._let_go()
        while self.size > self._max_bytes and len(messages) > 1:
            self._let_go()
            self.dropped += 1

    def mark(self, text: str = "") -> Path:
        """Write what the ring holds, in a thread; it goes on meanwhile.

        Args:
            text: Why, for the file's metadata.

        Returns:
            The file that is being written; :meth:`take_marks` says when it is whole.

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
        snapshot = Snapshot(path, list(self._definitions), facts, at_start, messages)
        self._writer.add(snapshot)
        return path

    def take_marks(self) -> tuple[Mark, ...]:
        """The marks that were finished since the last call.

        Returns:
            In the order of writing, the failed ones too.
        """
        done = self._writer.done
        fresh = done[self._told :]
        self._told = len(done)
        return fresh

    @property
    def marks(self) -> tuple[Mark, ...]:
        """All marks that are finished, the failed ones too, in order."""
        return self._writer.done

    def close(self, last: tuple[Metadata, ...]) -> None:
        """Wait for the marks that are being written; safe to call twice.

        Args:
            last: Of no use here: a mark says what was known when it was made.

        Raises:
            LogWriteError: If a mark failed that nobody was told of.
        """
        del last
        if not self._open:
            return
        self._open = False
        self._writer.join()
        self._messages.clear()
        self._state.clear()
        self.size = 0
        failed = [mark.error for mark in self.take_marks() if mark.error is not None]
        if failed:
            raise failed[0]
        if self.waiting:  # its thread died of something that is no fault of the disk
            raise LogWriteError(self._path, f"{self.waiting} marks are not written")

    # -- inside ----------------------------------------------------------------------------

    def _let_go(self) -> None:
        """Drop the oldest message; what it said may stay in force."""
        message = self._messages.popleft()
        self.size -= len(message.payload) + MESSAGE_OVERHEAD
        if message.channel_id in self._latched:
            told = message.payload if message.channel_id in self._adds_up else b""
            self._state[message.channel_id, told] = message

    def _next_path(self) -> Path:
        self._number += 1
        while (path := _mark_path(self._path, self._number)).exists():
            self._number += 1
        return path


def _mark_path(path: Path, number: int) -> Path:
    return path.with_name(f"{path.stem}_mark{number:04d}{path.suffix}")


def _last_number(path: Path) -> int:
    """The highest number of a mark that is there already."""
    pattern = re.compile(rf"{re.escape(path.stem)}_mark(\d{{4,9}}){re.escape(path.suffix)}")
    try:
        names = [entry.name for entry in path.parent.iterdir()]
    except OSError:  # the folder may not be there: the first mark says so
        return 0
    return max((int(found[1]) for found in map(pattern.fullmatch, names) if found), default=0)
