"""One segment of a write-ahead log: a reserved, memory-mapped file.

A store to a mapped page is in the kernel's page cache at once, so a process that is killed loses
nothing of it; only power loss does, until :meth:`Segment.sync`.

The first store to a page, and the first after a sync has protected it, is a page fault that the
file system may hold up for as long as the disk is busy: a journal's commit, 60 ms and more beside
other writers. So another thread takes the faults ahead of the writing (:meth:`Segment.hold`), and a
sync of a busy segment leaves out the page that is being written.
"""

from __future__ import annotations

import ctypes
import errno
import mmap
import os
import secrets
import struct
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from zlib import crc32

from ...common.errors import DataError, LogWriteError
from .cut_mapping import watch_mapping
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

_LIBC = ctypes.CDLL(None, use_errno=True)
_MS_SYNC = 4
_MADV_POPULATE_WRITE = 23  # Linux 5.14; Python's mmap.madvise() keeps the interpreter's lock
_PAGE = mmap.PAGESIZE
_BUSY = 8 * _PAGE  # so many bytes between two syncs: the last page is young enough to wait


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
        self.cut = False
        """Whether somebody cut the file short: what was put since is not in it."""
        self._at = HEADER_SIZE
        self._end = header.size - HEADER_SIZE
        self._salt = header.salt
        self._synced_at = 0
        self._durable = 0
        self._page_end = _PAGE
        self._whole = 0, 0  # where the page begins that is written, last record wholly before it
        try:
            flags = os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC
            self._file = os.open(path, flags, 0o666)
        except OSError as error:
            raise LogWriteError(path, f"can't be created: {error.strerror}") from error
        try:
            os.posix_fallocate(self._file, 0, header.size)
            self._view = mmap.mmap(self._file, header.size)
            self._address = ctypes.addressof(ctypes.c_char.from_buffer(self._view))
            self._unwatch = watch_mapping(self._address, header.size, self._note_cut)
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
            return False  # nor after the file was cut short
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
        if stop > self._page_end:
            page = self._at & -_PAGE
            self._whole, self._page_end = (page, self.last), page + _PAGE
        self.last = fields[0]
        return True

    @property
    def synced(self) -> bool:
        """Whether it ever was; before, the folder has to be synced too, for its name."""
        return self._synced_at > 0

    def sync(self, *, whole: bool = True) -> int:
        """Bring what was put so far to the disk; nothing to do if nothing was put since.

        Lets other threads run.

        Args:
            whole: With the page that is being written, even where much was put since the last
                sync. The next store to it is a page fault.

        Returns:
            Number of the last record that is on the disk; 0 for none.

        Raises:
            OSError: If the disk fails.
        """
        last, at = self.last, self._at
        page, before = self._whole
        if at == self._synced_at:
            return self._durable
        if not self._synced_at:
            os.fsync(self._file)
        elif whole or page - self._synced_at < _BUSY:
            os.fdatasync(self._file)
        else:
            start = self._synced_at & -_PAGE
            _call(_LIBC.msync, self._address + start, page - start, _MS_SYNC)
            last, at = before, page
        self._synced_at, self._durable = at, last
        return last

    def hold(self, ahead: int) -> int:
        """Take the page faults of what is written next; lets other threads run.

        Args:
            ahead: Bytes from where the next record goes.

        Returns:
            How many of these bytes are beyond this segment.

        Raises:
            OSError: If the kernel can't (before Linux 5.14), or the file was cut short.
        """
        start = self._at & -_PAGE
        stop = min(start + ahead, self.size)
        _call(_LIBC.madvise, self._address + start, stop - start, _MADV_POPULATE_WRITE)
        return start + ahead - stop

    def close(self, *, remove: bool) -> None:
        """Release the mapping.

        Args:
            remove: Delete the file too.
        """
        self._end = 0
        self._unwatch()
        self._view.close()
        os.close(self._file)
        if remove:
            with suppress(OSError):  # someone else may have tidied up
                self.path.unlink()

    def _note_cut(self) -> None:
        """Take no more records."""
        self.cut, self._end = True, 0


def _call(function: Callable[..., int], address: int, size: int, flag: int) -> None:
    """Call a function of the C library on mapped memory, the interpreter's lock released."""
    if function(ctypes.c_void_p(address), ctypes.c_size_t(size), ctypes.c_int(flag)):
        code = ctypes.get_errno()
        raise OSError(code, os.strerror(code))


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
