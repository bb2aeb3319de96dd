"""Writer of MCAP files, with the output of the mcap library at a fraction of its cost per message.

A message is packed once, directly into the chunk, and its index entry into an array that is the
content of the index record. Records that are written once per chunk or per file are those of the
library. Groups of channels may have separate chunks, so that reading one of them decompresses
nothing else. Each zstd frame has a checksum besides the chunk's CRC, which a reader checks in a
tenth of the time.

Format: https://mcap.dev/spec.
"""

from __future__ import annotations

import struct
import threading
import zlib
from array import array
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Protocol, TypeAlias

import numpy as np
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)

from ...common.process import WorkPiece
from .batch import SEQUENCE_MASK, MessageBatch
from .chunk import BODY_AT, FIXED_SIZE, HEAD, MAGIC, MESSAGE, PREFIX_SIZE

if TYPE_CHECKING:
    from concurrent.futures import ThreadPoolExecutor

CHUNK_SIZE = 1 << 20
"""Bytes of messages after which a chunk is written."""

Compression: TypeAlias = int | zstandard.ZstdCompressionParameters
"""Level of zstd, or its parameters, ``write_checksum`` among them."""

_LONGEST_WAIT_NS = 10 * 10**9  # of log time, once a chunk of other channels is full
_MOST_WAITING = 8 << 20  # bytes of messages in full chunks that helper threads compress
_COMPRESSION = "zstd"
_CHUNK = struct.Struct("<BQQQQII4sQ")
_INDEX = struct.Struct("<BQHI")
_OPCODE = int(Opcode.MESSAGE)
_HEAD = np.dtype([*HEAD.descr, ("publish", "<u8")])


class Stream(Protocol):
    """A stream of bytes."""

    def write(self, data: bytes, /) -> int:
        """Write bytes; return their number."""
        ...

    def tell(self) -> int:
        """Return the number of bytes so far."""
        ...

    def flush(self) -> None:
        """Flush buffered bytes."""


@dataclass(slots=True)
class _OpenChunk:
    """The unwritten chunk of one group of channels."""

    group: str
    data: bytearray = field(default_factory=bytearray)
    index: dict[int, array[int]] = field(default_factory=dict[int, "array[int]"])
    began: int = 0  # messages of the file before its first one
    schemas: set[int] = field(default_factory=set[int])  # that a chunk of this group has


class _Compressor(threading.local):
    """The zstd compressor of each thread."""

    def __init__(self, compression: Compression) -> None:
        self._zstd = (
            zstandard.ZstdCompressor(compression, write_checksum=True)
            if isinstance(compression, int)
            else zstandard.ZstdCompressor(compression_params=compression)
        )

    def pack(self, data: bytearray) -> tuple[bytes, int]:
        """Return the compressed content of a chunk, and the CRC-32 of the content."""
        return self._zstd.compress(data), zlib.crc32(data)


@dataclass(frozen=True, slots=True)
class _FullChunk:
    """A chunk that is compressed and not yet written."""

    began: int
    index: dict[int, array[int]]
    size: int
    packed: WorkPiece[tuple[bytes, int]]


