"""Formats of CAN traces that can be written, by suffix.

A format says what it keeps of frames (:meth:`FrameFormat.kept`) and writes just that, so that what
is lost can be counted before it is lost. Formats: candump (:mod:`.capture.exchange.candump`),
Vector's ASC and BLF by python-can, and messages of ROS 2 (:mod:`.capture.exchange.frame_formats`).

CAN frames as ROS 2 messages, one a frame, for the tools of ROS.

The type is ``can_msgs/msg/Frame`` of ros-industrial/ros_canopen, used by ros2_socketcan too. It
has no direction; the topics have it, with ros2_socketcan's names: ``/can0/from_can_bus`` for
received frames and ``/can0/to_can_bus`` for sent ones. A message's ``sequence`` is its place in the
trace, so that frames of one time keep their order.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from datetime import datetime
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

import numpy as np
from mcap.writer import Writer

from ..common.arrays import IntArray
from ..log.messages.cdr import encode, layout_of
from ..log.messages.definitions import parse_message_type, schema_text
from ..log.messages.frames import (
    DIR_RX,
    DIR_TX,
    ERROR_FLAG,
    EXTENDED_FLAG,
    FD_BRS,
    FD_ESI,
    ID_MASK,
    REMOTE_FLAG,
    FrameArray,
    holds_fd,
)
from .candump import candump_lines
from .frame_blocks import FrameFacts, is_error, is_remote, without_content
from .frame_log import LogBlock

if TYPE_CHECKING:
    from can.io.generic import MessageWriter


TYPE_NAME = "can_msgs/msg/Frame"
"""The messages' type."""

SCHEMA = (
    "std_msgs/Header header\nuint32 id\nbool is_rtr\nbool is_extended\nbool is_error\n"
    "uint8 dlc\nuint8[8] data\n"
    + "=" * 80
    + "\nMSG: std_msgs/Header\n"
    + schema_text("std_msgs/msg/Header")
)
"""Its definition, dependencies appended."""

TOPIC = {DIR_RX: "from_can_bus", DIR_TX: "to_can_bus"}
"""Direction to the last part of the topic."""

_NS = 1_000_000_000
_STAMP_END_NS = 2**31 * _NS


class RosFrames:
    """An MCAP file of ``can_msgs/msg/Frame``."""

    title = f"{TYPE_NAME}, one message a frame"
    holds_fd = False

    def kept(self, frames: FrameArray) -> FrameArray:
        """Everything."""
        return frames.copy()

    def notes(self, facts: FrameFacts) -> list[str]:
        """Bus names that a topic can't have, and directions that are none."""
        notes = [
            f"topics can't be named after bus {name}: its are in {_namespace(name)}"
            for name in facts.buses
            if f"/{name}" != _namespace(name)
        ]
        if not facts.directions:
            notes.append("no directions were recorded: all frames are on from_can_bus")
        if facts.end_ns >= _STAMP_END_NS:
            notes.append("stamps of ROS 2 end in 2038: only the log times are right after that")
        return notes

    @contextmanager
    def open(self, path: Path, facts: FrameFacts) -> Generator[WriteFrames]:
        """Create a file."""
        with path.open("wb") as stream:
            writer = Writer(stream)
            writer.start(profile="ros2", library=f"undulog/{version('undulog')}")
            writer.add_metadata("undulog.export", {"session_id": facts.session_id})
            schema = writer.register_schema(TYPE_NAME, "ros2msg", SCHEMA.encode())
            templates = [_Template(name) for name in facts.buses]
            channels: dict[tuple[int, int], int] = {}
            place = 0

            def write(block: LogBlock) -> None:
                nonlocal place
                frames, bus = block.frames, block.bus
                messages = _interleaved(templates, frames, bus)
                which: list[int] = bus.tolist()
                way: list[int] = np.where(frames["dir"] == DIR_TX, DIR_TX, DIR_RX).tolist()
                t_ns: list[int] = frames["t_host_ns"].tolist()
                for key, t, data in zip(zip(which, way, strict=True), t_ns, messages, strict=True):
                    if key not in channels:
                        topic = f"{_namespace(facts.buses[key[0]])}/{TOPIC[key[1]]}"
                        channels[key] = writer.register_channel(topic, "cdr", schema)
                    writer.add_message(channels[key], t, data, t, place)
                    place = (place + 1) & 0xFFFF_FFFF

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
        """One message a frame."""
        matrix = np.tile(self._example, (len(frames), 1))
        id_flags, t_ns = frames["id_flags"], frames["t_host_ns"]
        columns = {
            "header.stamp.sec": t_ns // _NS,
            "header.stamp.nanosec": t_ns % _NS,
            "id": id_flags & ID_MASK,
            "is_rtr": (id_flags & REMOTE_FLAG) != 0,
            "is_extended": (id_flags & EXTENDED_FLAG) != 0,
            "is_error": (id_flags & ERROR_FLAG) != 0,
            "dlc": frames["dlc"],
            "data": frames["data"],
        }
        for path, values in columns.items():
            leaf = self._leaves[path]
            cells = np.ascontiguousarray(values.reshape(len(frames), -1).astype(leaf.dtype))
            width = leaf.count * cells.dtype.itemsize
            matrix[:, leaf.offset : leaf.offset + width] = cells.view(np.uint8)
        return [row.tobytes() for row in matrix]


