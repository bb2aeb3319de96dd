"""Messages of one type sorted by layout, and the fields that a layout has in many of them.

Messages that share their length, strings and sequence lengths (:class:`.Layout`) have every number
at the same offset. So one comparison for each layout sorts them, and one numpy call reads a field
of all of them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...common.arrays import NS, IntArray
from ...common.errors import DataError
from ..file.log_file import FilePages
from ..mcap.chunk import MessageOffsets
from ..messages.cdr import Layout, Leaf
from .buffers import ColumnStore, Times, TimeStore
from .names import distinct_names

MOST_LAYOUTS = 64
MOST_JOINT_LISTS = 256
"""Most lists of joints (with frame id) of one topic: each costs as much as many messages."""

TIME = np.dtype([("sec", "<i4"), ("nanosec", "<u4")])
"""A ``builtin_interfaces/msg/Time`` in a message."""

_STAMPS = (("header.stamp.sec", "header.stamp.nanosec"), ("stamp.sec", "stamp.nanosec"))

Matrix = NDArray[np.uint8]

_COMPARED = 1 << 17
"""Bytes of constant parts that are compared at once: they stay in the cache."""


class LayoutMessages(NamedTuple):
    """Messages of one layout.

    Attributes:
        rows: Rows of the messages, shape (k,), increasing.
        layout: Their layout; for a message without one (big-endian, ``wstring``, damaged), the
            reason.
        number: Number of layouts found before this one.
        is_kept: Whether later messages are compared with the layout.
    """

    rows: IntArray
    layout: Layout | DataError
    number: int = -1
    is_kept: bool = False


class LayoutSorter:
    """Sorts messages of one type by layout, and keeps the layouts for later messages.

    Attributes:
        is_full: Whether the layout of some message was not kept.
    """

    def __init__(
        self, find: Callable[[bytes], Layout], *, most: int = MOST_LAYOUTS, in_all: bool = False
    ) -> None:
        """Start without layouts.

        Args:
            find: Returns the layout of a message, or raises DataError.
            most: Largest number of layouts that are kept.
            in_all: Whether ``most`` counts all layouts, instead of those of each length.
        """
        self.is_full = False
        self._find, self._most, self._in_all = find, most, in_all
        self._kept: dict[int, list[tuple[int, Layout]]] = {}
        self._total = self._kept_in_all = 0

    def sort(self, matrix: Matrix) -> Iterator[LayoutMessages]:
        """Sort messages of one length.

        Args:
            matrix: The messages, shape (n, length).

        Yields:
            Parts with each message once: those of known layouts in the order in which these were
            found, then the others. A message without a layout is a part of its own, and so is one
            whose layout is not kept, since text may have as many layouts as messages.
        """
        kept = self._kept.setdefault(matrix.shape[1], [])
        rows = np.arange(len(matrix))
        for number, layout in tuple(kept):
            fits = _fits(matrix, layout)
            count = np.count_nonzero(fits)
            if count == len(rows):  # the usual case: nothing to pick
                yield LayoutMessages(rows, layout, number, is_kept=True)
                return
            if count:
                yield LayoutMessages(rows[fits], layout, number, is_kept=True)
                rows, matrix = rows[~fits], matrix[~fits]
        while len(rows):
            fits, rest = slice(0, 1), slice(1, None)
            try:
                layout = self._find(matrix[0].tobytes())
            except DataError as error:
                yield LayoutMessages(rows[fits], error)
            else:
                number = self._total
                is_kept = (self._kept_in_all if self._in_all else len(kept)) < self._most
                if is_kept:
                    kept.append((number, layout))
                    if len(rows) > 1:  # one message fits its own layout
                        fits = _fits(matrix, layout)
                        rest = ~fits
                self._total += 1
                self._kept_in_all += is_kept
                self.is_full |= not is_kept
                yield LayoutMessages(rows[fits], layout, number, is_kept)
            rows, matrix = rows[rest], matrix[rest]


def _fits(matrix: Matrix, layout: Layout) -> NDArray[np.bool_]:
    """Whether each message has the strings and sequence lengths of a layout, shape (n,)."""
    example = np.frombuffer(layout.example, dtype=np.uint8)
    equal = [matrix[:, start:stop] == example[start:stop] for start, stop in layout.hull]
    fits = np.ones(len(matrix), dtype=bool)
    if all(part.all() for part in equal):  # the usual case, and a much faster reduction
        return fits
    for part in equal:
        fits &= part.all(axis=1)
    doubtful = np.flatnonzero(~fits)
    if doubtful.size:  # the difference may lie in padding alone
        static = layout.static
        fits[doubtful] = (matrix[np.ix_(doubtful, static)] == example[static]).all(axis=1)
    return fits


def names_of(layout: Layout, sequence: str = "name[") -> tuple[str, ...]:
    """Return the strings of a sequence, each of them once: see :mod:`.names`.

    Args:
        sequence: By default ``name``, the joints of a JointState.
    """
    given = [text for path, text in layout.strings.items() if path.startswith(sequence)]
    return distinct_names(given)


def values_of(layout: Layout, path: str, matrix: Matrix) -> NDArray[Any]:
    """Return all values of one field.

    Args:
        layout: The layout of the messages.
        path: Leaf path, e.g. ``position``.
        matrix: The messages, shape (n, length).

    Returns:
        Shape (n, count); (n, 0) where the layout has no such leaf.
    """
    leaf = layout.leaves.get(path)
    if leaf is None:
        return np.empty((len(matrix), 0))
    stop = leaf.offset + leaf.count * np.dtype(leaf.dtype).itemsize
    return np.ascontiguousarray(matrix[:, leaf.offset : stop]).view(leaf.dtype)


def stamp_leaves(layout: Layout) -> tuple[Leaf, Leaf] | None:
    """Return the leaves of a layout's stamp: seconds and nanoseconds; None without a stamp."""
    leaves = layout.leaves
    for sec, nanosec in _STAMPS:
        if sec in leaves and nanosec in leaves:
            return leaves[sec], leaves[nanosec]
    return None


