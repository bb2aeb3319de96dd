"""Windows of sampling times, which a log keeps by log time."""

from __future__ import annotations

from collections.abc import Mapping

from ...common.arrays import IntArray
from ..columns.batches import Window
from ..columns.columns import Messages

_NS = 1_000_000_000
SLACK_NS = 5 * _NS
"""How far a sampling time may lie from its log time before a window could miss it."""

NEAR_NS = _NS // 4
"""The same for logs of our own, as long as the window turns out to be covered."""


def widened(window_ns: Window, slack_ns: int) -> Window:
    """A window of log times for one of sampling times.

    Args:
        window_ns: Half-open window of sampling times [Unix ns]; None for open ends.
        slack_ns: How far log times may lie from them [ns].

    Returns:
        The window of log times, half-open.
    """
    start, stop = window_ns
    return None if start is None else start - slack_ns, None if stop is None else stop + slack_ns


def covers(found: Mapping[str, Messages], window_ns: Window) -> bool:
    """Whether what was read goes beyond a window at both ends, in order, so nothing is missing.

    Args:
        found: Topic to messages.
        window_ns: Half-open window of sampling times [Unix ns]; None for open ends.

    Returns:
        False where that isn't sure.
    """
    start, stop = window_ns
    for messages in found.values():
        if len(messages.groups) != 1 or messages.unread:
            return False
        stamps = messages.groups[0].stamps()
        if not (start is None or stamps[0] < start) or not (stop is None or stamps[-1] >= stop):
            return False
        if (stamps[1:] < stamps[:-1]).any():
            return False
    return True


def cut(t_ns: IntArray, window_ns: Window) -> tuple[slice, IntArray]:
    """The samples in a window.

    Args:
        t_ns: Sampling times [Unix ns], not decreasing, shape (n,).
        window_ns: Half-open window of them [Unix ns]; None for open ends.

    Returns:
        Which they are, and their times; a view.
    """
    start, stop = window_ns
    first = 0 if start is None else int(t_ns.searchsorted(start))
    last = len(t_ns) if stop is None else int(t_ns.searchsorted(stop))
    inside = slice(first, last)
    return inside, t_ns[inside]
