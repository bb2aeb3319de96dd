"""A foreign log of CAN frames as a stream of blocks, whatever its format."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from ..arrays import IntArray
from ..log.frames import FrameArray, empty_frames

FRAMES_PER_BLOCK = 65_536
"""Readers hand out blocks of this many frames, so no log is held in memory whole."""


@dataclass(frozen=True)
class LogBlock:
    """A stretch of a log.

    Attributes:
        frames: Its frames, in the order of the log, shape (n,). A log has one time a frame: it is
            the host time, and the device time is 0.
        bus: Index into the log's list of buses for each frame, shape (n,).
        done: How much of the log's file has been read, 0 to 1.
    """

    frames: FrameArray
    bus: IntArray
    done: float


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
class BlockBuilder:
    """Columns of a block in the making."""

    t_ns: list[int] = field(default_factory=list[int])
    id_flags: list[int] = field(default_factory=list[int])
    dlc: list[int] = field(default_factory=list[int])
    way: list[int] = field(default_factory=list[int])
    bus: list[int] = field(default_factory=list[int])
    data: bytearray = field(default_factory=bytearray)

    def __len__(self) -> int:
        """Number of frames so far."""
        return len(self.t_ns)

    def append(
        self, *, t_ns: int, id_flags: int, dlc: int, way: int, bus: int, data: bytes | bytearray
    ) -> None:
        """Add a frame.

        Args:
            t_ns: Its time [Unix ns].
            id_flags: Identifier with the flags of :mod:`capture.log.frames`.
            dlc: Length code.
            way: Direction.
            bus: Index of its bus.
            data: Up to 8 bytes.
        """
        self.t_ns.append(t_ns)
        self.id_flags.append(id_flags)
        self.dlc.append(dlc)
        self.way.append(way)
        self.bus.append(bus)
        self.data += data.ljust(8, b"\0")

    def block(self, done: float) -> LogBlock:
        """The frames so far as a block.

        Args:
            done: How much of the log's file has been read, 0 to 1.

        Returns:
            The block.
        """
        frames = empty_frames(len(self))
        frames["t_host_ns"] = self.t_ns
        frames["id_flags"] = self.id_flags
        frames["dlc"] = self.dlc
        frames["dir"] = self.way
        frames["data"] = np.frombuffer(self.data, dtype=np.uint8).reshape(-1, 8)
        return LogBlock(frames, np.array(self.bus, dtype=np.int64), done)
