"""What a source is: something that is asked, many times a second, for what has come since.

A source is found by the scheme of its address (``can:socketcan:can0``, ``unix:/run/snake.sock``,
``twin:flat``) among the entry points of the group :data:`ENTRY_POINTS`; each names a function that
takes a :class:`SourceAddress` and gives a :class:`Source`. All methods are called from the
recorder's one thread, and none may block: whatever has to wait (a connect, a device that only
offers a blocking read) waits in a thread of the source's own.

Frames packed one by one: for a few dozen at a time, cheaper than numpy's columns.

What a packet to a ``unix:`` source looks like.

::

    [sequence:u64 dropped:u64]   optional head, 16 bytes, little-endian
    record[0..256]               32 bytes each: capture.log.frames.FRAME_DTYPE

``sequence`` is the running number of the packet's first frame among all that the sender had, from
0 at the connection's start; ``dropped`` how many of them it could not send. A head alone is a valid
packet: it tells of frames dropped after the last one sent. Whether there is a head is told by the
size.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Protocol, runtime_checkable

import numpy as np

from ..log.messages.frames import FD_FRAME_DTYPE, FRAME_DTYPE, FrameArray, frames_from_bytes
from ..robot.model import ClockDomain, Robot

if TYPE_CHECKING:
    from ..log.write.writer import SessionWriter


RECORD_SIZE = FRAME_DTYPE.itemsize
"""Bytes of one frame."""
MOST_RECORDS = 256
"""Frames in one packet at most."""
HEAD = struct.Struct("<QQ")
"""Head: sequence, dropped."""
LONGEST = HEAD.size + MOST_RECORDS * RECORD_SIZE
"""Bytes of the longest packet."""


pack_record = struct.Struct("<QQIBB2x8s").pack
"""Packs ``t_device_ns, t_host_ns, id_flags, dlc, dir, data`` as
:data:`.capture.log.messages.frames.FRAME_DTYPE` has them; data is filled with zeros."""

pack_fd_record = struct.Struct("<QQIBBBx64s").pack
"""Packs ``t_device_ns, t_host_ns, id_flags, len, dir, fd_flags, data`` as
:data:`.capture.log.messages.frames.FD_FRAME_DTYPE` has them; data is filled with zeros."""


def records(packed: Iterable[bytes]) -> FrameArray:
    """Put packed records together.

    Args:
        packed: What :data:`pack_record` gave.

    Returns:
        Shape (n,), writeable.
    """
    return frames_from_bytes(memoryview(bytearray().join(packed)))


def fd_records(packed: Iterable[bytes]) -> FrameArray:
    """Put packed records of CAN FD frames together.

    Args:
        packed: What :data:`pack_fd_record` gave.

    Returns:
        Shape (n,), writeable.
    """
    return np.frombuffer(bytearray().join(packed), dtype=FD_FRAME_DTYPE)


ENTRY_POINTS = "undulog.sources"
"""Entry point group: the name is the scheme, the object opens a source."""

DEVICE_TIMES_END_NS = 1 << 62
"""Device times lie below this [ns], 146 years. A frame with another one is kept and decoded, at an
estimated time, and counts as malformed."""


@dataclass(frozen=True)
class SourceAddress:
    """A source as the command line names it: ``[NAME=]SCHEME:REST[?KEY=VALUE&...]``.

    Attributes:
        text: As it was given, for messages.
        name: What the session calls the source, e.g. the bus ``can0`` of ``/can/can0``.
        scheme: Which kind of source, e.g. ``can``.
        rest: What follows the scheme, without the options.
        options: The options, e.g. ``{"bitrate": "1000000"}``.
    """

    text: str
    name: str
    scheme: str
    rest: str
    options: Mapping[str, str]


@dataclass(frozen=True)
class SourceEvent:
    """Something that happened to a source: it goes to ``/rosout``.

    Attributes:
        t_ns: When [ns], on the session's clock.
        level: ``info``, ``warn`` or ``error``.
    """

    t_ns: int
    level: str
    text: str


@dataclass(frozen=True)
class Polled:
    """What came since the last poll.

    Attributes:
        frames: Arrays of records of :data:`.FRAME_DTYPE`, in the order they
            came. ``t_host_ns`` is the arrival on the session's clock, ``t_device_ns`` the device's
            own time, on the device's own clock and below :data:`DEVICE_TIMES_END_NS`, or equal to
            ``t_host_ns`` where it gives none.
        fd_frames: The same of CAN FD frames: records of :data:`.FD_FRAME_DTYPE`.
    """

    frames: tuple[FrameArray, ...] = ()
    events: tuple[SourceEvent, ...] = ()
    fd_frames: tuple[FrameArray, ...] = ()


@dataclass
class SourceCounts:
    """What became of a source's frames, since the start.

    Attributes:
        dropped: Frames that the source's own sequence numbers or counters prove lost before us;
            None where the source has no such thing.
        malformed: Packets or lines that could not be read, frames with impossible device times.
        error_frames: Frames that report a bus error.
        reconnects: How often the connection came back.
    """

    frames: int = 0
    dropped: int | None = None
    malformed: int = 0
    error_frames: int = 0
    reconnects: int = 0


@dataclass(frozen=True)
class SourceContext:
    """What a recording gives its sources.

    Attributes:
        now_ns: The session's clock: Unix time at the start plus monotonic time since [ns].
        writer: The session, for a source that has channels of its own (the twin); frames are
            written by the recorder.
        facts: Wishes for a twin: ``fast`` (``true``: as fast as it can), ``duration_s``.
    """

    now_ns: Callable[[], int]
    writer: SessionWriter
    facts: Mapping[str, str] = field(default_factory=dict[str, str])


class Source(Protocol):
    """A source of a recording."""

    @property
    def name(self) -> str:
        """What the session calls it."""
        ...

    @property
    def clock(self) -> ClockDomain:
        """Whose clock ``t_device_ns`` is on."""
        ...

    @property
    def robot(self) -> Robot | None:
        """The robot that it brings, or None."""
        ...

    @property
    def directions(self) -> bool:
        """Whether its frames tell those that the robot's computer sent from those it received.

        A node that only listens can't tell: to it, all frames are received.
        """
        ...

    @property
    def facts(self) -> Mapping[str, str]:
        """What the session's metadata should say of it, e.g. the bitrate; no secrets."""
        ...

    @property
    def counts(self) -> SourceCounts:
        """What became of its frames so far."""
        ...

    @property
    def connected(self) -> bool:
        """Whether data can come at the moment."""
        ...

    @property
    def finished(self) -> bool:
        """Whether nothing will come any more (a scenario that has ended)."""
        ...

    def start(self, context: SourceContext) -> None:
        """Begin: connect, or begin to try.

        Raises:
            SourceError: If it can never work: no such device type, a path that is not ours.
        """
        ...

    def poll(self) -> Polled:
        """Take what has come; returns at once."""
        ...

    def stop(self) -> None:
        """End and release everything; safe to call twice. Never raises for a dead device."""
        ...


@runtime_checkable
class EndingSource(Protocol):
    """A source that can end at an instant, so that its senders know what was accepted."""

    def end(self) -> None:
        """Accept nothing more. What was accepted comes with the next polls; then it is finished."""
        ...