def _interleaved(templates: list[_Template], frames: FrameArray, bus: IntArray) -> list[bytes]:
    """The messages of frames of several buses, in their order."""
    messages: list[bytes] = [b""] * len(frames)
    for which, template in enumerate(templates):
        rows = np.flatnonzero(bus == which)
        for row, message in zip(rows.tolist(), template.messages(frames[rows]), strict=True):
            messages[row] = message
    return messages


def _namespace(bus: str) -> str:
    """A name of ROS 2 for a bus: letters, digits and underscores, no digit first."""
    name = re.sub(r"[^A-Za-z0-9_]", "_", bus)
    return f"/can_{name}" if name[:1].isdigit() or not name else f"/{name}"


WriteFrames = Callable[[LogBlock], None]
"""Writes a stretch of frames; of CAN FD frames only where the format holds them."""


_BLF_EPOCH_NS = 631_152_000 * _NS  # 1990: python-can takes less for no date
_NUMBERED = re.compile(r"can(0|[1-9]\d{0,3})")


class FrameFormat(Protocol):
    """One format of CAN traces."""

    title: str
    """Its name, as in ``in the format of ...``."""

    holds_fd: bool
    """Whether it has CAN FD frames."""

    def kept(self, frames: FrameArray) -> FrameArray:
        """What the format keeps of frames.

        Args:
            frames: Records, classic or, where the format holds them, CAN FD, shape (n,).

        Returns:
            What a reader of the format gets, shape (n,); the device times are not looked at.
        """
        ...

    def notes(self, facts: FrameFacts) -> list[str]:
        """What the format can't say about the trace as a whole.

        Returns:
            One sentence each.
        """
        ...

    def open(self, path: Path, facts: FrameFacts) -> AbstractContextManager[WriteFrames]:
        """Create a file.

        Returns:
            A ``with`` block around what writes frames, which must have been through :meth:`kept`.

        Raises:
            OSError: If it can't be written.
        """
        ...


class Candump:
    """Text of ``candump -L``."""

    title = "candump -L"
    holds_fd = True

    def kept(self, frames: FrameArray) -> FrameArray:
        """Everything but data of remote frames and further flags of error frames."""
        kept = frames.copy()
        error, remote = is_error(frames), is_remote(frames)
        kept["id_flags"][error] &= ID_MASK | ERROR_FLAG
        if holds_fd(frames):
            return _without_remote(kept)
        kept["data"][remote] = 0
        kept["dlc"][remote] = np.minimum(frames["dlc"][remote], 8)
        return kept

    def notes(self, facts: FrameFacts) -> list[str]:  # noqa: ARG002
        """Nothing."""
        return []

    @contextmanager
    def open(self, path: Path, facts: FrameFacts) -> Generator[WriteFrames]:
        """Create a file."""
        with path.open("w", encoding="utf-8", newline="\n") as stream:

            def lines(frames: FrameArray, bus: IntArray) -> Iterator[str]:
                return candump_lines(
                    frames,
                    facts.buses,
                    bus,
                    directions=facts.directions,
                    nanoseconds=facts.nanoseconds,
                )

            def write(block: LogBlock) -> None:
                classic, fd = lines(block.frames, block.bus), lines(block.fd_frames, block.fd_bus)
                stream.writelines(block.interleaved(classic, fd))

            yield write


class Blf:
    """Vector's binary logging format, by python-can."""

    title = "Vector BLF"
    holds_fd = True

    def kept(self, frames: FrameArray) -> FrameArray:
        """Everything but data of remote frames, and directions and flags of error frames."""
        kept = frames.copy()
        error = is_error(frames)
        kept["id_flags"][error] &= ID_MASK | ERROR_FLAG
        if holds_fd(frames):
            return _without_remote(kept)
        kept["dlc"][error] = np.minimum(frames["dlc"][error], 8)
        kept["dir"][error] = DIR_RX
        kept["data"][is_remote(frames)] = 0
        return kept

    def notes(self, facts: FrameFacts) -> list[str]:
        """Bus names, directions that are none, and dates before 1990."""
        notes = _notes_on_buses(facts)
        if facts.start_ns < _BLF_EPOCH_NS:
            notes.append("its dates begin in 1990: the times are those since 1970, without a date")
        return notes

    @contextmanager
    def open(self, path: Path, facts: FrameFacts) -> Generator[WriteFrames]:
        """Create a file; its times count from the last whole second before the first frame."""
        from can import BLFWriter

        dated = facts.start_ns >= _BLF_EPOCH_NS
        start_s = facts.start_ns // _NS if dated else 0
        with BLFWriter(path) as writer:
            # Counted from the start, times are exact to 1 ns; as Unix times, which python-can
            # keeps as floating-point seconds, they would be to 240 ns.
            writer.start_timestamp = 0.0
            yield _writing(writer, facts, start_s)
            writer.start_timestamp = float(start_s) if dated else None
            writer.stop_timestamp = facts.end_ns / _NS


