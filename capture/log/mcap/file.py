"""MCAP as blocks of messages: the contents of a file and their positions, without decoding.

A :class:`Block` is one chunk (or the unchunked part of a file) with the offsets of each
channel's messages. An indexed file is opened from its summary alone; a file without one
(truncated, or written without an index) is read record by record, and ``warnings`` lists the parts
that could not be read.

Format: https://mcap.dev/spec.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from io import BytesIO
from pathlib import Path
from typing import TypeVar

import numpy as np
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    Header,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
)

from ...common.arrays import IntArray, frozen
from ...common.errors import LogError, NotALogError
from ...common.looks import HEAD, looks_like
from .chunk import (
    MAGIC,
    PREFIX_SIZE,
    Block,
    Buffer,
    chunk_at,
    next_chunk,
    summary_fits,
    walk_records,
)
from .payloads import FetchedFile, McapPayloads

_Record = TypeVar("_Record")


_FOOTER = struct.Struct("<QQI")  # first byte of the summary and of its offsets, CRC
_FOOTER_SIZE = PREFIX_SIZE + _FOOTER.size
_CHUNK_INDEX = struct.Struct("<16xQQI")  # after the times: the chunk's place and length, offsets
_INDEX_END = struct.Struct("<QI")  # behind the offsets: sizes of the indexes and of a name,
_SIZES = struct.Struct("<QQ")  # the compression's; behind it: of the payload, stored and not
_INDEX_OFFSET = struct.Struct("<HQ")  # channel, place of its message index


_INDEXED: dict[int, tuple[Opcode, Callable[[ReadDataStream], AttachmentIndex | MetadataIndex]]] = {
    Opcode.ATTACHMENT_INDEX: (Opcode.ATTACHMENT, AttachmentIndex.read),
    Opcode.METADATA_INDEX: (Opcode.METADATA, MetadataIndex.read),
}

_INDEX_HEAD = struct.Struct("<BQHI")  # of a message index: opcode, length, channel, entries' size
_NO_OFFSETS: IntArray = frozen(np.empty(0, dtype=np.int64))


class _NoSummaryError(Exception):
    """The file can't be opened from its summary."""


