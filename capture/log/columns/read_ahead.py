"""Work done ahead on threads, its results in order: bounded, and over when its user is done.

Decompression lets go of Python's lock, so threads of one process share it among the cores.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import Generic, TypeVar

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
