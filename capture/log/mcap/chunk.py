"""Chunks of an MCAP file: decompression, the walk over records, and messages many at a time.

Format: https://mcap.dev/spec.
"""

from __future__ import annotations

import io
import mmap
import os
import re
import struct
import threading
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, cast

import lz4.frame
import numpy as np
import zstandard
from mcap.opcode import Opcode
from numpy.typing import NDArray

from ...common.arrays import IntArray
from ...common.errors import UsageError

MAGIC = b"\x89MCAP0\r\n"
"""First and last bytes of a file."""

PREFIX_SIZE = 9
"""Opcode (u8) and length (u64) before each record's body."""

LAST_NS = 2**63 - 1
"""Latest log time that is read [Unix ns], in the year 2262; a later one is read as this."""

LARGEST_CHUNK_VARIABLE = "UNDULOG_MAX_CHUNK_MIB"
"""Environment variable with the largest uncompressed size of a chunk that is read [MiB]."""

_LARGEST_CHUNK_MIB = 256
_LEAST_WINDOW = 1 << 23

_CHUNK_HEAD = struct.Struct("<QQQII")  # start, end, size, CRC, length of the compression's name
_NAME_AT = PREFIX_SIZE + 8 + 8 + 8 + 4  # of the compression's name in a chunk's record

_CRC = struct.Struct("<I")

_COMPRESSION_NAME = re.compile(rb"\x04\0\0\0zstd|\x03\0\0\0lz4")

Buffer = bytes | bytearray | mmap.mmap

HEAD = np.dtype(
    [("opcode", "u1"), ("length", "<u8"), ("channel", "<u2"), ("sequence", "<u4"), ("log", "<u8")]
)
"""Start of a message record; the publish time and the message follow."""

MESSAGE = struct.Struct("<BQHIQQ")
"""Message record before the message: opcode, length, channel, sequence, log and publish time."""

BODY_AT = MESSAGE.size
"""Offset of the message in its record."""
FIXED_SIZE = BODY_AT - PREFIX_SIZE
"""Part of a record's length before the message."""


class _Own(threading.local):
    """A decompressor and a buffer of compressed bytes for each thread."""

    def __init__(self) -> None:
        self.decompressor = zstandard.ZstdDecompressor()
        self.raw = bytearray()


_own = _Own()


@dataclass
class Block:
    """A block of messages: one chunk, or the unchunked messages of a file.

    Attributes:
        start: First payload byte in the file.
        stop: One past the last payload byte in the file.
        compression: ``zstd``, ``lz4`` or empty.
        size: Uncompressed size [byte].
        crc: CRC-32 of the uncompressed payload, 0 for none.
        start_ns: Earliest log time in it [ns].
        end_ns: Latest log time in it [ns].
        index_at: Channel id to the file offset of its MessageIndex record.
        offsets: Channel id to message offsets in the payload, of a block without index.
        complete: False for a chunk that is cut short by the end of the file.
        part: Which file of the session it is in, from 0.
        record_at: File offset of its chunk record.
    """

    start: int
    stop: int
    compression: str
    size: int
    crc: int
    start_ns: int
    end_ns: int
    index_at: dict[int, int] = field(default_factory=dict[int, int])
    offsets: dict[int, IntArray] | None = None
    complete: bool = True
    part: int = 0
    record_at: int = 0

    @property
    def is_empty(self) -> bool:
        """Whether its declared size is 0."""
        return self.size == 0 if self.compression else self.start == self.stop


def largest_chunk() -> int:
    """Return the largest uncompressed size of a chunk that is read [byte].

    Raises:
        UsageError: If the environment variable is not a positive whole number of MiB.
    """
    text = os.environ.get(LARGEST_CHUNK_VARIABLE, str(_LARGEST_CHUNK_MIB))
    if not text.isascii() or not text.isdecimal() or not 0 < int(text[:9]) < 1 << 24:
        raise UsageError(f"{LARGEST_CHUNK_VARIABLE}={text!r}: give a whole number of MiB above 0")
    return int(text) << 20


