"""One segment of a write-ahead log: a reserved, memory-mapped file.

A store to a mapped page is in the kernel's page cache at once, so a process that is killed loses
nothing of it; only power loss does, until :meth:`Segment.sync`.
"""

from __future__ import annotations

import errno
import mmap
import os
import secrets
import struct
from contextlib import suppress
from pathlib import Path
from zlib import crc32

from ..errors import DataError, LogWriteError
from .wal_format import (
    HEADER_SIZE,
    RECORD_BODY,
    RECORD_CRC,
    RECORD_SIZE,
    RecordFields,
    RecordHead,
    SegmentHeader,
)

SEGMENT_OVERHEAD = 2 * HEADER_SIZE
"""Bytes of a segment that hold no records."""


def free_bytes(path: Path) -> int:
    """Space left for ordinary users on a file's disk.

    Args:
        path: The file or folder; where it isn't there yet, its nearest parent counts.

    Returns:
        Free space [byte].

    Raises:
        OSError: If the file system doesn't answer.
    """
    place = path.absolute()
    while not place.exists() and place != place.parent:
        place = place.parent
    found = os.statvfs(place)
    return found.f_bavail * found.f_frsize


def require_space(path: Path, needed: int) -> None:
    """Refuse to start what the disk has no room for.

    Args:
        path: The file or folder to be written.
        needed: How much it will take [byte].

    Raises:
        LogWriteError: If less is free; names the file and the missing bytes.
    """
    try:
        free = free_bytes(path)
    except OSError as error:
        raise LogWriteError(path, f"can't tell the free space: {error.strerror}") from error
    if free < needed:
        raise LogWriteError(path, _shortage(needed, free))


class Segment:
    """A segment that is being written. One thread puts records, another may sync."""

    def __init__(self, path: Path, header: SegmentHeader) -> None:
        """Create the file, all its blocks reserved.

        A sparse mapping would do until the disk is full, and then end the process with SIGBUS.

        Args:
            path: The file to create.
            header: What it says of itself; ``size`` is a multiple of 8.

        Raises:
            LogWriteError: If it can't be created or reserved; then no file is left.
        """
        self.path = path
        self.size = header.size
        self.last = 0
        self._at = HEADER_SIZE
        self._end = header.size - HEADER_SIZE
        self._salt = header.salt
        self._synced_at = 0
        try:
            flags = os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC
            self._file = os.open(path, flags, 0o666)
        except OSError as error:
            raise LogWriteError(path, f"can't be created: {error.strerror}") from error
        try:
            os.posix_fallocate(self._file, 0, header.size)
            self._view = mmap.mmap(self._file, header.size)
        except OSError as error:
            os.close(self._file)
            path.unlink(missing_ok=True)
            raise _reservation_error(path, header.size, error) from error
        packed = header.pack()
        self._view[:HEADER_SIZE] = packed
        self._view[self._end :] = packed

    def put(self, fields: RecordFields, payload: bytes) -> bool:
        """Write one record, if it fits.

        Args:
            fields: What stands before the payload, from the running number on.
            payload: Its bytes.

        Returns:
            Whether there was room; where there wasn't, nothing is written.

        Raises:
            DataError: If a number doesn't fit its field; nothing is written.
        """
        start = self._at
        length = len(payload)
        stop = start + RECORD_SIZE + length
        if stop > self._end:
            return False
        try:
            body = RECORD_BODY.pack(length, *fields) + payload
        except struct.error as error:
            head = RecordHead(length, *fields)
            raise DataError(
                f"{self.path}: channel_id (16 bits), sequence (32) or a time (64, not negative) "
                f"is out of range: {head}"
            ) from error
        view = self._view
        view[start + RECORD_CRC.size : stop] = body
        RECORD_CRC.pack_into(view, start, crc32(body, self._salt))
        self._at = (stop + 7) & -8
        self.last = fields[0]
        return True

    @property
    def synced(self) -> bool:
        """Whether it ever was; before, the folder has to be synced too, for its name."""
        return self._synced_at > 0

    def sync(self) -> None:
        """Bring what was put so far to the disk; nothing to do if nothing was put since.

        ``fdatasync`` covers pages dirtied through the mapping and lets other threads run.

        Raises:
            OSError: If the disk fails.
        """
        at = self._at
        if at == self._synced_at:
            return
        if self._synced_at:
            os.fdatasync(self._file)
        else:
            os.fsync(self._file)
        self._synced_at = at

    def close(self, *, remove: bool) -> None:
        """Release the mapping.

        Args:
            remove: Delete the file too.
        """
        self._end = 0
        self._view.close()
        os.close(self._file)
        if remove:
            with suppress(OSError):  # someone else may have tidied up
                self.path.unlink()


def new_header(stream: int, number: int, size: int, log_id: bytes) -> SegmentHeader:
    """Header of a new segment, with a salt of its own.

    Args:
        stream: ``MESSAGES`` or ``DEFINITIONS``.
        number: Its place in the stream, from 1.
        size: Bytes wanted; rounded up to a multiple of 8.
        log_id: The log's 16 bytes.

    Returns:
        The header.
    """
    return SegmentHeader(stream, secrets.randbits(32), number, (size + 7) & -8, log_id)


def sync_folder(folder: Path) -> None:
    """Bring a folder's entries to the disk, so that a new file's name survives power loss.

    Args:
        folder: The folder.

    Raises:
        OSError: If the disk fails.
    """
    opened = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        os.fsync(opened)
    finally:
        os.close(opened)


def _shortage(needed: int, free: int) -> str:
    return (
        f"needs {needed} bytes and the disk has {free} free: {needed - free} bytes are missing; "
        "free some space or write elsewhere"
    )


def _reservation_error(path: Path, size: int, error: OSError) -> LogWriteError:
    with suppress(OSError):
        free = free_bytes(path)
        if error.errno == errno.ENOSPC and free < size:
            return LogWriteError(path, _shortage(size, free))
    return LogWriteError(path, f"{size} bytes can't be reserved: {error.strerror}")