class Asc:
    """Vector's text format, by python-can."""

    title = "Vector ASC"
    holds_fd = True

    def kept(self, frames: FrameArray) -> FrameArray:
        """Data and remote frames at whole microseconds; of error frames only the time."""
        kept = frames.copy()
        kept["t_host_ns"] = (frames["t_host_ns"] + 500) // 1000 * 1000
        if holds_fd(frames):
            return _without_remote(kept)
        remote = is_remote(frames)
        without_content(kept, is_error(frames))
        # Readers take a length code above 8 for that of a CAN FD frame.
        kept["dlc"] = np.minimum(kept["dlc"], 8)
        kept["data"][remote] = 0
        return kept

    def notes(self, facts: FrameFacts) -> list[str]:
        """Bus names, and directions that are none."""
        return _notes_on_buses(facts)

    @contextmanager
    def open(self, path: Path, facts: FrameFacts) -> Generator[WriteFrames]:
        """Create a file; its times count from the last whole second before the first frame."""
        from can import ASCWriter

        start_s = facts.start_ns // _NS
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


FRAME_FORMATS: dict[str, FrameFormat] = {
    ".log": Candump(),
    ".blf": Blf(),
    ".asc": Asc(),
    ".mcap": RosFrames(),
}
"""Suffix to format."""


def channel_numbers(buses: Sequence[str]) -> list[int]:
    """Numbers for buses in formats that have no names, counted from 0 as python-can does.

    Returns:
        N for a bus ``canN``, so that an import names it the same; the lowest free number for any
        other.
    """
    matches = [_NUMBERED.fullmatch(name) for name in buses]
    taken = {int(match[1]) for match in matches if match}
    free = (number for number in range(len(buses) + len(taken)) if number not in taken)
    return [int(match[1]) if match else next(free) for match in matches]


def _without_remote(fd_frames: FrameArray) -> FrameArray:
    """CAN FD frames as they can be: none of them is a remote frame, none has over 64 bytes."""
    fd_frames["id_flags"] &= ~np.uint32(REMOTE_FLAG)
    fd_frames["len"] = np.minimum(fd_frames["len"], 64)
    return fd_frames


def _notes_on_buses(facts: FrameFacts) -> list[str]:
    numbers = channel_numbers(facts.buses)
    notes = [
        f"it has no names: bus {name} is channel {number + 1}"
        for name, number in zip(facts.buses, numbers, strict=True)
        if name != f"can{number}"
    ]
    if not facts.directions:
        notes.append("no directions were recorded: all frames are written as received")
    return notes


def _writing(writer: MessageWriter, facts: FrameFacts, start_s: int) -> WriteFrames:
    """What hands frames to a writer of python-can, timed from ``start_s`` [Unix s]."""
    from can import Message

    channels = channel_numbers(facts.buses)

    def messages(frames: FrameArray, bus: IntArray) -> Iterator[Message]:
        fd = holds_fd(frames)
        room = 64 if fd else 8
        columns: tuple[list[int], ...] = (
            (frames["t_host_ns"].astype(np.int64) - start_s * _NS).tolist(),
            frames["id_flags"].tolist(),
            frames["len" if fd else "dlc"].tolist(),
            frames["dir"].tolist(),
            frames["fd_flags"].tolist() if fd else [0] * len(frames),
        )
        numbers: list[int] = np.array(channels)[bus].tolist()
        data = frames["data"].tobytes()
        rows = zip(*columns, numbers, strict=True)
        for i, (t_ns, id_flags, length, way, fd_flags, number) in enumerate(rows):
            yield Message(
                timestamp=(t_ns + 0.5) / _NS,  # python-can cuts to whole ns
                arbitration_id=id_flags & ID_MASK,
                is_extended_id=bool(id_flags & EXTENDED_FLAG),
                is_remote_frame=bool(id_flags & REMOTE_FLAG),
                is_error_frame=bool(id_flags & ERROR_FLAG),
                channel=number,
                dlc=length,
                data=data[room * i : room * i + min(length, room)],
                is_rx=way != DIR_TX,
                is_fd=fd,
                bitrate_switch=bool(fd_flags & FD_BRS),
                error_state_indicator=bool(fd_flags & FD_ESI),
            )

    def write(block: LogBlock) -> None:
        classic = messages(block.frames, block.bus)
        for message in block.interleaved(classic, messages(block.fd_frames, block.fd_bus)):
            writer(message)

    return write
