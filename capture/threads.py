"""Independent work shared out to threads."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

from .log.read_ahead import threads_or_default

_Item = TypeVar("_Item")
_Result = TypeVar("_Result")

MANY = 1 << 18
"""Samples of all channels from which on the work is shared out."""


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

    def work(item: _Item) -> _Result:
        result = function(item)
        after()
        return result

    if samples < MANY or threads == 1:
        return [work(item) for item in items]
    with ThreadPoolExecutor(threads) as pool:
        return list(pool.map(work, items))
