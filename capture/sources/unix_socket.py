"""Sources with the scheme ``unix``: frames from other processes of this computer.

The recorder listens at a path; whoever may write there connects and sends packets as
:mod:`capture.sources.packets` describes them. It is the fast way in: up to 256 frames a packet, and
the kernel stamps each packet's arrival.
"""

from __future__ import annotations

import contextlib
import errno
import os
import select
import socket
import stat
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..errors import SourceError, UsageError
from ..log.frames import FrameArray, frames_from_bytes
from ..robot import ClockDomain, Robot
from .bus_watch import BusWatch
from .contract import Polled, Source, SourceAddress, SourceContext, SourceCounts
from .events import Tally
from .options import flag, only
from .packets import HEAD, LONGEST, MOST_RECORDS, RECORD_SIZE
from .receive_many import SO_TIMESTAMPNS, ArrivalClock, Batch, ReceiveMany

_PACKETS = 128
_MOST_BATCHES = 64  # in one poll, of one sender: others want to be heard too
_BACKLOG = 64
_SHAPES = {
    head + count * RECORD_SIZE: (count, head)
    for head in (0, HEAD.size)
    for count in range(MOST_RECORDS + 1)
    if head or count
}
"""Size of a packet to its number of records and the size of its head."""
_GONE = select.EPOLLHUP | select.EPOLLRDHUP | select.EPOLLERR


@dataclass
class _Sender:
    """One connection."""

    sock: socket.socket
    floor_ns: int
    expected: int | None = None
    dropped: int = 0


