"""Message records in bulk: blocks are decompressed side by side and looked at together.

A chunk holds about a hundred messages of a topic, and a look at so few costs more than what is
seen. So the blocks of a few megabytes go into one buffer, which is used again for the next ones:
memory that is written for the first time costs a page fault each 4 KiB, as much as decompression.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from mcap.opcode import Opcode

from ..arrays import IntArray
from ..errors import LogError
from .chunk import PREFIX_SIZE, Block, Buffer
from .message_heads import BODY_AT, FIXED_SIZE, HEAD, gather
from .storage import LogFile

_ARENA_SIZE = 8 << 20

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
        log_ns: Their log times [Unix ns], shape (n,).
        lengths: Bytes of each message, shape (n,).
    """

    offsets: IntArray
    log_ns: IntArray
    lengths: IntArray


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
                data, base, stop = log_file.payload_once(block)
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
    offsets, stops, limits = _offsets(log_file, placed, wanted)
    if (offsets + BODY_AT > stops).any():
        raise LogError(log_file.path, "a message index points outside its chunk")
    heads = gather(data, offsets, HEAD) if len(offsets) else np.empty(0, HEAD)
    lengths = heads["length"]
    room = (stops - offsets - PREFIX_SIZE).astype(np.uint64)
    if (heads["opcode"] != Opcode.MESSAGE).any() or (
        (lengths < FIXED_SIZE) | (lengths > room)
    ).any():
        raise LogError(log_file.path, "a message index points to something that is not a message")
    log_ns = heads["log"].astype(np.int64)
    lengths = lengths.astype(np.int64) - FIXED_SIZE
    return [
        Records(offsets[a:b], log_ns[a:b], lengths[a:b])
        for a, b in itertools.pairwise(limits)
    ]


def _offsets(
    log_file: LogFile, placed: Sequence[Placed], wanted: Sequence[Sequence[int]]
) -> tuple[IntArray, IntArray, list[int]]:
    """Where the records start, topic by topic and each in file order.

    Returns:
        The starts, where the payload of each ends, and the topics' limits in both.
    """
    ids = [channel_id for channel_ids in wanted for channel_id in channel_ids]
    by_block = [log_file.entries(one.block, ids) for one in placed]
    by_channel = list(zip(*by_block, strict=True))
    counts = np.array([[len(part) // 16 for part in parts] for parts in by_channel], dtype=np.int64)
    raw = b"".join(part for parts in by_channel for part in parts)
    offsets = np.frombuffer(raw, dtype="<i8")[1::2]
    here = np.tile(np.array([(one.base, one.stop) for one in placed]), (len(ids), 1))
    bases, stops = np.repeat(here, counts.reshape(-1), axis=0).T
    if (offsets < 0).any() or (offsets > stops - bases).any():
        raise LogError(log_file.path, "a message index points outside its chunk")
    offsets = offsets + bases
    sums = np.concatenate([[0], np.cumsum(counts.sum(axis=1))])
    limits: list[int] = sums[np.cumsum([0, *(len(each) for each in wanted)])].tolist()
    steps_back = offsets[1:] < offsets[:-1]
    steps_back[[at - 1 for at in limits[1:-1] if 0 < at < len(offsets)]] = False
    if steps_back.any():  # an index that is not in file order, or a topic of several channels
        for a, b in itertools.pairwise(limits):
            order = a + np.argsort(offsets[a:b], kind="stable")
            offsets[a:b], stops[a:b] = offsets[order], stops[order]
    return offsets, stops, limits
