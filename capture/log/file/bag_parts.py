"""The files of a recording of ROS 2 as messages: MCAP and sqlite3, whole or compressed.

Every size in them is checked before it is used: a compressed file or message expands no further
than an :class:`Allowance`.

Formats: https://github.com/ros2/rosbag2, https://mcap.dev/spec.
"""

from __future__ import annotations

import io
import struct
from collections.abc import Callable, Generator, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, cast

import zstandard
from mcap.opcode import Opcode

from ...common.databases import DatabaseError, check_pages, open_database, table_names
from ...common.errors import LogError, NotALogError
from ...common.files import check_regular
from ..mcap.chunk import BODY_AT, PREFIX_SIZE, walk_records
from ..mcap.file import McapFile
from .bag_metadata import Stated

if TYPE_CHECKING:
    import sqlite3

    from rosbags.interfaces import Connection

_RATIO, _LEAST = 100, 64 << 20
_PIECE = 1 << 16
_FIXED = struct.Struct("<HIQQ")  # of a message: channel, sequence, log time, publish time
_SUFFIXES = (".mcap", ".db3")
_MOST_TOPICS = 1 << 16
_ROW_SIZE = 8  # of the shortest message in a database [byte]

_REINDEX = "run 'ros2 bag reindex' on a copy of its folder"


class Allowance:
    """The bytes that a recording may expand to: so many times its own, or a least number."""

    def __init__(self, path: Path, size: int) -> None:
        """Begin with all of it.

        Args:
            size: Of the recording's files [byte].
        """
        self._path = path
        self.size = self.left = max(_LEAST, _RATIO * size)

    def take(self, count: int) -> None:
        """Take some bytes.

        Raises:
            NotALogError: If they are more than what is left.
        """
        self.left -= count
        if self.left < 0:
            why = (
                f"expands to more than {self.size >> 20} MiB, over {_RATIO} times its size; "
                "if that is right, decompress it first ('ros2 bag convert', 'rosbag decompress')"
            )
            raise NotALogError(self._path, why)


@dataclass(frozen=True)
class BagPart:
    """One file of a recording, open.

    Attributes:
        count: Number of messages that it states.
        messages: Yields connection, log time [Unix ns] and message; None for a damaged one.
        warnings: Parts that could not be read.
    """

    connections: list[Connection]
    count: int
    messages: Callable[[], Iterator[tuple[Connection, int, bytes | None]]]
    warnings: list[str]


@contextmanager
def opened(path: Path, mode: str, scratch: Path, allowance: Allowance) -> Generator[BagPart]:
    """Open one file of a recording.

    Args:
        mode: What is compressed, as in :class:`.Stated`.
        scratch: A name for the file decompressed; removed afterwards.

    Raises:
        NotALogError: If it is damaged or expands too far.
    """
    kind = path.suffix if path.suffix in _SUFFIXES else Path(path.stem).suffix
    reader = _READERS.get(kind)
    if reader is None:
        raise NotALogError(path, f"is no {' or '.join(_SUFFIXES)} file; run 'ros2 bag reindex'")
    try:
        check_regular(path)
        if mode == "file":
            _decompress(path, scratch, allowance)
        with reader(scratch if mode == "file" else path) as part:
            yield _of_messages(part, allowance) if mode == "message" else part
    except LogError as error:
        if error.path != scratch:
            raise
        raise NotALogError(path, str(error).removeprefix(f"{scratch}: ")) from error
    finally:
        scratch.unlink(missing_ok=True)


def _decompress(path: Path, target: Path, allowance: Allowance) -> None:
    with path.open("rb") as stream, target.open("wb") as out:
        out.writelines(_pieces(stream, allowance, 16 * _PIECE))


def _pieces(packed: BinaryIO | bytes, allowance: Allowance, size: int) -> Iterator[bytes]:
    source = zstandard.ZstdDecompressor().stream_reader(packed, read_across_frames=True)
    with cast("io.RawIOBase", source) as reader:
        while piece := reader.read(size):
            allowance.take(len(piece))
            yield piece


def _of_messages(part: BagPart, allowance: Allowance) -> BagPart:
    def messages() -> Iterator[tuple[Connection, int, bytes | None]]:
        for connection, t_ns, data in part.messages():
            yield connection, t_ns, None if data is None else _expanded(data, allowance)

    return BagPart(part.connections, part.count, messages, part.warnings)


def _expanded(data: bytes, allowance: Allowance) -> bytes | None:
    """Return a message decompressed; None if it is damaged.

    Raises:
        NotALogError: If it expands too far.
    """
    try:
        stated = zstandard.get_frame_parameters(data).content_size
        whole = b"".join(_pieces(data, allowance, _PIECE))
    except zstandard.ZstdError:
        return None
    unknown = stated == zstandard.CONTENTSIZE_UNKNOWN
    return whole if unknown or len(whole) >= stated else None


