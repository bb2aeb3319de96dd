"""Pieces of files that were read last: decompressed payloads, and what came from a server."""

from __future__ import annotations

import itertools
import threading
from collections import OrderedDict, deque
from contextlib import suppress

_CACHE_SIZE = 64 << 20


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
