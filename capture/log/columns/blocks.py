"""Message records in bulk: the records of many blocks are found and checked together.

A chunk holds about a hundred messages of a topic, and reading so few at a time is slow. So blocks
of a few megabytes are decompressed into one buffer, which is used again for later blocks: memory
that is written for the first time costs a page fault each 4 KiB, as much as decompression. Threads
fill one buffer while another one is read; decompression releases Python's lock.
"""

from __future__ import annotations

import itertools
import mmap
import struct
from collections import deque
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import cycle
from typing import TYPE_CHECKING, TypeAlias, TypeVar

import numpy as np
from mcap.opcode import Opcode

from ...common.arrays import IntArray
from ...common.errors import LogError
from ...common.process import WorkPiece, helpers
from ..file.log_file import LogFile, keep_freed, new_pages
from ..mcap.chunk import (
    BODY_AT,
    FIXED_SIZE,
    LAST_NS,
    PREFIX_SIZE,
    Block,
    Buffer,
    MessageOffsets,
    gather,
    read_message_heads,
)

if TYPE_CHECKING:
    from concurrent.futures import ThreadPoolExecutor

_T = TypeVar("_T")

ARENA_SIZE = 8 << 20
SAME_SIZE = 9 << 18
"""Bytes of blocks of one channel that share a buffer: about the size of a core's own cache. More
would save nothing, since they have many messages of one topic."""

_START = struct.Struct("<BQ")  # of a record: opcode, length
_START_KIND = np.dtype(f"V{_START.size}")
_CHANNEL_START = struct.Struct("<BQH")  # of a message: opcode, length, channel
_CHANNEL_START_KIND = np.dtype(f"V{_CHANNEL_START.size}")
_LOG_TIME_AT = 15
_LOG_TIME_KIND = np.dtype("<i8")
_FAR = 1 << 62
_LARGEST_COPIED = 2048
"""Records up to this many bytes are copied whole before they are read: then they are side by side
in the cache."""


Window = tuple[int | None, int | None]


def ahead(items: Iterable[_T], count: int) -> Iterator[_T]:
    """Yield items in order, each taken from the iterable before it is needed.

    Args:
        items: Iterable that starts work for each item.
        count: Number of items taken beyond the one that is yielded.
    """
    waiting: deque[_T] = deque()
    for item in items:
        waiting.append(item)
        if len(waiting) > count:
            yield waiting.popleft()
    yield from waiting


@dataclass(frozen=True)
class Placed:
    """A block's payload in a buffer.

    Attributes:
        base: Start of the payload: offset 0 of its messages.
        stop: One past its last byte.
    """

    block: Block
    base: int
    stop: int


_Found: TypeAlias = tuple[Buffer, Placed] | LogError
"""A buffer and a block in it, or why the block can't be read."""


def filled_arenas(
    log_file: LogFile,
    channel_ids: Collection[int],
    blocks: Sequence[Block],
    warn: Callable[[str], None],
    threads: int,
) -> Iterator[tuple[Buffer, list[Placed]]]:
    """Decompress blocks into buffers, in file order; some blocks have a buffer of their own.

    Args:
        channel_ids: Blocks whose index has none of these channels are skipped.
        warn: Called with one sentence for each unreadable block.
        threads: Number of decompressing threads, with the caller's.

    Yields:
        A buffer, which is overwritten by the next iteration, and the blocks in it.
    """
    ids = set(channel_ids)
    selected = [
        block
        for block in blocks
        if (not ids.isdisjoint(block.index_at) if block.index_at else not block.is_empty)
    ]
    log_file.expect(selected)
    runs = list(_runs(log_file, selected))
    spare = 1 if threads > 1 and len(runs) > 1 else 0
    keep_freed(ARENA_SIZE)  # no copy of messages is larger
    scratch = log_file.scratch
    arenas = [scratch.pop() if scratch else new_pages(ARENA_SIZE) for _ in range(1 + spare)]
    with helpers(max(min(threads, len(selected)), 1)) as pool:
        for pieces in ahead(_begun(log_file, runs, arenas, pool), spare):
            if pool is not None:
                for piece in reversed(pieces):  # the helpers begin at the other end
                    piece.hurry()
            results = [piece.result() for piece in pieces]
            for outcome in results:
                if isinstance(outcome, LogError):
                    warn(f"{outcome}; its messages are missing")
            filled = [result for result in results if not isinstance(result, LogError)]
            if filled:
                yield filled[0][0], [placed for _, placed in filled]
    if len(blocks) < len(log_file.blocks):  # after a window there is often another
        scratch[:] = [*arenas, *scratch][:2]


