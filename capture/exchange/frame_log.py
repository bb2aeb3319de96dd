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
    fd_bus: IntArray = field(default_factory=lambda: np.empty(0, dtype=np.int64))
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


class _Rows:
    """The frames of one kind, classic or CAN FD, of a block that is being built."""

    def __init__(self) -> None:
        self.rows: list[tuple[int, int, int, int, int]] = []
        self.data = bytearray()

    def fill(self, frames: FrameArray, length: str) -> IntArray:
        """Fill records, their length under its name there; returns the buses."""
        columns = np.array(self.rows, dtype=np.int64).reshape(-1, 5).T
        frames["t_host_ns"], frames["id_flags"], frames[length], frames["dir"], bus = columns
        frames["data"] = np.frombuffer(self.data, np.uint8).reshape(frames["data"].shape)
        return bus


class BlockBuilder:
    """Gathers frames one by one."""

    def __init__(self) -> None:
        """Start empty."""
        self._classic, self._fd = _Rows(), _Rows()
        self._fd_flags: list[int] = []
        self._is_fd: list[bool] = []

    def __len__(self) -> int:
        """Number of frames."""
        return len(self._is_fd)

    def append(
        self,
        *,
        t_ns: int,
        id_flags: int,
        length: int,
        way: int,
        bus: int,
        data: bytes | bytearray,
        fd_flags: int | None = None,
    ) -> None:
        """Add one frame.

        Args:
            t_ns: Its time [ns].
            length: The DLC of a classic frame, the bytes of a CAN FD frame.
            bus: Index into :attr:`FrameLog.buses`.
            data: At most 8 bytes, of a CAN FD frame 64.
            fd_flags: ``FD_BRS`` and ``FD_ESI``; None for a classic frame.
        """
        self._is_fd.append(fd_flags is not None)
        kind, room = self._classic, 8
        if fd_flags is not None:
            kind, room = self._fd, 64
            self._fd_flags.append(fd_flags)
        kind.rows.append((t_ns, id_flags, length, way, bus))
        kind.data += data.ljust(room, b"\0")

    def block(self, done: float) -> LogBlock:
        """The frames as records.

        Args:
            done: How much of the log was read, 0 to 1.
        """
        fd_count = len(self._fd_flags)
        frames, fd_frames = empty_frames(len(self) - fd_count), empty_fd_frames(fd_count)
        bus, fd_bus = self._classic.fill(frames, "dlc"), self._fd.fill(fd_frames, "len")
        fd_frames["fd_flags"] = self._fd_flags
        is_fd = np.array(self._is_fd, dtype=np.bool_) if fd_count else None
        return LogBlock(frames, bus, done, fd_frames, fd_bus, is_fd)
