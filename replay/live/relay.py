"""The relay: reads a recorder's live feed and draws it in Rerun, in a process of its own.

A frozen viewer makes Rerun block for ever once some hundred megabytes are queued. That happens
here, in a thread of its own, and never in the recorder: the inbox continues to read and drops the
messages that are not drawn. If the whole relay is stopped the socket fills, and the recorder drops
the messages that the socket doesn't accept.
"""

from __future__ import annotations

import os
import socket
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from undulog.capture.common.clock import REAL, Clock
from undulog.capture.common.errors import DataError, NoAnswerError, UsageError
from undulog.capture.common.files import part_file
from undulog.capture.common.process import StopRequest, interruptible
from undulog.capture.common.waits import LIMIT_S
from undulog.capture.recorder.control_client import Identity, release
from undulog.capture.recorder.live_wire import (
    HEAD_SIZE,
    MAX_DATAGRAM,
    DatagramHead,
    DatagramKind,
    LiveMessage,
    read_head,
    read_records,
)

from ..recording import open_recording, recording_id, require_whole, send_properties
from ..stream import BoundedStream, RrdFile, keep_for_ever
from ..viewer import Viewer
from .decode import LiveLog
from .scene import LiveScene

_INBOX_LOOK_S = 0.005

BATCH_S = 0.025
"""How often what has come is drawn [s]."""
SILENCE_S = 10.0
"""A feed that is silent for so long has ended; a live one repeats its definitions [s]."""

_REST_S = 0.01  # between two drawings, for the thread that reads
_LAGS_KEPT = 100_000
_FLUSH_S = 1.0
_GRACE_S = 3.0
_LOOK_S = 0.05


Connect = Callable[[BoundedStream], None]
"""Gives a recording stream its sink."""


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
                self._ending.wait(_INBOX_LOOK_S)  # to wake who waits costs the one who sends
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
            if oldest.head.kind is DatagramKind.MESSAGES:
                self.dropped += oldest.head.messages
            else:
                kept[_said(oldest)] = oldest
        self._queue.extendleft(reversed(kept.values()))
        self._bytes += sum(len(datagram.data) for datagram in kept.values())


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
        status = draft.stat()
        draft.replace(path)
    except OSError as error:
        link.close()
        draft.unlink(missing_ok=True)
        raise UsageError(f"{path}: the socket can't be made: {error.strerror or error}") from error
    return link, (status.st_dev, status.st_ino)


def _answers(path: Path) -> bool:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as link:
        try:
            link.connect(str(path))
        except OSError:
            return False
    return True


@dataclass
class RelayReport:
    """Counts and lag of a live feed.

    Attributes:
        sessions: Session ids, in the order they came.
        dropped: Messages that the recorder or the relay dropped because drawing took too long.
        unread: Messages and datagrams that could not be read.
        lag_s: From the recorder's taking a message to Rerun's taking what was drawn of it [s]:
            median, 99th percentile and largest of the last messages; None where there was none.
        complaint: Why the viewer did not take all of it; empty where it did.
    """

    sessions: tuple[str, ...]
    shown: int
    dropped: int
    unread: int
    lag_s: tuple[float, float, float] | None
    complaint: str = ""


class LiveStream(BoundedStream):
    """A recording stream that logs static data only when they change."""

    def __init__(self, application_id: str, **options: Any) -> None:
        """Make a stream that isn't connected yet."""
        super().__init__(application_id, **options)
        self._sent: dict[tuple[str, str], Any] = {}  # Arrow arrays

    def log(
        self,
        entity_path: str | list[object],
        entity: Any,
        *extra: Any,
        static: bool = False,
        strict: bool | None = None,
    ) -> None:
        """Log, unless it is static and known already.

        Args:
            static: Whether it has no time.
            strict: Whether to raise on data that can't be logged.
        """
        if static and not self._is_news(str(entity_path), [entity, *extra]):
            return
        super().log(entity_path, entity, *extra, static=static, strict=strict)

    def _is_news(self, entity_path: str, archetypes: Sequence[Any]) -> bool:
        batches = [batch for archetype in archetypes for batch in archetype.as_component_batches()]
        values = {
            (entity_path, str(batch.component_descriptor())): batch.as_arrow_array()
            for batch in batches
        }
        sent = self._sent
        news = [key for key in values if key not in sent or not sent[key].equals(values[key])]
        sent.update(values)
        return bool(news)


