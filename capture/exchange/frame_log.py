"""CAN frames as a stream of blocks, independent of a format: of a foreign log, and of a session."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import islice, pairwise
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ..common.arrays import BoolArray, IntArray
from ..common.errors import MissingChannelError
from ..log.messages import frames as wire
from ..log.messages.frames import (
    FrameArray,
    bus_of,
    empty_fd_frames,
    empty_frames,
    holds_fd,
    widened,
)

if TYPE_CHECKING:
    from ..log.read.session_view import SessionView

RELATIVE_EPOCH_NS = 946_684_800_000_000_000
"""Start of a log without a date: 2000-01-01T00:00:00Z [Unix ns]."""

EARLIEST_NS = 100_000_000_000_000_000
"""A smaller time counts from the start of the log and has no date [ns]: 1973."""

LATEST_NS = 2**31 * 1_000_000_000
"""End of the times that the stamp of a message can hold [Unix ns]: 2038."""

FRAMES_PER_BLOCK = 65_536
"""Frames of a block; only one block of a log is in memory at a time."""

DIRECTIONS_KEY = "import.directions"
"""Metadata key: ``recorded``, or ``none`` for a log without directions."""

_MESSAGES_PER_BLOCK = 200  # of 10 to 100 ms each
_LATEST_NS = 1_000_000_000  # a frame is logged at most this long after its time


class FrameRow(NamedTuple):
    """One frame of a log.

    Attributes:
        t_ns: Time [Unix ns].
        length: The DLC of a classic frame, the number of data bytes of a CAN FD frame.
        bus: Index into :attr:`FrameLog.buses`.
        fd_flags: ``FD_BRS`` and ``FD_ESI``; 0 for a classic frame.
        data: At most 8 bytes, of a CAN FD frame 64.
    """

    t_ns: int
    id_flags: int
    length: int
    way: int
    bus: int
    is_fd: bool
    fd_flags: int
    data: bytes


@dataclass(frozen=True)
class LogBlock:
    """A part of a log, in the order of the log.

    Attributes:
        frames: Records of :data:`.capture.log.messages.frames.FD_FRAME_DTYPE`, shape (n,); ``len``
            of a classic frame is its DLC. An imported frame has a host time only, its device time
            is 0.
        bus: Index into the log's list of buses, shape (n,).
        is_fd: Whether a frame is a CAN FD frame, shape (n,).
        done: Share of the log's file that has been read, 0 to 1.
    """

    frames: FrameArray
    bus: IntArray
    is_fd: BoolArray
    done: float = 0.0

    def __len__(self) -> int:
        """Return the number of frames."""
        return len(self.frames)

    def __getitem__(self, rows: slice | IntArray | BoolArray) -> LogBlock:
        """Return some of the frames."""
        return LogBlock(self.frames[rows], self.bus[rows], self.is_fd[rows], self.done)

    def times_ns(self) -> IntArray:
        """Return the time of each frame [Unix ns], shape (n,)."""
        return self.frames["t_host_ns"].astype(np.int64)

    def classic(self) -> FrameArray:
        """Return the classic frames as records of FRAME_DTYPE."""
        wide = self.frames[~self.is_fd]
        frames = empty_frames(len(wide))
        for name in ("t_device_ns", "t_host_ns", "id_flags", "dir"):
            frames[name] = wide[name]
        frames["dlc"], frames["data"] = wide["len"], wide["data"][:, :8]
        return frames

    def to_decode(self) -> FrameArray:
        """Return all frames in one array, of records of FRAME_DTYPE if no frame is CAN FD."""
        if not self.is_fd.any():
            return self.classic()
        frames = self.frames.copy()
        frames["len"] = np.minimum(frames["len"], np.where(self.is_fd, 64, 8))
        return frames

    def rows(self) -> Iterator[FrameRow]:
        """Yield the frames one by one; the inverse of :func:`blocks_of`."""
        data = self.frames["data"].tobytes()
        t_ns, id_flags, length, way, fd_flags = (
            self.frames[name].tolist()
            for name in ("t_host_ns", "id_flags", "len", "dir", "fd_flags")
        )
        columns = (t_ns, id_flags, length, way, self.bus.tolist(), self.is_fd.tolist(), fd_flags)
        for i, row in enumerate(zip(*columns, strict=True)):
            most = min(row[2], 64 if row[5] else 8)
            yield FrameRow._make((*row, data[64 * i : 64 * i + most]))


def joined(blocks: Sequence[LogBlock]) -> LogBlock:
    """Join blocks, at least one, into one block."""
    return LogBlock(
        np.concatenate([block.frames for block in blocks]),
        np.concatenate([block.bus for block in blocks]),
        np.concatenate([block.is_fd for block in blocks]),
    )


def block_of(frames: FrameArray, bus: int) -> LogBlock:
    """Return the frames of one topic, classic or CAN FD, as a block of one bus."""
    is_fd = holds_fd(frames)
    wide = widened(frames)
    if not is_fd:
        wide["len"] = frames["dlc"]
    count = len(frames)
    return LogBlock(wide, np.full(count, bus, dtype=np.int64), np.full(count, is_fd))


def blocks_of(rows: Iterable[FrameRow], done: Callable[[], float]) -> Iterator[LogBlock]:
    """Collect frames into blocks of :data:`FRAMES_PER_BLOCK`.

    Args:
        done: Share of the log's file that has been read, 0 to 1.
    """
    remaining = iter(rows)
    while batch := list(islice(remaining, FRAMES_PER_BLOCK)):
        t_ns, id_flags, length, way, bus, is_fd, fd_flags, data = zip(*batch, strict=True)
        frames = empty_fd_frames(len(batch))
        frames["t_host_ns"], frames["id_flags"], frames["len"] = t_ns, id_flags, length
        frames["dir"], frames["fd_flags"] = way, fd_flags
        padded = b"".join(payload.ljust(64, b"\0") for payload in data)
        frames["data"] = np.frombuffer(padded, np.uint8).reshape(-1, 64)
        share = done() if len(batch) == FRAMES_PER_BLOCK else 1.0
        yield LogBlock(frames, np.array(bus), np.array(is_fd), share)


@dataclass
class FrameLog:
    """A log of CAN frames.

    Attributes:
        blocks: The blocks; each can be taken once.
        buses: Names of the buses seen so far, in order of appearance.
        directions: Whether the frames' directions were recorded; without, all count as received.
        time: Meaning of the times, for the session's metadata.
        problems: Facts that could not be kept, one sentence each; grows while blocks are taken.
        read: Number of characters of a text that have been read.
    """

    blocks: Iterator[LogBlock]
    buses: list[str]
    directions: bool
    time: str
    problems: list[str] = field(default_factory=list[str])
    read: int = 0

    def epoch_ns(self, first_ns: float, precision: str) -> int:
        """Return the offset to Unix times [ns]; describe the times of a log without a date."""
        if first_ns >= EARLIEST_NS:
            return 0
        self.time = f"counted from the log's start, put at 2000-01-01T00:00:00Z; {precision}"
        return RELATIVE_EPOCH_NS

    def bus_index(self, name: str) -> int:
        """Return the index of a bus, which is added if it is new."""
        if name not in self.buses:
            self.buses.append(name)
        return self.buses.index(name)


def is_error(frames: FrameArray) -> BoolArray:
    """Return which frames are error frames, shape (n,)."""
    return (frames["id_flags"] & wire.ERROR_FLAG) != 0


def is_remote(frames: FrameArray) -> BoolArray:
    """Return which frames are remote frames and not error frames, shape (n,)."""
    return ((frames["id_flags"] & wire.REMOTE_FLAG) != 0) & ~is_error(frames)


def possible(block: LogBlock) -> FrameArray:
    """Copy frames, remote ones without data, CAN FD ones with 64 bytes and never remote."""
    frames, is_fd = block.frames.copy(), block.is_fd
    frames["id_flags"][is_fd] &= ~np.uint32(wire.REMOTE_FLAG)
    frames["len"][is_fd] = np.minimum(frames["len"][is_fd], 64)
    frames["data"][is_remote(frames)] = 0
    return frames


def shorten(frames: FrameArray, which: BoolArray) -> None:
    """Limit the length code of some frames to 8, in place."""
    frames["len"][which] = np.minimum(frames["len"][which], 8)


@dataclass(frozen=True)
class FrameFacts:
    """What is known of a session's frames before any is written.

    Attributes:
        counts: Bus to number of classic frames, in the order of the bus indices.
        directions: Whether the frames' directions were recorded.
        start_ns: Earliest time of a frame [Unix ns]; 0 where there is none.
        end_ns: Latest time of a frame [Unix ns]; 0 where there is none.
        nanoseconds: Whether a time isn't a whole microsecond.
        fd_counts: Bus to number of CAN FD frames.
    """

    session_id: str
    counts: Mapping[str, int]
    directions: bool
    start_ns: int
    end_ns: int
    nanoseconds: bool
    fd_counts: Mapping[str, int] = field(default_factory=dict[str, int])

    @property
    def buses(self) -> list[str]:
        """Names of the buses."""
        return list(self.counts)


def chosen_buses(session: SessionView, bus: str | None) -> list[str]:
    """Return the buses to export: one, or all if ``bus`` is None.

    Raises:
        MissingChannelError: If the session has no raw frames, or no such bus.
    """
    names = sorted(
        {bus_of(topic) for topic in session.channels if topic.startswith(wire.FRAME_TOPIC_PREFIXES)}
    )
    if not names:
        raise MissingChannelError(session.path, "raw CAN frames", sorted(session.channels))
    if bus is not None and bus not in names:
        raise MissingChannelError(session.path, f"bus {bus}", names)
    return [bus] if bus is not None else names


def frame_blocks(
    session: SessionView, buses: Sequence[str], *, fd: bool = True
) -> Iterator[LogBlock]:
    """Read the frames of some buses, a window of log times at a time.

    The frames of one topic, which is one kind of frame of one bus, come in the order they were
    logged. Those of several are sorted by their times; among equal ones classic frames come first,
    and then the order of ``buses`` holds.

    Args:
        fd: Whether to read CAN FD frames, too.

    Yields:
        Blocks; the bus of a frame is its index into ``buses``.
    """
    topics = [
        (
            prefix + bus,
            index,
            session.fd_frames if prefix == wire.FD_TOPIC_PREFIX else session.frames,
        )
        for prefix in (wire.FRAME_TOPIC_PREFIXES if fd else (wire.FRAME_TOPIC_PREFIX,))
        for index, bus in enumerate(buses)
        if prefix + bus in session.channels
    ]
    held = block_of(empty_fd_frames(0), 0)
    windows = list(pairwise(_edges(session, [topic for topic, _, _ in topics])))
    for number, (start_ns, stop_ns) in enumerate(windows, start=1):
        blocks = [
            block_of(read(topic, start_ns=start_ns, stop_ns=stop_ns), bus)
            for topic, bus, read in topics
        ]
        block = joined([held, *blocks])
        if len(topics) > 1:
            block = block[np.lexsort((block.bus, block.is_fd, block.times_ns()))]
            if stop_ns is not None:
                # Frames of the next window may be earlier than these, so they wait for it.
                ready = int(np.searchsorted(block.times_ns(), stop_ns - _LATEST_NS))
                block, held = block[:ready], block[ready:]
        if len(block):
            yield replace(block, done=number / len(windows))


def frame_facts(session: SessionView, buses: Sequence[str]) -> FrameFacts:
    """Look once over all frames."""
    counts, fd_counts = np.zeros((2, len(buses)), dtype=np.int64)
    times: list[int] = []
    nanoseconds = False
    for block in frame_blocks(session, buses):
        t_ns = block.times_ns()
        counts += np.bincount(block.bus[~block.is_fd], minlength=len(buses))
        fd_counts += np.bincount(block.bus[block.is_fd], minlength=len(buses))
        times += [int(t_ns.min()), int(t_ns.max())]
        nanoseconds |= bool((t_ns % 1000).any())
    facts = session.metadata.get("undulog", {})
    return FrameFacts(
        session_id=session.session_id,
        counts=dict(zip(buses, counts.tolist(), strict=True)),
        directions=facts.get(DIRECTIONS_KEY, "recorded") == "recorded",
        start_ns=min(times, default=0),
        end_ns=max(times, default=0),
        nanoseconds=nanoseconds,
        fd_counts=dict(zip(buses, fd_counts.tolist(), strict=True)),
    )


def _edges(session: SessionView, topics: Sequence[str]) -> list[int | None]:
    """Return borders of the windows of log times; open at both ends."""
    messages = sum(session.channels[topic].count for topic in topics)
    count = max(1, -(-messages // _MESSAGES_PER_BLOCK))
    span = session.end_ns - session.start_ns
    inner = [session.start_ns + span * k // count for k in range(1, count)]
    return [None, *sorted(set(inner)), None]
