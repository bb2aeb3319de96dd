"""The bytes of an MCAP file, and the payloads of its blocks decompressed and checked."""

from __future__ import annotations

import itertools
import mmap
import os
import tempfile
import threading
import weakref
import zlib
from collections import OrderedDict, deque
from collections.abc import Generator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

import zstandard

from ...common.arrays import merged_ranges
from ...common.errors import InputFileError, LogError, NotALogError
from ...common.files import check_regular
from ...common.remote import HEAD_SIZE, RemoteFile, RemotePath
from .chunk import (
    PREFIX_SIZE,
    Block,
    Buffer,
    checks_itself,
    chunk_at,
    inflate,
    inflate_zstd_into,
    read_at,
)

_CACHE_SIZE = 64 << 20

_PAGE = HEAD_SIZE // 2
_BATCH = 8 << 20
"""Bytes of blocks that are fetched at a time, if they are expected."""

_GAP = 64 << 10
"""A smaller gap between two ranges is fetched with them: a request costs as much."""

_CORRUPT = "is corrupt (its CRC doesn't fit)"


class Cache:
    """Pieces that were read last, of all open files together, up to 64 MiB.

    Attributes:
        owners: Numbers for files, each given once.
        abandoned: Files that nothing refers to. The garbage collector adds to it at any moment,
            also while the lock is held, so it must not take the lock.
    """

    def __init__(self) -> None:
        """Begin empty."""
        self._held: OrderedDict[tuple[int, int], bytes] = OrderedDict()
        self._size = 0
        self._lock = threading.Lock()
        self.owners = itertools.count()
        self.abandoned: deque[int] = deque()

    def get(self, key: tuple[int, int]) -> bytes | None:
        """Return a piece, by its file's number and its place; None if it isn't kept."""
        with self._lock:
            data = self._held.get(key)
            if data is not None:
                self._held.move_to_end(key)
            return data

    def put(self, key: tuple[int, int], data: bytes) -> None:
        """Keep a piece, unless it is larger than the cache."""
        with suppress(IndexError):  # empty, perhaps since another thread was faster
            while True:
                self.drop(self.abandoned.popleft())
        if len(data) > _CACHE_SIZE:
            return
        with self._lock:
            self._size += len(data) - len(self._held.pop(key, b""))
            self._held[key] = data
            while self._size > _CACHE_SIZE:
                _, dropped = self._held.popitem(last=False)
                self._size -= len(dropped)

    def drop(self, owner: int) -> None:
        """Drop all pieces of one file."""
        with self._lock:
            for key in [key for key in self._held if key[0] == owner]:
                self._size -= len(self._held.pop(key))


