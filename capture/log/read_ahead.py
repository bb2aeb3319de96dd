"""Work done ahead on threads, its results in order: bounded, and over when its user is done.

Decompression lets go of Python's lock, so threads of one process share it among the cores.
"""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import Protocol, TypeVar

from ..errors import UsageError

_MOST_BY_DEFAULT = 4
"""Beyond this the reader itself, which is one thread, is what takes the time."""

_T = TypeVar("_T")


class Start(Protocol):
    """Starts work."""

    def __call__(self, work: Callable[[], _T]) -> Callable[[], _T]:
        """Start a piece of work.

        Args:
            work: The work.

        Returns:
            What waits for it, and returns or raises what it did.
        """
        ...


def threads_or_default(threads: int | None) -> int:
    """How many threads to use.

    Args:
        threads: As many as was asked for; None for one a core that this process may use, at most
            four.

    Returns:
        At least 1.

    Raises:
        UsageError: If less than one was asked for.
    """
    if threads is None:
        usable = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else None
        return min(usable or os.cpu_count() or 1, _MOST_BY_DEFAULT)
    if threads < 1:
        raise UsageError(f"threads={threads}: give 1 or more, or None for one a core")
    return threads


@contextmanager
def helpers(threads: int) -> Generator[Start]:
    """Threads that do work meanwhile; at the end of the block none is left.

    Args:
        threads: How many; with 1 there is none but the caller's own, which does each piece of
            work when it asks for its result.

    Yields:
        What starts a piece of work.
    """
    if threads == 1:
        yield _later
        return
    pool = ThreadPoolExecutor(threads, thread_name_prefix="undulog-read")

    def start(work: Callable[[], _T]) -> Callable[[], _T]:
        return pool.submit(work).result

    try:
        yield start
    finally:  # also when the caller stops half-way: what hasn't begun never will
        pool.shutdown(cancel_futures=True)


def _later(work: Callable[[], _T]) -> Callable[[], _T]:
    return work


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
