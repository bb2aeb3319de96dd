"""CAN interfaces of the Linux kernel, drained in bulk from a raw socket.

The kernel stamps each frame at its arrival and counts the frames that it had to drop, so a stall of
the recorder changes no times and hides no losses. The socket is never written to;
whether the controller itself is listen-only is set when the interface is brought up
(``ip link set can0 type can bitrate 1000000 listen-only on``).
"""

from __future__ import annotations

import os
import socket
import struct
from collections.abc import Sequence

import numpy as np

from ..common.errors import SourceError, UsageError
from ..log.messages.frames import DIR_RX, DIR_TX, FrameArray, empty_fd_frames, empty_frames
from ..robot.model import ClockDomain
from .contract import SourceAddress, flag, only
from .drained_link import DrainedLink
from .events import Tally
from .link import LinkedSource
from .reader_thread import (
    SO_RCVBUFFORCE,
    SO_RXQ_OVFL,
    SO_TIMESTAMPNS,
    ArrivalClock,
    PacketBatch,
    ReceiveMany,
    enlarge_buffer,
)

CAN_MTU = 16
"""Bytes of a classic frame, ``struct can_frame``."""
CANFD_MTU = 72
"""Bytes of a CAN FD frame, ``struct canfd_frame``."""

_CAN_RAW_ERR_FILTER = 2  # linux/can/raw.h; Python's name for it is missing in its type hints
_CAN_FRAME = np.dtype([("id", "=u4"), ("len", "u1"), ("pad", "V3"), ("data", "u1", (8,))])
_CANFD_FRAME = np.dtype(
    [("id", "=u4"), ("len", "u1"), ("flags", "u1"), ("pad", "V2"), ("data", "u1", (64,))]
)
_BUFFER_BYTES = 8 << 20
_PACKETS = 256
_MOST_BATCHES = 64
_MOST_DRAINED = 4096  # after an error: more than the largest buffer holds
_PAUSE_S = 0.005  # the kernel has the times


def frames_of(batch: PacketBatch, times_ns: Sequence[int], *, fd: bool = False) -> FrameArray:
    """Convert the kernel's frames of one kind, classic or CAN FD.

    Args:
        batch: Packets of a raw CAN socket; those of another kind are left out.
        times_ns: Their arrival [Unix ns], which becomes device and host time.
    """
    mtu, layout = (CANFD_MTU, _CANFD_FRAME) if fd else (CAN_MTU, _CAN_FRAME)
    rows = [row for row, size in enumerate(batch.sizes) if size == mtu]
    raw = batch.packets[rows, :mtu].view(layout)[:, 0]
    if fd:
        frames = empty_fd_frames(len(rows))
        frames["len"], frames["fd_flags"] = raw["len"], raw["flags"]
    else:
        frames = empty_frames(len(rows))
        frames["dlc"] = raw["len"]
    frames["t_device_ns"] = frames["t_host_ns"] = [times_ns[row] for row in rows]
    frames["id_flags"] = raw["id"]
    local = socket.MSG_DONTROUTE
    frames["dir"] = [DIR_TX if batch.flags[row] & local else DIR_RX for row in rows]
    frames["data"] = raw["data"]
    return frames


