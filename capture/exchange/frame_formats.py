"""Formats of CAN traces that can be written, by suffix.

A format declares what it keeps of frames (:meth:`FrameFormat.kept`) and writes that, so that what
is lost can be counted before it is lost. Formats: candump (:mod:`.capture.exchange.frame_log`),
Vector's ASC and BLF by python-can, and messages of ROS 2 (:mod:`.capture.exchange.frame_formats`).

CAN frames as ROS 2 messages, one a frame, for the tools of ROS.

The type is ``can_msgs/msg/Frame`` of ros-industrial/ros_canopen, used by ros2_socketcan too. It
has no direction; the topics have it, with ros2_socketcan's names: ``/can0/from_can_bus`` for
received frames and ``/can0/to_can_bus`` for sent ones. A message's ``sequence`` is its place in the
trace, so that frames of one time keep their order.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from datetime import datetime
from importlib.metadata import version
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from mcap.writer import Writer

from ..common.arrays import NS, BoolArray
from ..log.messages import frames as wire
from ..log.messages.cdr import encode, layout_of
from ..log.messages.definitions import parse_message_type, schema_text
from ..log.messages.frames import FrameArray
from .candump import candump_lines
from .frame_log import FrameFacts, LogBlock, is_error, is_remote

if TYPE_CHECKING:
    from can.io.generic import MessageWriter


TYPE_NAME = "can_msgs/msg/Frame"
"""Type of a frame in ROS 2."""

SCHEMA = (
    "std_msgs/Header header\nuint32 id\nbool is_rtr\nbool is_extended\nbool is_error\n"
    "uint8 dlc\nuint8[8] data\n"
    + "=" * 80
    + "\nMSG: std_msgs/Header\n"
    + schema_text("std_msgs/msg/Header")
)
"""Its definition, with that of its header."""

_STAMP_END_NS = 2**31 * NS

_BLF_EPOCH_NS = 631_152_000 * NS  # 1990: python-can takes less for no date
_NUMBERED = re.compile(r"can(0|[1-9]\d{0,3})")


def _ros_notes(facts: FrameFacts) -> Iterator[str]:
    """Report changed bus names, missing directions and times after 2038."""
    for name in facts.buses:
        if f"/{name}" != _namespace(name):
            yield f"topics can't be named after bus {name}: its are in {_namespace(name)}"
    if not facts.directions:
        yield "no directions were recorded: all frames are on from_can_bus"
    if facts.end_ns >= _STAMP_END_NS:
        yield "stamps of ROS 2 end in 2038: only the log times are right after that"


@contextmanager
def _open_ros(path: Path, facts: FrameFacts) -> Generator[WriteFrames]:
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start(profile="ros2", library=f"undulog/{version('undulog')}")
        writer.add_metadata("undulog.export", {"session_id": facts.session_id})
        schema = writer.register_schema(TYPE_NAME, "ros2msg", SCHEMA.encode())
        templates = [_Template(name) for name in facts.buses]
        channels: dict[tuple[int, bool], int] = {}
        sequence = count()

        def write(block: LogBlock) -> None:
            messages = _interleaved(templates, block)
            is_sent = (block.frames["dir"] == wire.DIR_TX).tolist()
            t_ns: list[int] = block.frames["t_host_ns"].tolist()
            buses: list[int] = block.bus.tolist()
            for bus, sent, t, data in zip(buses, is_sent, t_ns, messages, strict=True):
                if (bus, sent) not in channels:
                    way = "to_can_bus" if sent else "from_can_bus"
                    topic = f"{_namespace(facts.buses[bus])}/{way}"
                    channels[bus, sent] = writer.register_channel(topic, "cdr", schema)
                number = next(sequence) & 0xFFFF_FFFF
                writer.add_message(channels[bus, sent], t, data, t, number)

        yield write
        writer.finish()


class _Template:
    """Messages of one bus: all have one length, and their numbers at the same places."""

    def __init__(self, bus: str) -> None:
        kind = parse_message_type(TYPE_NAME, SCHEMA)
        example = encode(kind, {"header": {"frame_id": bus}})
        self._example = np.frombuffer(example, dtype=np.uint8)
        self._leaves = layout_of(kind, example).leaves

    def messages(self, frames: FrameArray) -> list[bytes]:
        """Return one message a frame."""
        matrix = np.tile(self._example, (len(frames), 1))
        id_flags, t_ns = frames["id_flags"], frames["t_host_ns"]
        columns = {
            "header.stamp.sec": t_ns // NS,
            "header.stamp.nanosec": t_ns % NS,
            "id": id_flags & wire.ID_MASK,
            "is_rtr": (id_flags & wire.REMOTE_FLAG) != 0,
            "is_extended": (id_flags & wire.EXTENDED_FLAG) != 0,
            "is_error": (id_flags & wire.ERROR_FLAG) != 0,
            "dlc": frames["len"],
            "data": frames["data"][:, :8],
        }
        for path, values in columns.items():
            leaf = self._leaves[path]
            cells = np.ascontiguousarray(values.reshape(len(frames), -1).astype(leaf.dtype))
            width = leaf.count * cells.dtype.itemsize
            matrix[:, leaf.offset : leaf.offset + width] = cells.view(np.uint8)
        return [row.tobytes() for row in matrix]


def _interleaved(templates: list[_Template], block: LogBlock) -> list[bytes]:
    """Return the messages of the frames, in their order."""
    messages: list[bytes] = [b""] * len(block)
    for bus, template in enumerate(templates):
        rows = np.flatnonzero(block.bus == bus)
        for row, message in zip(rows.tolist(), template.messages(block.frames[rows]), strict=True):
            messages[row] = message
    return messages


def _namespace(bus: str) -> str:
    """Return a name of ROS 2 for a bus: letters, digits and underscores, no digit first."""
    name = re.sub(r"[^A-Za-z0-9_]", "_", bus)
    return f"/can_{name}" if name[:1].isdigit() or not name else f"/{name}"


WriteFrames = Callable[[LogBlock], None]
"""Writes a part of a log; CAN FD frames only where the format holds them."""


@dataclass(frozen=True)
class FrameFormat:
    """One format of CAN traces.

    Attributes:
        title: Its name, as in ``in the format of ...``.
        kept: Returns the frames as a reader of the format gets them, except for device times.
        notes: Yields what the format can't hold of the trace as a whole, one sentence each.
        open: Creates a file; gives a context of a function that writes frames, which must have been
            through ``kept``. Raises OSError if it can't be written.
        holds_fd: Whether it has CAN FD frames.
    """

    title: str
    kept: Callable[[LogBlock], FrameArray]
    notes: Callable[[FrameFacts], Iterable[str]]
    open: Callable[[Path, FrameFacts], AbstractContextManager[WriteFrames]]
    holds_fd: bool = True


def _possible(block: LogBlock) -> FrameArray:
    """Copy frames, remote ones without data, CAN FD ones with 64 bytes and never remote."""
    frames, is_fd = block.frames.copy(), block.is_fd
    frames["id_flags"][is_fd] &= ~np.uint32(wire.REMOTE_FLAG)
    frames["len"][is_fd] = np.minimum(frames["len"][is_fd], 64)
    frames["data"][is_remote(frames)] = 0
    return frames


def _shorten(frames: FrameArray, which: BoolArray) -> None:
    """Limit the length code of some frames to 8, in place."""
    frames["len"][which] = np.minimum(frames["len"][which], 8)


def _kept_by_candump(block: LogBlock) -> FrameArray:
    """Keep everything but data of remote frames and further flags of error frames."""
    frames = _possible(block)
    frames["id_flags"][is_error(frames)] &= wire.ID_MASK | wire.ERROR_FLAG
    _shorten(frames, is_remote(frames))
    return frames


@contextmanager
def _open_candump(path: Path, facts: FrameFacts) -> Generator[WriteFrames]:
    options = {"directions": facts.directions, "nanoseconds": facts.nanoseconds}
    with path.open("w", encoding="utf-8", newline="\n") as stream:
        yield lambda block: stream.writelines(candump_lines(block, facts.buses, **options))


def _kept_by_blf(block: LogBlock) -> FrameArray:
    """Keep everything but data of remote frames, and directions and flags of error frames."""
    frames = _possible(block)
    error = is_error(frames)
    frames["id_flags"][error] &= wire.ID_MASK | wire.ERROR_FLAG
    _shorten(frames, error & ~block.is_fd)
    frames["dir"][error & ~block.is_fd] = wire.DIR_RX
    return frames


def _blf_notes(facts: FrameFacts) -> Iterator[str]:
    """Report changed bus names, missing directions, and dates before 1990."""
    yield from _notes_on_buses(facts)
    if facts.start_ns < _BLF_EPOCH_NS:
        yield "its dates begin in 1990: the times are those since 1970, without a date"


@contextmanager
def _open_blf(path: Path, facts: FrameFacts) -> Generator[WriteFrames]:
    """Create a file; its times count from the last whole second before the first frame."""
    from can import BLFWriter

    dated = facts.start_ns >= _BLF_EPOCH_NS
    start_s = facts.start_ns // NS if dated else 0
    with BLFWriter(path) as writer:
        # Counted from the start, times are exact to 1 ns; as Unix times, which python-can
        # keeps as floating-point seconds, they would be to 240 ns.
        writer.start_timestamp = 0.0
        yield _writing(writer, facts, start_s)
        writer.start_timestamp = float(start_s) if dated else None
        writer.stop_timestamp = facts.end_ns / NS


def _kept_by_asc(block: LogBlock) -> FrameArray:
    """Keep data and remote frames at whole microseconds; of error frames only the time."""
    frames = _possible(block)
    frames["t_host_ns"] = (frames["t_host_ns"] + 500) // 1000 * 1000
    empty = is_error(frames) & ~block.is_fd
    frames["id_flags"][empty] = wire.ERROR_FLAG
    for name in ("len", "data", "dir"):
        frames[name][empty] = 0
    # Readers take a length code above 8 for that of a CAN FD frame.
    _shorten(frames, ~block.is_fd)
    return frames


@contextmanager
def _open_asc(path: Path, facts: FrameFacts) -> Generator[WriteFrames]:
    """Create a file; its times count from the last whole second before the first frame."""
    from can import ASCWriter

    start_s = facts.start_ns // NS
    # The format's dates are local times, and its readers take them as such.
    date = datetime.fromtimestamp(start_s).strftime("%a %b %d %H:%M:%S.000 %Y")  # noqa: DTZ006
    with path.open("w", encoding="ascii", newline="\n") as stream, ASCWriter(stream) as writer:
        # The writer dates the file by the clock, and from a first frame's fraction of a second.
        stream.seek(0)
        stream.truncate()
        stream.write(f"date {date}\nbase hex  timestamps absolute\ninternal events logged\n")
        stream.write(f"Begin Triggerblock {date}\n{0:9.6f} Start of measurement\n")
        writer.header_written = True
        yield _writing(writer, facts, start_s)


def channel_numbers(buses: Sequence[str]) -> list[int]:
    """Return numbers for buses in formats that have no names, counted from 0 as python-can does.

    Returns:
        N for a bus ``canN``, so that an import names it the same; the lowest free number for any
        other.
    """
    matches = [_NUMBERED.fullmatch(name) for name in buses]
    taken = {int(match[1]) for match in matches if match}
    free = (number for number in range(len(buses) + len(taken)) if number not in taken)
    return [int(match[1]) if match else next(free) for match in matches]


def _notes_on_buses(facts: FrameFacts) -> Iterator[str]:
    """Report changed bus names and missing directions."""
    for name, number in zip(facts.buses, channel_numbers(facts.buses), strict=True):
        if name != f"can{number}":
            yield f"it has no names: bus {name} is channel {number + 1}"
    if not facts.directions:
        yield "no directions were recorded: all frames are written as received"


def _writing(writer: MessageWriter, facts: FrameFacts, start_s: int) -> WriteFrames:
    """Return what hands frames to a writer of python-can, timed from ``start_s`` [Unix s]."""
    from can import Message

    channels = channel_numbers(facts.buses)

    def write(block: LogBlock) -> None:
        for row in block.rows():
            message = Message(
                timestamp=(row.t_ns - start_s * NS + 0.5) / NS,  # python-can cuts to whole ns
                arbitration_id=row.id_flags & wire.ID_MASK,
                is_extended_id=bool(row.id_flags & wire.EXTENDED_FLAG),
                is_remote_frame=bool(row.id_flags & wire.REMOTE_FLAG),
                is_error_frame=bool(row.id_flags & wire.ERROR_FLAG),
                channel=channels[row.bus],
                dlc=row.length,
                data=row.data,
                is_rx=row.way != wire.DIR_TX,
                is_fd=row.is_fd,
                bitrate_switch=bool(row.fd_flags & wire.FD_BRS),
                error_state_indicator=bool(row.fd_flags & wire.FD_ESI),
            )
            writer(message)

    return write


FRAME_FORMATS = {
    ".log": FrameFormat("candump -L", _kept_by_candump, lambda _: (), _open_candump),
    ".blf": FrameFormat("Vector BLF", _kept_by_blf, _blf_notes, _open_blf),
    ".asc": FrameFormat("Vector ASC", _kept_by_asc, _notes_on_buses, _open_asc),
    ".mcap": FrameFormat(
        f"{TYPE_NAME}, one message a frame",
        lambda block: block.frames,
        _ros_notes,
        _open_ros,
        holds_fd=False,
    ),
}
"""Suffix to format."""