class _Summary:
    """Reads the summary of a file; of the rest, only the heads of its chunks."""

    def __init__(self, file: McapFile) -> None:
        self._file = file
        self._buffer = file.buffer

    def read(self) -> None:
        buffer, file = self._buffer, self._file
        summary_start, footer = self._range()
        indexes: list[tuple[int, int]] = []  # opcode of the indexed record, its offset
        statistics: Statistics | None = None
        try:
            for opcode, start, stop in walk_records(buffer, len(MAGIC), footer):
                file.take(opcode, buffer, start, stop)
                break  # the header is the first record
            for opcode, start, stop in walk_records(buffer, summary_start, footer):
                if opcode == Opcode.CHUNK_INDEX:
                    file.blocks.append(self._block(start, stop))
                elif opcode == Opcode.STATISTICS:
                    statistics = file.parse(Statistics.read, buffer, start, stop)
                elif opcode in _INDEXED:
                    indexed, read = _INDEXED[opcode]
                    indexes.append((indexed, file.parse(read, buffer, start, stop).offset))
                else:
                    file.take(opcode, buffer, start, stop)
            self._check_places(summary_start)
            before = 0
            for opcode, offset in sorted(indexes, key=lambda index: index[1]):  # file order
                start, before = self._record_at(offset, before)
                file.take(opcode, buffer, start, before)
        except (LogError, McapError, struct.error, ValueError) as error:
            raise _NoSummaryError(f"the summary is damaged ({error})") from error
        if statistics is None or not file.channels:
            raise _NoSummaryError("the summary does not list the channels")
        if statistics.message_count and not file.blocks:
            raise _NoSummaryError("the file has no chunk index")
        if statistics.attachment_count + statistics.metadata_count != len(indexes):
            raise _NoSummaryError("the summary does not list all attachments and metadata")
        file.counts = dict(statistics.channel_message_counts)

    def _range(self) -> tuple[int, int]:
        """Return the first byte of the summary and of the footer."""
        buffer = self._buffer
        footer = len(buffer) - len(MAGIC) - _FOOTER_SIZE
        self._file.need(max(footer, 0), len(buffer))
        if footer < len(MAGIC) or buffer[-len(MAGIC) :] != MAGIC or buffer[footer] != Opcode.FOOTER:
            raise _NoSummaryError("the file is cut short (no footer)")
        summary_start, _, _ = _FOOTER.unpack_from(buffer, footer + PREFIX_SIZE)
        if not len(MAGIC) <= summary_start < footer:
            raise _NoSummaryError("the file has no summary")
        self._file.need(summary_start, footer)
        if not summary_fits(buffer, summary_start):
            raise _NoSummaryError("the summary is damaged (its CRC doesn't fit)")
        return summary_start, footer

    def _block(self, start: int, stop: int) -> Block:
        """Return the block of a chunk index; an hour has thousands of them, so little is read."""
        path, buffer = self._file.path, self._buffer
        entries_at = start + _CHUNK_INDEX.size
        if entries_at > stop:
            raise LogError(path, "a chunk index is cut short")
        at, length, size = _CHUNK_INDEX.unpack_from(buffer, start)
        if size % _INDEX_OFFSET.size or entries_at + size > stop:
            raise LogError(path, "a chunk index is damaged")
        if not len(MAGIC) <= at <= at + length <= len(buffer):
            raise LogError(path, f"a chunk index points to byte {at}, outside the file")
        if self._file.remote is None:
            block = _chunk_at(self._file, at + PREFIX_SIZE, at + length)
        else:
            block = self._indexed_only(self._file.remote, start, entries_at + size, stop)
        block.index_at = dict(_INDEX_OFFSET.iter_unpack(buffer[entries_at : entries_at + size]))
        return block

    def _indexed_only(self, remote: FetchedFile, start: int, at: int, stop: int) -> Block:
        """Return the block of a chunk that isn't here; its CRC is read with it."""
        buffer, error = self._buffer, LogError(self._file.path, "a chunk index is cut short")
        if at + _INDEX_END.size > stop:
            raise error
        indexes, name_size = _INDEX_END.unpack_from(buffer, at)
        name_at = at + _INDEX_END.size
        if name_at + name_size + _SIZES.size > stop:
            raise error
        name = buffer[name_at : name_at + name_size].decode("ascii", "replace")
        stored, size = _SIZES.unpack_from(buffer, name_at + name_size)
        begin, end, record_at, length = struct.unpack_from("<4Q", buffer, start)
        first, last = record_at + length - stored, record_at + length
        block = Block(first, last, name, size, 0, begin, end, record_at=record_at)
        if stored > length or last + indexes > len(buffer):
            raise LogError(self._file.path, "a chunk index is damaged")
        remote.add(block, last + indexes)
        return block

    def _check_places(self, summary_start: int) -> None:
        """Refuse chunks and message indexes that share bytes."""
        blocks = self._file.blocks
        blocks.sort(key=lambda block: block.start)
        starts = [block.start for block in blocks]
        for block, bound in zip(blocks, [*starts, summary_start][1:], strict=True):
            places = block.index_at.values()
            if block.stop > bound or (
                places and not block.stop <= min(places) <= max(places) < bound
            ):
                where = f"the chunk at byte {block.start}"
                raise LogError(self._file.path, f"the indexes of {where} and of another overlap")

    def _record_at(self, offset: int, before: int) -> tuple[int, int]:
        """Return the range of an indexed record's body, which begins at ``before`` or later."""
        if offset < before:
            raise LogError(self._file.path, f"indexes overlap at byte {offset}")
        self._file.need(offset, offset + PREFIX_SIZE)
        if self._file.remote is not None and offset + PREFIX_SIZE <= len(self._buffer):
            (length,) = struct.unpack_from("<Q", self._buffer, offset + 1)
            if length <= len(self._buffer):
                self._file.need(offset, offset + PREFIX_SIZE + length)
        for _, start, stop in walk_records(self._buffer, offset, len(self._buffer)):
            return start, stop
        raise LogError(self._file.path, f"an index points to byte {offset}, where no record is")


