"""Datagrams of the live feed.

A datagram is a head and then whole records, so that each can be read without any other::

    head   = magic (4), version u8, kind u8, messages u16, feed id u64, dropped u64
    record = kind u8, pad (1), channel u16, sequence u32, length u32, log time u64,
             publish time u64, offered u64, payload (length bytes)

All numbers are little-endian. ``kind`` of a record is the opcode of the MCAP record that it would
be (https://mcap.dev/spec); the payload of a definition is that record's body, compressed with zlib.
The definitions end with the last message of each topic that is published on change, which is valid
until the next one.

``offered`` is the monotonic clock of the machine when the message was queued, so that a reader on
the same machine can compute its delay.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterable
from enum import IntEnum
from typing import NamedTuple

from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Metadata, Schema

from ..common.errors import DataError
from ..log.messages.frames import FRAME_TOPIC_PREFIXES
from ..log.wal.format import Definition, pack_definition, unpack_definition
from ..log.write.mcap_sink import Description

MAX_DATAGRAM = 64 << 10
"""No datagram is longer [byte]."""

_MAGIC = b"ULIV"
_VERSION = 1
_HEAD = struct.Struct("<4sBBHQQ")
_RECORD = struct.Struct("<BxHIIQQQ")
_MAX_DEFINITION = 16 << 20

HEAD_SIZE = _HEAD.size
RECORD_SIZE = _RECORD.size
MAX_MESSAGE = MAX_DATAGRAM - HEAD_SIZE - RECORD_SIZE
"""Longest payload of a message [byte]."""

_STREAMS = {
    "sensor_msgs/msg/JointState",
    "nav_msgs/msg/Odometry",
    "sensor_msgs/msg/Imu",
    "sensor_msgs/msg/Range",
    "sensor_msgs/msg/MagneticField",
    "tf2_msgs/msg/TFMessage",
    "sensor_msgs/msg/TimeReference",
}
"""Types of samples, whose rate may be reduced."""

_STATES = {"std_msgs/msg/String"}
"""Types published on change, whose last message is sent to a new relay."""


class DatagramKind(IntEnum):
    """Content of a datagram."""

    MESSAGES = 0
    DEFINITIONS = 1
    END = 2


class LiveMessage(NamedTuple):
    """One message of the feed.

    Attributes:
        sequence: Number of the message in its channel.
        log_time_ns: Time of recording [Unix ns].
        publish_time_ns: Time of sampling [Unix ns].
        offered_ns: Time of queueing, on the machine's monotonic clock [ns].
    """

    channel_id: int
    sequence: int
    log_time_ns: int
    publish_time_ns: int
    offered_ns: int
    payload: bytes


Queued = tuple[int, int, int, int, int, bytes]
"""The fields of a :class:`LiveMessage`."""


class DatagramHead(NamedTuple):
    """Head of a datagram.

    Attributes:
        messages: Number of messages in it.
        feed_id: Random number of the recording: it changes with a restart of the recorder.
        dropped: Number of messages that the feed has dropped so far.
    """

    kind: DatagramKind
    messages: int
    feed_id: int
    dropped: int


def pack_datagram(head: DatagramHead, records: Iterable[bytes]) -> bytes:
    """Return a datagram of records packed by :func:`pack_message` or :func:`pack_description`."""
    return b"".join([_HEAD.pack(_MAGIC, _VERSION, *head), *records])


def pack_message(message: Queued) -> bytes:
    """Return the record of a message."""
    channel_id, sequence, log_ns, publish_ns, offered_ns, payload = message
    length = len(payload)
    return (
        _RECORD.pack(Opcode.MESSAGE, channel_id, sequence, length, log_ns, publish_ns, offered_ns)
        + payload
    )


def pack_description(record: Description) -> bytes:
    """Return the record of a definition, e.g. of a channel."""
    kind, body = pack_definition(record)
    payload = zlib.compress(body)
    return _RECORD.pack(kind, 0, 0, len(payload), 0, 0, 0) + payload


def read_head(data: bytes) -> DatagramHead:
    """Read the head of a datagram.

    Raises:
        DataError: If it is no datagram of this version.
    """
    if len(data) < HEAD_SIZE:
        raise DataError(f"a datagram of {len(data)} bytes is too short for the live feed")
    magic, version, kind, messages, feed_id, dropped = _HEAD.unpack_from(data)
    if magic != _MAGIC or version != _VERSION or kind not in DatagramKind.__members__.values():
        raise DataError("a datagram is not of this version's live feed")
    return DatagramHead(DatagramKind(kind), messages, feed_id, dropped)


def read_records(data: bytes) -> list[LiveMessage | Definition]:
    """Return the messages and definitions of a datagram, in order.

    Raises:
        DataError: If it is cut short or a definition can't be read.
    """
    messages: list[LiveMessage | Definition] = []
    at = HEAD_SIZE
    while at < len(data):
        start = at + RECORD_SIZE
        if start > len(data):
            raise DataError("a datagram of the live feed is cut short")
        kind, channel_id, sequence, length, log_ns, publish_ns, offered_ns = _RECORD.unpack_from(
            data, at
        )
        at = start + length
        if at > len(data):
            raise DataError("a datagram of the live feed is cut short")
        payload = data[start:at]
        if kind == Opcode.MESSAGE:
            messages.append(
                LiveMessage(channel_id, sequence, log_ns, publish_ns, offered_ns, payload)
            )
        else:
            messages.append(_description(kind, payload))
    return messages


def _description(kind: int, payload: bytes) -> Definition:
    unpacker = zlib.decompressobj()
    try:
        body = unpacker.decompress(payload, _MAX_DEFINITION)
        if not unpacker.eof:
            raise DataError("a definition of the live feed is too long or cut short")
        return unpack_definition(kind, body)
    except (zlib.error, struct.error, McapError, KeyError, ValueError, OverflowError) as error:
        raise DataError(f"a definition of the live feed can't be read: {error}") from error


class LiveDefinitions:
    """Definitions, and the last messages of topics that are published on change.

    Attributes:
        periods: Channels that are sent, and the least time between messages [ns], 0 for none.
        states: Channels published on change, and their last messages.
    """

    def __init__(self, period_ns: int) -> None:
        """Start without definitions.

        Args:
            period_ns: Least time between two messages of a channel of samples [ns].
        """
        self.periods: dict[int, int] = {}
        self.states: dict[int, Queued | None] = {}
        self._period_ns = period_ns
        self._schemas: dict[int, str] = {}
        self._packed: dict[tuple[str, object] | None, bytes] = {}

    def pack(self, record: Description) -> bytes | None:
        """Return a definition as a record, or None for one that isn't sent."""
        return None if _key(record) is None else pack_description(record)

    def keep(self, record: Description, packed: bytes) -> None:
        """Keep a definition that is sent; it replaces one of the same name or number."""
        self._packed[_key(record)] = packed
        if isinstance(record, Schema):
            self._schemas[record.id] = record.name
        elif isinstance(record, Channel) and not record.topic.startswith(FRAME_TOPIC_PREFIXES):
            kind = self._schemas.get(record.schema_id)
            self.periods[record.id] = self._period_ns if kind in _STREAMS else 0
            if kind in _STATES:
                self.states.setdefault(record.id, None)

    def groups(self, size: int) -> list[list[bytes]]:
        """Return the records of all definitions and then of the states, a group a datagram.

        Args:
            size: Most bytes of a group, unless one record alone is longer [B].
        """
        states = [pack_message(state) for state in self.states.values() if state is not None]
        groups: list[list[bytes]] = []
        filled = 0
        for packed in [*self._packed.values(), *(state for state in states if len(state) <= size)]:
            if not groups or filled + len(packed) > size:
                groups.append([])
                filled = 0
            groups[-1].append(packed)
            filled += len(packed)
        return groups


def _key(record: Description) -> tuple[str, object] | None:
    """Return the identity of a definition, or None for one that isn't sent."""
    match record:
        case Schema():
            return "schema", record.id
        case Channel():
            return "channel", record.id
        case Attachment():
            name = record.name
            return ("file", name) if name == "robot.toml" or name.endswith(".dbc") else None
        case Metadata():
            return ("facts", record.name) if record.name == "undulog" else None
