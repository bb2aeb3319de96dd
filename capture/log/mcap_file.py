"""MCAP as blocks of messages: what the file holds and where, without decoding it.

A :class:`Block` is one chunk (or the unchunked part of a file) with the offsets of each
channel's messages. An indexed file is opened from its summary alone; a file without one
(truncated, or written without an index) is walked record by record, and what could not be read
is said in ``warnings``.

Format: https://mcap.dev/spec.
"""

from __future__ import annotations

import mmap
import os
import struct
import weakref
import zlib
from collections import OrderedDict
from collections.abc import Callable, Sequence
from io import BytesIO
from pathlib import Path
from typing import TypeVar

import numpy as np
import zstandard
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

from ..arrays import IntArray, frozen
from ..errors import LogError, NotALogError
from .chunk import (
    PREFIX_SIZE,
    Block,
    Buffer,
    checks_itself,
    inflate,
    inflate_zstd_into,
    next_chunk,
    read_at,
    walk_records,
)

MAGIC = b"\x89MCAP0\r\n"
_FOOTER_SIZE = 1 + 8 + 20
_CHUNK_INDEX = struct.Struct("<16xQQI")  # after the times: the chunk's place and length, offsets
_CHUNK_HEAD = struct.Struct("<QQQII")  # start, end, size, CRC, length of the compression's name
_INDEX_OFFSET = struct.Struct("<HQ")  # channel, place of its message index
_INDEX_HEAD = struct.Struct("<BQHI")  # of a message index: opcode, length, channel, entries' size
_NO_OFFSETS: IntArray = frozen(np.empty(0, dtype=np.int64))
_MAX_BLOCK_SIZE = 1 << 30
_CACHE_SIZE = 64 << 20

_Record = TypeVar("_Record")


class _NoSummaryError(Exception):
    """The file can't be opened from its summary."""


