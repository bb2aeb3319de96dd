"""A foreign log of CAN frames as a stream of blocks, whatever its format."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from typing import TypeVar

import numpy as np

from ..common.arrays import BoolArray, IntArray
from ..log.messages.frames import FrameArray, empty_fd_frames, empty_frames, widened

RELATIVE_EPOCH_NS = 946_684_800_000_000_000
"""Where a log without a date is put: 2000-01-01T00:00:00Z [Unix ns]."""

EARLIEST_NS = 100_000_000_000_000_000
"""A time below this is no date but a time since the log's start [ns]: 1973."""

LATEST_NS = 2**31 * 1_000_000_000
"""No stamp of a message can hold this time or a later one [Unix ns]: 2038."""


_T = TypeVar("_T")

FRAMES_PER_BLOCK = 65_536
"""Readers hand out blocks of this many frames, so no log is held in memory whole."""


def _no_buses() -> IntArray:
    return np.empty(0, dtype=np.int64)


@dataclass(frozen=True)
class LogBlock:
    """A stretch of a log.

    Attributes:
        frames: Its classic frames, in the order of the log, shape (n,). A log has one time a
            frame: it is the host time, and the device time is 0.
        bus: Index into the log's list of buses for each of them, shape (n,).
        done: How much of the log's file has been read, 0 to 1.
        fd_frames: Its CAN FD frames, the same, shape (m,).
        fd_bus: The bus of each, shape (m,).
        is_fd: Which of all frames, in the order of the log, are CAN FD frames, shape (n + m,);
            None where there are none.
    """

    frames: FrameArray
    bus: IntArray
    done: float
    fd_frames: FrameArray = field(default_factory=lambda: empty_fd_frames(0))
    fd_bus: IntArray = field(default_factory=_no_buses)
    is_fd: BoolArray | None = None

    def __len__(self) -> int:
        """Number of frames of both kinds."""
        return len(self.frames) + len(self.fd_frames)

    def times_ns(self) -> IntArray:
        """Times of all frames, in the order of the log.

        Returns:
            Unix time [ns], shape (n + m,).
        """
        t_ns = self.frames["t_host_ns"].astype(np.int64)
        if self.is_fd is None:
            return t_ns
        every = np.empty(len(self), dtype=np.int64)
        every[~self.is_fd], every[self.is_fd] = t_ns, self.fd_frames["t_host_ns"]
        return every

    def where(self, keep: BoolArray) -> LogBlock:
        """Some of the frames.

        Args:
            keep: Which, shape (n + m,).

        Returns:
            The block without the others.
        """
        if self.is_fd is None:
            return replace(self, frames=self.frames[keep], bus=self.bus[keep])
        classic, fd = keep[~self.is_fd], keep[self.is_fd]
        return LogBlock(
            self.frames[classic],
            self.bus[classic],
            self.done,
            self.fd_frames[fd],
            self.fd_bus[fd],
            self.is_fd[keep],
        )

    def first_bus(self) -> int:
        """Index of the bus of the first frame."""
        starts_fd = self.is_fd is not None and bool(self.is_fd[0])
        return int((self.fd_bus if starts_fd else self.bus)[0])

    def of_bus(self, bus: int) -> FrameArray:
        """All frames of one bus, in the order of the log.

        Returns:
            Records of :data:`.capture.log.messages.frames.FRAME_DTYPE`, or of
            :data:`.capture.log.messages.frames.FD_FRAME_DTYPE` where any is a CAN FD frame.
        """
        own, own_fd = self.bus == bus, self.fd_bus == bus
        if self.is_fd is None or not own_fd.any():
            return self.frames[own]
        mine = np.empty(len(self), dtype=np.bool_)
        mine[~self.is_fd], mine[self.is_fd] = own, own_fd
        is_fd = self.is_fd[mine]
        both = empty_fd_frames(len(is_fd))
        both[~is_fd], both[is_fd] = widened(self.frames[own]), self.fd_frames[own_fd]
        return both

    def interleaved(self, classic: Iterable[_T], fd: Iterable[_T]) -> Iterator[_T]:
        """What was made of each frame, in the order of the log.

        Args:
            classic: One for each classic frame.
            fd: One for each CAN FD frame.

        Yields:
            Both, n + m of them.
        """
        if self.is_fd is None:
            yield from classic
            return
        next_classic, next_fd = iter(classic), iter(fd)
        order: list[bool] = self.is_fd.tolist()
        for is_fd in order:
            yield next(next_fd if is_fd else next_classic)


