"""Large pieces of memory that cost nothing until they are used."""

from __future__ import annotations

import mmap


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