class _Scan:
    """Reads the records of a file without a whole summary, one after the other."""

    def __init__(self, file: McapFile) -> None:
        self._file = file
        end = len(file.buffer)
        self._loose = Block(0, end, "", end, 0, 2**63 - 1, 0, offsets={})
        self._loose_at: dict[int, list[int]] = {}

    def read(self) -> None:
        """Read from the first record to the last whole one."""
        file, buffer, end = self._file, self._file.buffer, len(self._file.buffer)
        file.need(0, end)
        former = at = len(MAGIC)
        while at + PREFIX_SIZE <= end:
            opcode = buffer[at]
            (length,) = struct.unpack_from("<Q", buffer, at + 1)
            start, stop = at + PREFIX_SIZE, at + PREFIX_SIZE + length
            if stop > end or opcode == 0:
                # The break may be a wrong length in the record before, too.
                following = next_chunk(buffer, former + 1, end)
                if following is None:
                    self._salvage(opcode, start, end)
                    break
                file.warnings.append(
                    f"the record at byte {at} is damaged and was skipped: the next whole chunk is "
                    f"at byte {following}"
                )
                former = at = following
                continue
            try:
                self._record(opcode, start, stop)
            except (McapError, struct.error, ValueError, LogError) as error:
                file.warnings.append(f"the record at byte {at} is damaged and was skipped: {error}")
            if opcode == Opcode.DATA_END:
                break
            former, at = at, stop
        if self._loose_at:
            file.add_unindexed(self._loose, _arrays(self._loose_at))

    def _record(self, opcode: int, start: int, stop: int) -> None:
        buffer, loose = self._file.buffer, self._loose
        if opcode == Opcode.CHUNK:
            self._chunk(_chunk_at(self._file, start, stop))
        elif opcode == Opcode.MESSAGE:
            channel_id, _, log_time = struct.unpack_from("<HIQ", buffer, start)
            self._loose_at.setdefault(channel_id, []).append(start - PREFIX_SIZE)
            loose.start_ns = min(loose.start_ns, log_time)
            loose.end_ns = max(loose.end_ns, log_time)
        else:
            self._file.take(opcode, buffer, start, stop)

    def _chunk(self, block: Block) -> None:
        self._file.add_unindexed(block, self._file.walk(block))

    def _salvage(self, opcode: int, start: int, end: int) -> None:
        """Read the beginning of the last record, which is cut short by the end of the file."""
        warnings = self._file.warnings
        if opcode == Opcode.CHUNK:
            try:
                block = _chunk_at(self._file, start, end)
                block.complete = False
                self._chunk(block)
            except (McapError, struct.error, ValueError, LogError) as error:
                warnings.append(f"nothing of the last, cut chunk could be read: {error}")
                return
            count = sum(len(at) for at in (block.offsets or {}).values())
            data, _, _ = self._file.payload(block)
            warnings.append(
                f"the last chunk is cut short: {count} messages of it could be read "
                f"({len(data)} of {block.size} bytes)"
            )
        else:
            warnings.append(f"the last {end - start + PREFIX_SIZE} bytes are a cut record")


def _arrays(offsets: dict[int, list[int]]) -> dict[int, IntArray]:
    return {channel_id: np.array(at, dtype=np.int64) for channel_id, at in offsets.items()}


def _chunk_at(file: McapPayloads, start: int, stop: int) -> Block:
    block = chunk_at(file.buffer, start, stop)
    if block is None:
        raise LogError(file.path, f"the chunk at byte {start} is cut in its header")
    return block


class Contents:
    """Blocks, channels, schemas, metadata and attachments of one MCAP file or several.

    Attributes:
        profile: As stated in the header, like ``library``.
        counts: Channel id to number of messages.
        metadata: By name; records of one name are merged.
        attachments: By name; of several the last.
        appendices: Both, as stored; names may repeat.
        warnings: Parts that could not be read, one sentence each.
    """

    def __init__(self) -> None:
        """Start without any."""
        self.profile = self.library = ""
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self.blocks: list[Block] = []
        self.counts: dict[int, int] = {}
        self.metadata: dict[str, dict[str, str]] = {}
        self.attachments: dict[str, Attachment] = {}
        self.appendices: list[Attachment | Metadata] = []
        self.warnings: list[str] = []

    def append(self, item: Attachment | Metadata) -> None:
        """Add an attachment or a metadata record."""
        self.appendices.append(item)
        if isinstance(item, Attachment):
            self.attachments[item.name] = item
        else:
            self.metadata.setdefault(item.name, {}).update(item.metadata)


