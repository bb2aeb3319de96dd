"""Reader of a write-ahead log, which tolerates any damage and changes nothing.

A record is accepted only if length, CRC and running number fit; after damage, the next whole record
is searched. Missing records are counted by the running numbers. At the end only damaged bytes can
be counted: after a kill they are at most the record being written, which was not accepted yet.
"""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel

from ...common.arrays import IntArray
from ...common.errors import LogError, NotALogError
from ...common.files import check_regular
from ..mcap.chunk import FIXED_SIZE, MESSAGE, Block
from .format import (
    DEFINITIONS,
    HEADER_SIZE,
    MARK,
    MAX_PAYLOAD,
    MESSAGES,
    RECORD_BODY,
    RECORD_CRC,
    RECORD_SIZE,
    STREAM_KINDS,
    Definition,
    RecordHead,
    SegmentHeader,
    is_live,
    segment_files,
    unpack_definition,
)
from .writer import wal_folder

_PIECE = 1 << 20  # the most that is read at once before a CRC vouches for a length
_FIRST_LOOK = 1 << 12
_ZEROS = bytes(_PIECE + RECORD_SIZE)


MessageKey = tuple[int, int, int]
"""Channel, sequence number and log time: no two messages of a session share all three."""


class WalMessage(NamedTuple):
    """An accepted message.

    Attributes:
        position: Its number among all messages of the session, from 1.
        log_time_ns: When it was recorded [Unix ns].
        publish_time_ns: When it was sampled [Unix ns].
    """

    position: int
    channel_id: int
    sequence: int
    log_time_ns: int
    publish_time_ns: int
    payload: bytes


@dataclass(frozen=True)
class _Found:
    """A segment with a readable header; records end before byte ``end``."""

    path: Path
    header: SegmentHeader
    end: int