@contextmanager
def _mcap(path: Path) -> Generator[BagPart]:
    with closing(McapFile(path)) as file:
        ways: dict[int, Connection] = {}
        for key, channel in file.channels.items():
            schema = file.schemas.get(channel.schema_id)
            stated = ("", "", "")
            if schema is not None:
                text = schema.data.decode("utf-8", "replace")
                stated = schema.name, schema.encoding, text
            count = file.counts.get(key, 0)
            ways[key] = _connection(key, channel.topic, stated, channel.message_encoding, count)
        warnings = list(file.warnings)

        def messages() -> Iterator[tuple[Connection, int, bytes | None]]:
            for block in file.blocks:
                try:
                    data, start, stop = file.payload_once(block)
                except LogError as error:
                    warnings.append(f"{error}; its messages are missing")
                    continue
                if block.start:
                    walked = walk_records(data, start, stop)
                    places = ((a, b) for kind, a, b in walked if kind == Opcode.MESSAGE)
                else:  # messages outside of chunks lie between other records
                    by_channel = (block.offsets or {}).values()
                    offsets = sorted(start + at for array in by_channel for at in array.tolist())
                    places = ((at + PREFIX_SIZE, _end(data, at)) for at in offsets)
                for body, end in places:
                    if end - body >= _FIXED.size:
                        key, _, log_ns, _ = _FIXED.unpack_from(data, body)
                        if key in ways:
                            at = body - PREFIX_SIZE + BODY_AT
                            yield ways[key], log_ns, bytes(data[at:end])

        yield BagPart(list(ways.values()), sum(file.counts.values()), messages, warnings)


def _end(data: Any, at: int) -> int:
    (length,) = struct.unpack_from("<Q", data, at + 1)
    return at + PREFIX_SIZE + length


@contextmanager
def _sqlite(path: Path) -> Generator[BagPart]:
    with _connected(path) as base:
        yield _database(base)


@contextmanager
def _connected(path: Path) -> Generator[sqlite3.Connection]:
    """Open a database of topics and messages."""
    import sqlite3

    try:
        with open_database(path, ("topics", "messages")) as base:
            yield base
    except (sqlite3.Error, DatabaseError) as error:
        why = " ".join(str(error).split())
        raise NotALogError(path, f"is a damaged database: {why}; {_REINDEX}") from error


def read_database_facts(path: Path) -> Stated:
    """Read times, number and topics of the messages of a .db3 file, and not the messages.

    Its index of times is read, which has a few bytes a message.

    Raises:
        NotALogError: If it is damaged.
    """
    with _connected(path) as base:
        most = path.stat().st_size // _ROW_SIZE  # pages that lead to themselves have no end
        topics = base.execute("SELECT name FROM topics LIMIT ?", (_MOST_TOPICS,)).fetchall()
        count, first, last = base.execute(
            "SELECT count(*), min(timestamp), max(timestamp) "
            "FROM (SELECT timestamp FROM messages LIMIT ?)", (most,)
        ).fetchone()  # fmt: skip
    if count >= most:
        raise NotALogError(path, f"is a damaged database: more messages than bytes; {_REINDEX}")
    names = tuple(str(name) for (name,) in topics)
    if not (isinstance(first, int) and isinstance(last, int) and first >= 0):
        return Stated([path], "", messages=count, topics=names)
    return Stated([path], "", first, last - first, count, names)


def _database(base: sqlite3.Connection) -> BagPart:
    check_pages(base)
    definitions: dict[str, tuple[str, str]] = {}
    if "message_definitions" in table_names(base):
        rows = base.execute(
            "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions"
        )
        definitions = {str(kind): (str(form), str(text)) for kind, form, text in rows}
    ways: dict[int, Connection] = {}
    topics = base.execute("SELECT id, name, type, serialization_format FROM topics ORDER BY id")
    for key, topic, kind, encoding in topics:
        stated = str(kind), *definitions.get(str(kind), ("", ""))
        ways[key] = _connection(key, str(topic), stated, str(encoding), 0)
    (count,) = base.execute("SELECT count(*) FROM messages").fetchone()

    def messages() -> Iterator[tuple[Connection, int, bytes | None]]:
        # Messages are not sorted themselves: without an index they would go to temporary files.
        chosen = base.cursor()
        for row in base.execute("SELECT rowid FROM messages ORDER BY timestamp"):
            chosen.execute("SELECT topic_id, timestamp, data FROM messages WHERE rowid = ?", row)
            key, t_ns, data = chosen.fetchone()
            if key not in ways:
                continue
            whole = isinstance(data, bytes) and isinstance(t_ns, int) and t_ns >= 0
            yield ways[key], t_ns if whole else 0, data if whole else None

    return BagPart(list(ways.values()), count, messages, [])


_READERS = {".mcap": _mcap, ".db3": _sqlite}


def _connection(
    key: int, topic: str, described: tuple[str, str, str], encoding: str, count: int
) -> Connection:
    """Return a topic; ``described`` is its type, and encoding and text of the definition."""
    from rosbags.interfaces import (
        Connection,
        ConnectionExtRosbag2,
        MessageDefinition,
        MessageDefinitionFormat,
    )

    kind, form, text = described
    forms = {"ros2msg": MessageDefinitionFormat.MSG, "ros2idl": MessageDefinitionFormat.IDL}
    stated = MessageDefinition(forms.get(form, MessageDefinitionFormat.NONE), text)
    return Connection(key, topic, kind, stated, "", count, ConnectionExtRosbag2(encoding, []), None)
