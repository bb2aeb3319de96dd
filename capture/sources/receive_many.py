"""Many packets in one system call: Linux ``recvmmsg``, with the kernel's time of each packet.

Python's ``recv_into`` costs more than a microsecond a packet, and with the time of arrival twice
that. One call for all received packets is several times cheaper, and a packet's time is that of its
arrival, not of the call.
"""

from __future__ import annotations

import ctypes
import errno
import os
import socket
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import cast

import numpy as np
from numpy.typing import NDArray

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