class Relay:
    """Draws the messages of an inbox; one thread calls it."""

    def __init__(
        self,
        inbox: Inbox,
        connect: Connect,
        *,
        one_session: bool = False,
        clock: Clock = REAL,
    ) -> None:
        """Draw nothing yet.

        Args:
            inbox: Where the feed comes in.
            connect: Gives each session's recording stream its sink.
            one_session: Whether to draw the first session only, into a file.
            clock: Of silences and lags.
        """
        self._inbox, self._connect, self._one_session = inbox, connect, one_session
        self._clock = clock
        self.ended = False
        """Whether the last session has ended."""
        self._sessions: list[str] = []
        self._feed_id: int | None = None
        self._log = LiveLog()
        self._scene: LiveScene | None = None
        self._rec: LiveStream | None = None
        self._heard_ns = clock.monotonic_ns()
        self._complaint = ""
        self._shown = self._refused = 0
        self._unread_before = self._dropped_before = self._dropped = 0
        self._lags: deque[float] = deque(maxlen=_LAGS_KEPT)
        self._states: list[LiveMessage] = []

    @property
    def report(self) -> RelayReport:
        """Counts and lag of the feed so far."""
        lag_s = None
        if lags := tuple(self._lags):
            p50, p99 = np.percentile(lags, [50.0, 99.0]).tolist()
            lag_s = (p50, p99, max(lags))
        return RelayReport(
            sessions=tuple(self._sessions),
            shown=self._shown,
            dropped=self._not_shown + self._dropped_before,
            unread=self._refused + self._inbox.refused + self._log.unread + self._unread_before,
            lag_s=lag_s,
            complaint=self._complaint,
        )

    @property
    def _not_shown(self) -> int:
        return self._dropped + self._inbox.dropped

    def step(self) -> None:
        """Draw the messages received since the last step; blocks while Rerun blocks.

        Raises:
            LogWriteError: If the sink can't be made.
        """
        pending: list[LiveMessage] = []
        for datagram in self._inbox.take():
            self._heard_ns = self._clock.monotonic_ns()
            if datagram.head.feed_id != self._feed_id:
                self._draw(pending)
                if not self._begin(datagram.head.feed_id):
                    return
            self._take(datagram, pending)
            if datagram.head.kind is DatagramKind.END:
                self._draw(pending)
                self._end()
        self._draw(pending)
        silent_s = (self._clock.monotonic_ns() - self._heard_ns) * 1e-9
        if not self.ended and self._sessions and silent_s > SILENCE_S:
            self._end()

    def close(self) -> None:
        """Flush the remaining data; a viewer gets a second to take them."""
        self._end()
        if self._rec is None:
            return
        try:
            self._rec.flush(timeout_sec=None if self._one_session else _FLUSH_S)
        except (RuntimeError, NoAnswerError) as error:
            self._complaint = f"the viewer did not take the last of it: {error}"
            keep_for_ever(self._rec)
            return
        self._rec.disconnect()
        self._rec = None

    def _begin(self, feed_id: int) -> bool:
        """Switch to a new feed; return False if only the first is drawn."""
        if self._one_session and self._scene is not None:
            self._end()
            return False
        self._unread_before += self._log.unread
        self._dropped_before += self._dropped
        self._dropped = 0
        self._feed_id, self._log, self._scene, self.ended = feed_id, LiveLog(), None, False
        self._states.clear()
        return True

    def _take(self, datagram: Datagram, pending: list[LiveMessage]) -> None:
        """Read a datagram: definitions at once, messages to be drawn."""
        self._dropped = max(self._dropped, datagram.head.dropped)
        if datagram.head.kind is DatagramKind.MESSAGES:
            self.ended = False  # it was only silent
        try:
            for record in read_records(datagram.data):
                if not isinstance(record, LiveMessage):
                    self._log.define(record)
                elif datagram.head.kind is DatagramKind.DEFINITIONS:
                    self._states.append(record)
                else:
                    pending.append(record)
        except DataError:
            self._refused += 1

    def _draw(self, messages: list[LiveMessage]) -> None:
        """Draw messages, and take them off the list."""
        if not messages:
            return
        batch = self._log.decode(messages)
        if self._scene is None:
            self._scene = self._open(min(message.log_time_ns for message in messages))
        if self._states:  # latched states, repeated for late relays
            self._scene.draw(self._log.decode(self._states), self._not_shown)
            self._states.clear()
        self._scene.draw(batch, self._not_shown)
        self._shown += batch.messages
        now_ns = self._clock.monotonic_ns()
        self._lags.extend((now_ns - message.offered_ns) * 1e-9 for message in messages)
        messages.clear()

    def _open(self, first_ns: int) -> LiveScene:
        """Open a recording stream for the session."""
        facts = self._log.facts
        session_id = facts.get("session_id") or f"feed-{self._feed_id or 0:016x}"
        epoch = facts.get("epoch_ns", "")
        epoch_ns = int(epoch) if epoch.isdecimal() else first_ns
        if self._rec is not None:
            self._rec.disconnect()
        # Not the id of the replay, which has more in it; a relay that is started anew goes on here.
        rec = open_recording(recording_id(f"{session_id}/live"), LiveStream)
        self._connect(rec)
        send_properties(rec, f"{session_id} live", epoch_ns)
        self._rec = rec
        self._sessions.append(session_id)
        return LiveScene(rec, self._log, session_id, epoch_ns, self._clock.monotonic_ns)

    def _end(self) -> None:
        if self._scene is not None and not self.ended:
            self._scene.finish(self._not_shown)
        self.ended = True


