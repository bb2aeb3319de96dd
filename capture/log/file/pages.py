"""Large pieces of memory: a page costs a fault when it is first written, so few should be new."""

from __future__ import annotations

import ctypes
import mmap
import os
import sys
import tempfile
import weakref
from pathlib import Path

import numpy as np

_TRIM = getattr(ctypes.CDLL(None), "malloc_trim", None) if sys.platform == "linux" else None
"""glibc's (malloc_trim(3)); other allocators have none."""


def new_pages(size: int) -> mmap.mmap:
    """Memory of small pages, each of which comes when it is first written.

    numpy would ask for huge pages, and in a virtual machine a new one costs milliseconds; a
    bytearray would write all of it at once.

    Args:
        size: How much [byte], more than 0.

    Returns:
        Zeros, given back when nothing refers to them any more.

    Raises:
        MemoryError: If there is not as much.
    """
    try:
        return mmap.mmap(-1, size, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
    except OSError as error:
        raise MemoryError(f"{size} bytes for what is read") from error


def keep_freed(size: int) -> None:
    """Have pieces of memory that come and go use the same pages again.

    glibc gives a large piece back to the system as soon as it is freed, up to the size of the
    largest that it has seen freed: from then on it keeps them (mallopt(3), M_MMAP_THRESHOLD). Other
    allocators take no notice.

    Args:
        size: Of the largest such piece [byte].
    """
    np.empty(size, dtype=np.uint8)  # freed at once, never written


class FilePages:
    """Memory that lies in a file, so that what is not looked at need not be in memory.

    The file has no name and is gone with what refers to it. What was written stays when its pages
    are let go of: the system writes it to the disk when it needs the room, and not before.
    """

    def __init__(self, folder: Path) -> None:
        """Choose where the files go.

        Args:
            folder: On a disk; in a file system in memory nothing is gained.
        """
        self._folder = folder
        self._held: weakref.WeakSet[mmap.mmap] = weakref.WeakSet()
        self._used = False

    def new(self, size: int) -> mmap.mmap:
        """Memory in a file of its own; where there is no room for one, memory as it usually is.

        Args:
            size: How much [byte], more than 0.

        Returns:
            Zeros, given back when nothing refers to them any more.

        Raises:
            MemoryError: If there is not as much, neither on the disk nor in memory.
        """
        if sys.platform != "linux":
            return new_pages(size)
        try:
            with tempfile.TemporaryFile(dir=self._folder) as file:
                # A hole in a mapped file ends the process when the disk is full: reserve it all.
                os.posix_fallocate(file.fileno(), 0, size)
                found = mmap.mmap(file.fileno(), size)
        except OSError:
            return new_pages(size)
        self._held.add(found)
        self._used = True
        return found

    def release(self) -> None:
        """Let go of the pages, and of memory that was freed but kept.

        What the pages hold is read again when it is looked at.
        """
        held = list(self._held)
        for each in held:
            each.madvise(mmap.MADV_DONTNEED)
        if self._used and _TRIM is not None:
            _TRIM(0)
        self._used = bool(held)  # once more when all are gone: it takes milliseconds