cache = Cache()
"""The one of this process."""


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
            ranges = merged_ranges(((at, min(at + _PAGE, self._file.size)) for at in missing), 0)
            for (at, _), data in zip(ranges, self._file.read_many(ranges), strict=True):
                self._write(at, data)
            self._whole = self._whole or (start == 0 and stop == self._file.size)

    def read(self, start: int, stop: int) -> bytes:
        """Return the bytes [start, stop), fetched alone if they are not here.

        Raises:
            InputFileError: If they can't be fetched.
        """
        with self._lock:
            if self._pages.issuperset(range(start // _PAGE, -(-stop // _PAGE))):
                return self._buffer[start:stop]
        (data,) = self._file.read_many([(start, stop)])
        return data

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
        place, content = self._place.get(block.record_at), b""
        batch, size = [block], self._size(block)
        for other in () if place is None else self._expected[place + 1 :]:
            size += self._size(other)
            if size > _BATCH:
                break
            batch.append(other)
        extents = [
            (part.record_at, self._ends[part.record_at])
            for part in batch
            if part is block or cache.get((self._owner, part.record_at)) is None
        ]
        ranges = merged_ranges(sorted(extents), _GAP)
        for (base, stop), data in zip(ranges, self._file.read_many(ranges), strict=True):
            for start, end in extents:
                if base <= start < stop:
                    piece = data[start - base : end - base]
                    cache.put((self._owner, start), piece)
                    content = piece if start == block.record_at else content
        return content

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


class McapPayloads:
    """A memory-mapped MCAP file and the payloads of its blocks.

    Attributes:
        buffer: The file; of one on a server, a file of its size that holds what was needed.
        remote: What was fetched of a file on a server; None for a local file.
    """

    def __init__(self, path: Path) -> None:
        """Map a file.

        Raises:
            NotALogError: If it is empty.
            LogError: If the operating system can't open it.
            InputFileError: If it is on a server and can't be read.
        """
        self.path = path
        self._owner = next(cache.owners)
        self.remote = FetchedFile(path, self._owner) if isinstance(path, RemotePath) else None
        self.buffer, descriptor = _mapped(path) if self.remote is None else self.remote.mapped()
        self._close_descriptor = weakref.finalize(self, os.close, descriptor)
        self._descriptor = descriptor
        weakref.finalize(self, cache.abandoned.append, self._owner)

    def close(self) -> None:
        """Release the mapping."""
        cache.drop(self._owner)
        with suppress(BufferError):  # the frames of an error still refer to it: it goes with them
            self.buffer.close()
        self._close_descriptor()
        if self.remote is not None:
            self.remote.close()

    def need(self, start: int, stop: int) -> None:
        """Fetch the bytes [start, stop) of a file on a server into the buffer, where they stay."""
        if self.remote is not None:
            self.remote.need(start, stop)

    def around(self, block: Block) -> tuple[Buffer, int]:
        """Return a buffer with a block and its message indexes, and its first byte's offset."""
        return (self.buffer, 0) if self.remote is None else self.remote.around(block)

    @contextmanager
    def whole(self) -> Generator[mmap.mmap]:
        """Map the whole file once more, so that its pages go when they have been read."""
        self.need(0, len(self.buffer))
        with mmap.mmap(self._descriptor, 0, access=mmap.ACCESS_READ) as data:
            yield data

    def forget(self) -> None:
        """Release the file's pages and decompressed payloads; they are read again when needed."""
        if self.remote is not None:
            return  # its cache is bounded, and fetching again is slow
        cache.drop(self._owner)
        if hasattr(mmap, "MADV_DONTNEED"):  # mapped pages count as this process's memory
            self.buffer.madvise(mmap.MADV_DONTNEED)

    def payload(self, block: Block) -> tuple[Buffer, int, int]:
        """Return the uncompressed bytes of a block and keep them in a cache.

        Returns:
            A buffer, and the first and one past the last byte of the payload in it.

        Raises:
            LogError: If the payload can't be decompressed or its CRC is wrong.
        """
        if not block.compression:
            return self._stored(block)
        key = self._owner, block.start
        data = cache.get(key)
        if data is None:
            data = self._decompress(block)
            cache.put(key, data)
        return data, 0, len(data)

    def payload_once(self, block: Block) -> tuple[Buffer, int, int]:
        """Return the uncompressed bytes of a block without keeping them.

        Unlike :meth:`payload` it checks the CRC of an uncompressed chunk, too.
        """
        if block.compression:
            data = self._decompress(block)
            return data, 0, len(data)
        data, start, stop = self._stored(block)
        if block.crc and block.complete:
            with memoryview(data) as whole, whole[start:stop] as payload:
                if zlib.crc32(payload) != block.crc:
                    raise self._error(block, _CORRUPT)
        return data, start, stop

    def inflates(self, block: Block, limit: int) -> bool:
        """Whether :meth:`inflate_into` can be used: a whole zstd chunk up to ``limit`` bytes."""
        return block.compression == "zstd" and block.complete and 0 < block.size <= limit

    def inflate_into(self, block: Block, room: memoryview) -> None:
        """Decompress a block into existing memory and check it; may be used by several threads.

        The chunk's CRC is not checked if the frame has a checksum of its own: both are 32 bits of
        the same bytes, and decompression has verified the one.

        Args:
            block: One for which :meth:`inflates` is true.
            room: Memory of the block's size.

        Raises:
            LogError: If it can't be decompressed or its CRC is wrong.
        """
        try:
            with self._compressed(block) as raw:
                size = inflate_zstd_into(raw, room)
                checked = not block.crc or checks_itself(raw)
        except zstandard.ZstdError as error:
            raise self._error(block, f"can't be decompressed: {error}") from error
        except InputFileError:  # of a server: no fault of the chunk
            raise
        except OSError as error:
            raise self._error(block, f"can't be read: {error.strerror}") from error
        if size != block.size:
            raise self._error(block, f"has {size} bytes, not {block.size}")
        if not checked and zlib.crc32(room) != block.crc:
            raise self._error(block, _CORRUPT)

    def _stored(self, block: Block) -> tuple[Buffer, int, int]:
        """Return a buffer, and the first and one past the last stored byte of a block in it."""
        data, base = self.around(block)
        return data, block.start - base, block.stop - base

    def _compressed(self, block: Block) -> memoryview:
        if self.remote is None:
            return read_at(self._descriptor, block.start, block.stop)
        data, start, stop = self._stored(block)
        return memoryview(data)[start:stop]

    def _decompress(self, block: Block) -> bytes:
        stored, start, stop = self._stored(block)
        raw = bytes(stored[start:stop])
        try:
            data = inflate(block.compression, raw, block.size, whole=block.complete)
        except (zstandard.ZstdError, RuntimeError, EOFError, MemoryError) as error:
            reason = str(error) or "it claims more bytes than there is memory"
            raise self._error(block, f"can't be decompressed: {reason}") from error
        if not block.complete:
            return data
        if len(data) != block.size:
            raise self._error(block, f"has {len(data)} bytes, not {block.size}")
        if block.crc and zlib.crc32(data) != block.crc:
            raise self._error(block, _CORRUPT)
        return data

    def _error(self, block: Block, text: str) -> LogError:
        return LogError(self.path, f"the chunk at byte {block.start} {text}")


def _mapped(path: Path) -> tuple[mmap.mmap, int]:
    """Map a file; return also a descriptor of it."""
    try:
        check_regular(path)
        with path.open("rb") as stream:
            if not stream.read(1):
                raise NotALogError(path, "the file is empty (0 bytes)")
            data = mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ)
            return data, os.dup(stream.fileno())
    except FileNotFoundError as error:
        raise LogError(path, "no such file") from error
    except OSError as error:
        raise LogError(path, f"can't be opened: {error.strerror}") from error