def _runs(log_file: LogFile, blocks: Sequence[Block]) -> Iterator[list[Placed] | Block]:
    """Yield blocks that share a buffer, with their ranges, or a block with a buffer of its own."""
    run: list[Placed] = []
    at, former = 0, None
    for block in blocks:
        shares = log_file.source_of(block).inflates(block, ARENA_SIZE)
        only = next(iter(block.index_at)) if len(block.index_at) == 1 else None
        most = ARENA_SIZE if only is None else min(SAME_SIZE, ARENA_SIZE)
        if run and not (shares and only == former and at + block.size <= most):
            yield run
            run, at = [], 0
        if shares:
            run.append(Placed(block, at, at + block.size))
            at, former = at + block.size, only
        else:
            yield block
    if run:
        yield run


def _begun(
    log_file: LogFile,
    runs: Iterable[list[Placed] | Block],
    arenas: Sequence[mmap.mmap],
    pool: ThreadPoolExecutor | None,
) -> Iterator[list[WorkPiece[_Found]]]:
    """Yield the work on each run, submitted to the helpers."""
    for run, arena in zip(runs, cycle(arenas), strict=False):
        if isinstance(run, list):
            yield [WorkPiece(partial(_inflated, log_file, arena, placed), pool) for placed in run]
        else:  # of those larger than a buffer only one at a time
            yield [
                WorkPiece(partial(_alone, log_file, run), pool if run.size <= ARENA_SIZE else None)
            ]


def _inflated(log_file: LogFile, arena: mmap.mmap, placed: Placed) -> _Found:
    try:
        with memoryview(arena) as whole, whole[placed.base : placed.stop] as room:
            log_file.source_of(placed.block).inflate_into(placed.block, room)
    except LogError as error:
        return error
    return arena, placed


def _alone(log_file: LogFile, block: Block) -> _Found:
    try:
        data, base, stop = log_file.source_of(block).payload_once(block)
    except LogError as error:
        return error
    return data, Placed(block, base, stop)


@dataclass(frozen=True)
class Records:
    """Message records of one topic in a buffer, in file order; all whole.

    Attributes:
        offsets: Offsets in the buffer, shape (n,).
        log_ns: Log times [Unix ns], shape (n,).
        length: Common length of the messages [byte]; None if it differs.
        bodies: Positions of the messages, in the buffer or in a copy.
    """

    offsets: IntArray
    log_ns: IntArray
    length: int | None
    bodies: MessageOffsets


def blocks_in(log_file: LogFile, window_ns: Window) -> list[Block]:
    """Return the blocks that may hold messages of a window, in file order.

    Args:
        window_ns: Half-open window of log times [Unix ns]; None for open ends.
    """
    start, stop = window_ns
    first_ns, last_ns = log_file.spans
    inside = np.ones(len(log_file.blocks), dtype=bool)
    if start is not None:
        inside &= last_ns >= start
    if stop is not None:
        inside &= first_ns < stop
    return [log_file.blocks[k] for k in np.flatnonzero(inside).tolist()]