class McapWriter:
    """Writes one MCAP file of zstd chunks with all indexes.

    The methods are those of ``mcap.writer.Writer``.
    """

    def __init__(
        self,
        stream: Stream,
        chunk_size: int = CHUNK_SIZE,
        group_of: Callable[[str, str], str] | None = None,
        compression: Compression = 3,
        helpers: ThreadPoolExecutor | None = None,
    ) -> None:
        """Write to a stream; :meth:`start` begins.

        Args:
            chunk_size: A chunk is written when it has more bytes than this.
            group_of: Topic and type name to the group of a channel; channels of one group share
                chunks. None for one group, named "".
            compression: Level or parameters of zstd.
            helpers: Threads that compress chunks while the next ones are filled; the caller does it
                if None. The file is the same.
        """
        self._stream, self._chunk_size = stream, chunk_size
        self._compressor, self._helpers = _Compressor(compression), helpers
        self._full: deque[_FullChunk] = deque()
        self._waiting = 0  # bytes of messages in these
        self._most_waiting = 0 if helpers is None else _MOST_WAITING
        self._group_of = group_of
        self._shared = _OpenChunk("")
        self._open = {"": self._shared}
        self._chunk_of: dict[int, _OpenChunk] = {}
        self._begun: dict[str, _OpenChunk] = {}  # those with messages, in the order they began
        self.messages = 0
        """Number of messages added."""
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Channel] = {}
        self._chunks: list[ChunkIndex] = []
        self._attachments: list[AttachmentIndex] = []
        self._metadata: list[MetadataIndex] = []
        self._counts: dict[int, int] = {}
        self._times: tuple[int, int] | None = None

    @property
    def settled(self) -> int:
        """Number of first messages that are all in written chunks."""
        chunks = (*self._full, *self._begun.values())
        return min((chunk.began for chunk in chunks), default=self.messages)

    def start(self, profile: str, library: str) -> None:
        """Write the beginning of the file.

        Args:
            profile: E.g. ``ros2``.

        Raises:
            OSError: If the stream can't take it.
        """
        self._stream.write(MAGIC)
        self._put(Header(profile, library))

    def register_schema(self, name: str, encoding: str, data: bytes) -> int:
        """Register a type.

        Args:
            encoding: E.g. ``ros2msg``.

        Returns:
            Its id: 1, 2 and so on.

        Raises:
            OSError: If the stream can't take a chunk that is full now.
        """
        schema = Schema(len(self._schemas) + 1, data, encoding, name)
        self._schemas[schema.id] = schema
        self._shared.schemas.add(schema.id)
        self._into(self._shared, schema)
        return schema.id

    def register_channel(
        self,
        topic: str,
        message_encoding: str,
        schema_id: int,
        metadata: Mapping[str, str] | None = None,
    ) -> int:
        """Register a channel.

        Args:
            message_encoding: E.g. ``cdr``.

        Returns:
            Its id: 1, 2 and so on.

        Raises:
            OSError: If the stream can't take a chunk that is full now.
        """
        number = len(self._channels) + 1
        channel = Channel(number, topic, message_encoding, dict(metadata or {}), schema_id)
        self._channels[number] = channel
        schema = self._schemas.get(schema_id)
        group = self._group_of(topic, schema.name if schema else "") if self._group_of else ""
        chunk = self._chunk_of[number] = self._open.setdefault(group, _OpenChunk(group))
        if schema is not None and schema_id not in chunk.schemas:  # it comes before the channel
            chunk.schemas.add(schema_id)
            self._into(chunk, schema)
        self._into(chunk, channel)
        return number

    def add_message(
        self, channel_id: int, log_time: int, data: bytes, publish_time: int, sequence: int = 0
    ) -> None:
        """Add a message to the chunk of its channel.

        Args:
            channel_id: Its channel, which is registered.
            log_time: When it was recorded [Unix ns].
            publish_time: When it was sampled [Unix ns].
            sequence: The channel's own counter.

        Raises:
            OSError: If the stream can't take the chunk that is full now.
            struct.error: If a number is out of range; the message is not in the chunk then.
        """
        chunk = self._chunk_of[channel_id]
        head = MESSAGE.pack(
            _OPCODE, FIXED_SIZE + len(data), channel_id, sequence, log_time, publish_time
        )
        index = chunk.index.get(channel_id)
        if index is None:
            index = self._index(chunk, channel_id)
        records = chunk.data
        index.append(log_time)
        index.append(len(records))
        records += head
        records += data
        self.messages += 1
        if len(records) > self._chunk_size:
            self._finish_chunk(chunk)
            if self._begun:
                self._finish_behind(log_time)

    def add_batch(self, batch: MessageBatch) -> None:
        """Add messages to the chunk of their channel, which is registered; as one by one.

        Raises:
            OSError: If the stream can't take a chunk that is full now.
        """
        records, log_ns, channel_id = batch.records, batch.log_ns, batch.channel_id
        count, length = records.shape
        heads = records[:, :BODY_AT].view(_HEAD)[:, 0]
        heads["opcode"], heads["length"] = _OPCODE, length - PREFIX_SIZE
        heads["channel"] = channel_id
        heads["sequence"] = (batch.sequence + np.arange(count)) & SEQUENCE_MASK
        heads["log"], heads["publish"] = log_ns, batch.publish_ns
        chunk, at = self._chunk_of[channel_id], 0
        while at < count:
            room = max(0, self._chunk_size - len(chunk.data)) // length + 1
            some = records[at : at + room]
            entries = np.empty((len(some), 2), np.uint64)
            entries[:, 0] = log_ns[at : at + room]
            entries[:, 1] = len(chunk.data) + length * np.arange(len(some))
            self._index(chunk, channel_id).frombytes(entries.tobytes())
            chunk.data += some.data
            self.messages += len(some)
            at += len(some)
            if len(chunk.data) > self._chunk_size:
                self._finish_chunk(chunk)
                self._finish_behind(int(log_ns[at - 1]))

    def _index(self, chunk: _OpenChunk, channel_id: int) -> array[int]:
        """Return the index of a channel in a chunk, which begins with its first message."""
        index = chunk.index.get(channel_id)
        if index is None:
            if not chunk.index:
                chunk.began = self.messages
                self._begun[chunk.group] = chunk
            index = chunk.index[channel_id] = array("Q")
        return index

    def add_attachment(
        self, create_time: int, log_time: int, name: str, media_type: str, data: bytes
    ) -> None:
        """Write an attachment.

        Args:
            create_time: Time of its creation [Unix ns], 0 if unknown.
            log_time: When it was recorded [Unix ns].

        Raises:
            OSError: If the stream can't take it.
        """
        self._write_full()
        offset = self._stream.tell()
        length = self._put(Attachment(create_time, log_time, name, media_type, data))
        self._attachments.append(
            AttachmentIndex(
                offset=offset,
                length=length,
                create_time=create_time,
                log_time=log_time,
                data_size=len(data),
                name=name,
                media_type=media_type,
            )
        )

    def add_metadata(self, name: str, data: Mapping[str, str]) -> None:
        """Write key-value pairs.

        Args:
            name: The record's name.

        Raises:
            OSError: If the stream can't take it.
        """
        self._write_full()
        offset = self._stream.tell()
        length = self._put(Metadata(name, dict(data)))
        self._metadata.append(MetadataIndex(offset=offset, length=length, name=name))

    def flush(self) -> None:
        """Write the chunks that have messages, and flush the stream.

        Raises:
            OSError: If the stream can't take it.
        """
        self.settle(self.messages)
        self._stream.flush()

    def settle(self, count: int) -> None:
        """Write the chunks that have any of the file's first messages.

        Args:
            count: Number of messages that must be in written chunks.

        Raises:
            OSError: If the stream can't take it.
        """
        for chunk in list(self._begun.values()):
            if chunk.began < count:
                self._finish_chunk(chunk)
        self._write_full()

    def finish(self) -> None:
        """Write the chunks and the summary; the stream stays open.

        Raises:
            OSError: If the stream can't take it.
        """
        self.settle(self.messages)
        self._put(DataEnd(0))
        start = self._stream.tell()
        summary, offsets = RecordBuilder(), list[SummaryOffset]()
        groups: tuple[tuple[Opcode, list[McapRecord]], ...] = (
            (Opcode.SCHEMA, [*self._schemas.values()]),
            (Opcode.CHANNEL, [*self._channels.values()]),
            (Opcode.STATISTICS, [self._statistics()]),
            (Opcode.CHUNK_INDEX, [*self._chunks]),
            (Opcode.ATTACHMENT_INDEX, [*self._attachments]),
            (Opcode.METADATA_INDEX, [*self._metadata]),
        )
        for opcode, records in groups:
            begin = summary.count
            for record in records:
                record.write(summary)
            offsets.append(SummaryOffset(opcode, start + begin, summary.count - begin))
        offsets_start = start + summary.count
        for offset in offsets:
            offset.write(summary)
        data = summary.end()
        head = struct.pack("<BQQQ", Opcode.FOOTER, 20, start, offsets_start)
        crc = zlib.crc32(head, zlib.crc32(data))
        self._stream.write(data)
        self._put(Footer(summary_start=start, summary_offset_start=offsets_start, summary_crc=crc))
        self._stream.write(MAGIC)

    # -- inside ----------------------------------------------------------------------------

    def _put(self, record: McapRecord) -> int:
        """Write one record; returns its length."""
        data = _encoded(record)
        self._stream.write(data)
        return len(data)

    def _into(self, chunk: _OpenChunk, record: Schema | Channel) -> None:
        chunk.data += _encoded(record)
        if chunk.index and len(chunk.data) > self._chunk_size:  # else it waits for a message
            self._finish_chunk(chunk)

    def _finish_behind(self, log_time: int) -> None:
        """Write the chunks that have been open for long, which a truncated file would lack."""
        for other in list(self._begun.values()):
            if log_time - next(iter(other.index.values()))[0] > _LONGEST_WAIT_NS:
                self._finish_chunk(other)

    def _finish_chunk(self, chunk: _OpenChunk) -> None:
        """Compress a chunk that has messages, and write the earlier ones that would be too many."""
        size, pack = len(chunk.data), partial(self._compressor.pack, chunk.data)
        self._full.append(
            _FullChunk(chunk.began, chunk.index, size, WorkPiece(pack, self._helpers))
        )
        self._waiting += size
        chunk.data, chunk.index = bytearray(), {}
        del self._begun[chunk.group]
        if self._waiting > self._most_waiting:
            self._full[-1].packed.hurry()  # the helpers are at the earlier ones
            self._write_full(self._most_waiting)

    def _write_full(self, most_waiting: int = 0) -> None:
        """Write full chunks, in order, until so many bytes of messages wait."""
        while self._full and self._waiting > most_waiting:
            chunk = self._full.popleft()
            self._waiting -= chunk.size
            self._write_chunk(chunk)

    def _write_chunk(self, chunk: _FullChunk) -> None:
        indexes = {key: np.frombuffer(index, np.uint64)[::2] for key, index in chunk.index.items()}
        begin = int(min(times.min() for times in indexes.values()))
        end = int(max(times.max() for times in indexes.values()))
        data, crc = chunk.packed.result()
        body = _CHUNK.size - 9 + len(data)
        at = self._stream.tell()
        head = _CHUNK.pack(
            Opcode.CHUNK, body, begin, end, chunk.size, crc, 4, _COMPRESSION.encode(), len(data)
        )
        self._stream.write(head)
        self._stream.write(data)
        written = ChunkIndex(
            message_start_time=begin,
            message_end_time=end,
            chunk_start_offset=at,
            chunk_length=len(head) + len(data),
            message_index_offsets={},
            message_index_length=0,
            compression=_COMPRESSION,
            compressed_size=len(data),
            uncompressed_size=chunk.size,
        )
        index_at = at + written.chunk_length
        records = bytearray()
        for key, index in chunk.index.items():
            written.message_index_offsets[key] = index_at + len(records)
            length = len(index) * index.itemsize
            records += _INDEX.pack(Opcode.MESSAGE_INDEX, length + 6, key, length)
            records += index.tobytes()
            self._counts[key] = self._counts.get(key, 0) + len(index) // 2
        written.message_index_length = len(records)
        self._stream.write(bytes(records))
        self._chunks.append(written)
        low, high = self._times or (begin, end)
        self._times = min(low, begin), max(high, end)

    def _statistics(self) -> Statistics:
        begin, end = self._times or (0, 0)
        return Statistics(
            attachment_count=len(self._attachments),
            channel_count=len(self._channels),
            channel_message_counts=self._counts,
            chunk_count=len(self._chunks),
            message_count=sum(self._counts.values()),
            message_end_time=end,
            message_start_time=begin,
            metadata_count=len(self._metadata),
            schema_count=len(self._schemas),
        )


def _encoded(record: McapRecord) -> bytes:
    builder = RecordBuilder()
    record.write(builder)
    return builder.end()
