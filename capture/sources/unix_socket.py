"""Frames from other processes: sources with the scheme ``unix``, and the sender for them.

The recorder listens at a path; processes of the same user connect and send packets as
:mod:`.capture.sources.contract` describes them, of up to 256 frames. The kernel stamps the arrival
of each packet.

>>> sender = FrameSender("/run/user/1000/snake.sock")
>>> sender.send(frames)          # an array of FRAME_DTYPE; never waits
128

A process in another language does the same with 20 lines: connect an ``AF_UNIX`` socket of type
``SOCK_SEQPACKET`` and send packets as :mod:`.capture.sources.contract` describes them.
"""

from __future__ import annotations

import contextlib
import errno
import os
import socket
import stat
import threading
import time
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..common.errors import DataError, SourceError, UsageError
from ..common.files import Closing, listen_at
from ..common.process import share_priority
from ..log.messages.frames import FRAME_DTYPE, FrameArray, frames_from_bytes
from ..robot.model import ClockDomain, Robot
from .contract import (
    HEAD,
    LONGEST,
    MOST_RECORDS,
    RECORD_SIZE,
    Polled,
    Source,
    SourceAddress,
    SourceContext,
    SourceCounts,
    flag,
    only,
)
from .events import BusWatch, Tally
from .reader_thread import SO_SNDBUFFORCE, ArrivalClock, PacketBatch, ReceiveThread, enlarge_buffer

_MOST_PACKETS = 8192  # in one poll, of one sender
_BACKLOG = 64
MOST_SENDERS = 64
"""Most connections. A further one replaces the sender that was silent for longest."""
_PAUSE_S = 0.1
_ORDER_S = 0.002  # in one poll,
_MOST_WAIT_S = 0.02  # and over several: a thread that gets no processor
_LATEST_NS = 1_000_000_000  # a packet is taken from the kernel within this time
_SHAPES = {
    head + count * RECORD_SIZE: (count, head)
    for head in (0, HEAD.size)
    for count in range(MOST_RECORDS + 1)
    if head or count
}
"""Size of a packet to its number of records and the size of its head."""

_BUFFER_BYTES = 4 << 20


@dataclass
class _Sender:
    """One connection."""

    receiver: ReceiveThread
    floor_ns: int
    last_ns: int
    empty: int = 0  # packets since the last one with bytes: beyond its end, all reads are empty
    expected: int | None = None
    dropped: int = 0
    active: bool = False
    leaves: bool = False


