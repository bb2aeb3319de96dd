"""Columns that grow while a log is read, without a second copy at the end."""

from __future__ import annotations

import mmap
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from ...common.arrays import IntArray
from ..file.log_file import FilePages, new_pages

_SHORT_NS = 2**31
_LARGE = 4 << 20
_STEPS = 16
"""Steps in which pages of a large column are requested; page faults cost twice as much."""
_STEP_SIZE = 1 << 18
"""Fewest bytes of a column that are requested at once: a call costs as much as some pages."""
_POPULATE_WRITE = 23
"""Linux's MADV_POPULATE_WRITE (5.14), which Python has no name for."""


class ColumnStore:
    """Rows of numbers, stored column by column; single bytes (text, records) row by row."""

    def __init__(
        self, dtype: str, width: int, capacity: int, pages: FilePages | None = None
    ) -> None:
        """Reserve memory, which is used only as rows are added.

        Args:
            dtype: numpy type string of a number.
            capacity: Expected number of rows; more cost a copy.
            pages: Storage of a large column in a file; None for memory.
        """
        self._pages = pages
        self._dtype = np.dtype(dtype)
        self._by_row = self._dtype.itemsize == 1
        self._width = width
        self._capacity = max(capacity, 1)
        self._memory: mmap.mmap | None = None
        self._ready = 0
        self._data = self._new(self._capacity)
        self._count = 0

    def __len__(self) -> int:
        """Number of rows."""
        return self._count

    def append(self, rows: NDArray[Any]) -> None:
        """Add rows.

        Args:
            rows: Shape (n, width), or (n,) of one number each.
        """
        stop = self._count + len(rows)
        if stop > self._capacity:
            self._capacity = max(2 * self._capacity, stop)
            old = self.values()
            self._data = self._new(self._capacity)
            self._part(0, self._count)[...] = old
        if self._memory is not None and stop > self._ready:
            self._make_ready(stop)
        if rows.ndim == 1:
            self._part(self._count, stop)[:, 0] = rows
        else:
            self._part(self._count, stop)[...] = rows
        self._count = stop

    def values(self) -> NDArray[Any]:
        """All rows, shape (n, width): a view; columns are contiguous, or rows for bytes."""
        return self._part(0, self._count)

    def column(self) -> NDArray[Any]:
        """The first column, shape (n,): a view."""
        return self.values()[:, 0]

    def _new(self, capacity: int) -> NDArray[Any]:
        shape = (capacity, self._width) if self._by_row else (self._width, capacity)
        size = capacity * self._width * self._dtype.itemsize
        self._memory, self._ready = None, 0
        if size < _LARGE:
            return np.empty(shape, dtype=self._dtype)
        memory = new_pages(size) if self._pages is None else self._pages.new(size)
        if sys.platform == "linux":
            self._memory = memory
        return np.frombuffer(memory, dtype=self._dtype).reshape(shape)

    def _make_ready(self, stop: int) -> None:
        """Request the pages of the rows up to ``stop`` and some more."""
        memory = self._memory
        if memory is None:
            return
        step = max(self._capacity // _STEPS, _STEP_SIZE // self._dtype.itemsize)
        first, self._ready = self._ready, min(self._capacity, stop + step)
        size, runs = self._dtype.itemsize, self._width
        if self._by_row:
            size, runs = size * self._width, 1
        for run in range(runs):
            start, end = ((run * self._capacity + row) * size for row in (first, self._ready))
            start -= start % mmap.PAGESIZE
            try:
                memory.madvise(_POPULATE_WRITE, start, end - start)
            except OSError:  # an older kernel: then each page is a fault
                self._memory = None
                return

    def _part(self, start: int, stop: int) -> NDArray[Any]:
        return self._data[start:stop] if self._by_row else self._data[:, start:stop].T


class EchoColumn:
    """A column that takes no memory as long as it is equal to another one.

    All topics of one tick of a recorder have the same stamps; an hour of stamps takes 3 MB.
    """

    def __init__(self, dtype: str, capacity: int, others: Sequence[EchoColumn] = ()) -> None:
        """Start empty.

        Args:
            dtype: numpy type string of a number.
            others: Columns that it may be equal to, if they get the rows first.
        """
        self._dtype, self._capacity, self._others = dtype, capacity, others
        self._leader: EchoColumn | None = None
        self._store: ColumnStore | None = None
        self._count = 0
        self._last: tuple[int, NDArray[Any]] | None = None

    def __len__(self) -> int:
        """Number of rows."""
        return self._count

    def append(self, rows: NDArray[Any]) -> None:
        """Add rows.

        Args:
            rows: Shape (n,); never written to afterwards.
        """
        start, stop = self._count, self._count + len(rows)
        if self._store is None and not start:
            leads = (other for other in self._others if other.has(rows, 0))
            self._leader, self._others = next(leads, None), ()
        elif self._leader is not None and not self._leader.has(rows, start):
            self._store = self._copied(stop)
            self._leader = None
        if self._leader is None:
            self._store = self._copied(stop) if self._store is None else self._store
            self._store.append(rows)
        self._count, self._last = stop, (start, rows)

    def has(self, rows: NDArray[Any], start: int) -> bool:
        """Whether its rows from ``start`` on are equal to ``rows``, shape (n,)."""
        if self._last is not None and self._last[1] is rows and self._last[0] == start:
            return True
        stop = start + len(rows)
        return self._count >= stop and np.array_equal(self.column()[start:stop], rows)

    def column(self) -> NDArray[Any]:
        """All rows, shape (n,): a view, perhaps of another column."""
        if self._leader is not None:
            return self._leader.column()[: self._count]
        return np.empty(0, self._dtype) if self._store is None else self._store.column()

    def _copied(self, capacity: int) -> ColumnStore:
        store = ColumnStore(self._dtype, 1, max(self._capacity, capacity))
        store.append(self.column())
        return store


@dataclass(frozen=True)
class Times:
    """Times of some messages; the arrays are not written to.

    Attributes:
        log_ns: Log times [Unix ns], shape (n,).
        stamp_ns: Stamps [ns], shape (n,); None without stamps.
        behind_ns: Log times minus stamps [ns], shape (n,); None without stamps.
        is_short: Whether those fit into 32 bits.
    """

    log_ns: IntArray
    stamp_ns: IntArray | None = None
    behind_ns: IntArray | None = None
    is_short: bool = True

    @classmethod
    def of(cls, log_ns: IntArray, stamp_ns: IntArray) -> Self:
        """Return the times of stamped messages.

        Args:
            log_ns: Log times [Unix ns], shape (n,).
            stamp_ns: Stamps [ns], shape (n,).
        """
        behind = log_ns - stamp_ns
        short = not len(behind) or (behind.min() >= -_SHORT_NS and behind.max() < _SHORT_NS)
        return cls(log_ns, stamp_ns, behind, bool(short))


class TimeStore:
    """Stamps and log times of messages.

    Log times are rarely used, so they are stored as their difference from the stamps, in 32 bits
    as long as it is below 2 s.
    """

    def __init__(self, capacity: int, *, stamped: bool, others: Sequence[TimeStore] = ()) -> None:
        """Start empty.

        Args:
            stamped: Whether the messages have stamps; if not, log times are used for them.
            others: Times of other topics, which may be equal.
        """
        self.is_stamped = stamped
        self.stamp_column = EchoColumn("<i8", capacity, [other.stamp_column for other in others])
        """Stamps, or log times without stamps."""
        self.behind_column = EchoColumn("<i4", capacity, [other.behind_column for other in others])
        """Log times minus stamps; empty without stamps."""
        self._is_short = True

    def append(self, times: Times) -> None:
        """Add messages."""
        if not self.is_stamped or times.stamp_ns is None or times.behind_ns is None:
            self.stamp_column.append(times.log_ns)
            return
        if self._is_short and not times.is_short:
            wide = EchoColumn("<i8", len(self.behind_column) + len(times.behind_ns))
            wide.append(self.behind_column.column())
            self.behind_column, self._is_short = wide, False
        self.stamp_column.append(times.stamp_ns)
        self.behind_column.append(times.behind_ns)

    def __len__(self) -> int:
        """Number of messages."""
        return len(self.stamp_column)

    def stamps(self) -> IntArray:
        """Stamps [ns], shape (n,), or log times where there are none: a view."""
        return self.stamp_column.column()

    def log(self) -> IntArray:
        """Log times [Unix ns], shape (n,)."""
        if not self.is_stamped:
            return self.stamp_column.column()
        return self.stamp_column.column() + self.behind_column.column()
