"""The raw frames of a session, a stretch at a time, and what a format must know beforehand."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from ..bus.frame_log import LogBlock
from ..errors import MissingChannelError
from ..log.frames import FrameArray, empty_frames
from ..log.session import Session
from .can_import import DIRECTIONS_KEY, FRAME_TOPIC_PREFIX

_MESSAGES_PER_BLOCK = 200  # of 10 to 100 ms each
_LATEST_NS = 1_000_000_000  # a frame is logged at most this long after its time


@dataclass(frozen=True)
class FrameFacts:
    """What is known of a session's frames before any is written.

    Attributes:
        session_id: Of the session.
        counts: Bus to number of frames, in the order of the bus indices.
        directions: Whether the frames' directions were recorded.
        start_ns: Earliest time of a frame [Unix ns]; 0 where there is none.
        end_ns: Latest time of a frame [Unix ns]; 0 where there is none.
        nanoseconds: Whether a time isn't a whole microsecond.
    """

    session_id: str
    counts: Mapping[str, int]
    directions: bool
    start_ns: int
    end_ns: int
    nanoseconds: bool

    @property
    def buses(self) -> list[str]:
        """Names of the buses."""
        return list(self.counts)


def chosen_buses(session: Session, bus: str | None) -> list[str]:
    """The buses to export.

    Args:
        session: The session.
        bus: The one wanted; all if None.

    Returns:
        Their names.

    Raises:
        MissingChannelError: If the session has no raw frames, or no such bus.
    """
    names = [
        topic.removeprefix(FRAME_TOPIC_PREFIX)
        for topic in sorted(session.channels)
        if topic.startswith(FRAME_TOPIC_PREFIX)
    ]
    if not names:
        raise MissingChannelError(session.path, "raw CAN frames", sorted(session.channels))
    if bus is not None and bus not in names:
        raise MissingChannelError(session.path, f"bus {bus}", names)
    return [bus] if bus is not None else names


def frame_blocks(session: Session, buses: Sequence[str]) -> Iterator[LogBlock]:
    """The frames of some buses, never all in memory.

    Those of one bus come in the order they were logged. Those of several are sorted by their
    times, with the order of ``buses`` among equal ones.

    Args:
        session: The session.
        buses: Names of the buses.

    Yields:
        Blocks; the bus of a frame is its index into ``buses``.
    """
    held: list[FrameArray] = [empty_frames(0) for _ in buses]
    windows = list(pairwise(_edges(session, buses)))
    for number, (start_ns, stop_ns) in enumerate(windows, start=1):
        found = [
            session.frames(FRAME_TOPIC_PREFIX + bus, start_ns=start_ns, stop_ns=stop_ns)
            for bus in buses
        ]
        if len(buses) > 1 and stop_ns is not None:
            both = [np.concatenate(pair) for pair in zip(held, found, strict=True)]
            # What comes in the next window may be earlier than these, so they wait for it.
            early = [frames["t_host_ns"] < stop_ns - _LATEST_NS for frames in both]
            found = [frames[ready] for frames, ready in zip(both, early, strict=True)]
            held = [frames[~ready] for frames, ready in zip(both, early, strict=True)]
        else:
            found = [np.concatenate(pair) for pair in zip(held, found, strict=True)]
        frames = np.concatenate(found)
        bus = np.repeat(np.arange(len(buses)), [len(part) for part in found])
        if len(buses) > 1:
            order = np.argsort(frames["t_host_ns"], kind="stable")
            frames, bus = frames[order], bus[order]
        if len(frames):
            yield LogBlock(frames, bus, number / len(windows))


def frame_facts(session: Session, buses: Sequence[str]) -> FrameFacts:
    """Look once over all frames.

    Args:
        session: The session.
        buses: Names of the buses.

    Returns:
        The facts.
    """
    counts = np.zeros(len(buses), dtype=np.int64)
    times: list[int] = []
    nanoseconds = False
    for block in frame_blocks(session, buses):
        t_ns = block.frames["t_host_ns"]
        counts += np.bincount(block.bus, minlength=len(buses))
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
    )


def _edges(session: Session, buses: Sequence[str]) -> list[int | None]:
    """Borders of the windows of log times; open at both ends."""
    messages = sum(session.channels[FRAME_TOPIC_PREFIX + bus].count for bus in buses)
    count = max(1, -(-messages // _MESSAGES_PER_BLOCK))
    span = session.end_ns - session.start_ns
    inner = [session.start_ns + span * k // count for k in range(1, count)]
    return [None, *sorted(set(inner)), None]