class UnixSource:
    """The :class:`.capture.sources.contract.Source` that other processes send to."""

    robot: Robot | None = None

    def __init__(
        self, address: SourceAddress, clock: ClockDomain, *, directions: bool = False
    ) -> None:
        """Describe the source; nothing is opened.

        Args:
            address: Its rest is the path.
            clock: Clock of the senders' ``t_device_ns``.
            directions: Whether the senders distinguish sent from received frames.
        """
        self.name = address.name
        self.clock = clock
        self.facts: Mapping[str, str] = {"interface": "unix", "path": str(Path(address.rest))}
        self.directions = directions
        self._address = address
        self._path = Path(address.rest)
        self._tally = Tally(lambda: 0)
        self._watch = BusWatch()
        self._arrivals = ArrivalClock(self._tally.now_ns)
        self._listener: socket.socket | None = None
        self._acceptor: threading.Thread | None = None
        self._inode: tuple[int, int] | None = None
        self._new: deque[_Sender] = deque()
        self._senders: list[_Sender] = []
        self._had_sender = False
        self._lost_sender = False
        self._waits_since = 0.0
        self._ending = self._finished = False

    @property
    def counts(self) -> SourceCounts:
        """Counts of its frames so far."""
        return self._tally.counts

    @property
    def connected(self) -> bool:
        """Whether a sender is connected."""
        return bool(self._senders)

    @property
    def lost(self) -> bool:
        """Whether the connection of a sender broke, and none has connected since."""
        return self._lost_sender

    @property
    def finished(self) -> bool:
        """Whether it was stopped, or has ended and returned all frames."""
        return self._finished or (self._ending and not self._senders and not self._new)

    def start(self, context: SourceContext) -> None:
        """Listen.

        Raises:
            SourceError: If another file is at the path, another program listens there, or the
                socket can't be made.
        """
        self._tally = Tally(context.now_ns)
        self._arrivals = ArrivalClock(context.now_ns)
        _clear(self._address.text, self._path)
        listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        try:
            listen_at(listener, self._path, _BACKLOG)
            made = self._path.lstat()
        except OSError as error:
            listener.close()
            reason = error.strerror or str(error)
            raise SourceError(self._address.text, f"can't listen at {self._path}: {reason}") from (
                error
            )
        self._listener = listener
        self._inode = (made.st_dev, made.st_ino)
        self._acceptor = threading.Thread(
            target=self._accept, args=(listener,), name="undulog-accept", daemon=True
        )
        self._acceptor.start()
        self._tally.events.log_event("info", f"listens at {self._path}")

    def poll(self) -> Polled:
        """Return the frames of all senders in the order of their arrival, and events."""
        if self._finished:
            return Polled((), self._tally.events.flush())
        while self._new:
            self._add(self._new.popleft())
        arrays: list[FrameArray] = []
        with_frames = 0
        if self._out_of_step():
            return Polled((), self._tally.events.take())
        for sender in tuple(self._senders):
            before = len(arrays)
            self._drain(sender, arrays)
            with_frames += len(arrays) > before
        if not arrays:
            return Polled((), self._tally.events.take())
        frames = arrays[0] if len(arrays) == 1 else np.concatenate(arrays)
        if with_frames > 1:
            frames = frames[np.argsort(frames["t_host_ns"], kind="stable")]
        self._tally.counts.frames += len(frames)
        self._watch.look(frames, self._tally)
        return Polled((frames,), self._tally.events.take())

    def end(self) -> None:
        """See :meth:`.capture.sources.contract.EndingSource.end`."""
        if self._ending or self._listener is None or self._acceptor is None:
            return
        self._listener.shutdown(socket.SHUT_RD)  # waiting senders are still accepted
        self._acceptor.join()
        for sender in (*self._new, *self._senders):
            sender.receiver.end()
        self._ending = True

    def stop(self) -> None:
        """Disconnect all senders and remove the socket."""
        self.end()
        self._finished = True
        for sender in (*self._new, *self._senders):
            sender.receiver.close()
        self._new.clear()
        self._senders.clear()
        if self._listener is not None:
            self._listener.close()
            self._listener = None
            with contextlib.suppress(OSError):
                there = self._path.lstat()
                if (there.st_dev, there.st_ino) == self._inode:  # not another recorder's
                    self._path.unlink()

    def _accept(self, listener: socket.socket) -> None:
        """Accept senders and begin to receive at once: their buffers hold only milliseconds."""
        share_priority()
        while True:
            try:
                sock, _ = listener.accept()
            except OSError as error:
                if error.errno == errno.EINVAL:  # shut down
                    return
                if error.errno != errno.ECONNABORTED:
                    reason = error.strerror or str(error)
                    self._tally.events.log_event("error", f"can't accept a sender: {reason}")
                    time.sleep(_PAUSE_S)
                continue
            now_ns = self._tally.now_ns()
            self._new.append(_Sender(ReceiveThread(sock, LONGEST + 1), now_ns, now_ns))

    def _add(self, sender: _Sender) -> None:
        back = self._had_sender and not self._senders
        self._had_sender = True
        self._lost_sender = False
        self._tally.counts.reconnects += back
        self._tally.events.log_event("info", "a sender is back" if back else "a sender connected")
        self._senders.append(sender)
        stay = [sender for sender in self._senders if not sender.leaves]
        if len(stay) > MOST_SENDERS:
            longest = min(stay, key=lambda sender: (sender.active, sender.last_ns))
            text = f"more than {MOST_SENDERS} senders: the one silent for longest is disconnected"
            self._tally.events.log_event("warn", text)
            longest.leaves = True
            longest.receiver.end()  # its earlier packets are still taken

    def _out_of_step(self) -> bool:
        """Whether to wait for a sender's thread, so that the frames of all stay in order."""
        if len(self._senders) < 2:
            return False
        now = time.monotonic()
        deadline = now + _ORDER_S
        while any(sender.receiver.pending for sender in self._senders):
            if time.monotonic() >= deadline:
                self._waits_since = self._waits_since or now
                return now - self._waits_since < _MOST_WAIT_S
            time.sleep(_ORDER_S / 10)
        self._waits_since = 0.0
        return False

    def _drain(self, sender: _Sender, arrays: list[FrameArray]) -> None:
        """Take a sender's packets; remove it if it has disconnected."""
        looked_ns = self._tally.now_ns()
        pending = sender.receiver.pending  # before: what isn't taken then comes later
        batches = sender.receiver.take(_MOST_PACKETS)
        ended = sender.receiver.ended
        for batch in batches:
            times = self._arrivals.times(batch.stamps_ns, sender.floor_ns)
            sender.floor_ns = times[-1]
            frames = self._unpack(sender, batch, times)
            if len(frames):
                arrays.append(frames)
                sender.active, sender.last_ns = True, times[-1]
        if not batches and not pending:  # after a stop of this process, packets may wait for long
            sender.floor_ns = max(sender.floor_ns, looked_ns - _LATEST_NS)
        if ended:
            self._remove(sender)

    def _unpack(self, sender: _Sender, batch: PacketBatch, times: list[int]) -> FrameArray:
        flat = batch.packets.reshape(-1).data
        width = batch.packets.shape[1]
        pieces: list[memoryview] = []
        arrivals: list[int] = []
        counts: list[int] = []
        malformed = 0
        for row, (size, time_ns) in enumerate(zip(batch.sizes, times, strict=True)):
            shape = _SHAPES.get(size)  # one that is too long is cut to a size that isn't there
            if not size:
                sender.empty += 1
                continue
            malformed += sender.empty + (shape is None)
            sender.empty = 0
            if shape is None:
                continue
            count, head = shape
            start = row * width
            if head:
                self._count_lost(sender, flat[start : start + head], count)
            pieces.append(flat[start + head : start + size])
            arrivals.append(time_ns)
            counts.append(count)
        self._tally.malformed("malformed packet", malformed)
        frames = frames_from_bytes(memoryview(bytearray().join(pieces)))
        frames["t_host_ns"] = np.repeat(np.array(arrivals, dtype=np.uint64), counts)
        return frames

    def _count_lost(self, sender: _Sender, head: memoryview, count: int) -> None:
        """Count the frames that a head proves lost."""
        sequence, dropped = HEAD.unpack(head)
        if sender.expected is None:
            # Its counters may be older than the connection: only what it dropped since counts.
            lost = dropped if dropped == sequence else 0
        else:
            lost = max(0, sequence - sender.expected, dropped - sender.dropped)
        sender.expected, sender.dropped = sequence + count, dropped
        self._tally.lost("frame lost before it reached us", lost)

    def _remove(self, sender: _Sender) -> None:
        self._senders.remove(sender)
        sender.receiver.close()
        error = sender.receiver.error
        if error is None or isinstance(error, ConnectionError):  # it ended, or was killed
            self._tally.events.log_event("warn", "a sender disconnected")
            return
        self._lost_sender = True
        reason = error.strerror or str(error)
        self._tally.events.log_event("error", f"lost the connection of a sender: {reason}")