@dataclass
class FrameLog:
    """A log of CAN frames.

    Attributes:
        blocks: The blocks; each can be taken once.
        buses: Names of the buses seen so far, in order of appearance.
        directions: Whether the frames' directions were recorded; without, all count as received.
        time: What the times are, for the session's metadata.
        problems: What could not be kept, one sentence each; grows while the blocks are taken.
    """

    blocks: Iterator[LogBlock]
    buses: list[str]
    directions: bool
    time: str
    problems: list[str] = field(default_factory=list[str])


@dataclass
class _Columns:
    """Columns of frames of one kind."""

    t_ns: list[int] = field(default_factory=list[int])
    id_flags: list[int] = field(default_factory=list[int])
    length: list[int] = field(default_factory=list[int])
    way: list[int] = field(default_factory=list[int])
    bus: list[int] = field(default_factory=list[int])
    data: bytearray = field(default_factory=bytearray)

    def append(self, t_ns: int, id_flags: int, length: int, way: int, bus: int) -> None:
        """Add a frame; its data are added by the caller."""
        self.t_ns.append(t_ns)
        self.id_flags.append(id_flags)
        self.length.append(length)
        self.way.append(way)
        self.bus.append(bus)

    def fill(self, frames: FrameArray, length: str) -> IntArray:
        """Copy all into records; returns the buses."""
        frames["t_host_ns"] = self.t_ns
        frames["id_flags"] = self.id_flags
        frames[length] = self.length
        frames["dir"] = self.way
        frames["data"] = np.frombuffer(self.data, np.uint8).reshape(frames["data"].shape)
        return np.array(self.bus, dtype=np.int64)


class BlockBuilder:
    """A block in the making."""

    def __init__(self) -> None:
        """Start empty."""
        self._classic, self._fd = _Columns(), _Columns()
        self._fd_flags: list[int] = []
        self._is_fd: list[bool] = []

    def __len__(self) -> int:
        """Number of frames so far."""
        return len(self._is_fd)

    def append(
        self, *, t_ns: int, id_flags: int, dlc: int, way: int, bus: int, data: bytes | bytearray
    ) -> None:
        """Add a classic frame.

        Args:
            t_ns: Its time [Unix ns].
            id_flags: Identifier with the flags of :mod:`.capture.log.messages.frames`.
            data: Up to 8 bytes.
        """
        self._is_fd.append(False)
        self._classic.append(t_ns, id_flags, dlc, way, bus)
        self._classic.data += data.ljust(8, b"\0")

    def append_fd(
        self,
        *,
        t_ns: int,
        id_flags: int,
        fd_flags: int,
        way: int,
        bus: int,
        data: bytes | bytearray,
    ) -> None:
        """Add a CAN FD frame.

        Args:
            t_ns: Its time [Unix ns].
            id_flags: Identifier with the flags of :mod:`.capture.log.messages.frames`.
            fd_flags: Flags that CAN FD alone has.
            data: Up to 64 bytes.
        """
        self._is_fd.append(True)
        self._fd_flags.append(fd_flags)
        self._fd.append(t_ns, id_flags, len(data), way, bus)
        self._fd.data += data.ljust(64, b"\0")

    def block(self, done: float) -> LogBlock:
        """The frames so far as a block.

        Args:
            done: How much of the log's file has been read, 0 to 1.
        """
        fd_count = len(self._fd_flags)
        frames, fd_frames = empty_frames(len(self) - fd_count), empty_fd_frames(fd_count)
        bus, fd_bus = self._classic.fill(frames, "dlc"), self._fd.fill(fd_frames, "len")
        fd_frames["fd_flags"] = self._fd_flags
        is_fd = np.array(self._is_fd, dtype=np.bool_) if fd_count else None
        return LogBlock(frames, bus, done, fd_frames, fd_bus, is_fd)
