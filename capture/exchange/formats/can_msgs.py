"""CAN frames as ROS 2 messages, one a frame, for the tools of ROS.

The type is ``can_msgs/msg/Frame`` of ros-industrial/ros_canopen, used by ros2_socketcan too. It
has no direction; the topics have it, with ros2_socketcan's names: ``/can0/from_can_bus`` for
received frames and ``/can0/to_can_bus`` for sent ones. A message's ``sequence`` is its place in the
trace, so that frames of one time keep their order.
"""

from __future__ import annotations

import re
from collections.abc import Generator, Iterator
from contextlib import contextmanager
from importlib.metadata import version
from itertools import count
from pathlib import Path

import numpy as np

from ...common.arrays import NS
from ...log.messages import frames as wire
from ...log.messages.cdr import encode, layout_of
from ...log.messages.definitions import parse_message_type, schema_text
from ...log.messages.frames import FrameArray
from ..frame_export import FrameWriter, WriteFrames
from ..frame_log import FrameFacts, LogBlock
from .format import Format, not_read

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
    from mcap.writer import Writer

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


FORMAT = Format(
    "can_msgs", "CAN frames of ROS 2", (".mcap",), not_read,
    write=FrameWriter(
        f"{TYPE_NAME}, one message a frame", lambda block: block.frames, _ros_notes, _open_ros,
        holds_fd=False,
    ),
)  # fmt: skip