def stamps_of(layout: Layout, matrix: Matrix) -> IntArray | None:
    """Return the stamps of messages [ns].

    Args:
        matrix: The messages, shape (n, length).

    Returns:
        Shape (n,); None without stamps.
    """
    leaves = stamp_leaves(layout)
    if leaves is None:
        return None
    sec, nanosec = (values_of(layout, leaf.path, matrix)[:, 0] for leaf in leaves)
    return time_ns(sec, nanosec)


def time_ns(sec: NDArray[Any], nanosec: NDArray[Any]) -> IntArray:
    """Return times [ns] of their two parts, each of shape (n,)."""
    ns = sec.astype(np.int64)
    ns *= NS
    ns += nanosec.astype(np.int64, copy=False)
    return ns


class Stamping:
    """Computes times of messages from their stamps, and caches the last ones.

    All topics of one tick of a recorder have the same stamps and log times, and share the result.
    """

    def __init__(self) -> None:
        """Start with an empty cache."""
        self._raw: NDArray[Any] = np.empty(0, dtype="<i8")
        self._times: Times | None = None

    def times(self, places: MessageOffsets, log_ns: IntArray, stamp: tuple[Leaf, Leaf]) -> Times:
        """Return the times of n messages; the cached object if they are equal.

        Args:
            log_ns: Log times [Unix ns], shape (n,); must not be written to afterwards.
            stamp: Leaves of the stamps: seconds and nanoseconds.
        """
        seconds, rest = stamp
        if (seconds.dtype, rest.dtype, rest.offset - seconds.offset) != ("<i4", "<u4", 4):
            parts = (places.field(leaf.dtype, leaf.offset) for leaf in stamp)
            return Times.of(log_ns, time_ns(*parts))
        raw = np.ascontiguousarray(places.field("V8", seconds.offset)).view("<i8")
        cached = self._times
        if (
            cached is not None
            and np.array_equal(raw, self._raw)
            and np.array_equal(log_ns, cached.log_ns)
        ):
            return cached
        parts = raw.view(TIME)
        self._raw = raw
        self._times = Times.of(log_ns, time_ns(parts["sec"], parts["nanosec"]))
        return self._times


