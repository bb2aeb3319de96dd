"""The container of a log, checked record by record: chain of records, CRCs, end.

Only record headers are read here, and the parts that a chunk's own CRC doesn't cover; the
payloads of indexed chunks are checked where they are read.

Format: https://mcap.dev/spec.
"""

from __future__ import annotations

import mmap
import struct
import zlib
from dataclasses import dataclass, field
from pathlib import Path

import zstandard
from mcap.opcode import Opcode

from .chunk import MAGIC, PREFIX_SIZE, inflate, walk_records

_CHUNK = struct.Struct("<QQQII")  # start, end, size, crc, length of the compression's name
_PIECE = 1 << 24


@dataclass(frozen=True)
class ChunkPlace:
    """A chunk found by walking the records.

    Attributes:
        record_at: Its record's first byte.
        start: First byte of its payload.
        stop: One past the last.
        compression: ``zstd``, ``lz4`` or empty.
        size: Uncompressed size [byte].
        crc: CRC-32 of the uncompressed payload, 0 where there is none.
    """

    record_at: int
    start: int
    stop: int
    compression: str
    size: int
    crc: int


@dataclass
class Container:
    """What the walk found.

    Attributes:
        chunks: Payload start to chunk, whole chunks only.
        damage: CRCs that don't fit and breaks in the chain of records, one sentence each.
        truncated: Whether the end is missing.
    """

    chunks: dict[int, ChunkPlace] = field(default_factory=dict[int, ChunkPlace])
    damage: list[str] = field(default_factory=list[str])
    truncated: bool = False


def check_container(path: Path) -> Container:
    """Walk all records of a file.

    Args:
        path: An MCAP file, known to start as one.

    Returns:
        Its chunks, and what is wrong outside them.
    """
    found = Container()
    with path.open("rb") as stream, mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as data:
        last, at, header_stop = 0, len(MAGIC), len(MAGIC)
        ended = False
        for opcode, start, stop in walk_records(data, at, len(data)):
            last, at = opcode, stop
            if opcode == Opcode.HEADER:
                header_stop = stop
            elif opcode == Opcode.CHUNK:
                place = _place(data, start, stop)
                if place is None:
                    found.damage.append(f"the chunk at byte {start - PREFIX_SIZE} has no header")
                else:
                    found.chunks[place.start] = place
            elif opcode == Opcode.DATA_END and ended:  # each CRC covers all of the data section
                found.damage.append(f"the data section ends a second time at byte {start}")
            elif stop - start >= 4:
                ended = ended or opcode == Opcode.DATA_END
                found.damage += _outside_chunks(data, opcode, start, stop, header_stop)
            if opcode == Opcode.FOOTER:
                break
        if last != Opcode.FOOTER:
            found.truncated = data[-len(MAGIC) :] != MAGIC
            if not found.truncated:
                found.damage.append(f"the chain of records breaks at byte {at}")
        elif data[at:] != MAGIC:
            found.truncated = True
    return found


def check_chunk(path: Path, place: ChunkPlace) -> str | None:
    """Check one chunk's payload against its CRC.

    Returns:
        What is wrong, or None.
    """
    with path.open("rb") as stream:
        stream.seek(place.start)
        raw = stream.read(place.stop - place.start)
    where = f"the chunk at byte {place.start}"
    if place.compression:
        try:
            raw = inflate(place.compression, raw, place.size, whole=True)
        except (zstandard.ZstdError, RuntimeError, EOFError, MemoryError) as error:
            told = str(error) or "it claims more bytes than there is memory"
            return f"{where} can't be decompressed: {told}"
    if place.crc and zlib.crc32(raw) != place.crc:
        return _corrupt("the chunk", place.start)
    return None


def _outside_chunks(
    data: mmap.mmap, opcode: int, start: int, stop: int, header_stop: int
) -> list[str]:
    """What the CRCs of attachments, data section and summary say."""
    if opcode == Opcode.ATTACHMENT and not _fits(data, start, stop - 4, stop - 4):
        return [_corrupt("the attachment", start)]
    if opcode == Opcode.DATA_END:
        # Writers differ on whether the magic and the header belong to the section.
        begins = (0, len(MAGIC), header_stop)
        if not any(_fits(data, begin, start - PREFIX_SIZE, start) for begin in begins):
            return [_corrupt("the data section", header_stop)]
    if opcode == Opcode.FOOTER and stop - start >= 20:
        (summary,) = struct.unpack_from("<Q", data, start)
        if 0 < summary < start and not _fits(data, summary, stop - 4, stop - 4):
            return [_corrupt("the summary", summary)]
    return []


def _corrupt(what: str, at: int) -> str:
    return f"{what} at byte {at} is corrupt (its CRC doesn't fit)"


def _place(data: mmap.mmap, start: int, stop: int) -> ChunkPlace | None:
    if stop - start < _CHUNK.size + 8:
        return None
    _, _, size, crc, name_size = _CHUNK.unpack_from(data, start)
    payload = start + _CHUNK.size + name_size + 8
    if payload > stop:
        return None
    name = data[start + _CHUNK.size : payload - 8].decode("ascii", "replace")
    (length,) = struct.unpack_from("<Q", data, payload - 8)
    return ChunkPlace(start - PREFIX_SIZE, payload, min(payload + length, stop), name, size, crc)


def _fits(data: mmap.mmap, start: int, stop: int, crc_at: int) -> bool:
    """Whether a stretch of the file has the CRC stored at ``crc_at``; 0 there means none."""
    (stored,) = struct.unpack_from("<I", data, crc_at)
    if not stored:
        return True
    crc = 0
    for at in range(start, stop, _PIECE):
        crc = zlib.crc32(data[at : min(at + _PIECE, stop)], crc)
    return crc == stored
