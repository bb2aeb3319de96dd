"""The contract of a source, and its address: ``[NAME=]SCHEME:REST[?KEY=VALUE&...]``.

A source is found by the scheme of its address (``can:socketcan:can0``, ``unix:/run/snake.sock``,
``twin:flat``) among the entry points of the group :data:`ENTRY_POINTS`; each names a function that
takes a :class:`SourceAddress` and returns a :class:`Source`. All methods are called from the
recorder's one thread, and none may block: calls that wait (a connect, a device with a blocking read
only) belong into a thread of the source's own.

A packet to a ``unix:`` source::

    [sequence:u64 dropped:u64]   optional head, 16 bytes, little-endian
    record[0..256]               32 bytes each: capture.log.frames.FRAME_DTYPE

``sequence`` is the running number of the packet's first frame among all frames of the sender, from
0 at the connection's start; ``dropped`` is the number of those that it could not send. A head alone
is a valid packet: it reports frames dropped after the last packet. The size shows whether there is
a head.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from importlib.metadata import EntryPoint, entry_points
from pathlib import PurePosixPath
from typing import TYPE_CHECKING, Protocol, cast, runtime_checkable

import numpy as np

from ..common.errors import MissingExtraError, SourceError, UndulogError, UsageError
from ..common.extras import extra_of, missing_package
from ..common.strict_table import listed
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

ENTRY_POINTS = "undulog.sources"
"""Entry point group: the name is the scheme, the object opens a source."""

DEVICE_TIMES_END_NS = 1 << 62
"""Device times lie below this [ns], 146 years. A frame with another one is kept and decoded, at an
estimated time, and counts as malformed."""

_YES = {"1", "true", "yes", "on"}
_NO = {"0", "false", "no", "off"}

FORM = "[NAME=]SCHEME:REST[?KEY=VALUE&...]"
"""Form of an address, for messages."""

_EXAMPLES = "can:socketcan:can0, can:slcan:/dev/ttyACM0?bitrate=1000000, unix:/run/snake.sock"
_NAME = re.compile(r"[a-zA-Z][a-zA-Z0-9_]*")
_VALID_NAME = "a letter, then letters, digits and underscores, e.g. can0 or left_arm"
_PREFIX = re.compile(r"([^:?=]*)=(.*)", re.DOTALL)


def records(packed: Iterable[bytes]) -> FrameArray:
    """Join records of :data:`pack_record` into a writeable array, shape (n,).

    For a few dozen frames this is faster than filling numpy's columns.
    """
    return frames_from_bytes(memoryview(bytearray().join(packed)))


def fd_records(packed: Iterable[bytes]) -> FrameArray:
    """Join records of :data:`pack_fd_record` into a writeable array, shape (n,)."""
    return np.frombuffer(bytearray().join(packed), dtype=FD_FRAME_DTYPE)


@dataclass(frozen=True)
class SourceAddress:
    """A source as the command line names it: ``[NAME=]SCHEME:REST[?KEY=VALUE&...]``.

    Attributes:
        text: The whole address, for messages.
        name: Name of the source in the session, e.g. ``can0`` of ``/can/can0``.
        scheme: Kind of source, e.g. ``can``.
        rest: The part between scheme and options.
        options: The options, e.g. ``{"bitrate": "1000000"}``.
    """

    text: str
    name: str
    scheme: str
    rest: str
    options: Mapping[str, str]


@dataclass(frozen=True)
class SourceEvent:
    """An event of a source, for ``/rosout``.

    Attributes:
        t_ns: Time on the session's clock [ns].
        level: ``info``, ``warn`` or ``error``.
    """

    t_ns: int
    level: str
    text: str


@dataclass(frozen=True)
class Polled:
    """Frames and events since the last poll.

    Attributes:
        frames: Arrays of records of :data:`.FRAME_DTYPE`, in the order of arrival. ``t_host_ns`` is
            the arrival on the session's clock, ``t_device_ns`` the time on the device's own clock,
            below :data:`DEVICE_TIMES_END_NS`, or equal to ``t_host_ns`` without one.
        fd_frames: The same for CAN FD frames: records of :data:`.FD_FRAME_DTYPE`.
    """

    frames: tuple[FrameArray, ...] = ()
    events: tuple[SourceEvent, ...] = ()
    fd_frames: tuple[FrameArray, ...] = ()


@dataclass
class SourceCounts:
    """Counts of a source's frames since the start.

    Attributes:
        dropped: Frames lost before the recorder, by the source's own sequence numbers or counters;
            None without these.
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
    """Context of a recording for its sources.

    Attributes:
        now_ns: The session's clock: Unix time at the start plus monotonic time since [ns].
        writer: The session, for a source that has channels of its own (the twin); frames are
            written by the recorder.
        facts: Settings of a twin: ``fast`` (``true``: as fast as it can), ``duration_s``.
    """

    now_ns: Callable[[], int]
    writer: SessionWriter
    facts: Mapping[str, str] = field(default_factory=dict[str, str])


