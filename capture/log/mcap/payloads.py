"""The bytes of an MCAP file, and the payloads of its blocks decompressed and checked."""

from __future__ import annotations

import mmap
import os
import weakref
import zlib
from collections.abc import Generator
from contextlib import contextmanager, suppress
from pathlib import Path

import zstandard

from ...common.errors import InputFileError, LogError, NotALogError
from ...common.remote import RemotePath
from .cache import cache
from .chunk import Block, Buffer, checks_itself, inflate, inflate_zstd_into, read_at
from .fetched import FetchedFile

_CORRUPT = "is corrupt (its CRC doesn't fit)"


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
        with path.open("rb") as stream:
            if not stream.read(1):
                raise NotALogError(path, "the file is empty (0 bytes)")
            data = mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ)
            return data, os.dup(stream.fileno())
    except FileNotFoundError as error:
        raise LogError(path, "no such file") from error
    except OSError as error:
        raise LogError(path, f"can't be opened: {error.strerror}") from error
