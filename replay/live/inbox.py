"""The relay's end of the live feed: a socket that is read at once, and a bounded queue.

A thread reads the socket, so that a slow picture doesn't fill it; when the queue is full the oldest
messages go. It looks a hundred times a second rather than waits: to wake a process that waits is
what makes a send dear, and the recorder would pay for it.
"""

from __future__ import annotations

import os
import socket
import threading
from collections import deque
from collections.abc import Iterable, Sequence
from contextlib import AbstractContextManager, suppress
from pathlib import Path
from typing import NamedTuple

import numpy as np

from undulog.capture.common.arrays import FloatArray, IntArray
from undulog.capture.common.errors import DataError, UsageError
from undulog.capture.recorder.live_wire import (
    HEAD_SIZE,
    MAX_DATAGRAM,
    DatagramHead,
    Kind,
    read_head,
)

from ..draw.scene.motion import HeadPath
from ..samples.sampling import ordered
from ..samples.tracks import Columns, Track
from .decode import Batch

KEPT_NS = 2_000_000_000
"""How much is kept [ns]."""
PATIENCE_NS = 250_000_000
"""How long a quantity that has gone silent holds up those computed from it [ns]."""


class Window:
    """Samples of the last seconds."""

    def __init__(self) -> None:
        """Start empty."""
        self.head: HeadPath | None = None
        self.ranges: dict[str, tuple[IntArray, FloatArray]] = {}
        self._tracks: dict[tuple[str, str], dict[str, Track]] = {}
        self._newest_ns = 0

    @property
    def columns(self) -> Columns:
        """All JointState columns."""
        return {key: tuple(tracks.values()) for key, tracks in self._tracks.items()}

    def tracks(self, topic: str, field: str = "position") -> tuple[Track, ...]:
        """One column.

        Args:
            topic: E.g. ``/joint_states``.
            field: ``position``, ``velocity`` or ``effort``.

        Returns:
            A track a joint; none where nothing has come.
        """
        return tuple(self._tracks.get((topic, field), {}).values())

    def add(self, batch: Batch) -> None:
        """Take new samples, and forget the oldest."""
        for key, tracks in batch.columns.items():
            own = self._tracks.setdefault(key, {})
            for track in tracks:
                old = own.get(track.name)
                kept = None if old is None else (old.t_ns, old.values)
                own[track.name] = Track(track.name, *_grown(kept, track.t_ns, track.values))
        for topic, (t_ns, values) in batch.ranges.items():
            self.ranges[topic] = _grown(self.ranges.get(topic), t_ns, values)
        if batch.head is not None:
            self.head = joined(self.head, batch.head)
        ends = [one.t_ns[-1] for tracks in batch.columns.values() for one in tracks]
        self._newest_ns = max([self._newest_ns, *map(int, ends)])

    def ready_ns(self, inputs: Iterable[Sequence[Track]], *others: IntArray) -> int:
        """Until when something can be computed that needs all of its inputs.

        Args:
            inputs: Tracks that it is computed from.
            others: Times of further inputs [ns].

        Returns:
            The earliest of the inputs' last times, but no more than the patience before the newest
            sample of all [ns].
        """
        ends = [int(track.t_ns[-1]) for tracks in inputs for track in tracks if track.t_ns.size]
        ends += [int(t_ns[-1]) for t_ns in others if t_ns.size]
        return max(min(ends, default=0), self._newest_ns - PATIENCE_NS)


class Fresh:
    """Remembers up to where something has been drawn."""

    def __init__(self) -> None:
        """Nothing has been drawn."""
        self._until_ns: dict[str, int] = {}

    def rows(self, name: str, t_ns: IntArray, upto_ns: int | None = None) -> slice:
        """Which samples are new; they count as drawn from now on.

        Args:
            t_ns: Their times [ns], ascending, shape (n,).
            upto_ns: The last time that can be drawn [ns]; None for all.
        """
        start = int(np.searchsorted(t_ns, self._until_ns.get(name, -1), side="right"))
        stop = t_ns.size
        if upto_ns is not None:
            stop = int(np.searchsorted(t_ns, upto_ns, side="right"))
        if stop > start:
            self._until_ns[name] = int(t_ns[stop - 1])
        return slice(start, max(start, stop))

    def tracks(
        self, name: str, tracks: Iterable[Track], upto_ns: int | None = None
    ) -> tuple[Track, ...]:
        """The new samples of tracks.

        Args:
            upto_ns: The last time that can be drawn [ns]; None for all.

        Returns:
            Those that have new samples, with these only.
        """
        found: list[Track] = []
        for track in tracks:
            rows = self.rows(f"{name}/{track.name}", track.t_ns, upto_ns)
            if rows.stop > rows.start:
                found.append(Track(track.name, track.t_ns[rows], track.values[rows]))
        return tuple(found)


def _grown(
    old: tuple[IntArray, FloatArray] | None, t_ns: IntArray, values: FloatArray
) -> tuple[IntArray, FloatArray]:
    """New samples after those of the last seconds before them."""
    if old is None:
        return t_ns, values
    if not t_ns.size:
        return old
    first = int(np.searchsorted(old[0], int(t_ns[0]) - KEPT_NS))
    return ordered(np.concatenate([old[0][first:], t_ns]), np.concatenate([old[1][first:], values]))


def joined(old: HeadPath | None, new: HeadPath) -> HeadPath:
    """A tracked head's path after that of the last seconds before it."""
    kept = None if old is None else (old.t_ns, old.pose)
    return HeadPath.of(*_grown(kept, new.t_ns, new.pose), tracked=True)


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
        self._socket.close()
        with suppress(FileNotFoundError):
            if self.path.stat().st_ino == self._file:
                self.path.unlink()

    def take(self) -> list[Datagram]:
        """What has come since the last time, in order."""
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
    """What tells definitions from their repetition: all but the counter in the head."""
    return bytes([datagram.head.kind]) + datagram.data[HEAD_SIZE:]


def _bind(path: Path) -> tuple[socket.socket, int]:
    """A socket of that name which only its owner may write to, and its inode."""
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
        inode = draft.stat().st_ino
        draft.replace(path)
    except OSError as error:
        link.close()
        draft.unlink(missing_ok=True)
        raise UsageError(f"{path}: the socket can't be made: {error.strerror or error}") from error
    return link, inode


def _answers(path: Path) -> bool:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as link:
        try:
            link.connect(str(path))
        except OSError:
            return False
    return True
