"""Message records in bulk: those of many blocks are found and checked together."""

from __future__ import annotations

import itertools
import struct
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from mcap.opcode import Opcode

from ..arrays import IntArray
from ..errors import LogError
from .arenas import Placed, filled_arenas
from .chunk import PREFIX_SIZE, Block, Buffer
from .message_heads import BODY_AT, FIXED_SIZE, HEAD, Places, gather
from .storage import LogFile

_START = struct.Struct("<BQ")  # of a record: opcode, length
_START_KIND = np.dtype(f"V{_START.size}")
_LOG_TIME_AT = 15
_LOG_TIME_KIND = np.dtype("<i8")
_LARGEST_COPIED = 2048
"""Records up to this many bytes are copied whole, before anything of them is looked at: then they
lie side by side in the cache."""

Window = tuple[int | None, int | None]


@dataclass(frozen=True)
class Records:
    """Message records of one topic in a buffer, in file order; all whole.

    Attributes:
        offsets: Where they start in the buffer, shape (n,).
        log_ns: Their log times [Unix ns], shape (n,).
        length: Bytes of each message, if all have as many; otherwise None.
        bodies: Where the messages start, in the buffer or in a copy.
    """

    offsets: IntArray
    log_ns: IntArray
    length: int | None
    bodies: Places


def blocks_in(log_file: LogFile, window_ns: Window) -> list[Block]:
    """The blocks that may hold messages of a window.

    Args:
        log_file: The file.
        window_ns: Half-open window of log times [Unix ns]; None for open ends.

    Returns:
        Those that are not wholly outside, in file order.
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
    wanted: Sequence[Sequence[int]],
    blocks: Sequence[Block],
    warn: Callable[[str], None],
    threads: int = 1,
) -> Iterator[tuple[Buffer, list[Records]]]:
    """The message records of some topics, many blocks at a time.

    Args:
        log_file: The file.
        wanted: Channel ids, one sequence a topic.
        blocks: Where to look.
        warn: Takes one sentence for each block that couldn't be read.
        threads: How many decompress the blocks.

    Yields:
        A buffer, which is overwritten when the next is asked for, and the records of each topic.
    """
    ids = list(itertools.chain.from_iterable(wanted))
    for data, placed in filled_arenas(log_file, ids, blocks, warn, threads):
        try:
            found = _records(log_file, data, placed, wanted)
        except LogError:  # which block is it? the others are read
            for one in placed:
                try:
                    alone = _records(log_file, data, [one], wanted)
                except LogError as error:
                    warn(f"{error}; its messages are missing")
                else:
                    yield data, alone
        else:
            yield data, found


def _records(
    log_file: LogFile, data: Buffer, placed: Sequence[Placed], wanted: Sequence[Sequence[int]]
) -> list[Records]:
    """The checked records of each topic.

    Raises:
        LogError: If an index is damaged or points to something that is no message.
    """
    offsets, limits, stops = _offsets(log_file, placed, wanted)
    found: list[Records] = []
    for a, b, lasts in zip(limits[:-1], limits[1:], stops, strict=True):
        at = offsets[a:b]
        records = _alike(data, at, lasts) if b > a else Records(at, at, None, Places(data, at))
        if records is None:
            _check_each(log_file, data, at, lasts)
            log_ns = gather(data, at, _LOG_TIME_KIND, _LOG_TIME_AT)
            records = Records(at, log_ns, None, Places(data, at + BODY_AT))
        found.append(records)
    return found


def _alike(data: Buffer, offsets: IntArray, stops: tuple[IntArray, IntArray]) -> Records | None:
    """Records that are whole messages of one length; None where something doesn't fit."""
    first = int(offsets[0])
    start = bytes(data[first : first + _START.size])
    opcode, length = _START.unpack(start)
    lasts, ends = stops
    # In file order the last record of a block reaches furthest.
    room = int((ends - offsets[lasts]).min())
    if opcode != Opcode.MESSAGE or not FIXED_SIZE <= length <= room - PREFIX_SIZE:
        return None
    size = PREFIX_SIZE + length
    places = Places(data, offsets)
    if size <= _LARGEST_COPIED:
        copied = gather(data, offsets, f"V{size}").view(np.uint8)
        places = Places(copied, np.arange(0, len(copied), size, dtype=np.int64), size)
    if places.field(_START_KIND, 0).tobytes() != start * len(offsets):
        return None
    log_ns = places.field(_LOG_TIME_KIND, _LOG_TIME_AT)
    bodies = Places(places.data, places.at + BODY_AT, places.step)
    return Records(offsets, log_ns, length - FIXED_SIZE, bodies)