class Recovery(Iterator[WalMessage]):
    """Iterates over the messages of a log, in order.

    Attributes:
        definitions: Headers, schemas, channels, metadata, attachments, in the order given.
        returned: Number of messages returned so far.
        before: Number of messages before the first one: released to the MCAP, or lost with their
            segment.
        missing: Number of messages missing between those found.
        warnings: Damage, one sentence each; complete when the iteration has ended.
    """

    def __init__(self, folder: Path) -> None:
        """Open a log; :func:`recover` does.

        Raises:
            NotALogError: If there is no segment, or no header of one can be read.
            LogError: If the folder can't be listed.
        """
        self.folder = folder
        self.returned = self.before = self.missing = 0
        self.warnings: list[str] = []
        segments = self._open()
        self._segments = [item for item in segments if item.header.stream == MESSAGES]
        self.definitions = tuple(
            self._define([item for item in segments if item.header.stream == DEFINITIONS])
        )
        self._messages = self._read_messages()

    def __iter__(self) -> Iterator[WalMessage]:
        """Return self: a second loop continues where the first one stopped."""
        return self

    def __next__(self) -> WalMessage:
        """Return the next whole message.

        Raises:
            StopIteration: At the end.
        """
        return next(self._messages)

    def _open(self) -> list[_Found]:
        try:
            files = segment_files(self.folder)
        except OSError as error:
            fault = f"no write-ahead log can be read here: {error.strerror}"
            raise LogError(self.folder, fault) from error
        if not files:
            raise NotALogError(self.folder, "no segment of a write-ahead log is in this folder")
        segments: list[_Found] = []
        for stream, number, path in files:
            opened = self._read_header(stream, number, path)
            if (
                opened is not None
                and segments
                and opened.header.log_id != segments[0].header.log_id
            ):
                self.warnings.append(f"{path.name} is of another log; left out")
            elif opened is not None:
                segments.append(opened)
        if not segments:
            reasons = "; ".join(self.warnings) or "its segments were made or removed meanwhile"
            raise NotALogError(self.folder, reasons)
        return segments

    def _read_header(self, stream: int, number: int, path: Path) -> _Found | None:
        try:
            check_regular(path)
            with path.open("rb") as file:
                size = file.seek(0, os.SEEK_END)
                file.seek(0)
                first = file.read(HEADER_SIZE)
                file.seek(max(0, size - HEADER_SIZE))
                last = file.read(HEADER_SIZE)
            header = SegmentHeader.unpack(first) or SegmentHeader.unpack(last)
            if header is None:
                if any(first + last) or not is_live(self.folder):  # else it is being made
                    self.warnings.append(f"{path.name} has no readable header; left out")
                return None
        except FileNotFoundError:  # a log in use: released since it was listed
            return None
        except OSError as error:
            self.warnings.append(f"{path.name} can't be read: {error.strerror}; left out")
            return None
        if (header.stream, header.number) != (stream, number):
            self.warnings.append(f"{path.name} is a renamed segment; left out")
            return None
        if size < header.size:
            self.warnings.append(f"{path.name} is cut short: {size} of {header.size} bytes")
        return _Found(path, header, min(size, header.size - HEADER_SIZE))

    def _define(self, segments: list[_Found]) -> Iterator[Definition]:
        last = 0
        for head, payload in self._records(segments):
            if head.position > last + 1:
                self.warnings.append(f"{head.position - last - 1} definitions are missing")
            last = head.position
            try:
                yield unpack_definition(head.kind, payload)
            except (McapError, struct.error, ValueError, OverflowError) as error:
                self.warnings.append(f"definition {head.position} can't be read: {error}")

    def _read_messages(self) -> Iterator[WalMessage]:
        defined = {item.id for item in self.definitions if isinstance(item, Channel)}
        unknown: set[int] = set()
        last = 0
        for head, payload in self._records(self._segments):
            gap = head.position - last - 1
            if last:
                self.missing += gap
            else:
                self.before = gap
            last = head.position
            self.returned += 1
            if head.channel_id not in defined:
                unknown.add(head.channel_id)
            yield WalMessage(
                head.position,
                head.channel_id,
                head.sequence,
                head.log_time_ns,
                head.publish_time_ns,
                payload,
            )
        if self.missing:
            self.warnings.append(f"{self.missing} messages are missing between those found")
        if unknown:
            listed = ", ".join(map(str, sorted(unknown)))
            self.warnings.append(f"messages of channels that are not defined: {listed}")

    def _records(self, segments: list[_Found]) -> Iterator[tuple[RecordHead, bytes]]:
        former: _SegmentReader | None = None
        reader: _SegmentReader | None = None
        last = 0
        try:
            for segment in segments:
                reader = None
                try:
                    reader = _SegmentReader(segment, segment.path.open("rb"), last)
                    for head, payload in reader.records():
                        if former is not None:
                            # A log in use: the former segment has grown while it was read.
                            yield from former.later()
                        last = head.position
                        former = _closed(former)
                        yield head, payload
                except FileNotFoundError:  # a log in use: released since it was listed
                    continue
                except OSError as error:
                    text = f"{segment.path.name} can't be read to its end: {error.strerror}"
                    self.warnings.append(text)
                    _closed(reader)
                    continue
                _closed(former)
                former = reader
                if reader.damaged:
                    self.warnings.append(
                        f"{segment.path.name}: {reader.damaged} bytes are no whole records, "
                        f"the first at byte {reader.first_damage}"
                    )
        finally:
            _closed(former)
            _closed(reader)