def record_batches(
    log_file: LogFile,
    topic_ids: Sequence[Sequence[int]],
    blocks: Sequence[Block],
    warn: Callable[[str], None],
    threads: int = 1,
) -> Iterator[tuple[Buffer, list[Records]]]:
    """Yield the message records of some topics, many blocks at a time.

    Args:
        topic_ids: Channel ids, one sequence per topic.
        warn: Called with one sentence for each unreadable block.
        threads: Number of decompressing threads.

    Yields:
        A buffer, which is overwritten by the next iteration, and the records of each topic.
    """
    ids = list(itertools.chain.from_iterable(topic_ids))
    for data, placed in filled_arenas(log_file, ids, _in_groups(blocks, topic_ids), warn, threads):
        try:
            records = _records(log_file, data, placed, topic_ids)
        except LogError:  # of one of the blocks: the others are read
            for single in placed:
                try:
                    alone = _records(log_file, data, [single], topic_ids)
                except LogError as error:
                    warn(f"{error}; its messages are missing")
                else:
                    yield data, alone
        else:
            yield data, records


def _in_groups(blocks: Sequence[Block], topic_ids: Sequence[Sequence[int]]) -> Sequence[Block]:
    """Order blocks by topic, if topics don't share blocks; those of a topic stay in file order.

    Their records are then many at a time and evenly spaced.
    """
    topic_of = {channel_id: k for k, ids in enumerate(topic_ids) for channel_id in ids}
    if not all(block.index_at for block in blocks):  # one without an index may have any of them
        return blocks
    had = [{topic_of[key] for key in block.index_at if key in topic_of} for block in blocks]
    shared = set[int]().union(*(topics for topics in had if len(topics) > 1))
    rows = [k for k, topics in enumerate(had) if topics]
    rows.sort(key=lambda k: -1 if had[k] & shared else min(had[k]))
    return [blocks[k] for k in rows]


def _records(
    log_file: LogFile, data: Buffer, placed: Sequence[Placed], topic_ids: Sequence[Sequence[int]]
) -> list[Records]:
    """Return the checked records of each topic."""
    tiled = _tiled(data, placed, topic_ids)
    if tiled is not None:
        return tiled
    by_topic: list[Records] = []
    for starts in _indexed(log_file, placed, topic_ids):
        at = starts.offsets
        records = (
            _alike(data, starts) if len(at) else Records(at, at, None, MessageOffsets(data, at))
        )
        if records is None:
            if read_message_heads(data, at, np.repeat(starts.ends, starts.counts)) is None:
                raise LogError(
                    log_file.path, "a message index points to something that is not a message"
                )
            log_ns = _readable(gather(data, at, _LOG_TIME_KIND, _LOG_TIME_AT))
            records = Records(at, log_ns, None, MessageOffsets(data, at + BODY_AT))
        by_topic.append(records)
    return by_topic


def _tiled(
    data: Buffer, placed: Sequence[Placed], topic_ids: Sequence[Sequence[int]]
) -> list[Records] | None:
    """Find the records of a topic that shares no block, without the index; None if impossible."""
    only = {key for part in placed for key in part.block.index_at}
    base, stop = placed[0].base, placed[-1].stop
    filled = sum(part.stop - part.base for part in placed)
    if len(only) != 1 or filled != stop - base or filled < BODY_AT:
        return None
    start = bytes(data[base : base + _CHANNEL_START.size])
    opcode, length, channel_id = _CHANNEL_START.unpack(start)
    size = PREFIX_SIZE + length
    if opcode != Opcode.MESSAGE or length < FIXED_SIZE or channel_id not in only:
        return None
    if any((part.stop - part.base) % size for part in placed):
        return None
    places = MessageOffsets(data, np.arange(base, stop, size, dtype=np.int64), size)
    if places.field(_CHANNEL_START_KIND, 0).tobytes() != start * len(places):
        return None
    nothing = np.empty(0, dtype=np.int64)
    none = Records(nothing, nothing, None, MessageOffsets(data, nothing))
    records = _records_at(places.at, places, length)
    return [records if channel_id in channel_ids else none for channel_ids in topic_ids]


def _records_at(offsets: IntArray, places: MessageOffsets, length: int) -> Records:
    """Return records of whole messages of one length, from their offsets and their positions."""
    log_ns = _readable(places.field(_LOG_TIME_KIND, _LOG_TIME_AT).copy())
    bodies = MessageOffsets(places.data, places.at + BODY_AT, places.step)
    return Records(offsets, log_ns, length - FIXED_SIZE, bodies)