class SocketcanLink:
    """An open raw CAN socket."""

    detail = "never transmits"

    def __init__(self, sock: socket.socket, tally: Tally) -> None:
        """Take over a bound socket."""
        self._socket, self._tally = sock, tally
        self._receive = ReceiveMany(_PACKETS, CANFD_MTU + 1)
        self._drops = 0
        self._clock = ArrivalClock(tally.now_ns)
        self._floor_ns = tally.now_ns()
        self._error: OSError | None = None

    def read(self, now_ns: int) -> Sequence[FrameArray]:  # noqa: ARG002 (the kernel has the time)
        """See :meth:`Link.read`."""
        if self._error is not None:
            raise self._error
        arrays: list[FrameArray] = []
        most = _MOST_BATCHES
        while most:
            most -= 1
            looked_ns = self._tally.now_ns()
            try:
                batch = self._receive.receive(self._socket.fileno())
            except OSError as error:
                if self._error is not None:
                    break
                self._error, most = error, _MOST_DRAINED  # first hand out what came before
                continue
            if len(batch.sizes):
                times = self._clock.times(batch.stamps_ns, self._floor_ns)
                self._floor_ns = times[-1]
                arrays.append(frames_of(batch, times))
                if CANFD_MTU in batch.sizes:
                    arrays.append(frames_of(batch, times, fd=True))
                self._count(batch)
            else:
                self._floor_ns = looked_ns
            if len(batch.sizes) < self._receive.capacity:
                break
        if not arrays and self._error is not None:
            raise self._error
        return arrays

    def fileno(self) -> int:
        """The socket."""
        return self._socket.fileno()

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()

    def _count(self, batch: PacketBatch) -> None:
        whole = batch.sizes.count(CAN_MTU) + batch.sizes.count(CANFD_MTU)
        self._tally.malformed("packet that is no CAN frame", len(batch.sizes) - whole)
        if batch.drops is not None and batch.drops != self._drops:
            lost = (batch.drops - self._drops) % 2**32
            self._drops = batch.drops
            self._tally.lost("frame dropped by the kernel", lost)


def open_socketcan(interface: str, tally: Tally) -> SocketcanLink:
    """Open a raw socket on an interface.

    Args:
        interface: E.g. ``can0``.

    Raises:
        OSError: If there is no such interface, or it is down: it may come.
    """
    sock = socket.socket(socket.AF_CAN, socket.SOCK_RAW | socket.SOCK_NONBLOCK, socket.CAN_RAW)
    try:
        _set_up(sock, interface)
    except OSError:
        sock.close()
        raise
    tally.counts.dropped = tally.counts.dropped or 0
    return SocketcanLink(sock, tally)


def _set_up(sock: socket.socket, interface: str) -> None:
    sock.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
    sock.setsockopt(socket.SOL_SOCKET, SO_RXQ_OVFL, 1)
    enlarge_buffer(sock, SO_RCVBUFFORCE, socket.SO_RCVBUF, _BUFFER_BYTES)
    every_class = struct.pack("=I", socket.CAN_ERR_MASK)
    sock.setsockopt(socket.SOL_CAN_RAW, _CAN_RAW_ERR_FILTER, every_class)
    sock.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FD_FRAMES, 1)
    sock.bind((interface,))
    # An interface that is down can be bound, but the kernel leaves an error behind.
    code = sock.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR)
    if code:
        raise OSError(code, os.strerror(code))


def socketcan_source(address: SourceAddress, channel: str) -> LinkedSource:
    """Make the source of an interface, e.g. ``can0``; nothing is opened.

    Its option ``directions`` states that this computer is the robot's own: then the frames that it
    sends are commands, which the kernel marks.

    Raises:
        UsageError: If an option is unknown or has no valid value.
        SourceError: If this computer's kernel has no CAN sockets.
    """
    if "bitrate" in address.options:
        raise UsageError(
            f"{address.text!r}: the bit rate of a kernel interface is set when it is brought up: "
            f"ip link set {channel} up type can bitrate {address.options['bitrate']} listen-only on"
        )
    only(address, ("directions",))
    try:
        socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW).close()
    except OSError as error:
        raise SourceError(
            address.text,
            f"this computer's kernel offers no CAN sockets ({error.strerror}); "
            "load its modules (modprobe can_raw), or use another interface",
        ) from error
    return LinkedSource(
        address,
        lambda tally: DrainedLink(open_socketcan(channel, tally), tally, pause_s=_PAUSE_S),
        place=channel,
        clock=ClockDomain.HOST,
        facts={"interface": "socketcan", "channel": channel},
        directions=flag(address, "directions", default=False),
    )