def open_unix(address: SourceAddress) -> Source:
    """Make the source of an address such as ``unix:/run/user/1000/snake.sock?clock=host``.

    Raises:
        UsageError: If an option is unknown or has no valid value.
    """
    only(address, ("clock", "directions"))
    value = address.options.get("clock", ClockDomain.DEVICE.value)
    valid = [ClockDomain.DEVICE.value, ClockDomain.HOST.value, ClockDomain.SIMULATED.value]
    if value not in valid:
        raise UsageError(f"{address.text!r}: clock {value!r} is not one of {', '.join(valid)}")
    directions = flag(address, "directions", default=False)
    return UnixSource(address, ClockDomain(value), directions=directions)


def _clear(text: str, path: Path) -> None:
    """Remove the socket of a killed recorder; refuse any other file."""
    try:
        there = path.lstat()
    except FileNotFoundError:
        return
    except OSError as error:
        raise SourceError(text, f"{path}: {error.strerror}") from error
    if not stat.S_ISSOCK(there.st_mode):
        raise SourceError(text, f"{path} is there already and is no socket")
    if there.st_uid != os.geteuid():
        raise SourceError(text, f"{path} belongs to another user")
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET | socket.SOCK_NONBLOCK) as probe:
        try:
            probe.connect(str(path))
        except ConnectionRefusedError:
            path.unlink(missing_ok=True)  # nobody listens: left behind
            return
        except OSError as error:
            if error.errno not in (errno.EAGAIN, errno.EPROTOTYPE):
                raise SourceError(text, f"{path}: {error.strerror}") from error
    raise SourceError(text, f"another program listens at {path}")


