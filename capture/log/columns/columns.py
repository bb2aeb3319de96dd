"""Messages in bulk: all messages of a channel as columns, without a Python loop over them.

Messages that share their length, strings and sequence lengths (:class:`.Layout`) have every number
at the same offset, so one numpy call takes one field of hundreds of them out of the payload, and
another compares their strings with the layout's. A bag with one message per servo has as many
layouts as servos; many different layouts are read correctly, but slower.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from ...common.arrays import IntArray
from ...common.errors import DataError
from ..file.log_file import FilePages, LogFile
from ..mcap.chunk import BODY_AT, FIXED_SIZE, MessageOffsets
from ..messages.cdr import Layout, layout_of
from ..messages.definitions import JOINT_LISTS, MessageType
from .blocks import Records, Window, blocks_in, record_batches
from .buffers import TimeStore
from .layouts import MOST_JOINT_LISTS, MOST_LAYOUTS, Group, LayoutSorter, Stamping

_LENGTH_AT = 1  # in a message record
_MAX_SHARED = 8
_HELD = 8
"""Batches after which memory is released, if columns are in files."""
_EXPANSION = 64
"""Memory is reserved for at most this many times the bytes in the file; more may be used."""


@dataclass
class Unread:
    """A message that has no layout here (big-endian, ``wstring``, damaged)."""

    log_ns: int
    data: bytes
    why: str


@dataclass(frozen=True)
class Request:
    """A request to read one topic.

    Attributes:
        channel_ids: The topic's channels.
        paths: Leaf paths to keep; None for all.
        layouts: A known layout of each message length; new ones are added.
    """

    topic: str
    channel_ids: Sequence[int]
    message_type: MessageType
    paths: Sequence[str] | None = None
    layouts: dict[int, Layout] = field(default_factory=dict[int, Layout])

    def layout(self, message: bytes) -> Layout:
        """Return the layout of a message, a known one if it fits.

        Raises:
            DataError: If it has no layout.
        """
        cached = self.layouts.get(len(message))
        if cached is not None and cached.fits(message):
            return cached
        layout = layout_of(self.message_type, message)
        if cached is not None or len(self.layouts) < MOST_LAYOUTS:
            self.layouts[len(message)] = layout
        return layout


@dataclass
class Messages:
    """All messages of one topic.

    Attributes:
        groups: By layout, in order of first appearance.
        unread: Messages without a layout.
    """

    groups: list[Group]
    unread: list[Unread]


def read_messages(
    log_file: LogFile,
    requests: Sequence[Request],
    *,
    window_ns: Window = (None, None),
    warn: Callable[[str], None],
    threads: int = 1,
) -> list[Messages]:
    """Read several topics in one pass over the file: each chunk is decompressed once.

    Args:
        requests: One per topic.
        window_ns: Half-open window of log times [Unix ns]; None for open ends.
        warn: Called with one sentence for each unreadable block.
        threads: Number of decompressing threads.

    Returns:
        The messages, one entry per request.

    Raises:
        DataError: If a topic of JointStates has more than :data:`MOST_JOINT_LISTS` lists of joints.
    """
    blocks = blocks_in(log_file, window_ns)
    shared: list[TimeStore] = []
    stamping = Stamping()
    stored = sum(block.stop - block.start for block in blocks)
    readers = [
        _GroupReader(
            request,
            _expected(log_file, request, len(blocks)),
            _EXPANSION * stored,
            shared,
            stamping=stamping,
            pages=log_file.pages,
        )
        for request in requests
    ]
    topic_ids = [request.channel_ids for request in requests]
    batches = record_batches(log_file, topic_ids, blocks, warn, threads)
    for k, (_, batch) in enumerate(batches, start=1):
        for reader, records in zip(readers, batch, strict=True):
            if len(records.offsets):
                reader.add(records, window_ns)
        if log_file.pages is not None and k % _HELD == 0:
            log_file.forget()
    return [Messages(reader.groups, reader.unread) for reader in readers]


def _expected(log_file: LogFile, request: Request, blocks: int) -> int:
    """Return the expected number of messages in a number of blocks."""
    counted = sum(log_file.counts.get(channel_id, 0) for channel_id in request.channel_ids)
    return int(counted * min(blocks / max(len(log_file.blocks), 1), 1.0)) + 1


class _GroupReader:
    """Sorts messages into groups by layout."""

    def __init__(
        self,
        request: Request,
        expected: int,
        reserve: int,
        shared: list[TimeStore],
        *,
        stamping: Stamping,
        pages: FilePages | None,
    ) -> None:
        self._topic = request.topic
        self._most = MOST_JOINT_LISTS if request.message_type.name in JOINT_LISTS else None
        self._paths = None if request.paths is None else frozenset(request.paths)
        self._expected, self._reserve = expected, reserve
        self._shared, self._stamping, self._pages = shared, stamping, pages
        self._sorter = LayoutSorter(request.layout)
        self._usual: dict[int, Group] = {}  # the first of each length
        self._count = 0
        self.groups: list[Group] = []
        self.unread: list[Unread] = []

    def add(self, records: Records, window_ns: Window) -> None:
        places, log_ns, length = records.bodies, records.log_ns, records.length
        start, stop = window_ns
        if (start is not None and (log_ns < start).any()) or (
            stop is not None and (log_ns >= stop).any()
        ):
            keep = np.ones(len(places), dtype=bool)
            keep &= True if start is None else log_ns >= start
            keep &= True if stop is None else log_ns < stop
            places, log_ns = places.take(keep), log_ns[keep]
        if not len(places):
            return
        first = self._count
        self._count += len(places)
        if length is not None:
            usual = self._usual.get(length)
            if usual is not None and usual.holds(places):
                usual.take(places, log_ns, range(first, self._count))
            else:
                self._sort_in(length, places, log_ns, np.arange(first, self._count))
            return
        lengths = (
            MessageOffsets(places.data, places.at - BODY_AT).field("<i8", _LENGTH_AT) - FIXED_SIZE
        )
        for length in np.unique(lengths).tolist():
            rows = np.flatnonzero(lengths == length)
            self._sort_in(length, places.take(rows), log_ns[rows], first + rows)

    def _sort_in(
        self, length: int, places: MessageOffsets, log_ns: IntArray, order: IntArray
    ) -> None:
        """Add messages of one length and any layouts."""
        matrix = places.rows(np.dtype(np.uint8), length, 0)
        for rows, layout, number, _ in self._sorter.sort(matrix):
            if isinstance(layout, DataError):
                (row,) = rows.tolist()
                self.unread.append(Unread(int(log_ns[row]), matrix[row].tobytes(), str(layout)))
                continue
            if number == len(self.groups):
                group = self._group(layout, self._capacity(length, len(rows)))
                self._usual.setdefault(length, group)
                self.groups.append(group)
            self.groups[number].take(places.take(rows), log_ns[rows], order[rows])

    def _group(self, layout: Layout, capacity: int) -> Group:
        """Return a new group; the first one of a topic may share the times of another topic."""
        if self._most is not None and len(self.groups) >= self._most:
            raise DataError(
                f"{self._topic} has more than {self._most} different lists of joints or frame "
                "ids; give each robot a topic of its own"
            )
        group = Group(
            layout,
            self._paths,
            capacity,
            () if self.groups else tuple(self._shared),
            stamping=self._stamping,
            pages=self._pages,
        )
        if not self.groups and len(self._shared) < _MAX_SHARED:
            self._shared.append(group.kept_times)
        return group

    def _capacity(self, length: int, seen: int) -> int:
        """Return the capacity of a group: for the first one all expected messages of the topic."""
        if self.groups:
            return 2 * seen
        return max(seen, min(self._expected, self._reserve // max(length, 1)))
