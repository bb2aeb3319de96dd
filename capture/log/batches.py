"""Message records in bulk: blocks are decompressed side by side and looked at together.

A chunk holds about a hundred messages of a topic, and a look at so few costs more than what is
seen. So the blocks of a few megabytes go into one buffer, which is used again for the next ones:
memory that is written for the first time costs a page fault each 4 KiB, as much as decompression.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from mcap.opcode import Opcode
from numpy.typing import NDArray

from ..arrays import IntArray
from ..errors import LogError
from .chunk import Block, Buffer
from .message_heads import BODY_AT, FIXED_SIZE, HEAD, gather
from .storage import LogFile

_ARENA_SIZE = 4 << 20

Window = tuple[int | None, int | None]


@dataclass(frozen=True)
class Placed:
    """A block's payload in a buffer.

    Attributes:
        block: The block.
        base: What its message offsets count from.
        stop: One past its last byte.
    """

    block: Block
    base: int
    stop: int


@dataclass(frozen=True)
class Records:
    """Message records of one topic in a buffer, in file order; all whole.

    Attributes:
        offsets: Where they start, shape (n,).
        heads: Their heads, of :data:`capture.log.message_heads.HEAD`, shape (n,).
    """

    offsets: IntArray
    heads: NDArray[np.void]


def blocks_in(log_file: LogFile, window_ns: Window) -> list[Block]:
    """The blocks that may hold messages of a window.

    Args:
        log_file: The file.
        window_ns: Half-open window of log times [Unix ns]; None for open ends.

    Returns:
        Those that are not wholly outside, in file order.
    """
    start, stop = window_ns
    return [
        block
        for block in log_file.blocks
        if (stop is None or block.start_ns < stop) and (start is None or block.end_ns >= start)
    ]


def record_batches(
    log_file: LogFile,
    wanted: Sequence[Sequence[int]],
    blocks: Sequence[Block],
    warn: Callable[[str], None],
) -> Iterator[tuple[Buffer, list[Records]]]:
    """The message records of some topics, many blocks at a time.

    Args:
        log_file: The file.
        wanted: Channel ids, one sequence a topic.
        blocks: Where to look.
        warn: Takes one sentence for each block that couldn't be read.

    Yields:
        A buffer, which is overwritten when the next is asked for, and the records of each topic.
    """
    for data, placed in _filled(log_file, wanted, blocks, warn):
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


def _filled(
    log_file: LogFile,
    wanted: Sequence[Sequence[int]],
    blocks: Sequence[Block],
    warn: Callable[[str], None],
) -> Iterator[tuple[Buffer, list[Placed]]]:
    """Buffers full of payloads; one that can't share a buffer comes alone."""
    ids = {channel_id for channel_ids in wanted for channel_id in channel_ids}
    arena = bytearray()
    placed: list[Placed] = []
    at = 0
    for block in blocks:
        if block.index_at and ids.isdisjoint(block.index_at):
            continue
        try:
            if not log_file.inflates(block, _ARENA_SIZE):
                data, base = log_file.payload(block)
                stop = block.stop if not block.compression else base + len(data)
                yield data, [Placed(block, base, stop)]
                continue
            if at + block.size > len(arena):
                if placed:
                    yield arena, placed
                placed, at = [], 0
            if not arena:
                arena = bytearray(min(_ARENA_SIZE, sum(each.size for each in blocks)))
            with memoryview(arena) as whole, whole[at : at + block.size] as room:
                log_file.inflate_into(block, room)
        except LogError as error:
            warn(f"{error}; its messages are missing")
            continue
        placed.append(Placed(block, at, at + block.size))
        at += block.size
    if placed:
        yield arena, placed


def _records(
    log_file: LogFile, data: Buffer, placed: Sequence[Placed], wanted: Sequence[Sequence[int]]
) -> list[Records]:
    """The checked records of each topic.

    Raises:
        LogError: If an index is damaged or points to something that is no message.
    """
    offsets = [_offsets(log_file, placed, channel_ids) for channel_ids in wanted]
    starts = np.concatenate([at for at, _ in offsets])
    stops = np.concatenate([stop for _, stop in offsets])
    if not len(starts):
        return [Records(starts, np.empty(0, HEAD)) for _ in wanted]
    if (starts + BODY_AT > stops).any():
        raise LogError(log_file.path, "a message index points outside its chunk")
    heads = gather(data, starts, HEAD)
    lengths = heads["length"]
    room = (stops - starts - 9).astype(np.uint64)
    if (heads["opcode"] != Opcode.MESSAGE).any() or (
        (lengths < FIXED_SIZE) | (lengths > room)
    ).any():
        raise LogError(log_file.path, "a message index points to something that is not a message")
    found: list[Records] = []
    at = 0
    for each, _ in offsets:
        found.append(Records(each, heads[at : at + len(each)]))
        at += len(each)
    return found


def _offsets(
    log_file: LogFile, placed: Sequence[Placed], channel_ids: Sequence[int]
) -> tuple[IntArray, IntArray]:
    """Where a topic's records start, in file order, and where the payload of each ends."""
    parts = [log_file.entries(one.block, ids) for one in placed for ids in channel_ids]
    size = len(channel_ids)
    counts = [
        sum(len(part) for part in parts[i * size : i * size + size]) // 16
        for i in range(len(placed))
    ]
    offsets = np.frombuffer(b"".join(parts), dtype="<i8")[1::2]
    stops = np.repeat(np.array([one.stop for one in placed], dtype=np.int64), counts)
    bases = np.repeat(np.array([one.base for one in placed], dtype=np.int64), counts)
    if (offsets < 0).any() or (offsets > stops - bases).any():
        raise LogError(log_file.path, "a message index points outside its chunk")
    offsets = offsets + bases
    if (offsets[1:] < offsets[:-1]).any():  # not in file order; the blocks are
        order = np.argsort(offsets, kind="stable")
        offsets, stops = offsets[order], stops[order]
    return offsets, stops