class McapFile:
    """An MCAP file, memory-mapped, as blocks, channels, schemas, metadata and attachments."""

    def __init__(self, path: Path, *, bare: bool = False) -> None:
        """Open a file and find what it holds.

        Args:
            path: The MCAP file.
            bare: Take it without any channel too: a write-ahead log or another part has them.

        Raises:
            NotALogError: If it is empty, not MCAP, or nothing in it can be read.
            LogError: If the operating system can't open it.
        """
        self.path = path
        self.warnings: list[str] = []
        self.profile = ""
        self.library = ""
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self.blocks: list[Block] = []
        self.counts: dict[int, int] = {}
        self.metadata: dict[str, dict[str, str]] = {}
        self.attachments: dict[str, Attachment] = {}
        self.appendices: list[Attachment | Metadata] = []  # as stored; names may repeat
        self.cut = ""  # why it was read record by record
        self._bare = bare
        self._cache: OrderedDict[int, Buffer] = OrderedDict()
        self._buffer, descriptor = self._map()
        self._close_descriptor = weakref.finalize(self, os.close, descriptor)
        self._descriptor = descriptor
        try:
            self._load()
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Release the mapping."""
        self._cache.clear()
        self._buffer.close()
        self._close_descriptor()

    def forget(self) -> None:
        """Let go of the file's pages and of what was decompressed; it is read again when needed."""
        self._cache.clear()
        if hasattr(mmap, "MADV_DONTNEED"):  # what is mapped counts as this process's memory
            self._buffer.madvise(mmap.MADV_DONTNEED)

    def payload(self, block: Block) -> tuple[Buffer, int]:
        """See :meth:`BlockSource.payload`."""
        if not block.compression:
            return self._buffer, block.start
        if block.start in self._cache:
            self._cache.move_to_end(block.start)
            return self._cache[block.start], 0
        data = self._decompress(block)
        self._cache[block.start] = data
        while len(self._cache) > 1 and sum(map(len, self._cache.values())) > _CACHE_SIZE:
            self._cache.popitem(last=False)
        return data, 0

    def payload_once(self, block: Block) -> tuple[Buffer, int, int]:
        """See :meth:`BlockSource.payload_once`."""
        if block.compression:
            data = self._decompress(block)
            return data, 0, len(data)
        if block.crc and block.complete:
            with memoryview(self._buffer) as whole, whole[block.start : block.stop] as payload:
                if zlib.crc32(payload) != block.crc:
                    where = f"the chunk at byte {block.start}"
                    raise LogError(self.path, f"{where} is corrupt (its CRC doesn't fit)")
        return self._buffer, block.start, block.stop

    def inflates(self, block: Block, limit: int) -> bool:
        """See :meth:`BlockSource.inflates`."""
        return block.compression == "zstd" and block.complete and 0 < block.size <= limit

    def inflate_into(self, block: Block, room: memoryview) -> None:
        """See :meth:`BlockSource.inflate_into`.

        A frame that has a checksum of its own is not held against the chunk's CRC as well: both
        are 32 bits of the same bytes, and decompression has verified the one.
        """
        where = f"the chunk at byte {block.start}"
        try:
            with read_at(self._descriptor, block.start, block.stop) as raw:
                size = inflate_zstd_into(raw, room)
                checked = not block.crc or checks_itself(raw)
        except zstandard.ZstdError as error:
            raise LogError(self.path, f"{where} can't be decompressed: {error}") from error
        except OSError as error:
            raise LogError(self.path, f"{where} can't be read: {error.strerror}") from error
        if size != block.size:
            raise LogError(self.path, f"{where} has {size} bytes, not {block.size}")
        if not checked and zlib.crc32(room) != block.crc:
            raise LogError(self.path, f"{where} is corrupt (its CRC doesn't fit)")

    def indexed(self, block: Block, channel_ids: Sequence[int]) -> list[IntArray]:
        """See :meth:`BlockSource.indexed`."""
        if block.offsets is not None or not block.index_at:
            return [self.offsets(block, channel_id) for channel_id in channel_ids]
        buffer, end = self._buffer, len(self._buffer)
        head_size = _INDEX_HEAD.size
        found: list[IntArray] = []
        for channel_id in channel_ids:
            at = block.index_at.get(channel_id)
            if at is None:
                found.append(_NO_OFFSETS)
                continue
            if at + head_size > end:
                raise LogError(self.path, f"an index points to byte {at}, where no record is")
            opcode, length, found_id, size = _INDEX_HEAD.unpack_from(buffer, at)
            if opcode != Opcode.MESSAGE_INDEX or at + head_size + size > end:
                raise LogError(self.path, f"no message index at byte {at}")
            if found_id != channel_id or size + 6 != length or size % 16:
                raise LogError(self.path, f"the message index at byte {at} is damaged")
            entries = np.frombuffer(buffer, "<i8", size // 8, at + head_size)
            found.append(entries[1::2])  # log time and offset of each
        return found

    def offsets(self, block: Block, channel_id: int) -> IntArray:
        """See :meth:`BlockSource.offsets`."""
        if block.offsets is None and block.index_at:
            return self._message_index(block, channel_id)
        if block.offsets is None:  # a chunk that was written without a message index
            block.offsets = self._walk_block(block)
        return block.offsets.get(channel_id, np.empty(0, dtype=np.int64))

    # -- opening ---------------------------------------------------------------------------

    def _map(self) -> tuple[mmap.mmap, int]:
        """The file in memory, and a descriptor of it."""
        try:
            with self.path.open("rb") as stream:
                if not stream.read(1):
                    raise NotALogError(self.path, "the file is empty (0 bytes)")
                data = mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ)
                return data, os.dup(stream.fileno())
        except FileNotFoundError as error:
            raise LogError(self.path, "no such file") from error
        except OSError as error:
            raise LogError(self.path, f"can't be opened: {error.strerror}") from error

    def _load(self) -> None:
        if self._buffer[: len(MAGIC)] != MAGIC:
            found = bytes(self._buffer[: len(MAGIC)]).hex(" ")
            raise NotALogError(
                self.path,
                f"not an MCAP file (it starts with {found}); "
                "'undulog import' reads CAN logs and CSV files",
            )
        try:
            self._load_summary()
        except _NoSummaryError as why:
            self.blocks.clear()
            self.counts.clear()
            self.appendices.clear()
            self._scan()
            self.cut = str(why)
            self.warnings.append(f"{why}; read record by record")
        if not self.channels and not self._bare:
            raise NotALogError(self.path, "an MCAP file without any channel that could be read")
        self.blocks.sort(key=lambda block: block.start)

    def _load_summary(self) -> None:
        """Fill in everything from the summary.

        Raises:
            _NoSummaryError: If the file has no whole summary; says why.
        """
        summary_start, footer = self._summary_range()
        indexes: list[tuple[int, int]] = []  # opcode of the indexed record, its offset
        statistics: Statistics | None = None
        try:
            for opcode, start, stop in walk_records(self._buffer, len(MAGIC), footer):
                self._take(opcode, start, stop)
                break  # the header is the first record
            for opcode, start, stop in walk_records(self._buffer, summary_start, footer):
                if opcode == Opcode.CHUNK_INDEX:
                    self.blocks.append(self._block(start, stop))
                elif opcode == Opcode.STATISTICS:
                    statistics = self._parse(Statistics.read, start, stop)
                elif opcode == Opcode.ATTACHMENT_INDEX:
                    entry = self._parse(AttachmentIndex.read, start, stop)
                    indexes.append((Opcode.ATTACHMENT, entry.offset))
                elif opcode == Opcode.METADATA_INDEX:
                    entry = self._parse(MetadataIndex.read, start, stop)
                    indexes.append((Opcode.METADATA, entry.offset))
                else:
                    self._take(opcode, start, stop)
            for opcode, offset in sorted(indexes, key=lambda index: index[1]):  # file order
                self._take(opcode, *self._record_at(offset))
        except (LogError, McapError, struct.error, ValueError) as error:
            raise _NoSummaryError(f"the summary is damaged ({error})") from error
        if statistics is None or not self.channels:
            raise _NoSummaryError("the summary does not list the channels")
        if statistics.message_count and not self.blocks:
            raise _NoSummaryError("the file has no chunk index")
        if statistics.attachment_count + statistics.metadata_count != len(indexes):
            raise _NoSummaryError("the summary does not list all attachments and metadata")
        self.counts = dict(statistics.channel_message_counts)

    def _summary_range(self) -> tuple[int, int]:
        """First byte of the summary, and of the footer."""
        buffer = self._buffer
        footer = len(buffer) - len(MAGIC) - _FOOTER_SIZE
        if footer < len(MAGIC) or buffer[-len(MAGIC) :] != MAGIC or buffer[footer] != Opcode.FOOTER:
            raise _NoSummaryError("the file is cut short (no footer)")
        (summary_start,) = struct.unpack_from("<Q", buffer, footer + PREFIX_SIZE)
        if not len(MAGIC) <= summary_start < footer:
            raise _NoSummaryError("the file has no summary")
        return summary_start, footer

    def _take(self, opcode: int, start: int, stop: int, data: Buffer | None = None) -> None:
        """Note a record that reads alike in the data section, in a chunk and in the summary."""
        if opcode == Opcode.HEADER:
            header = self._parse(Header.read, start, stop, data)
            self.profile, self.library = header.profile, header.library
        elif opcode == Opcode.SCHEMA:
            schema = self._parse(Schema.read, start, stop, data)
            self.schemas[schema.id] = schema
        elif opcode == Opcode.CHANNEL:
            channel = self._parse(Channel.read, start, stop, data)
            self.channels[channel.id] = channel
        elif opcode == Opcode.ATTACHMENT:
            attachment = self._parse(Attachment.read, start, stop, data)
            self.attachments[attachment.name] = attachment
            self.appendices.append(attachment)
        elif opcode == Opcode.METADATA:
            metadata = self._parse(Metadata.read, start, stop, data)
            self.metadata.setdefault(metadata.name, {}).update(metadata.metadata)
            self.appendices.append(metadata)

    def _block(self, start: int, stop: int) -> Block:
        """The block of a chunk index; the chunk's own header is checked against it.

        An hour has thousands of them, so only what is used is read.
        """
        entries_at = start + _CHUNK_INDEX.size
        if entries_at > stop:
            raise LogError(self.path, "a chunk index is cut short")
        at, length, size = _CHUNK_INDEX.unpack_from(self._buffer, start)
        if size % _INDEX_OFFSET.size or entries_at + size > stop:
            raise LogError(self.path, "a chunk index is damaged")
        if not len(MAGIC) <= at <= at + length <= len(self._buffer):
            raise LogError(self.path, f"a chunk index points to byte {at}, outside the file")
        block = self._chunk_at(at + PREFIX_SIZE, at + length)
        block.index_at = dict(
            _INDEX_OFFSET.iter_unpack(self._buffer[entries_at : entries_at + size])
        )
        return block

    def _chunk_at(self, start: int, stop: int) -> Block:
        """The block of the chunk record whose body is [start, stop), possibly cut short."""
        begin, end, size, crc, name_size = _CHUNK_HEAD.unpack_from(self._buffer, start)
        name_at = start + _CHUNK_HEAD.size
        data_at = name_at + name_size + 8
        if data_at > stop:
            raise LogError(self.path, f"the chunk at byte {start} is cut in its header")
        name = self._buffer[name_at : data_at - 8].decode("ascii", "replace")
        (data_size,) = struct.unpack_from("<Q", self._buffer, data_at - 8)
        data_stop = min(data_at + data_size, stop)
        complete = data_at + data_size <= stop
        return Block(data_at, data_stop, name, size, crc, begin, end, complete=complete)

    def _scan(self) -> None:
        """Fill in everything by walking the records from the first to the last whole one."""
        buffer, end = self._buffer, len(self._buffer)
        loose = Block(0, end, "", end, 0, 2**63 - 1, 0, offsets={})
        loose_at: dict[int, list[int]] = {}
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
                self.warnings.append(
                    f"the record at byte {at} is damaged and was skipped: the next whole chunk is "
                    f"at byte {following}"
                )
                former = at = following
                continue
            try:
                self._scan_record(opcode, start, stop, loose, loose_at)
            except (McapError, struct.error, ValueError, LogError) as error:
                self.warnings.append(f"the record at byte {at} is damaged and was skipped: {error}")
            if opcode == Opcode.DATA_END:
                break
            former, at = at, stop
        if loose_at:
            loose.offsets = {k: np.array(v, dtype=np.int64) for k, v in loose_at.items()}
            self._count(loose.offsets)
            self.blocks.append(loose)

    def _scan_record(
        self, opcode: int, start: int, stop: int, loose: Block, loose_at: dict[int, list[int]]
    ) -> None:
        if opcode == Opcode.CHUNK:
            self._scan_chunk(self._chunk_at(start, stop))
        elif opcode == Opcode.MESSAGE:
            channel_id, _, log_time = struct.unpack_from("<HIQ", self._buffer, start)
            loose_at.setdefault(channel_id, []).append(start - PREFIX_SIZE)
            loose.start_ns = min(loose.start_ns, log_time)
            loose.end_ns = max(loose.end_ns, log_time)
        else:
            self._take(opcode, start, stop)

    def _scan_chunk(self, block: Block) -> None:
        block.offsets = self._walk_block(block)
        self._count(block.offsets)
        self.blocks.append(block)

    def _salvage(self, opcode: int, start: int, end: int) -> None:
        """Read what there is of the last record, which the end of the file cuts short."""
        if opcode == Opcode.CHUNK:
            try:
                block = self._chunk_at(start, end)
                block.complete = False
                self._scan_chunk(block)
            except (McapError, struct.error, ValueError, LogError) as error:
                self.warnings.append(f"nothing of the last, cut chunk could be read: {error}")
                return
            found = sum(len(at) for at in (block.offsets or {}).values())
            got = len(self.payload(block)[0])
            self.warnings.append(
                f"the last chunk is cut short: {found} messages of it could be read "
                f"({got} of {block.size} bytes)"
            )
        else:
            self.warnings.append(f"the last {end - start + PREFIX_SIZE} bytes are a cut record")

    def _count(self, offsets: dict[int, IntArray]) -> None:
        for channel_id, at in offsets.items():
            self.counts[channel_id] = self.counts.get(channel_id, 0) + len(at)

    # -- records ---------------------------------------------------------------------------

    def _record_at(self, offset: int) -> tuple[int, int]:
        for _, start, stop in walk_records(self._buffer, offset, len(self._buffer)):
            return start, stop
        raise LogError(self.path, f"an index points to byte {offset}, where no record is")

    def _parse(
        self,
        read: Callable[[ReadDataStream], _Record],
        start: int,
        stop: int,
        data: Buffer | None = None,
    ) -> _Record:
        body = (self._buffer if data is None else data)[start:stop]
        try:
            return read(ReadDataStream(BytesIO(body)))
        except OverflowError as error:  # a length beyond all memory
            raise LogError(self.path, f"the record at byte {start} is damaged") from error

    def _walk_block(self, block: Block) -> dict[int, IntArray]:
        """Offsets by channel of a payload without index; schemas and channels are noted."""
        data, base = self.payload(block)
        found: dict[int, list[int]] = {}
        end = len(data) if block.compression else block.stop
        for opcode, start, stop in walk_records(data, base, end):
            if opcode == Opcode.MESSAGE:
                (channel_id,) = struct.unpack_from("<H", data, start)
                found.setdefault(channel_id, []).append(start - PREFIX_SIZE - base)
            else:
                self._take(opcode, start, stop, data)
        return {channel_id: np.array(at, dtype=np.int64) for channel_id, at in found.items()}

    def _message_index(self, block: Block, channel_id: int) -> IntArray:
        (offsets,) = self.indexed(block, [channel_id])
        if offsets.size and not 0 <= offsets.min() <= offsets.max() <= block.size - PREFIX_SIZE:
            raise LogError(
                self.path, f"a message index of channel {channel_id} points outside its chunk"
            )
        return offsets.copy()

    # -- payloads --------------------------------------------------------------------------

    def _decompress(self, block: Block) -> bytes:
        where = f"the chunk at byte {block.start}"
        if block.size > _MAX_BLOCK_SIZE:
            raise LogError(self.path, f"{where} claims {block.size} bytes; at most 1 GiB is read")
        raw = self._buffer[block.start : block.stop]
        try:
            data = inflate(block.compression, raw, block.size, whole=block.complete)
        except (zstandard.ZstdError, RuntimeError, EOFError, MemoryError) as error:
            told = str(error) or "it claims more bytes than there is memory"
            raise LogError(self.path, f"{where} can't be decompressed: {told}") from error
        if not block.complete:
            return data
        if len(data) != block.size:
            raise LogError(self.path, f"{where} has {len(data)} bytes, not {block.size}")
        if block.crc and zlib.crc32(data) != block.crc:
            raise LogError(self.path, f"{where} is corrupt (its CRC doesn't fit)")
        return data
