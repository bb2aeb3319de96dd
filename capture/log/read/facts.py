"""Facts of a log from its first and last bytes: what it is, without opening it as a session.

A file that lies in an object store costs at most :data:`MOST_REQUESTS` requests for ranges of
bytes, whatever its size: the header and the first metadata, the footer and the summary behind it,
and metadata between them. A log without an id has no such metadata; two pieces between, which its
id is made from, take their place.

Of the recordings of ROS that are no plain MCAP, a rosbag2 folder states them in its metadata.yaml,
a .bag of ROS 1 at its end; of a .db3 file the topics and the index of times are read.

Format: https://mcap.dev/spec.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import closing
from dataclasses import dataclass, field, replace
from io import BytesIO
from pathlib import Path
from typing import Any

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Footer, Metadata, MetadataIndex, Statistics

from ...common.confined import Confined
from ...common.confined_child import Send
from ...common.errors import MissingExtraError, NotALogError, UndulogError
from ...common.extras import is_installed
from ...common.packets import Packet
from ...common.part_files import stored_path
from ..file.bag_metadata import Stated, read_stated
from ..file.bag_parts import Allowance, read_database_facts
from ..file.content import content_id, content_id_of
from ..mcap.chunk import MAGIC, summary_fits, walk_records
from ..wal.reader import Recovery
from ..wal.writer import wal_folder

MOST_REQUESTS = 5
"""Ranges that are read of one file."""

_EDGE = 64 * 1024
_MOST_SUMMARY = 64 << 20
RECORDS = ("undulog", "undulog.health", "undulog.part")
"""Metadata records that are facts of a log."""

_FOOTER = 1 + 8 + 20 + len(MAGIC)


TIMES_FROM_FPS = "import.times_from_fps"
"""Key of the record ``undulog``: the frame rate [1/s] that a data set's times were made from."""


@dataclass(frozen=True)
class LogFacts:
    """What the first and last bytes of a log say.

    Attributes:
        start_ns: Log time of its first message [Unix ns]; None without messages or summary.
        end_ns: Log time of its last message [Unix ns].
        messages: Their number, or None.
        topics: In order of name.
        metadata: Of the log contract: ``undulog``, ``undulog.health`` and ``undulog.part``.
        damage: Why there is no summary; empty where there is one.
        content: Id from its content; empty where the metadata has one.
    """

    start_ns: int | None = None
    end_ns: int | None = None
    messages: int | None = None
    topics: tuple[str, ...] = ()
    metadata: Mapping[str, Mapping[str, str]] = field(default_factory=dict[str, Mapping[str, str]])
    damage: str = ""
    content: str = ""

    @property
    def session_id(self) -> str:
        """Its own id, or the one from its content; empty if there is neither."""
        return self.metadata.get("undulog", {}).get("session_id") or self.content


class _Ranges:
    """Ranges of a file that were read."""

    def __init__(self, read: Callable[[int, int], bytes], size: int) -> None:
        self._read, self._size = read, size
        self._parts: list[tuple[int, bytes]] = []
        self.left = MOST_REQUESTS

    def get(self, start: int, stop: int, ahead: int = 0) -> bytes | None:
        """Return bytes of the file; None where they take one request too many."""
        if not 0 <= start <= stop <= self._size:
            return None
        for base, data in self._parts:
            if base <= start and stop <= base + len(data):
                return data[start - base : stop - base]
        if not self.left:
            return None
        self.left -= 1
        data = self._read(start, min(max(stop, start + ahead), self._size))
        self._parts.append((start, data))
        return data[: stop - start] if len(data) >= stop - start else None


def read_facts(name: str, size: int, read: Callable[[int, int], bytes]) -> LogFacts:
    """Read the facts of an MCAP file.

    Args:
        name: For messages.
        size: Its size in bytes.
        read: Returns the bytes from a first offset up to a second one.

    Returns:
        The facts; of a file that was cut or written without a summary, those of its beginning.

    Raises:
        NotALogError: If it is no MCAP file.
        OSError: As ``read`` raises it.
    """
    ranges = _Ranges(read, size)
    head = ranges.get(0, min(size, _EDGE)) or b""
    if not head.startswith(MAGIC):
        raise NotALogError(name, "no MCAP file: it doesn't start as one")
    metadata: dict[str, dict[str, str]] = {}
    _add_metadata(metadata, _records(head, len(MAGIC)))
    tail = ranges.get(max(0, size - _EDGE), size) or b""
    facts = _found(ranges, size, tail, metadata)
    if facts.session_id:
        return facts

    def piece(start: int, stop: int) -> bytes:
        if stop <= len(head):
            return head[start:stop]
        ahead = size - len(tail)
        return tail[start - ahead : stop - ahead] if start >= ahead else read(start, stop)

    return replace(facts, content=content_id([(size, piece)]))


def _found(
    ranges: _Ranges, size: int, tail: bytes, metadata: dict[str, dict[str, str]]
) -> LogFacts:
    if size < 2 * len(MAGIC) + 29 or not tail.endswith(MAGIC):
        return LogFacts(metadata=metadata, damage="it has no end: undulog log recover")
    try:
        footer = _parse(Footer, tail[len(tail) - _FOOTER + 9 : len(tail) - len(MAGIC)])
        start, stop = footer.summary_start, footer.summary_offset_start or size - _FOOTER
        if not start:
            return LogFacts(metadata=metadata, damage="it has no summary")
        rest = ranges.get(start, size) if start < stop <= start + _MOST_SUMMARY else None
        if rest is None:
            damage = f"its summary claims the bytes {start:,} to {stop:,}"
            return LogFacts(metadata=metadata, damage=damage)
        if not summary_fits(rest):
            return LogFacts(metadata=metadata, damage="its summary is damaged: its CRC doesn't fit")
        return _from_summary(rest[: stop - start], ranges, metadata)
    except (McapError, struct.error, ValueError, OverflowError) as error:
        return LogFacts(metadata=metadata, damage=f"its summary is damaged: {error}")


