"""The raw frames of a session, a stretch at a time, and what a format must know beforehand."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..common.arrays import IntArray
from ..common.errors import MissingChannelError
from ..log.messages.frames import (
    DIR_RX,
    ERROR_FLAG,
    EXTENDED_FLAG,
    FD_BRS,
    FD_ESI,
    FD_TOPIC_PREFIX,
    FRAME_TOPIC_PREFIX,
    FRAME_TOPIC_PREFIXES,
    ID_MASK,
    REMOTE_FLAG,
    FrameArray,
    bus_of,
    empty_fd_frames,
    empty_frames,
    holds_fd,
)
from ..log.read.session import SessionView
from .can_import import DIRECTIONS_KEY
from .frame_log import LogBlock

Mask = NDArray[np.bool_]
_FLAGS = ERROR_FLAG | REMOTE_FLAG | EXTENDED_FLAG

_FIELDS: dict[str, Callable[[FrameArray], NDArray[Any]]] = {
    "identifier": lambda frames: frames["id_flags"] & ID_MASK,
    "flags": lambda frames: frames["id_flags"] & _FLAGS,
    "length code": lambda frames: frames["dlc"],
    "data": lambda frames: frames["data"].view("<u8")[:, 0],
    "direction": lambda frames: frames["dir"],
    "time below 1 us": lambda frames: frames["t_host_ns"],
}
"""What is compared of a classic frame: name to one number a frame."""

_FD_FIELDS: dict[str, Callable[[FrameArray], NDArray[Any]]] = {
    **{name: _FIELDS[name] for name in ("identifier", "flags", "direction", "time below 1 us")},
    "length": lambda frames: frames["len"],
    "data": lambda frames: frames["data"],
    "bit rate switch": lambda frames: frames["fd_flags"] & FD_BRS,
    "error state": lambda frames: frames["fd_flags"] & FD_ESI,
}
"""The same of a CAN FD frame."""


def is_error(frames: FrameArray) -> Mask:
    """Which frames are error frames.

    Args:
        frames: Records, shape (n,).

    Returns:
        Shape (n,).
    """
    return (frames["id_flags"] & ERROR_FLAG) != 0


def is_remote(frames: FrameArray) -> Mask:
    """Which frames are remote frames, and no error frames.

    Args:
        frames: Records, shape (n,).

    Returns:
        Shape (n,).
    """
    return ((frames["id_flags"] & REMOTE_FLAG) != 0) & ~is_error(frames)


def without_content(frames: FrameArray, which: Mask) -> None:
    """Leave of some error frames only their times, in place.

    Args:
        frames: Records, shape (n,).
        which: Those frames, shape (n,).
    """
    frames["id_flags"][which] = ERROR_FLAG
    frames["dlc"][which] = 0
    frames["data"][which] = 0
    frames["dir"][which] = DIR_RX


class LossTally:
    """Counts what gets lost on the way from frames to a format."""

    def __init__(self) -> None:
        """Start with nothing lost."""
        self._lost: Counter[tuple[str, str]] = Counter()

    def add(self, frames: FrameArray, kept: FrameArray) -> None:
        """Compare frames with what the format keeps of them.

        Args:
            frames: As the session has them, classic or CAN FD, shape (n,).
            kept: The same as the format has them, shape (n,).
        """
        if holds_fd(frames):
            kinds = {"CAN FD frame": np.ones(len(frames), dtype=np.bool_)}
            fields = _FD_FIELDS
        else:
            error, remote = is_error(frames), is_remote(frames)
            kinds = {"error frame": error, "remote frame": remote, "data frame": ~error & ~remote}
            fields = _FIELDS
        for kind, mask in kinds.items():
            for name, number in fields.items():
                lost = number(frames[mask]) != number(kept[mask])
                self._count(kind, name, lost if lost.ndim == 1 else lost.any(axis=1))
        device, host = frames["t_device_ns"], frames["t_host_ns"]
        self._count("frame", "device time", (device != 0) & (device != host))

    def sentences(self) -> Iterator[str]:
        """What was lost, most important first.

        Yields:
            One sentence a kind of frame and field, e.g. ``3 error frames lose their data``.
        """
        for (kind, name), count in sorted(self._lost.items()):
            yield (
                f"{count} {kind} loses its {name}"
                if count == 1
                else f"{count} {kind}s lose their {name}"
            )

    def _count(self, kind: str, name: str, lost: Mask) -> None:
        if count := int(lost.sum()):
            self._lost[kind, name] += count


_MESSAGES_PER_BLOCK = 200  # of 10 to 100 ms each
_LATEST_NS = 1_000_000_000  # a frame is logged at most this long after its time


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
    """The buses to export.

    Args:
        bus: The one wanted; all if None.

    Raises:
        MissingChannelError: If the session has no raw frames, or no such bus.
    """
    names = sorted(
        {bus_of(topic) for topic in session.channels if topic.startswith(FRAME_TOPIC_PREFIXES)}
    )
    if not names:
        raise MissingChannelError(session.path, "raw CAN frames", sorted(session.channels))
    if bus is not None and bus not in names:
        raise MissingChannelError(session.path, f"bus {bus}", names)
    return [bus] if bus is not None else names


@dataclass(frozen=True)
class _Topic:
    """A topic of frames."""

    name: str
    bus: int
    is_fd: bool

    def frames(self, session: SessionView, start_ns: int | None, stop_ns: int | None) -> FrameArray:
        read = session.fd_frames if self.is_fd else session.frames
        return read(self.name, start_ns=start_ns, stop_ns=stop_ns)


def frame_blocks(
    session: SessionView, buses: Sequence[str], *, fd: bool = True
) -> Iterator[LogBlock]:
    """The frames of some buses, never all in memory.

    Those of one topic, which is one kind of frame of one bus, come in the order they were logged.
    Those of several are sorted by their times; among equal ones classic frames come first, and
    then the order of ``buses`` holds.

    Args:
        fd: Whether CAN FD frames are wanted, too.

    Yields:
        Blocks; the bus of a frame is its index into ``buses``.
    """
    topics = [
        _Topic(prefix + bus, index, prefix == FD_TOPIC_PREFIX)
        for prefix in (FRAME_TOPIC_PREFIXES if fd else (FRAME_TOPIC_PREFIX,))
        for index, bus in enumerate(buses)
        if prefix + bus in session.channels
    ]
    held = [empty_fd_frames(0) if topic.is_fd else empty_frames(0) for topic in topics]
    windows = list(pairwise(_edges(session, [topic.name for topic in topics])))
    for number, (start_ns, stop_ns) in enumerate(windows, start=1):
        found = [topic.frames(session, start_ns, stop_ns) for topic in topics]
        if len(topics) > 1 and stop_ns is not None:
            both = [np.concatenate(pair) for pair in zip(held, found, strict=True)]
            # What comes in the next window may be earlier than these, so they wait for it.
            early = [frames["t_host_ns"] < stop_ns - _LATEST_NS for frames in both]
            found = [frames[ready] for frames, ready in zip(both, early, strict=True)]
            held = [frames[~ready] for frames, ready in zip(both, early, strict=True)]
        else:
            found = [np.concatenate(pair) for pair in zip(held, found, strict=True)]
        block = _block(topics, found, number / len(windows))
        if len(block):
            yield block


def _block(topics: Sequence[_Topic], found: Sequence[FrameArray], done: float) -> LogBlock:
    """One block of frames of several topics, by their times; of one topic in their order."""
    parts: list[tuple[FrameArray, IntArray]] = []
    for is_fd in (False, True):
        own = [(t, frames) for t, frames in zip(topics, found, strict=True) if t.is_fd == is_fd]
        empty = empty_fd_frames(0) if is_fd else empty_frames(0)
        bus = np.repeat([topic.bus for topic, _ in own], [len(frames) for _, frames in own])
        parts.append((np.concatenate([empty, *(frames for _, frames in own)]), bus.astype(int)))
    (frames, bus), (fd_frames, fd_bus) = parts
    is_fd = np.repeat([False, True], [len(frames), len(fd_frames)])
    if len(topics) > 1:
        order = np.argsort(
            np.concatenate([frames["t_host_ns"], fd_frames["t_host_ns"]]), kind="stable"
        )
        is_fd = order >= len(frames)
        by_time, fd_by_time = order[~is_fd], order[is_fd] - len(frames)
        frames, bus = frames[by_time], bus[by_time]
        fd_frames, fd_bus = fd_frames[fd_by_time], fd_bus[fd_by_time]
    return LogBlock(frames, bus, done, fd_frames, fd_bus, is_fd if len(fd_frames) else None)


def frame_facts(session: SessionView, buses: Sequence[str]) -> FrameFacts:
    """Look once over all frames."""
    counts, fd_counts = np.zeros((2, len(buses)), dtype=np.int64)
    times: list[int] = []
    nanoseconds = False
    for block in frame_blocks(session, buses):
        t_ns = block.times_ns()
        counts += np.bincount(block.bus, minlength=len(buses))
        fd_counts += np.bincount(block.fd_bus, minlength=len(buses))
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
    """Borders of the windows of log times; open at both ends."""
    messages = sum(session.channels[topic].count for topic in topics)
    count = max(1, -(-messages // _MESSAGES_PER_BLOCK))
    span = session.end_ns - session.start_ns
    inner = [session.start_ns + span * k // count for k in range(1, count)]
    return [None, *sorted(set(inner)), None]
