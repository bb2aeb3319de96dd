"""Connections emptied by threads, many packets in one system call.

Python's ``recv_into`` costs more than a microsecond a packet, and with the time of arrival twice
that. One call for all received packets is several times cheaper, and a packet's time is that of its
arrival, not of the call.

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

import ctypes
import errno
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
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol, cast

import numpy as np
from numpy.typing import NDArray

from ..common.process import share_priority
from ..log.messages.frames import FrameArray
from .events import Tally
from .link import Link

SO_TIMESTAMPNS = 35
"""Socket option and control message: arrival as timespec (``asm-generic/socket.h``)."""
SO_RXQ_OVFL = 40
"""Socket option and control message: packets dropped by the kernel since the socket was made."""
SO_SNDBUFFORCE = 32
"""Socket option: send buffer beyond the system's limit, for the superuser."""
SO_RCVBUFFORCE = 33
"""Socket option: receive buffer beyond the system's limit, for the superuser."""

_CONTROL = 128
_EMPTY = 2**32 - 1  # no packet has this size
_SLACK_NS = 20_000_000


class _Mmsghdr(ctypes.Structure):
    """``struct mmsghdr`` with its ``struct msghdr`` in line; pointers as integers, for numpy."""

    _fields_ = (
        ("name", ctypes.c_size_t),
        ("namelen", ctypes.c_uint),
        ("iov", ctypes.c_size_t),
        ("iovlen", ctypes.c_size_t),
        ("control", ctypes.c_size_t),
        ("controllen", ctypes.c_size_t),
        ("flags", ctypes.c_int),
        ("pad", ctypes.c_int),  # msghdr is a structure of its own, aligned to 8 bytes
        ("size", ctypes.c_uint),
    )


_MMSGHDR = cast("np.dtype[np.void]", np.dtype(_Mmsghdr))
_IOVEC = np.dtype([("base", np.uintp), ("len", np.uintp)])
_HEAD = [("len", np.uintp), ("kind", "<u8")]  # level and type, compared as one
_STAMP = np.dtype([*_HEAD, ("s", np.intp), ("ns", np.intp)])
_DROPS = np.dtype([*_HEAD, ("count", "<u4")])
_TIME_KIND = SO_TIMESTAMPNS << 32 | socket.SOL_SOCKET
_DROPS_KIND = SO_RXQ_OVFL << 32 | socket.SOL_SOCKET
_RECVMMSG = ctypes.CDLL(None, use_errno=True).recvmmsg


@dataclass(frozen=True)
class Batch:
    """Packets of one call. Lists, as they are mostly short: they cost less than numpy's columns.

    Attributes:
        packets: Their bytes, shape (n, longest); valid until the next call.
        sizes: Number of bytes of each.
        flags: Of each: ``MSG_TRUNC`` if it was longer, ``MSG_DONTROUTE`` and others.
        stamps_ns: Arrival [Unix ns, on the computer's wall clock]; 0 if unknown.
        drops: The kernel's count of dropped packets, modulo 2**32; None if unknown.
    """

    packets: NDArray[np.uint8]
    sizes: list[int]
    flags: list[int]
    stamps_ns: list[int]
    drops: int | None


