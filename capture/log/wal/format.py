"""Layout of a write-ahead log: segment files of length- and CRC-framed records.

A log is a folder beside its MCAP file, ``X.mcap.wal/``. Messages are in ``000001.seg``,
``000002.seg``, ...; definitions (schemas, channels, metadata, attachments) in
``def-000001.seg``, ... . All numbers are little-endian.

::

    segment = header (64 bytes), records, zeros, header again
    header  = magic (8), stream u32, salt u32, number u64, size u64, log id (16), CRC-32, pad (12)
    record  = CRC-32, length u32, position u64, kind u8, mark u8, channel u16, sequence u32,
              log time u64, publish time u64, payload (length bytes), zeros to a multiple of 8

The header is stored at both ends for safety. ``position`` counts the records of a stream from 1,
so that the number of missing records is known. ``kind`` is the opcode of the corresponding MCAP
record, and the payload of a definition is that record's body (https://mcap.dev/spec). A record's
CRC covers all following bytes and starts from the segment's random salt, so that bytes of another
log, in a payload or on a reused disk block, are never taken for records.
"""

from __future__ import annotations

import fcntl
import os
import re
import struct
import time
import zlib
from contextlib import suppress
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import NamedTuple, Self

from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Header, Metadata, Schema

from ...common.errors import LogWriteError
from ...common.part_files import present_path, remove_opened

LOCK_NAME = "recorder.lock"
LOCK_TRIES, LOCK_PAUSE_S = 100, 0.001
"""Attempts at a lock, and the pause between [s]: that of :func:`is_live` lasts microseconds."""

MAGIC = b"\x89UWAL1\r\n"
MARK = 0xA5
"""Mark in every record for a quick search for the next whole record."""

HEADER_SIZE = 64
RECORD_SIZE = 40
"""Bytes of a record before its payload."""

MAX_PAYLOAD = 256 << 20
"""Longest payload [byte]; a length beyond it is damage."""

RECORD_CRC = struct.Struct("<I")
RECORD_BODY = struct.Struct("<IQBBHIQQ")
_HEADER_BODY = struct.Struct("<8sIIQQ16s")

_MCAP_PREFIX = 9  # opcode and length, which the record has already

MESSAGES, DEFINITIONS = 0, 1
"""The two streams of a log."""

_NAME = re.compile(r"(def-)?(\d{6,19})\.seg")


Definition = Header | Schema | Channel | Metadata | Attachment
"""A definition, as a record of the MCAP library."""

RecordFields = tuple[int, int, int, int, int, int, int]
"""Position, kind, mark, channel id, sequence, log time, publish time: :class:`RecordHead` without
its length, as a plain tuple, for the hot path."""

_KINDS: dict[type[Definition], int] = {
    Header: Opcode.HEADER,
    Schema: Opcode.SCHEMA,
    Channel: Opcode.CHANNEL,
    Metadata: Opcode.METADATA,
    Attachment: Opcode.ATTACHMENT,
}

_TYPES = {kind: record for record, kind in _KINDS.items()}

STREAM_KINDS = {MESSAGES: frozenset({int(Opcode.MESSAGE)}), DEFINITIONS: frozenset(_TYPES)}
"""The kinds of record that a stream has."""


class WalLock:
    """A lock that a recorder holds from the creation of its log to the end."""

    def __init__(self, folder: Path) -> None:
        """Take the lock.

        Raises:
            LogWriteError: If another recorder holds it, or the folder can't be written.
        """
        self._path = folder / LOCK_NAME
        try:
            flags = os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW
            self._file = os.open(self._path, flags, 0o666)
        except OSError as error:
            raise LogWriteError(folder, f"can't be written: {error.strerror}") from error
        try:
            _lock(self._file)
            if not os.path.samestat(self._path.lstat(), os.fstat(self._file)):
                raise BlockingIOError  # of a recorder that has just ended; another one has begun
        except OSError as error:
            os.close(self._file)
            if isinstance(error, BlockingIOError):
                raise LogWriteError(folder, "another recorder is writing it") from error
            raise LogWriteError(folder, f"can't be locked: {error.strerror}") from error

    @property
    def folder(self) -> Path | None:
        """Where the log's folder is now; None if it was deleted."""
        where = present_path(self._file, self._path)
        return None if where is None else where.parent

    def release(self) -> None:
        """Release the lock."""
        remove_opened(self._file, self._path)
        os.close(self._file)