class Source(Protocol):
    """A source of a recording."""

    @property
    def name(self) -> str:
        """Its name in the session."""
        ...

    @property
    def clock(self) -> ClockDomain:
        """Clock of ``t_device_ns``."""
        ...

    @property
    def robot(self) -> Robot | None:
        """The robot that it defines, or None."""
        ...

    @property
    def directions(self) -> bool:
        """Whether its frames distinguish those that the robot's computer sent from received ones.

        To a node that only listens, all frames are received.
        """
        ...

    @property
    def facts(self) -> Mapping[str, str]:
        """Facts for the session's metadata, e.g. the bitrate; no secrets."""
        ...

    @property
    def counts(self) -> SourceCounts:
        """Counts of its frames so far."""
        ...

    @property
    def connected(self) -> bool:
        """Whether data can arrive at present."""
        ...

    @property
    def finished(self) -> bool:
        """Whether no more data will come (a scenario that has ended)."""
        ...

    def start(self, context: SourceContext) -> None:
        """Connect, or begin to try.

        Raises:
            SourceError: If it can never work: no such device type, a path of another user.
        """

    def poll(self) -> Polled:
        """Return new frames and events, without waiting."""
        ...

    def stop(self) -> None:
        """End and release everything, also a dead device; safe to call twice."""


@runtime_checkable
class ConnectedSource(Protocol):
    """A source over a connection that may break; it is tried again."""

    @property
    def lost(self) -> bool:
        """Whether the connection broke, and has not come back."""
        ...


@runtime_checkable
class EndingSource(Protocol):
    """A source that can end at an instant: its senders get an error from then on."""

    def end(self) -> None:
        """Accept no more frames. Those accepted come with the next polls; then it is finished."""


def only(address: SourceAddress, valid: Iterable[str]) -> None:
    """Check that an address has valid options only.

    Raises:
        UsageError: If it has another one; lists the valid ones.
    """
    names = sorted(valid)
    for key in address.options:
        if key not in names:
            raise UsageError(f"{address.text!r}: no option {key!r}; valid: {listed(names, key)}")


def number(address: SourceAddress, key: str, default: int) -> int:
    """Return an option that is a whole number, at least 0.

    Raises:
        UsageError: If it has another value.
    """
    value = address.options.get(key)
    if value is None:
        return default
    if not (value.isascii() and value.isdigit()):
        raise UsageError(f"{address.text!r}: {key}={value} is not a whole number")
    return int(value)


def flag(address: SourceAddress, key: str, *, default: bool) -> bool:
    """Return an option that is 1, true, yes or on, or 0, false, no or off.

    Raises:
        UsageError: If it has another value.
    """
    value = address.options.get(key)
    if value is None:
        return default
    if value.lower() not in _YES | _NO:
        raise UsageError(f"{address.text!r}: {key}={value} is neither 1 nor 0")
    return value.lower() in _YES


