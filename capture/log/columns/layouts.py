"""Messages of one type sorted by layout, and the fields that a layout has in many of them.

Messages that share their length, strings and sequence lengths (:class:`.Layout`) have every number
at the same place. So they are sorted with one comparison for each layout, and one numpy call takes
a field of all of them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...common.arrays import IntArray
from ...common.errors import DataError
from ..messages.cdr import Layout, Leaf

MOST_LAYOUTS = 64
MOST_JOINT_LISTS = 256
"""Lists of joints (with frame id) of one topic: each takes the time of many usual messages."""

TIME = np.dtype([("sec", "<i4"), ("nanosec", "<u4")])
"""A ``builtin_interfaces/msg/Time`` in a message."""

_NS = 1_000_000_000
_STAMPS = (("header.stamp.sec", "header.stamp.nanosec"), ("stamp.sec", "stamp.nanosec"))

Matrix = NDArray[np.uint8]


class Part(NamedTuple):
    """Messages of one layout.

    Attributes:
        rows: Which of the messages, shape (k,), in their order.
        layout: Their layout; of a message that has none (big-endian, ``wstring``, damaged), the
            reason.
        number: How many layouts were found before this one.
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
            find: Finds the layout of a message, or raises DataError.
            most: How many layouts are kept.
            in_all: Whether ``most`` counts all layouts, instead of those of each length.
        """
        self.is_full = False
        self._find = find
        self._most, self._in_all = most, in_all
        self._kept: dict[int, list[tuple[int, Layout]]] = {}
        self._found = self._kept_in_all = 0

    def sort(self, matrix: Matrix) -> Iterator[Part]:
        """Sort messages of one length.

        Args:
            matrix: The messages, shape (n, length).

        Yields:
            Parts that have each message once: those of known layouts in the order in which these
            were found, then the others. A message without a layout is a part of its own, and so is
            one whose layout is not kept, since text may have as many layouts as messages.
        """
        kept = self._kept.setdefault(matrix.shape[1], [])
        rows = np.arange(len(matrix))
        for number, layout in tuple(kept):
            fits = _fits(matrix, layout)
            count = np.count_nonzero(fits)
            if count == len(rows):  # the usual case: nothing to pick
                yield Part(rows, layout, number, is_kept=True)
                return
            if count:
                yield Part(rows[fits], layout, number, is_kept=True)
                rows, matrix = rows[~fits], matrix[~fits]
        while len(rows):
            fits, rest = slice(0, 1), slice(1, None)
            try:
                layout = self._find(matrix[0].tobytes())
            except DataError as error:
                yield Part(rows[fits], error)
            else:
                number = self._found
                is_kept = (self._kept_in_all if self._in_all else len(kept)) < self._most
                if is_kept:
                    kept.append((number, layout))
                    fits = _fits(matrix, layout)
                    rest = ~fits
                self._found += 1
                self._kept_in_all += is_kept
                self.is_full |= not is_kept
                yield Part(rows[fits], layout, number, is_kept)
            rows, matrix = rows[rest], matrix[rest]


def _fits(matrix: Matrix, layout: Layout) -> NDArray[np.bool_]:
    """Which messages of a layout's length have its strings and sequence lengths, shape (n,)."""
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


def names_of(layout: Layout) -> tuple[str, ...]:
    """Return the strings of the sequence ``name``: the joints of a JointState."""
    return tuple(text for path, text in layout.strings.items() if path.startswith("name["))


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
    """Return where a layout has its stamp: seconds and nanoseconds; None without a stamp."""
    leaves = layout.leaves
    for sec, nanosec in _STAMPS:
        if sec in leaves and nanosec in leaves:
            return leaves[sec], leaves[nanosec]
    return None


def stamps_of(layout: Layout, matrix: Matrix) -> IntArray | None:
    """Return the stamps of messages [ns].

    Args:
        layout: Their layout.
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
    ns *= _NS
    ns += nanosec.astype(np.int64, copy=False)
    return ns
