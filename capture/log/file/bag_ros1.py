"""Bags of ROS 1, read by ``rosbags`` with bounds on what their records claim.

Format: https://wiki.ros.org/Bags/Format/2.0.
"""

from __future__ import annotations

import bz2
import io
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO, cast

from rosbags.rosbag1 import Reader
from rosbags.rosbag1.reader import Chunk, ChunkInfo, Header, IndexData, ReaderError, RecordType

from ..mcap.chunk import inflate, largest_chunk
from .bag_parts import Allowance


class _Stream(io.BufferedReader):
    """A file of which no more than its size is requested, since as much would be allocated."""

    def __init__(self, path: Path) -> None:
        super().__init__(io.FileIO(path))
        self._size = path.stat().st_size

    def read(self, size: int | None = -1, /) -> bytes:
        return super().read(size if size is None else min(size, self._size))


class _Path:
    """A path as ``rosbags`` takes it, which opens as such a file."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def exists(self) -> bool:
        return self._path.exists()

    def open(self, _mode: str) -> BinaryIO:
        return cast("BinaryIO", _Stream(self._path))

    def __str__(self) -> str:
        return str(self._path)


class BoundedReader(Reader):
    """A reader that reads each chunk's index once, and expands no chunk beyond its stated size."""

    def __init__(self, path: Path, allowance: Allowance) -> None:
        """Set the file, and the bytes that its chunks may expand to."""
        super().__init__(cast("Any", _Path(path)))
        self._allowance = allowance
        self._places: set[int] = set()
        self._index_left = path.stat().st_size

    def read_chunk_info(self) -> ChunkInfo:
        """Read the place of a chunk; raises ``ReaderError`` if another one has it."""
        chunk_info = super().read_chunk_info()
        if chunk_info.pos in self._places:
            raise ReaderError(f"two chunks are at byte {chunk_info.pos}.")
        self._places.add(chunk_info.pos)
        return chunk_info

    def read_index_data(self, pos: int, indexes: dict[int, list[IndexData]]) -> None:
        """Read an index; raises ``ReaderError`` if all are longer than the file."""
        bio = cast("BinaryIO", self.bio)
        begun = bio.tell()
        super().read_index_data(pos, indexes)
        self._index_left -= bio.tell() - begun
        if self._index_left < 0:
            raise ReaderError("The indexes of its chunks overlap.")

    def read_chunk(self) -> Chunk:
        """Read the head of a chunk."""
        bio = cast("BinaryIO", self.bio)
        begun = bio.tell()
        header = Header.read(bio, RecordType.CHUNK)
        bio.seek(begun)
        kind, size = header.get_string("compression"), header.get_uint32("size")
        expand = partial(_EXPAND[kind], size) if kind in _EXPAND else bytes
        return super().read_chunk()._replace(decompressor=partial(self._taken, expand))

    def _taken(self, expand: Callable[[bytes], bytes], data: bytes) -> bytes:
        expanded = expand(data)
        self._allowance.take(len(expanded))
        return expanded


class SummaryReader(BoundedReader):
    """A reader of what the end of a bag states: topics, and times and counts of its chunks."""

    def read_chunk(self) -> Chunk:
        """Leave a chunk unread."""
        return Chunk(0, 0, bytes)

    def read_index_data(self, pos: int, indexes: dict[int, list[IndexData]]) -> None:
        """Leave its index unread."""


def _bz2(size: int, data: bytes) -> bytes:
    if size > largest_chunk():
        raise ReaderError(f"A chunk declares {size} bytes, more than {largest_chunk() >> 20} MiB.")
    decompressor = bz2.BZ2Decompressor()
    expanded = decompressor.decompress(data, max_length=size + 1)
    if len(expanded) != size:
        raise ReaderError(f"A chunk of {size} bytes expands to {len(expanded)} or more.")
    return expanded


def _lz4(size: int, data: bytes) -> bytes:
    return inflate("lz4", data, size, whole=True)


_EXPAND: dict[str, Callable[[int, bytes], bytes]] = {"bz2": _bz2, "lz4": _lz4}