def parse_address(text: str) -> SourceAddress:
    """Parse an address such as ``front=can:slcan:/dev/ttyACM0?bitrate=500000``.

    The default name is the last part of a CAN channel, the file of a socket, or the scenario.

    Raises:
        UsageError: If it isn't of that form, or the name can't be part of a topic.
    """
    named = _PREFIX.fullmatch(text)
    name, address = named.groups() if named else (None, text)
    place, _, query = address.partition("?")
    scheme, colon, rest = place.partition(":")
    if not colon or not scheme or not rest:
        raise UsageError(f"{text!r} is no source: expected {FORM}, e.g. {_EXAMPLES}")
    if name is None:
        name = _default_name(scheme, rest)
    elif not _NAME.fullmatch(name):
        raise UsageError(
            f"{text!r}: a source can't be called {name!r}, as the name becomes part of topics; "
            f"valid: {_VALID_NAME}"
        )
    return SourceAddress(text, name, scheme, rest, _options(text, query))


def _default_name(scheme: str, rest: str) -> str:
    """Return the name of a source without one: other characters become underscores.

    A name that would not begin with a letter gets the scheme before it.
    """
    if scheme == "can":
        last = PurePosixPath(rest.partition(":")[2]).name
    else:
        last = PurePosixPath(rest).stem
    name = re.sub(r"[^a-zA-Z0-9_]+", "_", last).strip("_")
    if _NAME.fullmatch(name):
        return name
    return re.sub(r"[^a-zA-Z0-9_]+", "_", scheme + name)


def _options(text: str, query: str) -> dict[str, str]:
    options: dict[str, str] = {}
    for pair in query.split("&") if query else []:
        key, equals, value = pair.partition("=")
        if not key or not equals:
            raise UsageError(f"{text!r}: {pair!r} is no option; expected KEY=VALUE")
        if key in options:
            raise UsageError(f"{text!r}: the option {key} is given twice")
        options[key] = value
    return options


def schemes() -> tuple[str, ...]:
    """Return the installed schemes, sorted."""
    return tuple(sorted(entry_points(group=ENTRY_POINTS).names))


def open_source(address: SourceAddress) -> Source:
    """Make the source of an address; it is not started.

    Raises:
        UsageError: If there is no such scheme or its options are wrong.
        MissingExtraError: If the scheme needs an extra that is not installed.
        SourceError: If it can never work here, or its plug-in fails.
    """
    plugins = entry_points(group=ENTRY_POINTS, name=address.scheme)
    if not plugins:
        valid = listed(schemes(), address.scheme)
        raise UsageError(f"{address.text!r}: no kind of source {address.scheme!r}; valid: {valid}")
    return _open(next(iter(plugins)), address)


def open_sources(texts: Iterable[str]) -> list[Source]:
    """Make the sources of a recording from their addresses; none is started.

    Raises:
        UsageError: If there is none, one is wrong, or two have one name.
        MissingExtraError: If one needs an extra that is not installed.
        SourceError: If one can never work here.
    """
    addresses = [parse_address(text) for text in texts]
    if not addresses:
        raise UsageError("no source given; e.g. can:socketcan:can0")
    first: dict[str, SourceAddress] = {}
    for address in addresses:
        if address.name in first:
            raise UsageError(
                f"{first[address.name].text!r} and {address.text!r} are both called "
                f"{address.name}; put another name before one, e.g. {address.name}_2=..."
            )
        first[address.name] = address
    return [open_source(address) for address in addresses]


def _open(entry: EntryPoint, address: SourceAddress) -> Source:
    try:
        return cast("Callable[[SourceAddress], Source]", entry.load())(address)
    except UndulogError:
        raise
    except Exception as error:
        if (missing := missing_package(error)) is not None:
            raise MissingExtraError(address.text, extra_of(missing), missing) from error
        fault = f"{entry.value} can't be opened: {error!r}"  # a plug-in, or the installation
        raise SourceError(address.text, fault) from error