class Group:
    """All messages of a topic that share one layout.

    Attributes:
        is_stamped: Whether they have a stamp.
        strings: The requested strings, by path.
    """

    def __init__(
        self,
        layout: Layout,
        paths: frozenset[str] | None,
        capacity: int,
        others: Sequence[TimeStore] = (),
        *,
        stamping: Stamping | None = None,
        pages: FilePages | None = None,
    ) -> None:
        """Start empty.

        Args:
            paths: Leaf paths to keep; None for all. A stamp is kept as a time, not as a leaf.
            others: Times of other topics, which may be equal.
            stamping: Shared with other topics; None for a new one.
            pages: Storage of large columns in files; None for memory.
        """
        self.layout = layout
        self._stamping = stamping or Stamping()
        leaves = layout.leaves
        self._stamp = stamp_leaves(layout)
        self.is_stamped = self._stamp is not None
        self.strings = {
            path: text for path, text in layout.strings.items() if paths is None or path in paths
        }
        self.kept_times = TimeStore(capacity, stamped=self.is_stamped, others=others)
        self._order: list[IntArray | range] = []
        self._columns = {
            path: ColumnStore(leaf.dtype, leaf.count, capacity, pages)
            for path, leaf in leaves.items()
            if leaf not in (self._stamp or ()) and (paths is None or path in paths)
        }
        self._parts = [
            (np.dtype(leaves[path].dtype), leaves[path].count, leaves[path].offset, store)
            for path, store in self._columns.items()
        ]
        self._hull = [(start, np.dtype(f"V{stop - start}")) for start, stop in layout.hull]
        self._tiles = [b"" for _ in layout.hull]

    def __len__(self) -> int:
        """Number of messages."""
        return len(self.kept_times)

    @property
    def paths(self) -> tuple[str, ...]:
        """Leaf paths in wire order, without the stamp."""
        return tuple(self._columns)

    def times(self) -> IntArray:
        """Return the log times of all messages [Unix ns], shape (n,)."""
        return self.kept_times.log()

    def stamps(self) -> IntArray:
        """Return the stamps of all messages [ns], shape (n,), or log times without stamps."""
        return self.kept_times.stamps()

    def order(self) -> IntArray:
        """Return the position of each message among the topic's in file order, shape (n,)."""
        return np.concatenate([np.arange(0), *(np.asarray(part) for part in self._order)])

    def values(self, path: str) -> NDArray[Any]:
        """Return all values of one field.

        Args:
            path: Leaf path, e.g. ``position``.

        Returns:
            Shape (n, count), each column contiguous (bytes: each row); (n, 0) if the layout has no
            such leaf.
        """
        if path not in self._columns:
            return np.empty((len(self), 0), dtype=np.float64)
        return self._columns[path].values()

    def holds(self, places: MessageOffsets) -> bool:
        """Whether all messages, which have its length, have this layout and equal padding."""
        for k, (start, run) in enumerate(self._hull):
            count = _COMPARED // run.itemsize + 1
            if not self._tiles[k]:
                self._tiles[k] = self.layout.example[start : start + run.itemsize] * count
            fields = places.field(run, start)
            for first in range(0, len(fields), count):
                if not self._tiles[k].startswith(fields[first : first + count].tobytes()):
                    return False
        return True

    def take(self, places: MessageOffsets, log_ns: IntArray, order: IntArray | range) -> None:
        """Copy n messages of this layout.

        Args:
            log_ns: Log times [Unix ns], shape (n,).
            order: Positions in the topic, n of them.
        """
        self._order.append(order)
        if self._stamp:
            self.kept_times.append(self._stamping.times(places, log_ns, self._stamp))
        else:
            self.kept_times.append(Times(log_ns))
        for kind, count, start, store in self._parts:
            store.append(places.rows(kind, count, start))
