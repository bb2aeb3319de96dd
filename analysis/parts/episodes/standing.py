"""Signals that stand while they should move.

In windows of a second the state should move by what its delayed command moves times the gain. It
stands where it moves by less than a quarter of that from half a second before the window to half a
second behind it; and the command stands where that moves by less than a quarter of what the state
does.
"""

from __future__ import annotations

import numpy as np

from undulog.capture.common.arrays import FloatArray
from undulog.capture.judgement.levels import QUARTER

from .deviations import Regression
from .record import EpisodeBlock

WINDOW_S = 1.0
"""Length of a window [s]: longer than the lag of a servo."""


def standing_of(
    block: EpisodeBlock, regression: Regression, gain: FloatArray, fps: float
) -> tuple[FloatArray, FloatArray]:
    """Return the largest motion of the other signal while states, or commands, stand.

    Args:
        gain: Of sound episodes, shape (m,).

    Returns:
        By states that stand and by commands that stand, shape (k, m) each, in the states' unit.
    """
    half = max(round(WINDOW_S * fps / 2), 1)
    x = regression.x * np.abs(gain)
    (asked, asked_around), (moved, moved_around) = (
        _ranges(values, block, half) for values in (x, block.states)
    )
    frozen = np.where(moved_around < QUARTER * asked, asked, 0.0)
    unasked = np.where(asked_around < QUARTER * moved, moved, 0.0)
    return frozen.max(axis=0, initial=0.0), unasked.max(axis=0, initial=0.0)


def _ranges(values: FloatArray, block: EpisodeBlock, half: int) -> tuple[FloatArray, FloatArray]:
    """Return the range of values in windows of two halves, and with one more on either side.

    The windows overlap by half. One that isn't wholly inside has none: its range is 0.

    Returns:
        Shape (w, k, m) each.
    """
    count = len(values) // half
    if count < 2:
        none = np.zeros((1, *values.shape[1:]))
        return none, none
    halves = values[: count * half].reshape(count, half, *values.shape[1:])
    high, low = halves.max(axis=1), halves.min(axis=1)
    pairs = np.maximum(high[1:], high[:-1]), np.minimum(low[1:], low[:-1])
    edges = np.r_[0, np.arange(count - 1), count - 2]  # the outer windows have one neighbour
    before, after = edges[:-2], edges[2:]
    around = (
        np.maximum(pairs[0][before], pairs[0][after]),
        np.minimum(pairs[1][before], pairs[1][after]),
    )
    inside = block.inside[half * np.arange(2, count + 1) - 1][:, :, None]
    return (pairs[0] - pairs[1]) * inside, around[0] - around[1]