class ReceiveMany:
    """Buffers for many packets of any socket."""

    def __init__(self, packets: int, longest: int) -> None:
        """Make the buffers.

        Args:
            packets: Most packets of one call.
            longest: Most bytes of a packet.
        """
        self.capacity = packets
        self._packets = np.zeros((packets, longest), dtype=np.uint8)
        self._control = np.zeros((packets, _CONTROL), dtype=np.uint8)
        self._iov = np.zeros(packets, dtype=_IOVEC)
        self._heads = np.zeros(packets, dtype=_MMSGHDR)
        row = np.arange(packets, dtype=np.uintp)
        self._iov["base"] = self._packets.ctypes.data + row * longest
        self._iov["len"] = longest
        self._heads["iov"] = self._iov.ctypes.data + row * _IOVEC.itemsize
        self._heads["iovlen"] = 1
        self._heads["control"] = self._control.ctypes.data + row * _CONTROL
        self._heads["controllen"] = _CONTROL
        self._sizes = self._heads["size"]
        self._call = (ctypes.c_void_p(self._heads.ctypes.data), ctypes.c_uint(packets))
        self._stamps = self._control[:, : _STAMP.itemsize].view(_STAMP)[:, 0]
        drops = self._control[:, _STAMP.itemsize : _STAMP.itemsize + _DROPS.itemsize]
        self._drops = drops.view(_DROPS)[:, 0]

    def receive(self, fileno: int) -> Batch:
        """Receive the packets of a socket, up to the capacity, without waiting.

        Raises:
            OSError: As ``recvmmsg`` has it.
        """
        return self.batch(0, self._received(fileno, socket.MSG_DONTWAIT))

    def fill(self, fileno: int) -> int:
        """Wait for packets in the kernel, the interpreter's lock released, until all rows are full.

        Meanwhile another thread gets the received packets by :meth:`arrived` and :meth:`batch`.
        :meth:`clear` must be called before.

        Returns:
            Number of filled rows: fewer after a signal or before an error.

        Raises:
            OSError: As ``recvmmsg`` has it.
        """
        return self._received(fileno, 0)

    def clear(self) -> None:
        """Empty the rows, before the next :meth:`fill`."""
        self._sizes[:] = _EMPTY
        self._heads["controllen"] = _CONTROL

    def arrived(self, start: int) -> int:
        """Return the number of rows filled so far by :meth:`fill`, of which ``start`` are known.

        The kernel stores the bytes of a packet before its size, and the calls between this check
        and the reading of the bytes take longer than a store needs to reach another core.
        """
        empty = self._sizes[start:] == _EMPTY
        return start + int(empty.argmax()) if empty.any() else self.capacity

    def sizes(self, count: int) -> list[int]:
        """Return the sizes of the first packets [B]."""
        sizes: list[int] = self._sizes[:count].tolist()
        return sizes

    def batch(self, start: int, stop: int) -> Batch:
        """Return received packets."""
        if start == stop:
            return Batch(self._packets[:0], [], [], [], None)
        heads = self._heads[start:stop]
        used: list[int] = heads["controllen"].tolist()
        heads["controllen"] = _CONTROL  # for the next call
        stamps_ns = [
            s * 1_000_000_000 + ns if kind == _TIME_KIND and room >= _STAMP.itemsize else 0
            for (_, kind, s, ns), room in zip(self._stamps[start:stop].tolist(), used, strict=True)
        ]
        drops = None
        if max(used) > _STAMP.itemsize:
            rows = zip(self._drops[start:stop].tolist(), used, strict=True)
            counts = [
                n for (_, kind, n), room in rows if kind == _DROPS_KIND and room > _STAMP.itemsize
            ]
            drops = counts[-1] if counts else None
        return Batch(
            packets=self._packets[start:stop],
            sizes=heads["size"].tolist(),
            flags=heads["flags"].tolist(),
            stamps_ns=stamps_ns,
            drops=drops,
        )

    def _received(self, fileno: int, flags: int) -> int:
        count = int(_RECVMMSG(ctypes.c_int(fileno), *self._call, ctypes.c_int(flags), None))
        if count < 0:
            code = ctypes.get_errno()
            if code not in (errno.EAGAIN, errno.EINTR):
                raise OSError(code, os.strerror(code))
            count = 0
        return count


class ArrivalClock:
    """Converts the kernel's times, on the wall clock, to the session's clock.

    The two clocks are read one after the other, and a process may be delayed in between; so the
    offset between them is only changed as far as a reading contradicts it.
    """

    def __init__(self, now_ns: Callable[[], int]) -> None:
        """Compare the clocks for the first time.

        Args:
            now_ns: The session's clock [Unix ns].
        """
        self._now_ns = now_ns
        readings = [(now_ns(), time.time_ns(), now_ns()) for _ in range(5)]
        before, wall, after = min(readings, key=lambda reading: reading[2] - reading[0])
        self._offset_ns = (before + after) // 2 - wall

    def times(self, stamps_ns: Sequence[int], floor_ns: int) -> list[int]:
        """Arrival on the session's clock.

        Args:
            stamps_ns: Arrival on the wall clock [Unix ns], 0 where unknown, in the order of one
                socket's queue.
            floor_ns: Lower limit of the arrivals on the session's clock [Unix ns]: the socket was
                empty then, or gave an earlier packet. It limits the error after the wall clock was
                set.

        Returns:
            Arrival on the session's clock [Unix ns], in order, not after now.
        """
        before, wall, after = self._now_ns(), time.time_ns(), self._now_ns()
        offset = self._offset_ns = min(max(self._offset_ns, before - wall), after - wall)
        times: list[int] = []
        latest = after
        for stamp in reversed(stamps_ns):
            # A packet that came before stamps were enabled is stamped when it is fetched, but the
            # queue keeps the order: it came no later than those behind it. A time long before the
            # floor is wrong: the wall clock was set in between.
            if stamp and floor_ns - _SLACK_NS < stamp + offset < latest:
                latest = max(stamp + offset, floor_ns)
            times.append(latest)
        times.reverse()
        return times


def enlarge_buffer(sock: socket.socket, force: int, option: int, size: int) -> None:
    """Enlarge a socket's buffer as far as permitted.

    Args:
        force: :data:`SO_SNDBUFFORCE` or :data:`SO_RCVBUFFORCE`.
        option: ``SO_SNDBUF`` or ``SO_RCVBUF``, which the system limits.
    """
    try:
        sock.setsockopt(socket.SOL_SOCKET, force, size)
    except PermissionError:
        sock.setsockopt(socket.SOL_SOCKET, option, size)


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
