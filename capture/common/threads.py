"""Independent work shared out to threads."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

from .errors import UsageError

_MOST_BY_DEFAULT = 4
"""Beyond this the reader itself, which is one thread, is what takes the time."""


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


_Item = TypeVar("_Item")
_Result = TypeVar("_Result")

MANY = 1 << 18
"""Samples of all channels from which on the work is shared out."""

_SHARES = 16
"""Shares for each thread, so that none waits long for the last."""


def in_threads(
    function: Callable[[_Item], _Result],
    items: Sequence[_Item],
    samples: int,
    after: Callable[[], None] = lambda: None,
) -> list[_Result]:
    """Apply a function to independent items, in threads where there is much to do.

    Args:
        function: Spends its time in NumPy, which lets other threads run.
        items: What it is applied to.
        samples: All that it will look at.
        after: Called after each item, by the thread that worked on it.

    Returns:
        Its results, in the order of the items; the same bits however many threads there are.
    """
    threads = threads_or_default(None)

    def work(some: Sequence[_Item]) -> list[_Result]:
        results = list[_Result]()
        for item in some:
            results.append(function(item))
            after()
        return results

    if samples < MANY or threads == 1:
        return work(items)
    # Shares of many items, since handing out one costs some 30 us.
    size = max(1, len(items) // (threads * _SHARES))
    shares = [items[first : first + size] for first in range(0, len(items), size)]
    with ThreadPoolExecutor(threads) as pool:
        return [result for share in pool.map(work, shares) for result in share]
