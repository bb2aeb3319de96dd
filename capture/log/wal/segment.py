"""One segment of a write-ahead log: a reserved, memory-mapped file.

A store to a mapped page is in the kernel's page cache at once, so a process that is killed loses
nothing of it; only power loss does, until :meth:`Segment.sync`.

The first store to a page, and the first after a sync has protected it, is a page fault, which the
file system may delay while the disk is busy (60 ms and more for a journal's commit). So another
thread takes the faults ahead of the writing (:meth:`Segment.hold`), and a sync of a busy segment
leaves out the page that is being written.

If another program truncates a mapped file, a store behind its end raises SIGBUS, which ends the
process and loses everything that is only in its memory. So a signal handler replaces the missing
pages by ordinary memory and marks the segment as cut; the store then succeeds, and the recorder can
finish.
"""

from __future__ import annotations

import ctypes
import errno
import mmap
import os
import signal
import struct
import sys
import threading
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from zlib import crc32

from ...common.errors import DataError, LogWriteError
from ...common.part_files import NEW_FILE, remove_opened
from ..mcap.batch import MessageFields
from .format import (
    HEADER_SIZE,
    RECORD_BODY,
    RECORD_CRC,
    RECORD_SIZE,
    RecordFields,
    RecordHead,
    SegmentHeader,
)

_LIBC = ctypes.CDLL(None, use_errno=True)
_LIBC.mmap.restype = ctypes.c_void_p
_LIBC.mmap.argtypes = (
    ctypes.c_void_p,
    ctypes.c_size_t,
    ctypes.c_int,
    ctypes.c_int,
    ctypes.c_int,
    ctypes.c_long,
)
_MAP_FIXED = 0x10
_SA_SIGINFO = 4
_BUS_ADRERR = 2  # beyond the end of a mapped file
_ADDRESS_AT = 16  # of si_addr in siginfo_t, on 64-bit systems

_HANDLER = ctypes.CFUNCTYPE(None, ctypes.c_int, ctypes.c_void_p, ctypes.c_void_p)

SEGMENT_OVERHEAD = 2 * HEADER_SIZE
"""Bytes of a segment that hold no records."""

_MS_SYNC = 4
_MADV_POPULATE_WRITE = 23  # Linux 5.14; Python's mmap.madvise() keeps the interpreter's lock
_PAGE = mmap.PAGESIZE
_BUSY = 8 * _PAGE  # so many bytes between two syncs: the last page is young enough to wait

RESERVED_SPACE_NAME = "ballast"

FULL = frozenset({errno.ENOSPC, errno.EDQUOT})
"""Error numbers of a lack of free space."""


class _Action(ctypes.Structure):
    """``struct sigaction`` of glibc and musl."""

    _fields_ = (
        ("handler", ctypes.c_void_p),
        ("mask", ctypes.c_ulong * 16),
        ("flags", ctypes.c_int),
        ("restorer", ctypes.c_void_p),
    )


@dataclass
class _Mapping:
    """One mapped file.

    Attributes:
        cut: Called in the storing thread if the file was truncated; must not store to the mapping.
    """

    address: int
    size: int
    cut: Callable[[], None]


