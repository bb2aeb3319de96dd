"""Check of the container of a log, record by record: chain of records, CRCs, end.

Only record headers and the parts outside the chunks' CRCs are read here; the payload of a chunk is
checked when it is read.

Format: https://mcap.dev/spec.
"""

from __future__ import annotations

import mmap
import struct
import zlib
from dataclasses import dataclass, field
from pathlib import Path

from mcap.opcode import Opcode

from .chunk import MAGIC, PREFIX_SIZE, Block, chunk_at, walk_records

_PIECE = 1 << 24


@dataclass
class Container:
    """Result of the check.

    Attributes:
        chunks: Payload start to chunk, whole chunks only.
        damage: CRC mismatches and breaks in the chain of records, one sentence each.
        truncated: Whether the end is missing.
    """

    chunks: dict[int, Block] = field(default_factory=dict[int, Block])
    damage: list[str] = field(default_factory=list[str])
    truncated: bool = False


def check_container(path: Path) -> Container:
    """Check all records of an MCAP file whose magic is right."""
    found = Container()
    with path.open("rb") as stream, mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as data:
        last, at, header_stop = 0, len(MAGIC), len(MAGIC)
        ended = False
        for opcode, start, stop in walk_records(data, at, len(data)):
            last, at = opcode, stop
            if opcode == Opcode.HEADER:
                header_stop = stop
            elif opcode == Opcode.CHUNK:
                chunk = chunk_at(data, start, stop)
                if chunk is None:
                    found.damage.append(f"the chunk at byte {start - PREFIX_SIZE} has no header")
                else:
                    chunk.complete = True  # as its record is
                    found.chunks[chunk.start] = chunk
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


def _outside_chunks(
    data: mmap.mmap, opcode: int, start: int, stop: int, header_stop: int
) -> list[str]:
    """Check the CRCs of attachments, data section and summary."""
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


def _fits(data: mmap.mmap, start: int, stop: int, crc_at: int) -> bool:
    """Whether the bytes [start, stop) have the CRC stored at ``crc_at``; 0 means none."""
    (stored,) = struct.unpack_from("<I", data, crc_at)
    if not stored:
        return True
    crc = 0
    for at in range(start, stop, _PIECE):
        crc = zlib.crc32(data[at : min(at + _PIECE, stop)], crc)
    return crc == stored
