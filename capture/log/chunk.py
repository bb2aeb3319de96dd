"""Chunks of an MCAP file: decompression and the walk over records.

Format: https://mcap.dev/spec.
"""

from __future__ import annotations

import io
import mmap
import os
import struct
import threading
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, cast

import lz4.frame  # pyright: ignore[reportMissingTypeStubs]
import zstandard
from mcap.opcode import Opcode

from ..arrays import IntArray

MAGIC = b"\x89MCAP0\r\n"
"""First and last bytes of a file."""

PREFIX_SIZE = 9
"""Opcode (u8) and length (u64) before each record's body."""

_NAME_AT = PREFIX_SIZE + 8 + 8 + 8 + 4  # of the compression's name in a chunk's record

Buffer = bytes | bytearray | mmap.mmap


class _Own(threading.local):
    """Each thread's decompressor and compressed bytes, for one chunk after the other."""

    def __init__(self) -> None:
        self.decompressor = zstandard.ZstdDecompressor()
        self.raw = bytearray()


_own = _Own()


@dataclass
class Block:
    """A stretch of messages: one chunk, or the unchunked messages of a file.

    Attributes:
        start: First payload byte in the file.
        stop: One past the last payload byte in the file.
        compression: ``zstd``, ``lz4`` or empty.
        size: Uncompressed size [byte].
        crc: CRC-32 of the uncompressed payload, 0 where there is none.
        start_ns: Earliest log time in it [ns].
        end_ns: Latest log time in it [ns].
        index_at: Channel id to the file offset of its MessageIndex record.
        offsets: Channel id to message offsets in the payload; filled where there is no index.
        complete: False for a chunk that the end of the file cuts short.
        part: Which file of the session it is in, from 0.
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


def inflate(compression: str, raw: bytes, size: int, *, whole: bool) -> bytes:
    """Decompress a payload; of a cut one, as much as there is.

    Args:
        compression: ``zstd`` or ``lz4``.
        raw: The compressed bytes.
        size: Uncompressed size of the whole payload [byte]; no more than this is produced.
        whole: False where the end of the file cuts ``raw`` short.

    Returns:
        The payload, or its readable beginning.

    Raises:
        RuntimeError: If the compression is unknown or the lz4 frame is damaged.
        zstandard.ZstdError: If the zstd frame is damaged.
    """
    if compression == "zstd":
        if whole:
            return zstandard.ZstdDecompressor().decompress(raw, max_output_size=max(size, 1))
        return zstandard.ZstdDecompressor().decompressobj().decompress(raw)
    if compression == "lz4":
        frame = cast("Any", lz4.frame.LZ4FrameDecompressor())  # the package has no types
        return bytes(frame.decompress(raw, max_length=size))
    raise RuntimeError(f"unknown compression {compression!r}")


def inflate_zstd_into(raw: memoryview, room: memoryview) -> int:
    """Decompress a zstd frame into memory that is there already: no page of it is new.

    Args:
        raw: The compressed bytes, one frame.
        room: As much memory as the frame should need.

    Returns:
        Bytes that the frame has; at most one more than there is room for is found out.

    Raises:
        zstandard.ZstdError: If the frame is damaged.
    """
    with cast("io.RawIOBase", _own.decompressor.stream_reader(raw, closefd=False)) as reader:
        size = reader.readinto(room) or 0  # all at once, since there is room for the whole frame
        return size + len(reader.read(1) or b"")


def read_at(descriptor: int, start: int, stop: int) -> memoryview:
    """Read a stretch of a file that is looked at once.

    Through a mapping its pages would stay in this process's memory, and each costs a fault.

    Args:
        descriptor: The file.
        start: First byte.
        stop: One past the last byte.

    Returns:
        The bytes, until this thread reads again; fewer than asked for where the file ends before.

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
    """Whether a zstd frame has a checksum of its content: decompression verifies it.

    Args:
        raw: The frame.

    Returns:
        Whether it has; False for what is no zstd frame.
    """
    try:
        return zstandard.get_frame_parameters(raw).has_checksum
    except zstandard.ZstdError:
        return False


def walk_records(data: Buffer, start: int, stop: int) -> Iterator[tuple[int, int, int]]:
    """Walk records back to back.

    Args:
        data: The bytes.
        start: Offset of the first record's opcode.
        stop: One past the last byte to look at.

    Yields:
        Opcode, body start and body stop of each whole record in [start, stop).
    """
    at = start
    while at + PREFIX_SIZE <= stop:
        opcode = data[at]
        (length,) = struct.unpack_from("<Q", data, at + 1)
        body = at + PREFIX_SIZE
        if body + length > stop:
            return
        yield opcode, body, body + length
        at = body + length


def next_chunk(data: Buffer, start: int, stop: int) -> int | None:
    """Search for a whole compressed chunk where the chain of records is broken.

    Args:
        data: The bytes.
        start: First place to look at.
        stop: One past the last byte.

    Returns:
        Offset of its record's opcode, or None.
    """
    found: list[int] = []
    for name in (b"\x04\0\0\0zstd", b"\x03\0\0\0lz4"):
        tag = data.find(name, start + _NAME_AT, stop)
        while tag >= 0:
            at = tag - _NAME_AT
            size_at = tag + len(name)
            if data[at] == Opcode.CHUNK and size_at + 8 <= stop:
                (length,) = struct.unpack_from("<Q", data, at + 1)
                (size,) = struct.unpack_from("<Q", data, size_at)
                whole = size_at + 8 + size
                if at + PREFIX_SIZE + length == whole <= stop:
                    found.append(at)
                    break
            tag = data.find(name, tag + 1, stop)
    return min(found, default=None)
