"""The raw frames of a session, a stretch at a time, and what a format must know beforehand."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..common.arrays import BoolArray
from ..common.errors import MissingChannelError
from ..log.messages.frames import (
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
)
from ..log.read.session_view import SessionView
from .can_import import DIRECTIONS_KEY
from .frame_log import LogBlock, block_of, joined

_FLAGS = ERROR_FLAG | REMOTE_FLAG | EXTENDED_FLAG

_FIELDS: dict[str, Callable[[FrameArray], NDArray[Any]]] = {
    "identifier": lambda frames: frames["id_flags"] & ID_MASK,
    "flags": lambda frames: frames["id_flags"] & _FLAGS,
    "length code": lambda frames: frames["len"],
    "data": lambda frames: frames["data"],
    "direction": lambda frames: frames["dir"],
    "time below 1 us": lambda frames: frames["t_host_ns"],
    "bit rate switch": lambda frames: frames["fd_flags"] & FD_BRS,
    "error state": lambda frames: frames["fd_flags"] & FD_ESI,
}
"""Field of a frame that a format may lose to its values, one row a frame."""

_FD_NAMES = {"length code": "length"}
"""Names that differ for CAN FD frames."""


def is_error(frames: FrameArray) -> BoolArray:
    """Return which frames are error frames, shape (n,)."""
    return (frames["id_flags"] & ERROR_FLAG) != 0


def is_remote(frames: FrameArray) -> BoolArray:
    """Return which frames are remote frames and not error frames, shape (n,)."""
    return ((frames["id_flags"] & REMOTE_FLAG) != 0) & ~is_error(frames)


class LossTally:
    """Count of the facts that are lost from a session to a format."""

    def __init__(self) -> None:
        """Start with nothing lost."""
        self._lost: Counter[tuple[str, str]] = Counter()

    def add(self, block: LogBlock, kept: FrameArray) -> None:
        """Compare frames with those that the format keeps, of the same shape."""
        frames, classic = block.frames, ~block.is_fd
        error, remote = is_error(frames), is_remote(frames)
        kinds = {
            "CAN FD frame": block.is_fd,
            "error frame": classic & error,
            "remote frame": classic & remote,
            "data frame": classic & ~error & ~remote,
        }
        for name, values in _FIELDS.items():
            lost = values(frames) != values(kept)
            lost = lost if lost.ndim == 1 else lost.any(axis=1)
            for kind, mask in kinds.items():
                shown = _FD_NAMES.get(name, name) if kind == "CAN FD frame" else name
                self._lost[kind, shown] += int(np.count_nonzero(lost & mask))
        device, host = frames["t_device_ns"], frames["t_host_ns"]
        no_host = (device != 0) & (device != host)
        self._lost["frame", "device time"] += int(np.count_nonzero(no_host))

    def sentences(self) -> list[str]:
        """Return a sentence for each kind of frame and field that lost something."""
        return [
            f"{count} {kind} loses its {name}"
            if count == 1
            else f"{count} {kind}s lose their {name}"
            for (kind, name), count in sorted(self._lost.items())
            if count
        ]


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
    """Return the buses to export: one, or all if ``bus`` is None.

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
        (prefix + bus, index, session.fd_frames if prefix == FD_TOPIC_PREFIX else session.frames)
        for prefix in (FRAME_TOPIC_PREFIXES if fd else (FRAME_TOPIC_PREFIX,))
        for index, bus in enumerate(buses)
        if prefix + bus in session.channels
    ]
    held = block_of(empty_fd_frames(0), 0)
    windows = list(pairwise(_edges(session, [topic for topic, _, _ in topics])))
    for number, (start_ns, stop_ns) in enumerate(windows, start=1):
        found = [
            block_of(read(topic, start_ns=start_ns, stop_ns=stop_ns), bus)
            for topic, bus, read in topics
        ]
        block = joined([held, *found])
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
