"""The relay's end of the live feed: a socket that is read at once, and a bounded queue.

A thread reads the socket, so that slow drawing doesn't fill it; when the queue is full the oldest
messages are dropped. It polls a hundred times a second instead of blocking: a send that wakes a
blocked process costs the recorder time.
"""

from __future__ import annotations

import os
import socket
import threading
from collections import deque
from contextlib import AbstractContextManager
from pathlib import Path
from typing import NamedTuple

from undulog.capture.common.errors import DataError, UsageError
from undulog.capture.recorder.control_client import Identity, release
from undulog.capture.recorder.live_wire import (
    HEAD_SIZE,
    MAX_DATAGRAM,
    DatagramHead,
    Kind,
    read_head,
)

_LOOK_S = 0.01


class Datagram(NamedTuple):
    """One datagram, its head read.

    Attributes:
        head: Its head.
    """

    head: DatagramHead
    data: bytes


class Inbox(AbstractContextManager["Inbox"]):
    """Binds the socket and reads it until it is left."""

    def __init__(self, path: Path, *, max_bytes: int = 16 << 20) -> None:
        """Bind, and begin to read.

        Args:
            path: Where the socket will be; one that nobody reads is replaced.
            max_bytes: How many bytes wait at most to be shown.

        Raises:
            UsageError: If another relay reads there, or the socket can't be made.
        """
        self.path = path
        self.dropped = 0
        """Messages that were dropped here because showing them took too long."""
        self.refused = 0
        """Datagrams that were none of ours."""
        self._max_bytes = max_bytes
        self._queue: deque[Datagram] = deque()
        self._bytes = 0
        self._lock = threading.Lock()
        self._socket, self._file = _bind(path)
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._read, name="live inbox", daemon=True)
        self._thread.start()

    def __exit__(self, *_: object) -> None:
        """Stop reading and remove the socket."""
        self.close()

    def close(self) -> None:
        """Stop reading and remove the socket, unless another relay has taken its place."""
        self._ending.set()
        self._thread.join()
        release(self.path, self._socket, self._file)

    def take(self) -> list[Datagram]:
        """Take the datagrams received since the last call, in order."""
        with self._lock:
            taken = list(self._queue)
            self._queue.clear()
            self._bytes = 0
        return taken

    def _read(self) -> None:
        while not self._ending.is_set():
            try:
                data = self._socket.recv(MAX_DATAGRAM)
            except BlockingIOError:
                self._ending.wait(_LOOK_S)
                continue
            try:
                head = read_head(data)
            except DataError:
                self.refused += 1
                continue
            with self._lock:
                self._queue.append(Datagram(head, data))
                self._bytes += len(data)
                if self._bytes > self._max_bytes:
                    self._drop_oldest()

    def _drop_oldest(self) -> None:
        """Drop the oldest messages; the last of repeated definitions stay."""
        kept: dict[bytes, Datagram] = {}
        while self._queue and self._bytes > self._max_bytes:
            oldest = self._queue.popleft()
            self._bytes -= len(oldest.data)
            if oldest.head.kind is Kind.MESSAGES:
                self.dropped += oldest.head.messages
            else:
                kept[_said(oldest)] = oldest
        self._queue.extendleft(reversed(kept.values()))
        self._bytes += sum(len(one.data) for one in kept.values())


def _said(datagram: Datagram) -> bytes:
    """Return a definition's key, the same for its repetitions: all but the counter in the head."""
    return bytes([datagram.head.kind]) + datagram.data[HEAD_SIZE:]


def _bind(path: Path) -> tuple[socket.socket, Identity]:
    """Bind a socket that only its owner may write to."""
    if path.exists() and not path.is_socket():
        raise UsageError(f"{path} is there and is no socket; choose another name")
    if path.is_socket() and _answers(path):
        raise UsageError(f"{path}: another live view reads there")
    link = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    link.setblocking(False)
    # Bound under another name, closed to others, then renamed: nobody finds it open before.
    draft = path.with_name(f"{path.name}.{os.getpid()}")
    try:
        link.bind(str(draft))
        draft.chmod(0o600)
        found = draft.stat()
        draft.replace(path)
    except OSError as error:
        link.close()
        draft.unlink(missing_ok=True)
        raise UsageError(f"{path}: the socket can't be made: {error.strerror or error}") from error
    return link, (found.st_dev, found.st_ino)


def _answers(path: Path) -> bool:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as link:
        try:
            link.connect(str(path))
        except OSError:
            return False
    return True
