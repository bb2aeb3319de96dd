"""Blocks of a log decompressed side by side, in memory that is used again and again.

A chunk holds about a hundred messages of a topic, and a look at so few costs more than what is
seen. So the blocks of a few megabytes go into one buffer, which is used again for later ones:
memory that is written for the first time costs a page fault each 4 KiB, as much as decompression.
While one buffer is looked at, threads fill another.

Work done ahead on threads, its results in order: bounded, and over when its user is done.

Decompression lets go of Python's lock, so threads of one process share it among the cores.
"""

from __future__ import annotations

import mmap
from collections import deque
from collections.abc import Callable, Collection, Generator, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from itertools import cycle
from typing import Generic, TypeAlias, TypeVar

from ...common.errors import LogError
from ..file.pages import keep_freed, new_pages
from ..file.storage import LogFile
from ..mcap.chunk import Block, Buffer

_T = TypeVar("_T")


class Piece(Generic[_T]):
    """A piece of work: who comes first does it, a helper or the one who needs the result."""

    def __init__(self, work: Callable[[], _T], helpers: ThreadPoolExecutor | None) -> None:
        """Offer it to the helpers.

        Args:
            work: The work.
            helpers: Threads; None where there are none.
        """
        self._work = work
        self._taken = None if helpers is None else helpers.submit(work)
        self._done: list[_T] = []

    def hurry(self) -> None:
        """Do it now unless a helper has begun it."""
        if not self._done and (self._taken is None or self._taken.cancel()):
            self._taken = None
            self._done.append(self._work())

    def result(self) -> _T:
        """What the work gave; waits for it.

        Returns:
            The result; what the work raises is raised here, or where it was done in a hurry.
        """
        self.hurry()
        return self._done[0] if self._taken is None else self._taken.result()


@contextmanager
def helpers(threads: int) -> Generator[ThreadPoolExecutor | None]:
    """The threads that help a caller; at the end of the block none is left.

    Args:
        threads: How many work, the caller's own among them.

    Yields:
        The others; None where there are none.
    """
    if threads == 1:
        yield None
        return
    pool = ThreadPoolExecutor(threads - 1, thread_name_prefix="undulog-read")
    try:
        yield pool
    finally:  # also when the caller stops half-way: what hasn't begun never will
        pool.shutdown(cancel_futures=True)


def ahead(items: Iterable[_T], count: int) -> Iterator[_T]:
    """Items in order, each taken from where they come from some time before it is needed.

    Args:
        items: Whose making starts some work.
        count: How many are taken beyond the one that is given.

    Yields:
        The items. When the next is asked for, the one before is taken as done with.
    """
    waiting: deque[_T] = deque()
    for item in items:
        waiting.append(item)
        if len(waiting) > count:
            yield waiting.popleft()
    yield from waiting


ARENA_SIZE = 8 << 20
SAME_SIZE = 9 << 18
"""Bytes of blocks of one channel that share a buffer: about what a core's own cache holds. They
have so many messages of a topic that more would save nothing."""


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


_Found: TypeAlias = tuple[Buffer, Placed] | LogError
"""A buffer and what is in it, or why the block can't be read."""


def filled_arenas(
    log_file: LogFile,
    channel_ids: Collection[int],
    blocks: Sequence[Block],
    warn: Callable[[str], None],
    threads: int,
) -> Iterator[tuple[Buffer, list[Placed]]]:
    """Buffers full of payloads, in file order; one that can't share a buffer comes alone.

    Args:
        log_file: The file.
        channel_ids: Blocks whose index has none of these channels are passed over.
        blocks: Where to look.
        warn: Takes one sentence for each block that couldn't be read.
        threads: How many decompress, the caller's among them; others do so ahead of what is used.

    Yields:
        A buffer, which is overwritten when the next is asked for, and what is in it.
    """
    ids = set(channel_ids)
    wanted = [
        each
        for each in blocks
        if (not ids.isdisjoint(each.index_at) if each.index_at else not each.is_empty)
    ]
    runs = list(_runs(log_file, wanted))
    spare = 1 if threads > 1 and len(runs) > 1 else 0
    keep_freed(ARENA_SIZE)  # no copy of messages is larger
    scratch = log_file.scratch
    arenas = [scratch.pop() if scratch else new_pages(ARENA_SIZE) for _ in range(1 + spare)]
    with helpers(max(min(threads, len(wanted)), 1)) as pool:
        for pieces in ahead(_begun(log_file, runs, arenas, pool), spare):
            if pool is not None:
                for piece in reversed(pieces):  # the helpers come from the other end
                    piece.hurry()
            found = [piece.result() for piece in pieces]
            for each in found:
                if isinstance(each, LogError):
                    warn(f"{each}; its messages are missing")
            filled = [each for each in found if not isinstance(each, LogError)]
            if filled:
                yield filled[0][0], [placed for _, placed in filled]
    if len(blocks) < len(log_file.blocks):  # after a window there is often another
        scratch[:] = [*arenas, *scratch][:2]


def _runs(log_file: LogFile, blocks: Sequence[Block]) -> Iterator[list[Placed] | Block]:
    """Blocks that share a buffer, with their places in it, or one that comes alone."""
    run: list[Placed] = []
    at, former = 0, None
    for block in blocks:
        shares = log_file.inflates(block, ARENA_SIZE)
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
) -> Iterator[list[Piece[_Found]]]:
    """The work on each run; it is offered to the helpers when it is taken from here."""
    for run, arena in zip(runs, cycle(arenas), strict=False):
        if isinstance(run, list):
            yield [Piece(partial(_inflated, log_file, arena, placed), pool) for placed in run]
        else:  # two at once that are larger than a buffer are too much
            yield [Piece(partial(_alone, log_file, run), pool if run.size <= ARENA_SIZE else None)]


def _inflated(log_file: LogFile, arena: mmap.mmap, placed: Placed) -> _Found:
    try:
        with memoryview(arena) as whole, whole[placed.base : placed.stop] as room:
            log_file.inflate_into(placed.block, room)
    except LogError as error:
        return error
    return arena, placed


def _alone(log_file: LogFile, block: Block) -> _Found:
    try:
        data, base, stop = log_file.payload_once(block)
    except LogError as error:
        return error
    return data, Placed(block, base, stop)