def _from_summary(summary: bytes, ranges: _Ranges, metadata: dict[str, dict[str, str]]) -> LogFacts:
    topics: set[str] = set()
    statistics: Statistics | None = None
    metadata.clear()  # its index tells of all records
    for opcode, body in _records(summary, 0):
        if opcode == Opcode.CHANNEL:
            topics.add(_parse(Channel, body).topic)
        elif opcode == Opcode.STATISTICS:
            statistics = _parse(Statistics, body)
        elif opcode == Opcode.METADATA_INDEX:
            index = _parse(MetadataIndex, body)
            if index.name in RECORDS:
                record = ranges.get(index.offset, index.offset + index.length, _EDGE)
                if record is not None:
                    _add_metadata(metadata, _records(record, 0))
    facts = LogFacts(topics=tuple(sorted(topics)), metadata=metadata)
    if statistics is None:
        return facts
    count, start_ns = statistics.message_count, statistics.message_start_time
    times = {"start_ns": start_ns, "end_ns": statistics.message_end_time} if count else {}
    return replace(facts, messages=count, **times)


def _records(data: bytes, start: int) -> Iterator[tuple[int, bytes]]:
    """Yield opcode and body of each whole record."""
    for opcode, begin, end in walk_records(data, start, len(data)):
        yield opcode, data[begin:end]


def _add_metadata(
    metadata: dict[str, dict[str, str]], records: Iterable[tuple[int, bytes]]
) -> None:
    for opcode, body in records:
        if opcode == Opcode.METADATA:
            record = _parse(Metadata, body)
            if record.name in RECORDS:
                metadata.setdefault(record.name, {}).update(record.metadata)


def _parse(kind: Any, body: bytes) -> Any:
    return kind.read(ReadDataStream(BytesIO(body)))


def read_bag_facts(path: Path) -> LogFacts:
    """Read the facts of a rosbag2 folder, a .db3 file or a .bag file.

    Raises:
        NotALogError: If it is damaged.
        OSError: If it can't be read.
        MissingExtraError: If ``rosbags`` or the YAML parser is not installed and needed.
    """
    try:
        stated = read_stated(path) if path.is_dir() else _of_file(path)
    except ImportError as error:
        raise MissingExtraError("reading a recording of ROS", "bags", "rosbags") from error
    facts = LogFacts(
        messages=stated.messages,
        topics=tuple(sorted({*stated.topics})),
        content=content_id_of(stated.files),
    )
    if not stated.messages or stated.start_ns is None or stated.duration_ns is None:
        return facts
    end_ns = stated.start_ns + stated.duration_ns
    return replace(facts, start_ns=stated.start_ns, end_ns=end_ns)


def is_wal_alone(path: Path) -> bool:
    """Return whether a session's file is missing or empty, and its write-ahead log is there."""
    stored = stored_path(path)
    is_empty = not stored.exists() or (stored.is_file() and not stored.stat().st_size)
    return is_empty and wal_folder(path).is_dir()


def read_wal_facts(path: Path) -> LogFacts:
    """Read the facts of such a session; its messages are not read.

    Args:
        path: The session's file.

    Raises:
        NotALogError: If no segment of the log can be read.
        LogError: If its folder can't be listed.
    """
    metadata: dict[str, dict[str, str]] = {}
    topics: set[str] = set()
    for item in Recovery(wal_folder(path)).definitions:
        if isinstance(item, Metadata) and item.name in RECORDS:
            metadata.setdefault(item.name, {}).update(item.metadata)
        elif isinstance(item, Channel):
            topics.add(item.topic)
    damage = f"only its write-ahead log is there: undulog log recover {path.name}"
    return LogFacts(topics=tuple(sorted(topics)), metadata=metadata, damage=damage)


def _of_file(path: Path) -> Stated:
    """Read what a .db3 or .bag file states, in a child process."""
    if path.suffix == ".bag" and not is_installed("rosbags"):
        raise ImportError("rosbags")
    with closing(Confined(NotALogError)) as reader:
        facts = reader.call(f"{__name__}:parse", path).facts
    start_ns, duration_ns = facts["times"]
    return Stated([path], "", start_ns, duration_ns, facts["messages"], tuple(facts["topics"]))


def parse(path: Path, send: Send) -> None:
    """Send what a .db3 or .bag file states; runs in the child process."""
    stated = _of_ros1(path) if path.suffix == ".bag" else read_database_facts(path)
    times = stated.start_ns, stated.duration_ns
    send(Packet({"times": times, "messages": stated.messages, "topics": stated.topics}))


def _of_ros1(path: Path) -> Stated:
    from ..file.bag_ros1 import SummaryReader

    try:
        with SummaryReader(path, Allowance(path, 0)) as bag:
            topics = tuple(connection.topic for connection in bag.connections)
            count = sum(sum(chunk.connection_counts.values()) for chunk in bag.chunk_infos)
            start, stop = bag.start_time, bag.end_time
    except (MemoryError, OSError, UndulogError):
        raise
    except Exception as error:  # rosbags lets errors of struct and dictionaries through
        why = " ".join(str(error).split()) or type(error).__name__
        fix = "run 'rosbag reindex' or 'rosbag fix'"
        raise NotALogError(path, f"can't be read as a bag of ROS 1: {why}; {fix}") from error
    return Stated([path], "", start, stop - 1 - start, count, topics)