class _Watch:
    """The process's handler of SIGBUS, set with the first mapping."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._mappings: tuple[_Mapping, ...] = ()
        self._handler: object = None

    def add(self, mapping: _Mapping) -> None:
        with self._lock:
            self._mappings = (*self._mappings, mapping)
            if self._handler is None:
                self._set_handler()

    def remove(self, mapping: _Mapping) -> None:
        with self._lock:
            self._mappings = tuple(other for other in self._mappings if other is not mapping)

    def _set_handler(self) -> None:
        """Set the handler; if the system allows no callbacks from C, SIGBUS ends the process."""
        if sys.maxsize < 2**32:
            return
        try:
            handler = _HANDLER(self._on_signal)
        except MemoryError:
            return
        action = _Action(ctypes.cast(handler, ctypes.c_void_p), flags=_SA_SIGINFO)
        if not _LIBC.sigaction(int(signal.SIGBUS), ctypes.byref(action), None):
            self._handler = handler

    def _on_signal(self, number: int, info: int, context: int) -> None:
        """Run in the thread whose store failed, during that store."""
        del context
        code = ctypes.c_int.from_address(info + 8).value
        address = ctypes.c_size_t.from_address(info + _ADDRESS_AT).value
        for mapping in self._mappings:
            if code == _BUS_ADRERR and 0 <= address - mapping.address < mapping.size:
                page = address & -mmap.PAGESIZE
                left = mapping.address + mapping.size - page
                access = mmap.PROT_READ | mmap.PROT_WRITE
                kind = mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS | _MAP_FIXED
                if _LIBC.mmap(page, left, access, kind, -1, 0) == page:
                    mapping.cut()
                    return
        default = _Action(None)  # the store fails again and ends the process
        _LIBC.sigaction(number, ctypes.byref(default), None)
        if code != _BUS_ADRERR:
            signal.raise_signal(number)


_WATCH = _Watch()


def free_bytes(path: Path) -> int:
    """Return the space left for ordinary users on the disk of a file [byte].

    Args:
        path: The file or folder; if it doesn't exist, its nearest existing parent is used.

    Raises:
        OSError: If the file system can't be queried.
    """
    existing = path.absolute()
    while not existing.exists():
        existing = existing.parent
    disk = os.statvfs(existing)
    return disk.f_bavail * disk.f_frsize


def require_space(path: Path, needed: int) -> None:
    """Check that a disk has enough free space.

    Args:
        path: The file or folder to be written.
        needed: Required size [byte].

    Raises:
        LogWriteError: If less is free.
    """
    try:
        free = free_bytes(path)
    except OSError as error:
        raise LogWriteError(path, f"can't read the free space: {error.strerror}") from error
    if free < needed:
        raise LogWriteError(path, _shortage(needed, free))


class Segment:
    """A segment that is being written. One thread puts records, another may sync."""

    def __init__(self, path: Path, header: SegmentHeader) -> None:
        """Create the file, all its blocks reserved.

        A sparse mapping would do until the disk is full, and then end the process with SIGBUS.

        Args:
            header: Its header; ``size`` is a multiple of 8.

        Raises:
            LogWriteError: If it can't be created or reserved; then no file is left.
        """
        self.path = path
        self.size = header.size
        self.last = 0
        self.cut = False
        """Whether another program truncated the file: later records are not in it."""
        self._at = HEADER_SIZE
        self._end = header.size - HEADER_SIZE
        self._salt = header.salt
        self._synced_at = self._durable = 0
        self._page_end = _PAGE
        self._whole = 0, 0  # start of the page that is being written, last record wholly before it
        try:
            self._file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o666)
        except OSError as error:
            raise LogWriteError(path, f"can't be created: {error.strerror}") from error
        try:
            os.posix_fallocate(self._file, 0, header.size)
            self._view = mmap.mmap(self._file, header.size)
            self._address = ctypes.addressof(ctypes.c_char.from_buffer(self._view))
            self._mapping = _Mapping(self._address, header.size, self._note_cut)
            _WATCH.add(self._mapping)
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
            fields: The head of the record, from the running number on.

        Returns:
            Whether there was room; if not, nothing is written.

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

    def put_all(self, fields: tuple[int, int, int], messages: Sequence[MessageFields]) -> bool:
        """Write records of one size, if all fit; see :meth:`put`.

        Args:
            fields: Running number of the first one, kind, mark.
            messages: Channel id, log time, publish time, sequence number and payload of each.

        Returns:
            Whether there was room, and every number fits its field; if not, none counts.
        """
        position, kind, mark = fields
        length = len(messages[0][-1])
        size = (RECORD_SIZE + length + 7) & -8
        start = first = self._at
        if first + size * len(messages) > self._end:
            return False
        view, salt, pack, crc_size = self._view, self._salt, RECORD_BODY.pack, RECORD_CRC.size
        try:
            heads = [
                pack(length, number, kind, mark, channel_id, sequence, log_time_ns, publish_time_ns)
                for number, (channel_id, log_time_ns, publish_time_ns, sequence, _) in enumerate(
                    messages, position
                )
            ]
        except struct.error:
            return False
        for head, message in zip(heads, messages, strict=True):
            body = head + message[-1]
            view[start + crc_size : start + RECORD_SIZE + length] = body
            RECORD_CRC.pack_into(view, start, crc32(body, salt))
            start += size
        self._at = start
        if start > self._page_end:
            page = start & -_PAGE
            whole = (page - first) // size
            self._whole, self._page_end = (page, position - 1 + whole), page + _PAGE
        self.last = position + len(messages) - 1
        return True

    @property
    def synced(self) -> bool:
        """Whether it was ever synced; before, the folder must be synced too, for its name."""
        return self._synced_at > 0

    def sync(self, *, whole: bool = True) -> int:
        """Write the records to the disk; lets other threads run.

        Args:
            whole: Include the page that is being written, even after much was written since the
                last sync. The next store to it is a page fault.

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
        """Take the page faults of the next bytes; lets other threads run.

        Args:
            ahead: Number of bytes from the next record on.

        Returns:
            How many of these bytes are beyond this segment.

        Raises:
            OSError: If the kernel can't (before Linux 5.14), or the file was truncated.
        """
        start = self._at & -_PAGE
        stop = min(start + ahead, self.size)
        _call(_LIBC.madvise, self._address + start, stop - start, _MADV_POPULATE_WRITE)
        return start + ahead - stop

    def close(self, *, remove: bool) -> None:
        """Release the mapping."""
        self._end = 0
        _WATCH.remove(self._mapping)
        self._view.close()
        if remove:
            remove_opened(self._file, self.path)
        os.close(self._file)

    def _note_cut(self) -> None:
        """Take no more records."""
        self.cut, self._end = True, 0


def _call(function: Callable[..., int], address: int, size: int, flag: int) -> None:
    """Call a function of the C library on mapped memory, the interpreter's lock released."""
    if function(ctypes.c_void_p(address), ctypes.c_size_t(size), ctypes.c_int(flag)):
        code = ctypes.get_errno()
        raise OSError(code, os.strerror(code))


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


class ReservedSpace:
    """A file that reserves disk space and is deleted when the space is needed."""

    def __init__(self, folder: Path, size: int) -> None:
        """Reserve the space.

        Args:
            folder: Its folder; an old file is replaced.
            size: Size [byte]; no file is created for 0.

        Raises:
            LogWriteError: If there is no room; then no file is left.
        """
        self.path = folder / RESERVED_SPACE_NAME
        self._opened: int | None = None
        if not size:
            return
        require_space(self.path, size)
        try:
            self.path.unlink(missing_ok=True)
            self._opened = os.open(self.path, os.O_WRONLY | NEW_FILE, 0o666)
            os.posix_fallocate(self._opened, 0, size)
        except OSError as error:
            self.free()
            raise LogWriteError(
                self.path, f"{size} bytes can't be reserved: {error.strerror}"
            ) from error

    def free(self) -> bool:
        """Free the space; return whether it was reserved."""
        opened, self._opened = self._opened, None
        if opened is None:
            return False
        remove_opened(opened, self.path)
        os.close(opened)
        return True