class UnixSource:
    """The :class:`capture.sources.contract.Source` that other processes send to."""

    def __init__(
        self, address: SourceAddress, clock: ClockDomain, *, directions: bool = False
    ) -> None:
        """Describe the source; nothing is opened.

        Args:
            address: What was asked for; its rest is the path.
            clock: Whose clock the senders' ``t_device_ns`` is on.
            directions: Whether the senders tell sent frames from received ones.
        """
        self.directions = directions
        self._address = address
        self._path = Path(address.rest)
        self._clock = clock
        self._tally = Tally(lambda: 0)
        self._watch = BusWatch()
        self._receive = ReceiveMany(_PACKETS, LONGEST + 1)
        self._arrivals = ArrivalClock(self._tally.now_ns)
        self._listener: socket.socket | None = None
        self._epoll: select.epoll | None = None
        self._inode: tuple[int, int] | None = None
        self._senders: dict[int, _Sender] = {}
        self._had_sender = False
        self._finished = False

    @property
    def name(self) -> str:
        """What the session calls it."""
        return self._address.name

    @property
    def clock(self) -> ClockDomain:
        """Whose clock ``t_device_ns`` is on."""
        return self._clock

    @property
    def robot(self) -> Robot | None:
        """None: frames say nothing of the robot."""
        return None

    @property
    def facts(self) -> Mapping[str, str]:
        """Where it listens."""
        return {"interface": "unix", "path": str(self._path)}

    @property
    def counts(self) -> SourceCounts:
        """What became of its frames so far."""
        return self._tally.counts

    @property
    def connected(self) -> bool:
        """Whether a sender is connected."""
        return bool(self._senders)

    @property
    def finished(self) -> bool:
        """Whether it was stopped: a sender may come at any time."""
        return self._finished

    def start(self, context: SourceContext) -> None:
        """Listen.

        Args:
            context: The recording.

        Raises:
            SourceError: If something else is at the path, another program listens there, or it
                can't be made.
        """
        self._tally = Tally(context.now_ns)
        self._arrivals = ArrivalClock(context.now_ns)
        _clear(self._address.text, self._path)
        listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET | socket.SOCK_NONBLOCK)
        try:
            os.fchmod(listener.fileno(), 0o600)  # before it has a name: no moment without
            listener.bind(str(self._path))
            made = self._path.lstat()
            listener.listen(_BACKLOG)
        except OSError as error:
            listener.close()
            reason = error.strerror or str(error)
            raise SourceError(self._address.text, f"can't listen at {self._path}: {reason}") from (
                error
            )
        self._listener = listener
        self._inode = (made.st_dev, made.st_ino)
        self._epoll = select.epoll()
        self._epoll.register(listener.fileno(), select.EPOLLIN)
        self._tally.events.say("info", f"listens at {self._path}")

    def poll(self) -> Polled:
        """Take what has come.

        Returns:
            Frames, of all senders in the order of their arrival, and events.
        """
        if self._epoll is None or self._listener is None:
            return Polled((), self._tally.events.flush())
        found: list[FrameArray] = []
        heard = 0
        for fileno, mask in self._epoll.poll(0, _BACKLOG + 1):
            if fileno == self._listener.fileno():
                new = self._accept()
                senders = [(sender, False) for sender in new]
            else:
                senders = [(self._senders[fileno], bool(mask & _GONE))]
            for sender, gone in senders:
                before = len(found)
                self._drain(sender, gone, found)
                heard += len(found) > before
        if not found:
            return Polled((), self._tally.events.take())
        frames = found[0] if len(found) == 1 else np.concatenate(found)
        if heard > 1:
            frames = frames[np.argsort(frames["t_host_ns"], kind="stable")]
        self._tally.counts.frames += len(frames)
        self._watch.look(frames, self._tally)
        return Polled((frames,), self._tally.events.take())

    def stop(self) -> None:
        """Disconnect everybody and remove the socket."""
        self._finished = True
        for sender in self._senders.values():
            sender.sock.close()
        self._senders.clear()
        if self._epoll is not None:
            self._epoll.close()
            self._epoll = None
        if self._listener is not None:
            self._listener.close()
            self._listener = None
            with contextlib.suppress(OSError):
                there = self._path.lstat()
                if (there.st_dev, there.st_ino) == self._inode:  # not another recorder's
                    self._path.unlink()

    def _accept(self) -> list[_Sender]:
        """Let in who waits."""
        new: list[_Sender] = []
        if self._listener is None or self._epoll is None:
            return new
        while True:
            try:
                sock, _ = self._listener.accept()
            except BlockingIOError:
                return new
            except OSError as error:
                if error.errno != errno.ECONNABORTED:
                    reason = error.strerror or str(error)
                    self._tally.events.say("error", f"can't accept a sender: {reason}")
                return new
            sock.setblocking(False)
            sock.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
            back = self._had_sender and not self._senders
            self._had_sender = True
            self._tally.counts.reconnects += back
            self._tally.events.say("info", "a sender is back" if back else "a sender connected")
            new.append(_Sender(sock, self._tally.now_ns()))
            self._senders[sock.fileno()] = new[-1]
            self._epoll.register(sock.fileno(), select.EPOLLIN | select.EPOLLRDHUP)

    def _drain(self, sender: _Sender, gone: bool, found: list[FrameArray]) -> None:
        """Take a sender's packets; afterwards let it go if it has gone."""
        for _ in range(_MOST_BATCHES):
            looked_ns = self._tally.now_ns()
            try:
                batch = self._receive.receive(sender.sock.fileno())
            except ConnectionError:
                self._forget(sender)
                return
            if 0 in batch.sizes:  # beyond a sender's last packet, reads are empty
                gone = gone or _hung_up(sender.sock)
            if gone and not any(batch.sizes):
                self._forget(sender)
                return
            if len(batch.sizes):
                times = self._arrivals.times(batch.stamps_ns, sender.floor_ns)
                sender.floor_ns = times[-1]
                frames = self._unpack(sender, batch, times, gone)
                if len(frames):
                    found.append(frames)
            else:
                sender.floor_ns = looked_ns
            if len(batch.sizes) < self._receive.capacity and not gone:
                return

    def _unpack(self, sender: _Sender, batch: Batch, times: list[int], gone: bool) -> FrameArray:
        flat = batch.packets.reshape(-1).data
        width = batch.packets.shape[1]
        pieces: list[memoryview] = []
        arrivals: list[int] = []
        counts: list[int] = []
        malformed = 0
        for row, (size, time_ns) in enumerate(zip(batch.sizes, times, strict=True)):
            shape = _SHAPES.get(size)  # one that is too long is cut to a size that isn't there
            if shape is None:
                malformed += bool(size) or not gone
                continue
            count, head = shape
            start = row * width
            if head:
                self._prove(sender, flat[start : start + head], count)
            pieces.append(flat[start + head : start + size])
            arrivals.append(time_ns)
            counts.append(count)
        self._tally.malformed("malformed packet", malformed)
        frames = frames_from_bytes(memoryview(bytearray().join(pieces)))
        frames["t_host_ns"] = np.repeat(np.array(arrivals, dtype=np.uint64), counts)
        return frames

    def _prove(self, sender: _Sender, head: memoryview, count: int) -> None:
        """Count what a head proves lost."""
        sequence, dropped = HEAD.unpack(head)
        if sender.expected is None:
            # Its counters may be older than the connection: only what it dropped since counts.
            lost = dropped if dropped == sequence else 0
        else:
            lost = max(0, sequence - sender.expected, dropped - sender.dropped)
        sender.expected, sender.dropped = sequence + count, dropped
        self._tally.counts.dropped = (self._tally.counts.dropped or 0) + lost
        if lost:
            self._tally.events.say("warn", "frame lost before it reached us", lost)

    def _forget(self, sender: _Sender) -> None:
        fileno = sender.sock.fileno()
        if self._epoll is not None:
            self._epoll.unregister(fileno)
        del self._senders[fileno]
        sender.sock.close()
        self._tally.events.say("warn", "a sender disconnected")


def _hung_up(sock: socket.socket) -> bool:
    poll = select.poll()
    poll.register(sock.fileno(), select.POLLRDHUP)
    return bool(poll.poll(0))


def open_unix(address: SourceAddress) -> Source:
    """Make the source that a ``unix:`` address names.

    Args:
        address: E.g. of ``unix:/run/user/1000/snake.sock?clock=host``.

    Returns:
        The source; nothing is opened.

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
    """Remove a socket that a recorder left behind; anything else stays."""
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
