"""Connections emptied by threads, many packets in one system call.

Python's ``recv_into`` costs more than a microsecond a packet, and with the time of arrival twice
that. One call for all received packets is several times cheaper, and a packet's time is that of its
arrival, not of the call.

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
from contextlib import suppress
from dataclasses import dataclass
from typing import cast

import numpy as np
from numpy.typing import NDArray

from ..common.process import join_running, share_priority

SO_TIMESTAMPNS = 35
"""Socket option and control message: arrival as timespec (``asm-generic/socket.h``)."""
SO_RXQ_OVFL = 40
"""Socket option and control message: packets dropped by the kernel since the socket was made."""
SO_SNDBUFFORCE = 32
"""Socket option: send buffer beyond the system's limit, for the superuser."""
SO_RCVBUFFORCE = 33
"""Socket option: receive buffer beyond the system's limit, for the superuser."""

INTERRUPTED = frozenset({errno.EINTR, *range(512, 517)})
"""Errors of a call that a stop or a signal interrupted; it is made again.

``recvmmsg`` that waits with packets in hand leaves the kernel's own code in the socket, ERESTARTSYS
(512) after SIGSTOP, and the next call returns it (``net/socket.c``, ``do_recvmmsg``;
``include/linux/errno.h`` has 512 to 516)."""

_CONTROL = 128
_EMPTY = 2**32 - 1  # no packet has this size
_SLACK_NS = 20_000_000

_IOVEC = np.dtype([("base", np.uintp), ("len", np.uintp)])
_HEAD = [("len", np.uintp), ("kind", "<u8")]  # level and type, compared as one
_STAMP = np.dtype([*_HEAD, ("s", np.intp), ("ns", np.intp)])
_DROPS = np.dtype([*_HEAD, ("count", "<u4")])
_TIME_KIND = SO_TIMESTAMPNS << 32 | socket.SOL_SOCKET
_DROPS_KIND = SO_RXQ_OVFL << 32 | socket.SOL_SOCKET
_RECVMMSG = ctypes.CDLL(None, use_errno=True).recvmmsg

_JOIN_S = 1.0
_FEWEST, _MOST = 256, 1024  # rows; the kernel takes no more
_BRIEF_S = 0.2  # rows that are full sooner become more
_LAST_CALLS = 3  # without a packet: an error that waits in the socket, an interruption, the end
_MOST_BYTES = 64 << 20  # so much may wait for the loop: then the kernel's buffer fills


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


@dataclass(frozen=True)
class PacketBatch:
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

    def receive(self, fileno: int) -> PacketBatch:
        """Receive the packets of a socket, up to the capacity, without waiting.

        Raises:
            OSError: As ``recvmmsg`` has it.
        """
        return self.batch(0, self._received(fileno, socket.MSG_DONTWAIT))

    def fill(self, fileno: int, *, waiting: bool = True) -> int:
        """Wait for packets in the kernel, the interpreter's lock released, until all rows are full.

        Meanwhile another thread gets the received packets by :meth:`arrived` and :meth:`batch`.
        :meth:`clear` must be called before.

        Args:
            waiting: Whether to wait; else the packets that the kernel has now.

        Returns:
            Number of filled rows: fewer after a signal or before an error.

        Raises:
            OSError: As ``recvmmsg`` has it.
        """
        return self._received(fileno, 0 if waiting else socket.MSG_DONTWAIT)

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

    def batch(self, start: int, stop: int) -> PacketBatch:
        """Return received packets."""
        if start == stop:
            return PacketBatch(self._packets[:0], [], [], [], None)
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
        return PacketBatch(
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
            if code != errno.EAGAIN and code not in INTERRUPTED:
                raise OSError(code, os.strerror(code))
            count = 0
        return count


class ArrivalClock:
    """Converts the kernel's times, on the wall clock, to the session's clock.

    The two clocks are read one after the other, and a process may be delayed in between; so the
    offset between them is only changed as far as a reading contradicts it.
    """

    def __init__(
        self, now_ns: Callable[[], int], wall_ns: Callable[[], int] = time.time_ns
    ) -> None:
        """Compare the clocks for the first time.

        Args:
            now_ns: The session's clock [Unix ns].
            wall_ns: The kernel's clock of arrivals [Unix ns].
        """
        self._now_ns, self._wall_ns = now_ns, wall_ns
        readings = [(now_ns(), wall_ns(), now_ns()) for _ in range(5)]
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
        before, wall, after = self._now_ns(), self._wall_ns(), self._now_ns()
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

    def take(self, most: int) -> list[PacketBatch]:
        """Return the received packets, at least ``most`` if there are so many.

        They are valid until the next call.
        """
        for rows in self._used:
            rows.room.clear()
            rows.count = None
            self._free.append(rows)
        self._used.clear()
        batches: list[PacketBatch] = []
        while self._filled and most > 0:
            rows = self._filled[0]
            count = rows.count
            stop = rows.room.arrived(self._read) if count is None else count
            if stop > self._read:
                batches.append(rows.room.batch(self._read, stop))
                most -= stop - self._read
                self._read = stop
            if count is None:
                break
            self._used.append(self._filled.popleft())
            self._read = 0
        return batches

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
        join_running(self._thread, _JOIN_S)
        self._sock.close()

    def _run(self) -> None:
        # Signals must interrupt the main thread.
        signal.pthread_sigmask(signal.SIG_BLOCK, signal.valid_signals())
        share_priority()
        try:
            while not self._closing.is_set():
                received = self._fill(self._next())
                # Empty packets are the end; none at all, an interrupted call.
                if received and not any(received) and _hung_up(self._sock):
                    return
        except OSError as error:
            self.error = error
            self._fetch_rest()
        finally:
            self._ended = True

    def _fetch_rest(self) -> None:
        """Fetch what a broken connection has in the kernel; senders are refused from now on."""
        self.end()
        calls_without = 0
        while calls_without < _LAST_CALLS and not self._closing.is_set():
            received: list[int] = []
            with suppress(OSError):  # reported already: it broke the connection
                received = self._fill(self._next(), waiting=False)
            calls_without = 0 if any(received) else calls_without + 1

    def _next(self) -> _Rows:
        while self._free:
            rows = self._free.popleft()
            if rows.room.capacity >= self._rows:
                return rows
        return _Rows(self._rows, self._longest)

    def _fill(self, rows: _Rows, *, waiting: bool = True) -> list[int]:
        """Receive packets; return their sizes [B], 0 behind a sender's last."""
        while len(self._filled) >= self._most_waiting and not self._closing.wait(0.001):
            pass
        self._filled.append(rows)
        begun = time.monotonic()
        count = 0
        try:
            count = rows.room.fill(self._sock.fileno(), waiting=waiting)
        finally:
            rows.count = count
        if count == self._rows and time.monotonic() - begun < _BRIEF_S:
            self._rows = min(self._rows * 4, _MOST)
        return rows.room.sizes(count)


def _hung_up(sock: socket.socket) -> bool:
    poll = select.poll()
    poll.register(sock.fileno(), select.POLLRDHUP)
    # An error that waits in the socket is reported, too; the next call returns it.
    return any(state & (select.POLLRDHUP | select.POLLHUP) for _, state in poll.poll(0))
