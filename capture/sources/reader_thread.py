"""Connections emptied by threads, so that no frames are lost while the recorder's loop is delayed.

The loop polls once a tick, and may be delayed by another program that has the processor, by a disk,
or by decoding. A serial device or a raw CAN socket holds some ten or hundred milliseconds of a busy
bus: :class:`DrainedLink` reads such a link in a thread, and stamps frames without a time closer to
their arrival.

An ``AF_UNIX`` socket holds 30 ms of a busy bus with one frame a packet. So the thread of
:class:`ReceiveThread` gives the kernel room for up to a thousand packets in one ``recvmmsg`` that
waits for them all: the kernel fills row after row as packets arrive, without Python code and
without the interpreter's lock, and the loop takes the filled rows while the call continues. The
lock is only needed when the room is full.
"""

from __future__ import annotations

import fcntl
import os
import select
import signal
import socket
import termios
import threading
import time
from array import array
from collections import deque
from collections.abc import Sequence
from typing import Protocol

from ..common.process import share_priority
from ..log.messages.frames import FrameArray
from .events import Tally
from .link import Link
from .receive_many import SO_TIMESTAMPNS, Batch, ReceiveMany

_JOIN_S = 1.0
_MOST_HELD = 2_000_000  # frames: 64 MB, four minutes of a busy bus


class LinkWithFile(Link, Protocol):
    """A link with a file descriptor to wait for."""

    def fileno(self) -> int:
        """Return its file descriptor."""
        ...


class DrainedLink:
    """The :class:`.capture.sources.link.Link` that reads another one in a thread."""

    def __init__(
        self, link: LinkWithFile, tally: Tally, *, pause_s: float, longest_s: float | None = None
    ) -> None:
        """Take over an open link, and begin.

        Args:
            link: From now on, only the thread uses it.
            tally: Counts lost frames; the link may have the same.
            pause_s: Pause after each read [s]: frames without a time are stamped at most this much
                later.
            longest_s: Read again after so long without a byte [s], so that the link notices.
        """
        self.detail = link.detail
        self._link, self._tally, self._pause_s = link, tally, pause_s
        self._longest_s = longest_s
        self._held: deque[FrameArray] = deque()
        self._count = self._taken = 0
        self._error: Exception | None = None
        self._stop = threading.Event()
        self._wake = os.pipe()
        self._closed = False
        self._thread = threading.Thread(target=self._run, name="undulog-drain", daemon=True)
        self._thread.start()

    def read(self, now_ns: int) -> Sequence[FrameArray]:  # noqa: ARG002 (stamped by the thread)
        """See :meth:`Link.read`."""
        error = self._error  # before the frames: none comes after it
        found: list[FrameArray] = []
        while self._held:
            found.append(self._held.popleft())
            self._taken += len(found[-1])
        if not found and error is not None:
            raise error
        return found

    def close(self) -> None:
        """End the thread and close the link."""
        if self._closed:
            return
        self._closed = True
        self._stop.set()
        os.write(self._wake[1], b"x")
        self._thread.join(_JOIN_S)
        self._link.close()
        for end in self._wake:
            os.close(end)

    def _run(self) -> None:
        try:
            fileno = self._link.fileno()
            while not self._stop.is_set():
                for frames in self._link.read(self._tally.now_ns()):  # some may be there already
                    self._hold(frames)
                self._stop.wait(self._pause_s)
                select.select([fileno, self._wake[0]], [], [], self._longest_s)
        except Exception as error:  # noqa: BLE001 (raised again by read(), in the recorder's thread)
            self._error = error

    def _hold(self, frames: FrameArray) -> None:
        if self._count - self._taken + len(frames) > _MOST_HELD:
            text = "frame dropped, as the recorder was held up for minutes"
            self._tally.lost(text, len(frames), "error")
            return
        self._count += len(frames)
        self._held.append(frames)


_FEWEST, _MOST = 256, 1024  # rows; the kernel takes no more
_BRIEF_S = 0.2  # rows that are full sooner become more
_MOST_BYTES = 64 << 20  # so much may wait for the loop: then the kernel's buffer fills