def inflate(compression: str, raw: bytes, size: int, *, whole: bool) -> bytes:
    """Decompress a payload into no more memory than it is declared to need.

    Args:
        compression: ``zstd`` or ``lz4``.
        size: Declared size of the whole payload [byte].
        whole: False where the end of the file cuts ``raw`` short.

    Returns:
        The payload; of a cut one, its readable beginning.

    Raises:
        RuntimeError: If the compression is unknown, the lz4 frame is damaged, or the payload is
            larger than declared or declared larger than :func:`largest_chunk`.
        zstandard.ZstdError: If the zstd frame is damaged.
    """
    if size > largest_chunk():
        raise RuntimeError(
            f"it declares {size} bytes, more than {largest_chunk() >> 20} MiB; "
            f"--max-chunk-mib {-(-size >> 20)} reads it"
        )
    if compression == "zstd":
        # The library allocates what a frame states, whatever max_output_size says.
        stated = zstandard.get_frame_parameters(raw).content_size
        if stated not in (size, zstandard.CONTENTSIZE_UNKNOWN):
            raise RuntimeError(f"its frame states {stated} bytes, its record {size}")
        if whole:
            return zstandard.ZstdDecompressor().decompress(raw, max_output_size=max(size, 1))
        decompressor = zstandard.ZstdDecompressor(max_window_size=max(size, _LEAST_WINDOW))
        with cast("io.RawIOBase", decompressor.stream_reader(raw)) as reader:
            data, more = reader.read(size) or b"", reader.read(1)
    elif compression == "lz4":
        frame = cast("Any", lz4.frame.LZ4FrameDecompressor())  # the package has no types
        data = bytes(frame.decompress(raw, max_length=size))
        more = b"" if frame.eof else frame.decompress(b"", max_length=1)
    else:
        raise RuntimeError(f"unknown compression {compression!r}")
    if more:
        raise RuntimeError(f"it expands beyond the {size} bytes that its record declares")
    return data


def inflate_zstd_into(raw: memoryview, room: memoryview) -> int:
    """Decompress a zstd frame into existing memory, which costs no page faults.

    Args:
        raw: The compressed bytes, one frame.
        room: Memory of the frame's expected size.

    Returns:
        Size of the frame [byte]; of a larger frame, the size of ``room`` plus 1.

    Raises:
        zstandard.ZstdError: If the frame is damaged.
    """
    with cast("io.RawIOBase", _own.decompressor.stream_reader(raw, closefd=False)) as reader:
        size = reader.readinto(room) or 0  # all at once, since there is room for the whole frame
        return size + len(reader.read(1) or b"")


def read_at(descriptor: int, start: int, stop: int) -> memoryview:
    """Read bytes of a file that are used once.

    Through a mapping the pages would stay in this process's memory, and each costs a fault.

    Args:
        stop: One past the last byte.

    Returns:
        The bytes, valid until this thread reads again; fewer if the file ends before ``stop``.

    Raises:
        OSError: If it can't be read.
    """
    size, done = stop - start, 0
    if len(_own.raw) < size:
        _own.raw = bytearray(size)
    room = memoryview(_own.raw)[:size]
    while done < size and (got := os.preadv(descriptor, [room[done:]], start + done)):
        done += got
    return room[:done]


def checks_itself(raw: memoryview) -> bool:
    """Whether a zstd frame has a checksum of its content, which decompression verifies."""
    try:
        return zstandard.get_frame_parameters(raw).has_checksum
    except zstandard.ZstdError:
        return False


def summary_fits(data: Buffer, start: int = 0) -> bool:
    """Return whether a summary fits its CRC; True without one.

    Args:
        data: Ends as the file ends.
        start: First byte of the summary.
    """
    covered = len(data) - len(MAGIC) - _CRC.size
    (crc,) = _CRC.unpack_from(data, covered)
    return not crc or zlib.crc32(data[start:covered]) == crc


def walk_records(data: Buffer, start: int, stop: int) -> Iterator[tuple[int, int, int]]:
    """Walk consecutive records.

    Args:
        start: Offset of the first record's opcode.
        stop: One past the last byte.

    Yields:
        Opcode, body start and body stop of each whole record in [start, stop), until an opcode 0.
    """
    at = start
    while at + PREFIX_SIZE <= stop:
        opcode = data[at]
        if not opcode:  # no record has it: millions of them fit into a small chunk
            return
        (length,) = struct.unpack_from("<Q", data, at + 1)
        body = at + PREFIX_SIZE
        if body + length > stop:
            return
        yield opcode, body, body + length
        at = body + length


def chunk_at(data: Buffer, start: int, stop: int) -> Block | None:
    """Return the block of a chunk record, possibly cut short; None if its header is cut.

    Args:
        start: First byte of the record's body.
        stop: One past the last byte of the body.
    """
    if stop - start < _CHUNK_HEAD.size + 8:
        return None
    begin, end, size, crc, name_size = _CHUNK_HEAD.unpack_from(data, start)
    name_at = start + _CHUNK_HEAD.size
    data_at = name_at + name_size + 8
    if data_at > stop:
        return None
    name = data[name_at : data_at - 8].decode("ascii", "replace")
    (data_size,) = struct.unpack_from("<Q", data, data_at - 8)
    return Block(
        start=data_at,
        stop=min(data_at + data_size, stop),
        compression=name,
        size=size,
        crc=crc,
        start_ns=begin,
        end_ns=end,
        complete=data_at + data_size <= stop,
        record_at=start - PREFIX_SIZE,
    )


