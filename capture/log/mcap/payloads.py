"""The bytes of an MCAP file, and the payloads of its blocks decompressed and checked."""

from __future__ import annotations

import itertools
import mmap
import os
import threading
import weakref
import zlib
from collections import OrderedDict, deque
from contextlib import suppress
from pathlib import Path

import zstandard

from ...common.errors import LogError, NotALogError
from .chunk import Block, Buffer, checks_itself, inflate, inflate_zstd_into, read_at

_CACHE_SIZE = 64 << 20
_CORRUPT = "is corrupt (its CRC doesn't fit)"


class _Cache:
    """Payloads that were decompressed last, of all open files together.

    Attributes:
        abandoned: Files that nothing refers to. The garbage collector adds to it at any moment,
            also while the lock is held, so it must not take the lock.
    """

    def __init__(self) -> None:
        self._held: OrderedDict[tuple[int, int], bytes] = OrderedDict()
        self._size = 0
        self._lock = threading.Lock()
        self.owners = itertools.count()
        self.abandoned: deque[int] = deque()

    def get(self, key: tuple[int, int]) -> bytes | None:
        with self._lock:
            data = self._held.get(key)
            if data is not None:
                self._held.move_to_end(key)
            return data

    def put(self, key: tuple[int, int], data: bytes) -> None:
        """Keep a payload, unless it is larger than the cache."""
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
        """Drop all payloads of one file."""
        with self._lock:
            for key in [key for key in self._held if key[0] == owner]:
                self._size -= len(self._held.pop(key))


_cache = _Cache()


class McapPayloads:
    """A memory-mapped MCAP file and the payloads of its blocks."""

    def __init__(self, path: Path) -> None:
        """Map a file.

        Raises:
            NotALogError: If it is empty.
            LogError: If the operating system can't open it.
        """
        self.path = path
        self.buffer, descriptor = _mapped(path)
        self._close_descriptor = weakref.finalize(self, os.close, descriptor)
        self._descriptor = descriptor
        self._owner = next(_cache.owners)
        weakref.finalize(self, _cache.abandoned.append, self._owner)

    def close(self) -> None:
        """Release the mapping."""
        _cache.drop(self._owner)
        with suppress(BufferError):  # the frames of an error still refer to it: it goes with them
            self.buffer.close()
        self._close_descriptor()

    def forget(self) -> None:
        """Release the file's pages and decompressed payloads; they are read again when needed."""
        _cache.drop(self._owner)
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
            return self.buffer, block.start, block.stop
        key = self._owner, block.start
        data = _cache.get(key)
        if data is None:
            data = self._decompress(block)
            _cache.put(key, data)
        return data, 0, len(data)

    def payload_once(self, block: Block) -> tuple[Buffer, int, int]:
        """Return the uncompressed bytes of a block without keeping them.

        Unlike :meth:`payload` it checks the CRC of an uncompressed chunk, too.
        """
        if block.compression:
            data = self._decompress(block)
            return data, 0, len(data)
        if block.crc and block.complete:
            with memoryview(self.buffer) as whole, whole[block.start : block.stop] as payload:
                if zlib.crc32(payload) != block.crc:
                    raise self._error(block, _CORRUPT)
        return self.buffer, block.start, block.stop

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
            with read_at(self._descriptor, block.start, block.stop) as raw:
                size = inflate_zstd_into(raw, room)
                checked = not block.crc or checks_itself(raw)
        except zstandard.ZstdError as error:
            raise self._error(block, f"can't be decompressed: {error}") from error
        except OSError as error:
            raise self._error(block, f"can't be read: {error.strerror}") from error
        if size != block.size:
            raise self._error(block, f"has {size} bytes, not {block.size}")
        if not checked and zlib.crc32(room) != block.crc:
            raise self._error(block, _CORRUPT)

    def _decompress(self, block: Block) -> bytes:
        raw = self.buffer[block.start : block.stop]
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
        with path.open("rb") as stream:
            if not stream.read(1):
                raise NotALogError(path, "the file is empty (0 bytes)")
            data = mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ)
            return data, os.dup(stream.fileno())
    except FileNotFoundError as error:
        raise LogError(path, "no such file") from error
    except OSError as error:
        raise LogError(path, f"can't be opened: {error.strerror}") from error
