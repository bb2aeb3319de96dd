"""CAN frames as ROS 2 messages, one a frame, for the tools of ROS.

The type is ``can_msgs/msg/Frame`` of ros-industrial/ros_canopen, used by ros2_socketcan too. It
has no direction; the topics have it, with ros2_socketcan's names: ``/can0/from_can_bus`` for
received frames and ``/can0/to_can_bus`` for sent ones. A message's ``sequence`` is its place in the
trace, so that frames of one time keep their order.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Generator
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path

import numpy as np
from mcap.writer import Writer

from ..common.arrays import IntArray
from ..log.messages.cdr import encode, layout_of
from ..log.messages.frames import (
    DIR_RX,
    DIR_TX,
    ERROR_FLAG,
    EXTENDED_FLAG,
    ID_MASK,
    REMOTE_FLAG,
    FrameArray,
)
from ..log.messages.rosmsg import parse_message_type
from ..log.messages.schemas import schema_text
from .frame_blocks import FrameFacts
from .frame_log import LogBlock

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