class _SegmentReader:
    """Reads one segment.

    ``damaged`` counts the bytes from the expected start of a record to the next whole record, or to
    the last byte that isn't zero.
    """

    def __init__(self, segment: _Found, file: BinaryIO, last: int) -> None:
        self.last = last
        self.damaged = self.first_damage = 0
        self._file = file
        self._at = HEADER_SIZE
        self._end = segment.end
        self._salt = segment.header.salt
        self._kinds = STREAM_KINDS[segment.header.stream]

    def records(self) -> Iterator[tuple[RecordHead, bytes]]:
        while (at := self._at) < self._end:
            head = self._whole(at)
            if head is None:
                following, stop = self._search(at)
                if following is not None:
                    # A log in use: this record was being written; a later one exists, so now it is
                    # whole.
                    self._forget()
                    head = self._whole(at)
                if head is None:
                    self.first_damage = self.first_damage or at
                    self.damaged += stop - at
                    if following is None:
                        return
                    at, head = following
            self.last = head.position
            self._file.seek(at + RECORD_SIZE)
            payload = self._file.read(head.length)
            self._at = (at + RECORD_SIZE + head.length + 7) & -8
            yield head, payload

    def later(self) -> Iterator[tuple[RecordHead, bytes]]:
        """Yield records written since the end was reached."""
        self._forget()
        yield from self.records()

    def close(self) -> None:
        self._file.close()

    def _forget(self) -> None:
        """Drop the read buffer, as every seek to the end does."""
        self._file.seek(0, os.SEEK_END)

    def _whole(self, at: int) -> RecordHead | None:
        """Return the head of the record at an offset, if its CRC fits.

        The CRC is computed in pieces, so that a wrong length allocates no memory.
        """
        left = self._end - at - RECORD_SIZE
        self._file.seek(at)
        raw = self._file.read(RECORD_SIZE)
        if len(raw) < RECORD_SIZE:
            return None
        head = RecordHead._make(RECORD_BODY.unpack_from(raw, RECORD_CRC.size))
        fits = head.length <= min(left, MAX_PAYLOAD) and head.position > self.last
        if head.mark != MARK or head.kind not in self._kinds or not fits:
            return None
        crc = zlib.crc32(raw[RECORD_CRC.size :], self._salt)
        for start in range(0, head.length, _PIECE):
            crc = zlib.crc32(self._file.read(min(_PIECE, head.length - start)), crc)
        return head if (crc,) == RECORD_CRC.unpack_from(raw) else None

    def _search(self, at: int) -> tuple[tuple[int, RecordHead] | None, int]:
        """Find the next whole record behind an offset, and the end of the damage."""
        damage_stop = at
        start, size = at, _FIRST_LOOK
        while start < self._end:
            self._file.seek(start)
            # Reads overlap by the length of a head, so that none is split.
            data = self._file.read(min(size + RECORD_SIZE, self._end - start))
            if not _ZEROS.startswith(data):  # the usual case, at the speed of memcmp
                for offset in self._candidates(data):
                    head = self._whole(start + offset)
                    if head is not None:
                        return (start + offset, head), start + offset
                damage_stop = start + len(data.rstrip(b"\0"))
            start += size
            size = min(2 * size, _PIECE)
        return None, damage_stop

    def _candidates(self, data: bytes) -> list[int]:
        """Return offsets, multiples of 8, with kind and mark of a record."""
        words = np.frombuffer(data[: len(data) & -8], dtype="<u8")
        marked = np.zeros(words[2:].size, dtype=bool)
        for kind in self._kinds:
            marked |= words[2:] & np.uint64(0xFFFF) == kind | MARK << 8
        return [int(index) * 8 for index in np.flatnonzero(marked)]


def _closed(reader: _SegmentReader | None) -> None:
    if reader is not None:
        reader.close()


def recover(folder: Path | str) -> Recovery:
    """Read a write-ahead log without changing it.

    ::

        recovery = recover("run.mcap.wal")
        for message in recovery:
            ...
        print(recovery.returned, recovery.missing, recovery.warnings)

    Args:
        folder: The log, see :func:`.capture.log.wal.writer.wal_folder`.

    Returns:
        The messages, with the definitions and the number of missing messages. One message is in
        memory at a time.

    Raises:
        NotALogError: If there is no segment in it, or none that can be read.
        LogError: If the folder can't be listed.
    """
    return Recovery(Path(folder))


