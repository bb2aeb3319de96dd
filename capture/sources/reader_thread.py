"""A socket emptied by a thread that waits in the kernel.

The recorder's loop looks once a tick, and may be held up: by another program that has the
processor, by a disk, by decoding. An ``AF_UNIX`` socket holds 30 ms of a busy bus with one frame a
packet. So a thread lends the kernel room for up to a thousand packets in one ``recvmmsg`` that
waits for them all: the kernel fills row after row as packets come, without a line of Python and
without the interpreter's lock, and the loop takes the rows that are filled while the call goes on.
The lock is only needed when the room is full.

A connection emptied by a thread of its own, as soon as something comes.

The recorder looks once a tick, and may be held up for longer by a disk that is slow. A serial
device or a raw CAN socket holds some ten or hundred milliseconds of a busy bus; then frames are
lost. The thread takes them meanwhile, and stamps what carries no time closer to its arrival.
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
    """A link that can be waited for."""

    def fileno(self) -> int:
        """What to wait for."""
        ...


class DrainedLink:
    """The :class:`.capture.sources.link.Link` that empties another one."""

    def __init__(self, link: LinkWithFile, tally: Tally, *, pause_s: float) -> None:
        """Take over an open link, and begin.

        Args:
            link: From now on, only the thread uses it.
            tally: Where to count; the link may have the same.
            pause_s: How long to let frames gather after some came [s]: what carries no time is
                stamped at most this much later.
        """
        self.detail = link.detail
        self._link = link
        self._tally = tally
        self._pause_s = pause_s
        self._held: deque[FrameArray] = deque()
        self._count = 0
        self._taken = 0
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
        """End the thread and release the link."""
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
                select.select([fileno, self._wake[0]], [], [])
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
        count: How many rows were filled in the end; None while the kernel fills them.
    """

    def __init__(self, rows: int, longest: int) -> None:
        self.room = ReceiveMany(rows, longest)
        self.count: int | None = None
        self.room.clear()


class ReceiveThread:
    """Takes what comes to one socket, with the kernel's times."""

    def __init__(self, sock: socket.socket, longest: int) -> None:
        """Begin.

        Args:
            sock: The socket; from now on only the thread receives from it.
            longest: Bytes of a packet at most; of a stream, bytes that share a time.
        """
        self.error: OSError | None = None
        """Why the connection ended; None where the other end closed it in good order."""
        self._sock = sock
        self._longest = longest
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
        """Whether nothing will come any more, and all was taken."""
        return self._ended and not self._filled

    @property
    def pending(self) -> bool:
        """Whether the kernel has bytes that the thread has yet to take."""
        size = array("i", (0,))
        fcntl.ioctl(self._sock.fileno(), termios.FIONREAD, size)
        return size[0] > 0

    def take(self, most: int) -> list[Batch]:
        """Take what has come.

        Returns:
            The packets in order; good until the next call.
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
        """Let nothing more in: senders here get an error; what came before is kept."""
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
        # The main thread is the one whose waiting a signal has to interrupt.
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
        """Wait for packets; True if there was nothing but empty ones, as behind a sender's last."""
        self._filled.append(rows)
        begun = time.monotonic()
        count = 0
        try:
            count = rows.room.fill(self._sock.fileno())
        except ConnectionError as error:
            self.error = error  # what came before it is still to be fetched
        finally:
            rows.count = count
        if count == self._rows and time.monotonic() - begun < _BRIEF_S:
            self._rows = min(self._rows * 4, _MOST)
        return not any(rows.room.sizes(count))


def _hung_up(sock: socket.socket) -> bool:
    poll = select.poll()
    poll.register(sock.fileno(), select.POLLRDHUP)
    return bool(poll.poll(0))