def _check_each(
    log_file: LogFile, data: Buffer, offsets: IntArray, stops: tuple[IntArray, IntArray]
) -> None:
    """Raise LogError where a record is not a whole message."""
    rows, ends = stops
    stop = np.repeat(ends, np.diff(rows, prepend=-1))
    heads = gather(data, offsets, HEAD)
    lengths, room = heads["length"], (stop - offsets - PREFIX_SIZE).astype(np.uint64)
    whole = (heads["opcode"] == Opcode.MESSAGE) & (lengths >= FIXED_SIZE) & (lengths <= room)
    if not whole.all():
        raise LogError(log_file.path, "a message index points to something that is not a message")


def _offsets(
    log_file: LogFile, placed: Sequence[Placed], wanted: Sequence[Sequence[int]]
) -> tuple[IntArray, list[int], list[tuple[IntArray, IntArray]]]:
    """Where the records start, topic by topic and each in file order; all heads lie in the blocks.

    Returns:
        The starts; the topics' limits in them; and for each topic, block by block, which of its
        records is the last and where the payload ends.
    """
    ids = [channel_id for channel_ids in wanted for channel_id in channel_ids]
    by_block = [log_file.entries(one.block, ids) for one in placed]
    counts = np.array([[len(part) // 16 for part in parts] for parts in by_block], dtype=np.int64)
    by_topic: list[bytes] = []
    totals = np.empty((len(wanted), len(placed)), dtype=np.int64)
    at = 0
    for row, channel_ids in enumerate(wanted):
        size = len(channel_ids)
        by_topic += [part for parts in by_block for part in parts[at : at + size]]
        totals[row] = counts[:, at : at + size].sum(axis=1)
        at += size
    offsets = np.frombuffer(b"".join(by_topic), dtype="<i8")[1::2]
    each = totals.reshape(-1)
    room = np.array([max(one.stop - one.base - BODY_AT, -1) for one in placed], dtype=np.int64)
    # As unsigned numbers, negative offsets are beyond all room too.
    limit = np.repeat(np.tile(room + 1, len(wanted)).view(np.uint64), each)
    if (offsets.view(np.uint64) >= limit).any():
        raise LogError(log_file.path, "a message index points outside its chunk")
    bases = np.array([one.base for one in placed], dtype=np.int64)
    offsets = offsets + np.repeat(np.tile(bases, len(wanted)), each)
    limits: list[int] = [0, *np.cumsum(totals.sum(axis=1)).tolist()]
    steps_back = offsets[1:] < offsets[:-1]
    steps_back[[at - 1 for at in limits[1:-1] if 0 < at < len(offsets)]] = False
    if steps_back.any():  # an index that is not in file order, or a topic of several channels
        for a, b in itertools.pairwise(limits):
            offsets[a:b] = np.sort(offsets[a:b], kind="stable")
    stops: list[tuple[IntArray, IntArray]] = []
    ends = np.array([one.stop for one in placed], dtype=np.int64)
    for row in totals:
        filled = row > 0
        stops.append((np.cumsum(row)[filled] - 1, ends[filled]))
    return offsets, limits, stops