@dataclass(frozen=True)
class WalContents:
    """Contents of a write-ahead log.

    Attributes:
        definitions: Headers, schemas, channels, metadata, attachments, in the order given.
        messages: In the order they were accepted.
        live: Whether a recorder is writing it.
        warnings: What was damaged, one sentence each.
    """

    folder: Path
    definitions: tuple[Definition, ...]
    messages: tuple[WalMessage, ...]
    live: bool
    warnings: tuple[str, ...]

    @property
    def accepted(self) -> int:
        """Number of messages that the recorder accepted; 0 if unknown."""
        return self.messages[-1].position if self.messages else 0

    @property
    def before(self) -> int:
        """Number of messages accepted before the first one in the log."""
        return self.messages[0].position - 1 if self.messages else 0

    @property
    def damaged(self) -> bool:
        """Whether a part can't be read, so that it may have had more messages."""
        return any("header" not in text for text in self.warnings)


def read_wal(first: Path) -> WalContents | None:
    """Read the write-ahead log of a session, without changing it.

    Args:
        first: The session's first file; it need not be there.

    Returns:
        Its contents; None if there is no log.

    Raises:
        LogError: If its folder can't be listed.
    """
    folder = wal_folder(first)
    if not folder.is_dir():
        return None
    live = is_live(folder)
    try:
        recovery = recover(folder)
        messages = tuple(recovery)
    except NotALogError as error:
        warnings = () if live else (str(error),)
        return WalContents(folder, (), (), live, warnings)
    except LogError:
        if not folder.is_dir():  # its recorder has just finished
            return None
        raise
    # Only log and file together show whether a message is missing.
    warnings = [text for text in recovery.warnings if "messages are missing" not in text]
    return WalContents(folder, recovery.definitions, messages, live, tuple(warnings))


class WalTail:
    """A block in memory; read like a file's."""

    def __init__(self, messages: Iterable[WalMessage]) -> None:
        """Lay out messages as MCAP records.

        Args:
            messages: At least one, in order.
        """
        data = bytearray()
        places: dict[int, list[int]] = {}
        times_ns: list[int] = []
        for item in messages:
            places.setdefault(item.channel_id, []).append(len(data))
            data += MESSAGE.pack(
                Opcode.MESSAGE,
                FIXED_SIZE + len(item.payload),
                item.channel_id,
                item.sequence,
                item.log_time_ns,
                item.publish_time_ns,
            )
            data += item.payload
            times_ns.append(item.log_time_ns)
        self._data = bytes(data)
        self.counts = {channel_id: len(at) for channel_id, at in places.items()}
        offsets = {channel_id: np.array(at, dtype=np.int64) for channel_id, at in places.items()}
        size = len(self._data)
        self.blocks = [Block(0, size, "", size, 0, min(times_ns), max(times_ns), offsets=offsets)]

    def payload(self, block: Block) -> tuple[bytes, int, int]:
        """See :meth:`.McapPayloads.payload`."""
        return self._data, block.start, block.stop

    payload_once = payload

    def offsets(self, block: Block, channel_id: int) -> IntArray:
        """See :meth:`.McapFile.offsets`."""
        return (block.offsets or {}).get(channel_id, np.empty(0, dtype=np.int64))

    def indexed(self, block: Block, channel_ids: Sequence[int]) -> list[IntArray]:
        """See :meth:`.McapFile.indexed`."""
        return [self.offsets(block, channel_id) for channel_id in channel_ids]

    def inflates(self, block: Block, limit: int) -> bool:  # noqa: ARG002 (as a file has it)
        """Return False: nothing is compressed."""
        return False

    def inflate_into(self, block: Block, room: memoryview) -> None:
        """See :meth:`.McapPayloads.inflate_into`."""
        room[:] = self._data[block.start : block.stop]


def beyond(messages: Iterable[WalMessage], keys: Collection[MessageKey]) -> list[WalMessage]:
    """Return the messages that a file lacks.

    Args:
        keys: Keys of the file's messages: at least of the last ones, as many as the log has.
    """
    return [
        item for item in messages if (item.channel_id, item.sequence, item.log_time_ns) not in keys
    ]