class _Rows:
    """Room for packets.

    Attributes:
        count: Number of filled rows; None while the kernel fills them.
    """

    def __init__(self, rows: int, longest: int) -> None:
        self.room = ReceiveMany(rows, longest)
        self.count: int | None = None
        self.room.clear()


class ReceiveThread:
    """Receives the packets of one socket, with the kernel's times."""

    def __init__(self, sock: socket.socket, longest: int) -> None:
        """Begin.

        Args:
            sock: The socket; from now on only the thread receives from it.
            longest: Most bytes of a packet; of a stream, most bytes that share a time.
        """
        self.error: OSError | None = None
        """Why the connection broke; None if the other end closed it."""
        self._sock, self._longest = sock, longest
        self._most_waiting = max(2, _MOST_BYTES // (longest * _MOST))
        self._rows = _FEWEST
        self._filled: deque[_Rows] = (
            deque()
        )  # in the order of the packets; the last is being filled
        self._free: deque[_Rows] = deque()
        self._used: list[_Rows] = []
        self._read = 0  # rows that were taken of the first
        self._ended = False
        self._closing = threading.Event()
        sock.setblocking(True)
        sock.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
        self._thread = threading.Thread(target=self._run, name="undulog-receive", daemon=True)
        self._thread.start()

    @property
    def ended(self) -> bool:
        """Whether the connection has ended, and all was taken."""
        return self._ended and not self._filled

    @property
    def pending(self) -> bool:
        """Whether the kernel has bytes that the thread has not received yet."""
        size = array("i", (0,))
        fcntl.ioctl(self._sock.fileno(), termios.FIONREAD, size)
        return size[0] > 0

    def take(self, most: int) -> list[Batch]:
        """Return the received packets, at least ``most`` if there are so many.

        They are valid until the next call.
        """
        for rows in self._used:
            rows.room.clear()
            rows.count = None
            self._free.append(rows)
        self._used.clear()
        found: list[Batch] = []
        while self._filled and most > 0:
            rows = self._filled[0]
            count = rows.count
            stop = rows.room.arrived(self._read) if count is None else count
            if stop > self._read:
                found.append(rows.room.batch(self._read, stop))
                most -= stop - self._read
                self._read = stop
            if count is None:
                break
            self._used.append(self._filled.popleft())
            self._read = 0
        return found

    def end(self) -> None:
        """Receive no more: local senders get an error; received packets are kept."""
        try:
            self._sock.shutdown(socket.SHUT_RD)
        except OSError:  # the other end was faster
            return

    def close(self) -> None:
        """End the thread and close the socket; safe to call twice."""
        self._closing.set()
        self.end()
        self._thread.join(_JOIN_S)
        self._sock.close()

    def _run(self) -> None:
        # Signals must interrupt the main thread.
        signal.pthread_sigmask(signal.SIG_BLOCK, signal.valid_signals())
        share_priority()
        try:
            while not self._closing.is_set():
                if len(self._filled) >= self._most_waiting:
                    self._closing.wait(0.001)
                    continue
                if self._fill(self._next()) and _hung_up(self._sock):
                    return
        except OSError as error:
            self.error = error
        finally:
            self._ended = True

    def _next(self) -> _Rows:
        while self._free:
            rows = self._free.popleft()
            if rows.room.capacity >= self._rows:
                return rows
        return _Rows(self._rows, self._longest)

    def _fill(self, rows: _Rows) -> bool:
        """Wait for packets; return whether all were empty, as after a sender's last."""
        self._filled.append(rows)
        begun = time.monotonic()
        count = 0
        try:
            count = rows.room.fill(self._sock.fileno())
        except ConnectionError as error:
            self.error = error  # earlier packets are still to be fetched
        finally:
            rows.count = count
        if count == self._rows and time.monotonic() - begun < _BRIEF_S:
            self._rows = min(self._rows * 4, _MOST)
        return not any(rows.room.sizes(count))


def _hung_up(sock: socket.socket) -> bool:
    poll = select.poll()
    poll.register(sock.fileno(), select.POLLRDHUP)
    return bool(poll.poll(0))