def _readable(log_ns: IntArray) -> IntArray:
    """Limit unsigned log times of 64 bits to signed numbers."""
    if log_ns.min(initial=0) < 0:
        log_ns[log_ns < 0] = LAST_NS
    return log_ns


def _alike(data: Buffer, starts: _Starts) -> Records | None:
    """Return records that are whole messages of one length; None if any is not."""
    offsets = starts.offsets
    first = int(offsets[0])
    start = bytes(data[first : first + _START.size])
    opcode, length = _START.unpack(start)
    if opcode != Opcode.MESSAGE or not FIXED_SIZE <= length <= starts.room - PREFIX_SIZE:
        return None
    size = PREFIX_SIZE + length
    places = MessageOffsets(data, offsets)
    if size <= _LARGEST_COPIED:
        copied = gather(data, offsets, f"V{size}").view(np.uint8)
        places = MessageOffsets(copied, np.arange(0, len(copied), size, dtype=np.int64), size)
    if places.field(_START_KIND, 0).tobytes() != start * len(offsets):
        return None
    return _records_at(offsets, places, length)


@dataclass(frozen=True)
class _Starts:
    """Offsets of the records of a topic in a buffer; all heads are within their blocks.

    Attributes:
        offsets: In file order, shape (n,).
        room: Bytes from the last start in a block to the block's end, in the block with the least.
        counts: Number of records in each piece of the index, shape (k,), in file order.
        ends: End of the payload of that piece's block, shape (k,).
    """

    offsets: IntArray
    room: int
    counts: IntArray
    ends: IntArray


def _indexed(
    log_file: LogFile, placed: Sequence[Placed], topic_ids: Sequence[Sequence[int]]
) -> list[_Starts]:
    """Find the records of each topic in the blocks' indexes."""
    ids = list(itertools.chain.from_iterable(topic_ids))
    indexes = [log_file.source_of(part.block).indexed(part.block, ids) for part in placed]
    pieces: list[IntArray] = []
    blocks: list[int] = []
    limits = [0]  # of the topics, in pieces
    at = 0
    for channel_ids in topic_ids:
        for number, index in enumerate(indexes):
            for piece in index[at : at + len(channel_ids)]:
                if len(piece):
                    pieces.append(piece)
                    blocks.append(number)
        at += len(channel_ids)
        limits.append(len(pieces))
    if not pieces:
        nothing = np.empty(0, dtype=np.int64)
        return [_Starts(nothing, 0, nothing, nothing) for _ in topic_ids]
    bounds = np.array([(part.base, part.stop) for part in placed], dtype=np.int64)[blocks]
    bases, ends = bounds[:, 0], bounds[:, 1]
    counts = np.array([len(piece) for piece in pieces], dtype=np.int64)
    offsets = np.concatenate(pieces)
    offsets += np.repeat(bases, counts)
    starts = np.concatenate([[0], np.cumsum(counts)])
    room = ends - np.maximum.reduceat(offsets, starts[:-1])
    outside = np.minimum.reduceat(offsets, starts[:-1]) < bases  # so are sums that are too large
    if outside.any() or int(room.min()) < BODY_AT:
        raise LogError(log_file.path, "a message index points outside its chunk")
    cuts = starts[limits].tolist()
    steps_back = offsets[1:] < offsets[:-1]
    steps_back[[cut - 1 for cut in cuts[1:-1] if 0 < cut < len(offsets)]] = False
    if steps_back.any():  # an index that is not in file order, or a topic of several channels
        for a, b in itertools.pairwise(cuts):
            offsets[a:b].sort()
    return [
        _Starts(offsets[a:b], int(room[p:q].min(initial=_FAR)), counts[p:q], ends[p:q])
        for (a, b), (p, q) in zip(itertools.pairwise(cuts), itertools.pairwise(limits), strict=True)
    ]
