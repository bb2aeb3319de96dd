"""Messages of one topic that share one layout: a store for each of their numbers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...common.arrays import IntArray
from ..file.pages import FilePages
from ..mcap.message_heads import Places
from ..messages.cdr import Layout, Leaf
from .layouts import TIME, stamp_leaves, time_ns
from .stores import ColumnStore, Times, TimeStore

_COMPARED = 1 << 17
"""Bytes of constant parts that are compared at once: few enough to stay in the cache."""


class Stamping:
    """Times of messages by their stamps; those of the last messages are kept.

    All topics that one tick of a recorder writes have the same stamps and log times: then nothing
    is to be worked out, and who has them twice need not compare them.
    """

    def __init__(self) -> None:
        """Start with no messages."""
        self._raw: NDArray[Any] = np.empty(0, dtype="<i8")
        self._times: Times | None = None

    def times(self, places: Places, log_ns: IntArray, stamp: tuple[Leaf, Leaf]) -> Times:
        """Times of messages.

        Args:
            places: Where they start, n of them.
            log_ns: Their log times [Unix ns], shape (n,); never written to afterwards.
            stamp: Where their stamps are: seconds and nanoseconds.

        Returns:
            The times; the very same as before if they are equal.
        """
        seconds, rest = stamp
        pair = (seconds.dtype, rest.dtype, rest.offset - seconds.offset)
        if pair != ("<i4", "<u4", 4):
            parts = (places.field(leaf.dtype, leaf.offset) for leaf in stamp)
            return Times.of(log_ns, time_ns(*parts))
        raw = np.ascontiguousarray(places.field("V8", seconds.offset)).view("<i8")
        known = self._times
        if (
            known is not None
            and np.array_equal(raw, self._raw)
            and np.array_equal(log_ns, known.log_ns)
        ):
            return known
        parts = raw.view(TIME)
        self._raw = raw
        self._times = Times.of(log_ns, time_ns(parts["sec"], parts["nanosec"]))
        return self._times


class Group:
    """All messages of a topic that share one layout.

    Attributes:
        layout: The layout.
        is_stamped: Whether they have a stamp.
        strings: The strings that are wanted, by path.
        kept_times: Stamps and log times.
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
            layout: The layout.
            paths: Leaf paths to keep; None for all. A stamp is kept as a time, not as a leaf.
            capacity: Messages to expect.
            others: Times of other topics, which may be the same.
            stamping: What works out the times, of other topics too; None for one of its own.
            pages: Where large columns lie; None for memory.
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
        """Leaf paths that are kept, in wire order, without the stamp's."""
        return tuple(self._columns)

    def times(self) -> IntArray:
        """Log times of all its messages [Unix ns], shape (n,)."""
        return self.kept_times.log()

    def stamps(self) -> IntArray:
        """Stamps of all its messages [ns], shape (n,), or log times where they have none."""
        return self.kept_times.stamps()

    def order(self) -> IntArray:
        """Place of each message among all of the topic, in file order, shape (n,)."""
        return np.concatenate([np.arange(0), *(np.asarray(part) for part in self._order)])

    def values(self, path: str) -> NDArray[Any]:
        """All values of one field.

        Args:
            path: Leaf path, e.g. ``position``.

        Returns:
            Shape (n, count), each column contiguous (bytes: each row); (n, 0) where the layout has
            no such leaf.
        """
        if path not in self._columns:
            return np.empty((len(self), 0), dtype=np.float64)
        return self._columns[path].values()

    def holds(self, places: Places) -> bool:
        """Whether messages have this layout: the quick check, for messages of its length.

        Args:
            places: Where they start.

        Returns:
            True if all do; False if some don't, or differ in padding.
        """
        for k, (start, run) in enumerate(self._hull):
            count = _COMPARED // run.itemsize + 1
            if not self._tiles[k]:
                self._tiles[k] = self.layout.example[start : start + run.itemsize] * count
            found = places.field(run, start)
            for first in range(0, len(found), count):
                if not self._tiles[k].startswith(found[first : first + count].tobytes()):
                    return False
        return True

    def take(self, places: Places, log_ns: IntArray, order: IntArray | range) -> None:
        """Copy messages of this layout.

        Args:
            places: Where they start, n of them.
            log_ns: Their log times [Unix ns], shape (n,).
            order: Their places in the topic, n of them.
        """
        self._order.append(order)
        if self._stamp:
            self.kept_times.append(self._stamping.times(places, log_ns, self._stamp))
        else:
            self.kept_times.append(Times(log_ns))
        for kind, count, start, store in self._parts:
            store.append(places.rows(kind, count, start))