class FrameSender(Closing):
    """Sends frames to a recorder that may start later, be slow, and restart.

    Frames that are not accepted are not kept; their count is reported to the recorder.
    """

    def __init__(self, path: str | Path) -> None:
        """Set the path of the recorder; the first :meth:`send` connects."""
        self.path = Path(path)
        self.accepted = 0
        """Frames accepted, over all connections."""
        self.refused = 0
        """Frames not accepted: no recorder, or its buffer is full."""
        self._socket: socket.socket | None = None
        self._sequence = self._dropped = 0
        self._retry_at = 0.0

    @property
    def connected(self) -> bool:
        """Whether the last attempt to connect succeeded."""
        return self._socket is not None

    def send(self, frames: FrameArray) -> int:
        """Send frames, without waiting.

        Args:
            frames: Records of :data:`.FRAME_DTYPE`, shape (n,). ``t_device_ns``
                is the sampling time on the sender's own clock; ``t_host_ns`` is set on receipt.

        Returns:
            Number of accepted frames, from the first one on. The others are lost, and counted.

        Raises:
            DataError: If the array is of another type.
            OSError: If the socket can't be used at all, e.g. for want of permission.
        """
        if frames.dtype != FRAME_DTYPE or frames.ndim != 1:
            raise DataError(f"frames are records of 32 bytes, shape (n,); found {frames.dtype}")
        sock = self._connect()
        done = 0
        if sock is not None:
            payload = np.ascontiguousarray(frames)
            while done < len(frames):
                records = payload[done : done + MOST_RECORDS]
                if not self._put(sock, records.tobytes()):
                    break
                done += len(records)
                self._sequence += len(records)
            if self._socket is not None:
                self._sequence += len(frames) - done
                self._dropped += len(frames) - done
        self.accepted += done
        self.refused += len(frames) - done
        return done

    def close(self) -> None:
        """Report the last dropped frames, if possible, and disconnect; safe to call twice."""
        if self._socket is not None and self._dropped:
            self._put(self._socket, b"")
        self._disconnect()

    def _put(self, sock: socket.socket, records: bytes) -> bool:
        """Send one packet; return False if there is no room or no recorder."""
        try:
            sock.send(HEAD.pack(self._sequence, self._dropped) + records)
        except BlockingIOError:
            return False
        except (BrokenPipeError, ConnectionError):
            self._disconnect()
            return False
        return True

    def _connect(self) -> socket.socket | None:
        if self._socket is not None or time.monotonic() < self._retry_at:
            return self._socket
        sock = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET | socket.SOCK_NONBLOCK)
        try:
            enlarge_buffer(sock, SO_SNDBUFFORCE, socket.SO_SNDBUF, _BUFFER_BYTES)
            sock.connect(str(self.path))
        except (FileNotFoundError, ConnectionRefusedError, BlockingIOError):
            sock.close()
            self._retry_at = time.monotonic() + _PAUSE_S
            return None
        except OSError:
            sock.close()
            raise
        self._socket, self._sequence, self._dropped = sock, 0, 0
        return sock

    def _disconnect(self) -> None:
        if self._socket is not None:
            with contextlib.suppress(OSError):
                self._socket.close()
            self._socket = None
            self._retry_at = time.monotonic() + _PAUSE_S
