"""The live feed: sends messages to a relay process without ever delaying the recording.

A send to a viewer that is frozen would block the recorder. So the feed sends datagrams
(:mod:`.capture.recorder.live_wire`) to a Unix socket that a relay process reads. While the socket
is full, messages wait in a bounded queue that drops the oldest. Without a relay nothing is sent.
"""

from __future__ import annotations

import errno
import importlib.util
import os
import signal
import socket
import stat
import subprocess
import sys
import tempfile
import time
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from mcap.records import Channel

from ..common.errors import MissingExtraError, UndulogError
from ..common.waits import end_process
from ..log.mcap.batch import MessageBatch, MessageFields
from ..log.write.mcap_sink import Description
from .live_wire import (
    HEAD_SIZE,
    MAX_DATAGRAM,
    MAX_MESSAGE,
    RECORD_SIZE,
    DatagramHead,
    DatagramKind,
    LiveDefinitions,
    Queued,
    pack_datagram,
    pack_message,
)

_GRACE_S = 3.0

RENEW_NS = 2_000_000_000
"""Interval of sending all definitions again, and of looking up the path again [ns]."""
RETRY_NS = 500_000_000
"""Interval of looking for a relay [ns]."""

_BUDGET_NS = 300_000
_FILL_NS = 20_000_000
_FILL = 16 << 10
_DATAGRAM = 32 << 10
_END_TRIES = 20
_END_PAUSE_S = 0.005
_NEVER_NS = 1 << 63


class RelayProcess:
    """A running relay, with its viewer if it has one."""

    def __init__(self, process: subprocess.Popen[bytes], complaints: Path) -> None:
        """Take over a relay that leads a session of its own.

        Args:
            complaints: File of its standard error.
        """
        self._process = process
        self._complaints = complaints

    @property
    def pid(self) -> int:
        """Process id, and that of its process group."""
        return self._process.pid

    def poll(self) -> int | None:
        """Return its exit code, or None while it runs, without waiting."""
        return self._process.poll()

    def complaint(self) -> str:
        """Return the last line of its standard error; may be empty."""
        try:
            lines = self._complaints.read_text(errors="replace").splitlines()
        except FileNotFoundError:
            return ""
        return next((line.strip() for line in reversed(lines) if line.strip()), "")

    def close(self, *, leave_window: bool = False) -> None:
        """End it and its child processes, within seconds; safe to call twice.

        Args:
            leave_window: Leave it running until the viewer's window is closed.
        """
        if not leave_window:
            self._end()
        self._complaints.unlink(missing_ok=True)

    def _end(self) -> None:
        end_process(self._process, "the live view", grace_s=_GRACE_S)
        with suppress(ProcessLookupError):  # a viewer that a killed relay has left
            os.killpg(self._process.pid, signal.SIGKILL)


def spawn_relay(path: Path, arguments: Sequence[str] = ()) -> RelayProcess:
    """Start ``undulog view --live PATH`` in a session of its own.

    An interrupt in the recorder's terminal doesn't reach it.

    Args:
        path: The socket that the relay will make.
        arguments: Further options of the command, e.g. ``--web``.

    Raises:
        MissingExtraError: If Rerun is not installed.
        UndulogError: If the process can't be started.
    """
    if importlib.util.find_spec("rerun") is None:
        raise MissingExtraError("the live view", "replay", "rerun")
    handle, name = tempfile.mkstemp(prefix="undulog-live-", suffix=".txt")
    try:
        process = subprocess.Popen(  # noqa: S603  our own arguments
            [sys.executable, "-m", "undulog", "view", "--live", str(path), *arguments],
            stdin=subprocess.DEVNULL,
            stdout=handle,
            stderr=handle,
            start_new_session=True,
        )
    except OSError as error:
        Path(name).unlink()
        raise UndulogError(f"the live view can't be started: {error}") from error
    finally:
        os.close(handle)
    return RelayProcess(process, Path(name))


@dataclass
class LiveCounts:
    """Counts of messages.

    Attributes:
        dropped: Dropped because the relay was too slow, or ended while they waited.
        thinned: Left out because of the highest rate of their channel.
        too_big: Left out because they don't fit into a datagram, definitions included.
        connections: Number of relays found.
    """

    sent: int = 0
    dropped: int = 0
    thinned: int = 0
    too_big: int = 0
    connections: int = 0


class _Packed(NamedTuple):
    """A datagram that is not sent yet, and its number of messages."""

    data: bytes
    messages: int


