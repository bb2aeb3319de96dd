"""Messages in bulk: all messages of a channel as columns, without a Python loop over them.

The messages of a block that have one length are gathered into a matrix of bytes by one numpy
call; those that share their strings and sequence lengths (:class:`capture.log.cdr.Layout`) have
every number in the same columns of that matrix. So a bag with one message per servo costs as
many layouts as servos, and a message of any other layout is still read right, only slower.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from mcap.opcode import Opcode
from numpy.typing import NDArray

from ..arrays import IntArray
from ..errors import DataError, LogError
from .cdr import Layout, layout_of
from .chunk import Buffer
from .message_heads import BODY_AT, FIXED_SIZE, gather
from .rosmsg import MessageType
from .storage import LogFile

# A message record: opcode u8, length u64, channel u16, sequence u32, log time u64, publish u64.
_LENGTH_AT, _LOG_TIME_AT = 1, 15
_MAX_LAYOUTS = 64

Matrix = NDArray[np.uint8]


@dataclass
class Group:
    """All messages of a channel that share one layout.

    Attributes:
        layout: The layout.
        log_ns: Log times, one array a block.
        order: Place of each message among all of the topic, in file order, one array a block.
        columns: Leaf path to values, one array of shape (n, count) a block.
    """

    layout: Layout
    log_ns: list[IntArray] = field(default_factory=list[IntArray])
    order: list[IntArray] = field(default_factory=list[IntArray])
    columns: dict[str, list[NDArray[Any]]] = field(default_factory=dict[str, list[NDArray[Any]]])

    def times(self) -> IntArray:
        """Log times of all its messages [Unix ns], shape (n,)."""
        return np.concatenate(self.log_ns)

    def values(self, path: str) -> NDArray[Any]:
        """All values of one field.

        Args:
            path: Leaf path, e.g. ``position``.

        Returns:
            Shape (n, count); (n, 0) where the layout has no such leaf.
        """
        if path not in self.columns:
            return np.empty((sum(map(len, self.log_ns)), 0), dtype=np.float64)
        return np.concatenate(self.columns[path])


@dataclass
class Unread:
    """A message that has no layout here (big-endian, ``wstring``, damaged).

    Attributes:
        log_ns: Its log time.
        data: Its bytes.
        why: What was wrong.
    """

    log_ns: int
    data: bytes
    why: str


@dataclass(frozen=True)
class Request:
    """What to read of one topic.

    Attributes:
        channel_ids: The topic's channels.
        message_type: Their type.
        paths: Leaf paths to keep; None for all.
    """

    channel_ids: Sequence[int]
    message_type: MessageType
    paths: Sequence[str] | None = None


@dataclass
class Messages:
    """All messages of one topic.

    Attributes:
        groups: By layout, in order of first appearance.
        unread: Those that have no layout.
    """

    groups: list[Group]
    unread: list[Unread]


def read_messages(
    log_file: LogFile,
    requests: Sequence[Request],
    *,
    window_ns: tuple[int | None, int | None] = (None, None),
    warn: Callable[[str], None],
) -> list[Messages]:
    """Read several topics in one pass over the file: each chunk is decompressed once.

    Args:
        log_file: The file.
        requests: What to read, one a topic.
        window_ns: Half-open window of log times [Unix ns]; None for open ends.
        warn: Takes one sentence for each block that couldn't be read.

    Returns:
        The messages, one entry a request.
    """
    readers = [_GroupReader(request) for request in requests]
    wanted = [request.channel_ids for request in requests]
    for data, found in message_blocks(log_file, wanted, window_ns, warn):
        for reader, offsets in zip(readers, found, strict=True):
            if len(offsets):
                reader.add(data, offsets, window_ns)
    return [Messages(reader.groups, reader.unread) for reader in readers]


def message_blocks(
    log_file: LogFile,
    wanted: Sequence[Sequence[int]],
    window_ns: tuple[int | None, int | None],
    warn: Callable[[str], None],
) -> Iterator[tuple[Buffer, list[IntArray]]]:
    """The payloads that hold messages of some topics, with the offsets of their records.

    Args:
        log_file: The file.
        wanted: Channel ids, one sequence a topic.
        window_ns: Blocks wholly outside this window of log times are passed over.
        warn: Takes one sentence for each block that couldn't be read.

    Yields:
        Payload and checked record offsets, one array of shape (n,) a topic, not all empty.
    """
    start, stop = window_ns
    for block in log_file.blocks:
        if (stop is not None and block.start_ns >= stop) or (
            start is not None and block.end_ns < start
        ):
            continue
        try:
            found = [
                np.concatenate([log_file.offsets(block, channel_id) for channel_id in ids])
                for ids in wanted
            ]
            if not any(map(len, found)):
                continue
            data, base = log_file.payload(block)
            found = [np.sort(offsets) + base for offsets in found]  # file order
            _check(data, np.concatenate(found))
        except LogError as error:
            warn(f"{error}; its messages are missing")
            continue
        yield data, found


def message_bytes(data: Buffer, offset: int) -> tuple[int, bytes]:
    """One message record's log time and message.

    Args:
        data: The payload.
        offset: Where the record starts.

    Returns:
        Log time [Unix ns] and the message's bytes.
    """
    length = int.from_bytes(data[offset + _LENGTH_AT : offset + 9], "little") - FIXED_SIZE
    log_ns = int.from_bytes(data[offset + _LOG_TIME_AT : offset + 23], "little")
    return log_ns, data[offset + BODY_AT : offset + BODY_AT + length]


class _GroupReader:
    """Sorts messages into groups by layout."""

    def __init__(self, request: Request) -> None:
        self._type = request.message_type
        self._paths = None if request.paths is None else set(request.paths)
        self._by_length: dict[int, list[Group]] = {}
        self._count = 0
        self.groups: list[Group] = []
        self.unread: list[Unread] = []

    def add(
        self, data: Buffer, offsets: IntArray, window_ns: tuple[int | None, int | None]
    ) -> None:
        log_ns = gather(data, offsets + _LOG_TIME_AT, "<u8").astype(np.int64)
        if window_ns != (None, None):
            start, stop = window_ns
            keep = np.ones(len(offsets), dtype=bool)
            keep &= True if start is None else log_ns >= start
            keep &= True if stop is None else log_ns < stop
            offsets, log_ns = offsets[keep], log_ns[keep]
        order = self._count + np.arange(len(offsets))
        self._count += len(offsets)
        lengths = gather(data, offsets + _LENGTH_AT, "<u8").astype(np.int64) - FIXED_SIZE
        one_length = bool((lengths == lengths[0]).all()) if len(lengths) else False
        for length in lengths[:1].tolist() if one_length else np.unique(lengths).tolist():
            rows = slice(None) if one_length else np.flatnonzero(lengths == length)
            records = gather(data, offsets[rows] + BODY_AT, f"V{max(length, 1)}")
            matrix = records.view(np.uint8).reshape(len(records), -1)
            self._add_matrix(matrix[:, :length], log_ns[rows], order[rows])

    def _add_matrix(self, matrix: Matrix, log_ns: IntArray, order: IntArray) -> None:
        known = self._by_length.setdefault(matrix.shape[1], [])
        for group in known:
            fits = fits_layout(matrix, group.layout)
            if fits.all():
                self._take(group, matrix, log_ns, order)
                return
            if fits.any():
                self._take(group, matrix[fits], log_ns[fits], order[fits])
                matrix, log_ns, order = matrix[~fits], log_ns[~fits], order[~fits]
        while len(matrix):
            example = matrix[0].tobytes()
            try:
                group = Group(layout_of(self._type, example))
            except DataError as error:
                self.unread.append(Unread(int(log_ns[0]), example, str(error)))
                matrix, log_ns, order = matrix[1:], log_ns[1:], order[1:]
                continue
            # Text topics have a layout a message: don't hold every later message against each.
            fits = np.zeros(len(matrix), dtype=bool)
            fits[0] = True
            if len(known) < _MAX_LAYOUTS:
                fits = fits_layout(matrix, group.layout)
                known.append(group)
            self.groups.append(group)
            self._take(group, matrix[fits], log_ns[fits], order[fits])
            matrix, log_ns, order = matrix[~fits], log_ns[~fits], order[~fits]

    def _take(self, group: Group, matrix: Matrix, log_ns: IntArray, order: IntArray) -> None:
        group.log_ns.append(log_ns)
        group.order.append(order)
        for path, leaf in group.layout.leaves.items():
            if self._paths is not None and path not in self._paths:
                continue
            width = leaf.count * np.dtype(leaf.dtype).itemsize
            cut = np.ascontiguousarray(matrix[:, leaf.offset : leaf.offset + width])
            group.columns.setdefault(path, []).append(cut.view(leaf.dtype))


def fits_layout(matrix: Matrix, layout: Layout) -> NDArray[np.bool_]:
    """Which messages have a layout's strings and sequence lengths.

    Args:
        matrix: Messages of the layout's length, shape (n, length).
        layout: The layout.

    Returns:
        Shape (n,).
    """
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


def _check(data: Buffer, offsets: IntArray) -> None:
    """Raise LogError-compatible complaints before numpy reads beyond the records."""
    size = len(data)
    if offsets.size and (offsets.min() < 0 or offsets.max() + BODY_AT > size):
        raise LogError("message index", "points outside its chunk")
    opcodes = gather(data, offsets, "u1")
    lengths = gather(data, offsets + _LENGTH_AT, "<u8")
    room = (size - offsets - 9).astype(np.uint64)
    if np.any(opcodes != Opcode.MESSAGE) or np.any((lengths < FIXED_SIZE) | (lengths > room)):
        raise LogError("message index", "points to something that is not a message")
