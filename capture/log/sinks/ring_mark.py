"""Marks of a ring: each one a session file, written in a thread while the ring goes on."""

from __future__ import annotations

import os
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from mcap.records import Metadata

from ...common.errors import LogWriteError, UndulogError
from .mcap_sink import write_error
from .sink import Description, MessageSink

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
        path: Its file.
        messages: Messages in the file.
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
        path: The file to write.
        definitions: What explains the messages.
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
        """Have a mark written.

        Args:
            snapshot: What it holds.
        """
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