class McapFile(Contents, McapPayloads):
    """The contents of an MCAP file.

    Attributes:
        cut: Why the file was read record by record; empty if the summary was enough.
    """

    def __init__(self, path: Path, *, bare: bool = False) -> None:
        """Open a file and find its contents.

        Args:
            bare: Accept a file without channels: a write-ahead log or another part has them.

        Raises:
            NotALogError: If it is empty, not MCAP, or nothing in it can be read.
            LogError: If the operating system can't open it.
        """
        McapPayloads.__init__(self, path)
        Contents.__init__(self)
        self.cut = ""
        try:
            self._find_contents(bare=bare)
        except BaseException:
            self.close()
            raise

    def _find_contents(self, *, bare: bool) -> None:
        if self.buffer[: len(MAGIC)] != MAGIC:
            looks = looks_like(bytes(self.buffer[:HEAD]))
            raise NotALogError(
                self.path,
                f"not an MCAP file: it {looks}; 'undulog import' takes logs of other formats",
            )
        try:
            _Summary(self).read()
        except _NoSummaryError as why:
            # What a damaged summary says of channels may be wrong as well.
            Contents.__init__(self)
            _Scan(self).read()
            self.cut = str(why)
            self.warnings.append(f"{why}; read record by record")
        if not self.channels and not bare:
            raise NotALogError(self.path, "an MCAP file without any channel that could be read")
        self.blocks.sort(key=lambda block: block.start)

    def take(self, opcode: int, data: Buffer, start: int, stop: int) -> None:
        """Store a record of the data section, a chunk or the summary; ignore other kinds.

        Args:
            data: Buffer that holds the record's body, [start, stop).

        Raises:
            LogError: If it is damaged; mcap, struct and codecs raise errors of their own, too.
        """
        if opcode == Opcode.HEADER:
            header = self.parse(Header.read, data, start, stop)
            self.profile, self.library = header.profile, header.library
        elif opcode == Opcode.SCHEMA:
            schema = self.parse(Schema.read, data, start, stop)
            self.schemas[schema.id] = schema
        elif opcode == Opcode.CHANNEL:
            channel = self.parse(Channel.read, data, start, stop)
            self.channels[channel.id] = channel
        elif opcode == Opcode.ATTACHMENT:
            self.append(self.parse(Attachment.read, data, start, stop))
        elif opcode == Opcode.METADATA:
            self.append(self.parse(Metadata.read, data, start, stop))

    def parse(
        self, read: Callable[[ReadDataStream], _Record], data: Buffer, start: int, stop: int
    ) -> _Record:
        """Parse the body of one record, [start, stop) of ``data``, with the reader of its kind.

        Raises:
            LogError: If it claims more bytes than there is memory for.
        """
        try:
            return read(ReadDataStream(BytesIO(data[start:stop])))
        except OverflowError as error:  # a length beyond all memory
            raise LogError(self.path, f"the record at byte {start} is damaged") from error

    def walk(self, block: Block) -> dict[int, IntArray]:
        """Walk a block without index and store its schemas and channels.

        Returns:
            Channel id to the offsets of its messages in the payload.

        Raises:
            LogError: If a record is damaged; as for :meth:`take`.
        """
        offsets: dict[int, list[int]] = {}
        data, base, end = self.payload(block)
        for opcode, start, stop in walk_records(data, base, end):
            if opcode == Opcode.MESSAGE:
                (channel_id,) = struct.unpack_from("<H", data, start)
                offsets.setdefault(channel_id, []).append(start - PREFIX_SIZE - base)
            else:
                self.take(opcode, data, start, stop)
        return _arrays(offsets)

    def add_unindexed(self, block: Block, offsets: dict[int, IntArray]) -> None:
        """Add a block whose messages were found by reading it."""
        block.offsets = offsets
        for channel_id, at in offsets.items():
            self.counts[channel_id] = self.counts.get(channel_id, 0) + len(at)
        self.blocks.append(block)

    def indexed(self, block: Block, channel_ids: Sequence[int]) -> list[IntArray]:
        """Return the offsets of some channels' message records in a block's payload, unchecked.

        Returns:
            For each channel the offsets of its records' opcode bytes, shape (n,), in the order of
            the index. They may be views of the file and must be dropped before it is closed.

        Raises:
            LogError: If the index or the payload is damaged.
        """
        if block.offsets is not None or not block.index_at:
            return [self.offsets(block, channel_id) for channel_id in channel_ids]
        buffer, base = self.around(block)
        end = len(buffer)
        head_size = _INDEX_HEAD.size
        offsets: list[IntArray] = []
        for channel_id in channel_ids:
            at = block.index_at.get(channel_id)
            if at is None:
                offsets.append(_NO_OFFSETS)
                continue
            at -= base
            if at + head_size > end:
                raise LogError(self.path, f"an index points to byte {at}, where no record is")
            opcode, length, found_id, size = _INDEX_HEAD.unpack_from(buffer, at)
            if opcode != Opcode.MESSAGE_INDEX or at + head_size + size > end:
                raise LogError(self.path, f"no message index at byte {at}")
            if found_id != channel_id or size + 6 != length or size % 16:
                raise LogError(self.path, f"the message index at byte {at} is damaged")
            entries = np.frombuffer(buffer, "<i8", size // 8, at + head_size)
            offsets.append(entries[1::2])  # log time and offset of each
        return offsets

    def offsets(self, block: Block, channel_id: int) -> IntArray:
        """Return the offsets of a channel's message records in a block's payload, checked.

        Returns:
            Offsets of the records' opcode bytes, shape (n,), in the order of the index.

        Raises:
            LogError: If the index or the payload is damaged.
        """
        if block.offsets is None and block.index_at:
            return self._message_index(block, channel_id)
        if block.offsets is None:  # a chunk that was written without a message index
            block.offsets = self.walk(block)
        return block.offsets.get(channel_id, np.empty(0, dtype=np.int64))

    def _message_index(self, block: Block, channel_id: int) -> IntArray:
        (offsets,) = self.indexed(block, [channel_id])
        if offsets.size and not 0 <= offsets.min() <= offsets.max() <= block.size - PREFIX_SIZE:
            raise LogError(
                self.path, f"a message index of channel {channel_id} points outside its chunk"
            )
        return offsets.copy()
