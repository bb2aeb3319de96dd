"""Large pieces of memory: a page costs a fault when it is first written, so few should be new."""

from __future__ import annotations

import mmap

import numpy as np


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
