"""What was fetched of an MCAP file on a server: its definitions for good, its blocks for a while.

Definitions, summary and indexes lie in a sparse file without a name that has the size of the whole.
Blocks are immutable pieces in the bounded cache, so that threads may read one that is dropped.
"""

from __future__ import annotations

import mmap
import os
import tempfile
import threading
import weakref
from collections.abc import Iterable, Sequence

from ...common.errors import LogError, NotALogError
from ...common.remote import HEAD_SIZE, RemoteFile, RemotePath
from .cache import cache
from .chunk import PREFIX_SIZE, Block, Buffer, chunk_at

_PAGE = HEAD_SIZE // 2
_BATCH = 8 << 20
"""Bytes of blocks that are fetched at a time, if they are expected."""

_GAP = 64 << 10
"""A smaller gap between two ranges is fetched with them: a request costs as much."""


class FetchedFile:
    """Parts of a file on a server."""

    def __init__(self, path: RemotePath, owner: int) -> None:
        """Connect and fetch the first bytes.

        Args:
            owner: Number of the file in the cache.

        Raises:
            NotALogError: If it is empty.
            InputFileError: If it can't be read, or not in ranges of bytes.
        """
        self._file, self._owner = RemoteFile(path), owner
        self._lock = threading.RLock()
        self._pages: set[int] = set()
        self._ends: dict[int, int] = {}  # chunk record to the end of its message indexes
        self._expected: Sequence[Block] = ()
        self._place: dict[int, int] = {}
        self._whole = False
        if not self._file.size:
            raise NotALogError(path, "the file is empty (0 bytes)")
        with tempfile.TemporaryFile(prefix="undulog-") as sparse:
            sparse.truncate(self._file.size)
            self._descriptor = os.dup(sparse.fileno())
        self.close = weakref.finalize(self, os.close, self._descriptor)
        self._buffer = mmap.mmap(self._descriptor, 0, access=mmap.ACCESS_READ)
        self._write(0, self._file.head)

    @property
    def tag(self) -> str:
        """ETag of the object, or else the time of its last change."""
        return self._file.tag

    def mapped(self) -> tuple[mmap.mmap, int]:
        """Return the mapped sparse file and a descriptor of it."""
        return self._buffer, os.dup(self._descriptor)

    def need(self, start: int, stop: int) -> None:
        """Fetch the bytes [start, stop) into the mapped file.

        Raises:
            InputFileError: If they can't be fetched.
        """
        stop = min(stop, self._file.size)
        with self._lock:
            pages = range(start // _PAGE, -(-stop // _PAGE))
            missing = [page * _PAGE for page in pages if page not in self._pages]
            ranges = _merged((at, min(at + _PAGE, self._file.size)) for at in missing)
            for (at, _), data in zip(ranges, self._file.read_many(ranges), strict=True):
                self._write(at, data)
            self._whole = self._whole or (start == 0 and stop == self._file.size)

    def add(self, block: Block, end: int) -> None:
        """Add a block that only its index describes; its message indexes end at ``end``."""
        self._ends[block.record_at] = end

    def expect(self, blocks: Sequence[Block]) -> None:
        """Announce blocks that will be read next, in this order, to be fetched many at a time."""
        with self._lock:
            self._expected = blocks
            self._place = {block.record_at: k for k, block in enumerate(blocks)}

    def around(self, block: Block) -> tuple[Buffer, int]:
        """Return a buffer with a block and its message indexes, and its first byte's offset.

        Raises:
            InputFileError: If it can't be fetched.
            LogError: If the chunk isn't what its index says.
        """
        if block.record_at not in self._ends:  # found by reading the whole file
            return self._buffer, 0
        if self._whole:
            return self._buffer, self._check_head(block, self._buffer, 0)
        key = self._owner, block.record_at
        data = cache.get(key)
        if data is None:
            with self._lock:  # another thread may be fetching it, among others
                data = cache.get(key) or self._fetch(block)
        return data, self._check_head(block, data, block.record_at)

    def _fetch(self, block: Block) -> bytes:
        """Fetch a block and those that are expected behind it; return the block's piece."""
        place, found = self._place.get(block.record_at), b""
        batch, size = [block], self._size(block)
        for other in () if place is None else self._expected[place + 1 :]:
            size += self._size(other)
            if size > _BATCH:
                break
            batch.append(other)
        wanted = [
            (one.record_at, self._ends[one.record_at])
            for one in batch
            if one is block or cache.get((self._owner, one.record_at)) is None
        ]
        ranges = _merged(sorted(wanted), _GAP)
        for (base, stop), data in zip(ranges, self._file.read_many(ranges), strict=True):
            for start, end in wanted:
                if base <= start < stop:
                    piece = data[start - base : end - base]
                    cache.put((self._owner, start), piece)
                    found = piece if start == block.record_at else found
        return found

    def _size(self, block: Block) -> int:
        return self._ends[block.record_at] - block.record_at

    def _check_head(self, block: Block, data: Buffer, base: int) -> int:
        """Hold a chunk to its index and take its CRC, which no index has; return the offset."""
        at = block.record_at - base + PREFIX_SIZE
        head = chunk_at(data, at, block.stop - base)
        same = (
            head is not None
            and head.complete
            and (
                (head.start + base, head.stop + base, head.size, head.compression)
                == (block.start, block.stop, block.size, block.compression)
            )
        )
        if head is None or not same:
            where = f"the chunk at byte {block.start}"
            raise LogError(self._file.path, f"{where} is not what its index says")
        block.crc = head.crc
        return base

    def _write(self, at: int, data: bytes) -> None:
        """Write into the sparse file: on a full disk the mapping would end the process."""
        pages = range(at // _PAGE, -(-(at + len(data)) // _PAGE))
        while data:
            written = os.pwrite(self._descriptor, data, at)
            at, data = at + written, data[written:]
        self._pages.update(pages)


def _merged(ranges: Iterable[tuple[int, int]], gap: int = 0) -> list[tuple[int, int]]:
    """Join ranges, in order, that are no further apart than a gap."""
    found: list[tuple[int, int]] = []
    for start, stop in ranges:
        if found and start <= found[-1][1] + gap:
            found[-1] = found[-1][0], max(found[-1][1], stop)
        else:
            found.append((start, stop))
    return found