class LiveFeed:
    """The recorder's end of the feed; one thread calls it, and no call waits."""

    def __init__(
        self,
        path: Path | str,
        *,
        max_messages: int = 4096,
        max_bytes: int = 2 << 20,
        max_rate_hz: float = 200.0,
        clock: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        """Set up a feed to a relay that may come and go at any time.

        Args:
            path: The relay's socket.
            max_messages: Most messages that wait, beside those of one datagram.
            max_bytes: Most bytes that wait, beside one datagram.
            max_rate_hz: Highest rate of a channel of samples; events are never left out.
            clock: Returns the time [ns, monotonic].
        """
        self._clock = clock
        self.path = Path(path)
        self.counts = LiveCounts()
        self._max_messages, self._max_bytes = max_messages, max_bytes
        self._definitions = LiveDefinitions(round(1e9 / max_rate_hz))
        self._feed_id = int.from_bytes(os.urandom(8), "little")
        self._socket: socket.socket | None = None
        self._periods = self._definitions.periods
        self._due: dict[int, int] = {}  # empty without a relay
        self._states = self._definitions.states
        self._queue: deque[Queued] = deque()
        self._queued_bytes = 0
        self._unsent_definitions: deque[_Packed] = deque()
        self._waiting: _Packed | None = None
        self._full = False
        self._now_ns = clock()
        self._renew_at_ns = 0
        self._send_at_ns = 0

    @property
    def connected(self) -> bool:
        """Whether a relay was found."""
        return self._socket is not None

    @property
    def queued(self) -> int:
        """Number of messages that wait."""
        return len(self._queue) + (self._waiting.messages if self._waiting is not None else 0)

    def define(self, record: Description) -> None:
        """Keep a definition for every relay that comes; schemas before their channels.

        Of metadata only ``undulog`` is sent, of attachments only the robot's description and its
        bus databases.
        """
        packed = self._definitions.pack(record)
        if packed is None:
            return
        if len(packed) > MAX_DATAGRAM - HEAD_SIZE:
            self.counts.too_big += 1
            return
        self._definitions.keep(record, packed)
        if self._socket is not None:
            if isinstance(record, Channel) and record.id in self._definitions.periods:
                self._due[record.id] = 0
            self._unsent_definitions.append(self._pack(DatagramKind.DEFINITIONS, [packed]))

    def offer(self, *message: *MessageFields) -> None:
        """Queue a message if a relay was found; see :meth:`MessageSink.write`."""
        channel_id, log_time_ns, publish_time_ns, sequence, payload = message
        due = self._due.get(channel_id)
        is_state = channel_id in self._states
        if due is None and not is_state:
            return
        queued = (channel_id, sequence, log_time_ns, publish_time_ns, self._now_ns, payload)
        if is_state:
            self._states[channel_id] = queued
        if due is None:
            return
        if log_time_ns < due:
            self.counts.thinned += 1
            return
        size = len(payload)
        if size > MAX_MESSAGE:
            self.counts.too_big += 1
            return
        period = self._periods[channel_id]
        if period:  # a late message doesn't delay the later ones
            self._due[channel_id] = max(due, log_time_ns - period) + period
        self._queue.append(queued)
        self._queued_bytes += size + RECORD_SIZE
        if self._queued_bytes > self._max_bytes or len(self._queue) > self._max_messages:
            self._drop_oldest()

    def offer_batch(self, batch: MessageBatch) -> None:
        """Queue messages if a relay was found; see :meth:`MessageSink.write_batch`."""
        if batch.channel_id in self._due or batch.channel_id in self._states:
            for message in batch.messages:
                self.offer(*message)

    def pump(self) -> None:
        """Send waiting datagrams, for 0.3 ms at most; called once a tick."""
        now_ns = self._now_ns = self._clock()
        if now_ns >= self._renew_at_ns:
            self._renew(now_ns)
        if self._socket is None or not self._ripe(now_ns):
            return
        until_ns = now_ns + _BUDGET_NS
        self._send_at_ns = now_ns + _FILL_NS
        while self._send_one():
            if self._clock() >= until_ns:
                return

    def close(self) -> None:
        """Send the rest and the end, if the relay takes it within 0.1 s; safe to call twice."""
        for _ in range(_END_TRIES):
            while self._send_one():
                pass
            if not self.connected or (self._is_empty and self._taken(self._pack(DatagramKind.END))):
                break
            time.sleep(_END_PAUSE_S)
        self._lose(self._clock())
        self._renew_at_ns = _NEVER_NS

    def _pack(self, kind: DatagramKind, records: Sequence[bytes] = ()) -> _Packed:
        messages = len(records) if kind is DatagramKind.MESSAGES else 0
        head = DatagramHead(kind, messages, self._feed_id, self.counts.dropped)
        return _Packed(pack_datagram(head, records), messages)

    # -- the queue -------------------------------------------------------------------------

    @property
    def _is_empty(self) -> bool:
        """Whether nothing waits, apart from an end that is packed again."""
        messages_wait = self._waiting is not None and self._waiting.messages > 0
        return not (self._queue or self._unsent_definitions or messages_wait)

    def _drop_oldest(self) -> None:
        if self._waiting is not None and self._waiting.messages:
            self.counts.dropped += self._waiting.messages
            self._waiting = None
        while self._queued_bytes > self._max_bytes or len(self._queue) > self._max_messages:
            self._queued_bytes -= len(self._queue.popleft()[-1]) + RECORD_SIZE
            self.counts.dropped += 1

    def _ripe(self, now_ns: int) -> bool:
        """Whether to send: a datagram fills, and a full socket rests, for 20 ms."""
        if now_ns < self._send_at_ns:
            return not self._full and (
                bool(self._unsent_definitions) or self._queued_bytes >= _FILL
            )
        return bool(self._queue or self._unsent_definitions or self._waiting is not None)

    def _next(self) -> _Packed | None:
        """Return the next datagram: one that waits, then definitions, then the oldest messages."""
        if self._waiting is not None:
            return self._waiting
        if self._unsent_definitions:
            return self._unsent_definitions.popleft()
        if not self._queue:
            return None
        records: list[bytes] = []
        size = 0
        while self._queue:
            length = len(self._queue[0][-1]) + RECORD_SIZE
            if records and size + length > _DATAGRAM:
                break
            records.append(pack_message(self._queue.popleft()))
            size += length
        self._queued_bytes -= size
        return self._pack(DatagramKind.MESSAGES, records)

    # -- the socket ------------------------------------------------------------------------

    def _send_one(self) -> bool:
        """Send one datagram; return False if there is none, or the socket is full."""
        packed = self._next()
        return packed is not None and self._taken(packed)

    def _taken(self, packed: _Packed) -> bool:
        if self._socket is None:
            return False
        try:
            self._socket.send(packed.data)
        except OSError as error:
            if error.errno in {errno.EAGAIN, errno.ENOBUFS, errno.ENOMEM}:
                self._waiting, self._full = packed, True
                return False
            if error.errno == errno.EMSGSIZE:
                self._waiting = None
                self.counts.too_big += max(packed.messages, 1)
                return True
            self.counts.dropped += packed.messages  # the relay has ended
            self._waiting = None
            self._lose(self._now_ns)
            return False
        self._waiting, self._full = None, False
        self.counts.sent += packed.messages
        return True

    def _renew(self, now_ns: int) -> None:
        """Connect to the present relay, perhaps a new one, and queue all definitions for it."""
        fresh = self._socket is None
        if self._socket is None:
            self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK)
        try:
            _require_trusted(self.path)
            self._socket.connect(str(self.path))
        except OSError:  # no relay: looked for again later
            self._lose(now_ns)
            return
        self._renew_at_ns = now_ns + RENEW_NS
        if fresh:
            self.counts.connections += 1
            self._due = dict.fromkeys(self._periods, 0)
        if not self._unsent_definitions:
            self._unsent_definitions.extend(
                self._pack(DatagramKind.DEFINITIONS, group)
                for group in self._definitions.groups(_DATAGRAM)
            )

    def _lose(self, now_ns: int) -> None:
        """Disconnect, and drop the queue."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None
        self.counts.dropped += self.queued
        self._waiting, self._full = None, False
        self._queue.clear()
        self._queued_bytes = 0
        self._unsent_definitions.clear()
        self._due = {}
        self._renew_at_ns = now_ns + RETRY_NS


def _require_trusted(path: Path) -> None:
    """Check that a relay's socket is this user's or root's: a shared folder has others, too.

    Raises:
        OSError: If there is no such socket, or it is another user's.
    """
    facts = path.lstat()
    if not stat.S_ISSOCK(facts.st_mode) or facts.st_uid not in (os.geteuid(), 0):
        raise PermissionError(errno.EPERM, "no socket of this user", str(path))