def next_chunk(data: Buffer, start: int, stop: int) -> int | None:
    """Search for a whole compressed chunk behind a break in the chain of records.

    Args:
        start: Offset of the first byte.
        stop: One past the last byte.

    Returns:
        Offset of its record's opcode, or None.
    """
    for tag in _COMPRESSION_NAME.finditer(data, start + _NAME_AT, stop):
        at, size_at = tag.start() - _NAME_AT, tag.end()
        if data[at] == Opcode.CHUNK and size_at + 8 <= stop:
            (length,) = struct.unpack_from("<Q", data, at + 1)
            (size,) = struct.unpack_from("<Q", data, size_at)
            whole = size_at + 8 + size
            if at + PREFIX_SIZE + length == whole <= stop:
                return at
    return None


def read_message_heads(
    data: Buffer, offsets: IntArray, stop: int | IntArray
) -> NDArray[np.void] | None:
    """Return the heads of message records, if whole messages are at the offsets.

    Args:
        data: The payloads of one or more blocks.
        offsets: Where they should start, shape (n,).
        stop: One past the last byte of the payload; for several, of each record's, shape (n,).

    Returns:
        Of :data:`HEAD`, shape (n,); None if any is not a whole message.
    """
    if (offsets < 0).any() or (offsets + BODY_AT > stop).any():
        return None
    heads = gather(data, offsets, HEAD)
    room = (stop - offsets - 9).astype(np.uint64)
    lengths = heads["length"]
    whole = (lengths >= FIXED_SIZE) & (lengths <= room) & (heads["opcode"] == Opcode.MESSAGE)
    return heads if whole.all() else None


def gather(
    data: Buffer | NDArray[np.uint8], at: IntArray, kind: np.dtype[Any] | str, shift: int = 0
) -> NDArray[Any]:
    """Return items of one type at any offsets, through a view with a stride of one byte.

    Args:
        at: Offsets, shape (n,).
        shift: Offset of the items from there; all are whole.

    Returns:
        A copy, shape (n,).
    """
    record = np.dtype(kind)
    size = max(len(data) - shift - record.itemsize + 1, 0)
    return np.ndarray((size,), record, data, shift, (1,))[at]


@dataclass(frozen=True)
class MessageOffsets:
    """Offsets of messages in a buffer.

    Attributes:
        at: Offsets, shape (n,).
        step: From each to the next, if they are evenly spaced and whole; otherwise None.
    """

    data: Buffer | NDArray[np.uint8]
    at: IntArray
    step: int | None = None

    def __len__(self) -> int:
        """Number of messages."""
        return len(self.at)

    def take(self, rows: NDArray[Any] | slice) -> MessageOffsets:
        """Return some of them, in order; evenly spaced if none between them is left out."""
        at, step = self.at[rows], self.step
        if step is not None and len(at) and int(at[-1] - at[0]) != step * (len(at) - 1):
            step = None
        return MessageOffsets(self.data, at, step)

    def field(self, kind: np.dtype[Any] | str, shift: int) -> NDArray[Any]:
        """Return one field of each message.

        Args:
            shift: Offset from the message's start, not negative.

        Returns:
            Shape (n,): a view where they are evenly spaced, otherwise a copy.
        """
        if self.step is None:
            return gather(self.data, self.at, kind, shift)
        first = int(self.at[0]) + shift if len(self.at) else 0
        return np.ndarray((len(self.at),), kind, self.data, first, (self.step,))

    def rows(self, kind: np.dtype[Any], count: int, shift: int) -> NDArray[Any]:
        """Return an array field of each message.

        Args:
            shift: Offset from the message's start.

        Returns:
            Shape (n, count): a view where they are evenly spaced, otherwise a copy.
        """
        if not count:
            return np.empty((len(self.at), 0), kind)
        if self.step is None:
            run = kind if count == 1 else f"V{count * kind.itemsize}"
            return gather(self.data, self.at, run, shift).view(kind).reshape(len(self.at), count)
        first = int(self.at[0]) + shift if len(self.at) else 0
        return np.ndarray((len(self.at), count), kind, self.data, first, (self.step, kind.itemsize))
