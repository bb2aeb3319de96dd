"""Signals that stand while they should move.

In windows of a second the state should move by what its delayed command moves times the gain. It
stands where it moves by less than a quarter of that, and the command stands where that moves by
less than a quarter of what the state does.
"""

from __future__ import annotations

import numpy as np

from undulog.capture.common.arrays import FloatArray
from undulog.capture.judgement.levels import QUARTER

from .deviations import Regression
from .record import Block

WINDOW_S = 1.0
"""Length of a window [s]: longer than the lag of a servo."""


def standing_of(
    block: Block, regression: Regression, gain: FloatArray, fps: float
) -> tuple[FloatArray, FloatArray]:
    """Return the largest motion of the other signal while states, or commands, stand.

    Args:
        gain: Of sound episodes, shape (m,).

    Returns:
        By states that stand and by commands that stand, shape (k, m) each, in the states' unit.
    """
    half = max(round(WINDOW_S * fps / 2), 1)
    asked = _ranges(regression.x, block, half) * np.abs(gain)
    moved = _ranges(block.states, block, half)
    frozen = np.where(moved < QUARTER * asked, asked, 0.0).max(axis=0, initial=0.0)
    unasked = np.where(asked < QUARTER * moved, moved, 0.0).max(axis=0, initial=0.0)
    return frozen, unasked


def _ranges(values: FloatArray, block: Block, half: int) -> FloatArray:
    """Return the range of values in windows that overlap by half, shape (w, k, m).

    A window that isn't wholly inside has none: it has the range 0.
    """
    starts = np.arange(0, len(values) - half + 1, half)[: len(values) // half]
    if starts.size < 2:
        return np.zeros((1, *values.shape[1:]))
    whole = values[: starts.size * half].reshape(starts.size, half, *values.shape[1:])
    high, low = whole.max(axis=1), whole.min(axis=1)
    ranges = np.maximum(high[1:], high[:-1]) - np.minimum(low[1:], low[:-1])
    inside = block.inside[starts[1:] + half - 1]
    return ranges * inside[:, :, None]