def relay_to_viewer(path: Path, viewer: Viewer | None, address: str) -> RelayReport:
    """Draw sessions in a viewer until it is closed or a stop is requested.

    Args:
        viewer: The viewer, if it is a process of ours.
        address: Where it takes data, e.g. ``rerun+http://127.0.0.1:9876/proxy``.

    Returns:
        What became of the feed.

    Raises:
        UsageError: If the socket can't be made.
        UndulogError: If a sink can't be made.
    """
    with interruptible() as request, Inbox(path) as inbox:
        relay = Relay(inbox, lambda rec: rec.connect_grpc(address))
        return _run(relay, request, viewer)


def relay_to_file(path: Path, output: Path) -> RelayReport:
    """Draw one session to a file, which appears when the session ends or a stop is requested.

    Args:
        output: The .rrd file; one of that name is replaced.

    Returns:
        What became of the feed.

    Raises:
        UsageError: If the socket can't be made.
        DataError: If no session came.
        LogWriteError: If the file can't be written.
    """
    with (
        interruptible() as request,
        part_file(output) as draft,
        Inbox(path) as inbox,
        RrdFile(draft, output) as file,
    ):
        relay = Relay(inbox, file.connect, one_session=True)
        report = _run(relay, request, None, until_end=True, look=file.check)
        if not report.sessions:
            raise DataError(f"{path}: no recording was received; nothing is written")
        file.finish()
        require_whole(draft, output)
        return report


class _Painter(threading.Thread):
    """The thread that may have to wait for a viewer."""

    def __init__(self, relay: Relay) -> None:
        super().__init__(name="live painter", daemon=True)
        self.relay = relay
        self.stop = threading.Event()
        self.error: Exception | None = None

    def run(self) -> None:
        try:
            due_s = time.monotonic()
            while not self.stop.wait(max(due_s - time.monotonic(), _REST_S)):
                due_s = time.monotonic() + BATCH_S
                self.relay.step()
            self.relay.step()
            self.relay.close()
        except Exception as error:  # noqa: BLE001  raised again by the main thread
            self.error = error


def _run(
    relay: Relay,
    request: StopRequest,
    viewer: Viewer | None,
    *,
    until_end: bool = False,
    look: Callable[[], None] = lambda: None,
) -> RelayReport:
    """Draw until a stop is requested, or the viewer or (``until_end``) the session has ended."""
    painter = _Painter(relay)
    painter.start()
    try:
        while painter.is_alive() and not request.requested:
            if (viewer is not None and viewer.ended) or (until_end and relay.ended):
                break
            look()
            time.sleep(_LOOK_S)
    finally:
        painter.stop.set()
    painter.join(LIMIT_S if until_end else _GRACE_S)
    if painter.is_alive() and viewer is not None:
        viewer.close()  # it takes nothing: what waits for it is let go
        painter.join(_GRACE_S)
    if painter.error is not None:
        raise painter.error
    if painter.is_alive():
        return replace(relay.report, complaint="the viewer takes no data")
    return relay.report