def _lock(opened: int) -> None:
    """Take an exclusive lock beside whoever asks :func:`is_live`, which holds a shared one briefly.

    Raises:
        BlockingIOError: If a recorder holds it.
    """
    for _ in range(LOCK_TRIES):
        with suppress(BlockingIOError):
            fcntl.flock(opened, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return
        fcntl.flock(opened, fcntl.LOCK_SH | fcntl.LOCK_NB)  # refused beside a recorder
        fcntl.flock(opened, fcntl.LOCK_UN)
        time.sleep(LOCK_PAUSE_S)
    raise BlockingIOError


def is_live(folder: Path) -> bool:
    """Whether a recorder is writing a log now; always False on a file system without locks."""
    try:
        opened = os.open(folder / LOCK_NAME, os.O_RDONLY)
    except OSError:
        return False
    try:
        fcntl.flock(opened, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except OSError as error:
        return isinstance(error, BlockingIOError)
    finally:
        os.close(opened)
    return False


class RecordHead(NamedTuple):
    """Head of a record.

    Attributes:
        position: Running number in its stream, from 1.
        mark: :data:`MARK`.
        channel_id: MCAP channel; 0 for a definition.
        sequence: The message's own counter.
        log_time_ns: When it was recorded [Unix ns].
        publish_time_ns: When it was sampled [Unix ns].
    """

    length: int
    position: int
    kind: int
    mark: int
    channel_id: int
    sequence: int
    log_time_ns: int
    publish_time_ns: int


@dataclass(frozen=True)
class SegmentHeader:
    """Header of a segment.

    Attributes:
        stream: :data:`MESSAGES` or :data:`DEFINITIONS`.
        salt: Start value of the CRC of its records.
        number: Its number in the stream, from 1, as in its name.
        size: Reserved bytes, both headers included.
        log_id: The same 16 random bytes in all segments of a log.
    """

    stream: int
    salt: int
    number: int
    size: int
    log_id: bytes

    def pack(self) -> bytes:
        """Return its 64 bytes."""
        body = _HEADER_BODY.pack(MAGIC, self.stream, self.salt, self.number, self.size, self.log_id)
        return (body + RECORD_CRC.pack(zlib.crc32(body))).ljust(HEADER_SIZE, b"\0")

    @classmethod
    def unpack(cls, data: bytes) -> Self | None:
        """Read a header; None if the bytes are no whole header."""
        if len(data) != HEADER_SIZE:
            return None
        body, rest = data[: _HEADER_BODY.size], data[_HEADER_BODY.size :]
        (crc,) = RECORD_CRC.unpack_from(rest)
        if zlib.crc32(body) != crc:
            return None
        magic, stream, salt, number, size, log_id = _HEADER_BODY.unpack(body)
        return cls(stream, salt, number, size, log_id) if magic == MAGIC else None


def segment_name(stream: int, number: int) -> str:
    """Return the file name of a segment, e.g. ``000001.seg`` or ``def-000001.seg``."""
    return f"{'def-' if stream == DEFINITIONS else ''}{number:06d}.seg"


def segment_files(folder: Path) -> list[tuple[int, int, Path]]:
    """Return stream, number and path of the segments in a folder, sorted.

    Raises:
        OSError: If the folder can't be listed.
    """
    segments: list[tuple[int, int, Path]] = []
    for path in folder.iterdir():
        match = _NAME.fullmatch(path.name)
        if match is not None:
            segments.append((DEFINITIONS if match[1] else MESSAGES, int(match[2]), path))
    return sorted(segments)


def pack_definition(record: Definition) -> tuple[int, bytes]:
    """Return a definition as MCAP opcode and body of the MCAP record."""
    builder = RecordBuilder()
    record.write(builder)
    return _KINDS[type(record)], builder.end()[_MCAP_PREFIX:]


def unpack_definition(kind: int, payload: bytes) -> Definition:
    """Read a definition from the body of the MCAP record.

    Raises:
        McapError: If the body ends too early.
        ValueError: If a text in it is not UTF-8.
        OverflowError: If a length in it is beyond all memory.
    """
    return _TYPES[kind].read(ReadDataStream(BytesIO(payload)))
