"""Rounding of what is drawn: finer than can be seen, coarse enough to be packed.

Rerun packs its files with LZ4, which finds what repeats. Noise below what a screen shows never
does: values rounded to a power of two take half the space of those that were logged.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from undulog.capture.common.arrays import FloatArray

LEVELS = 500
"""Steps that the range of a plotted line is cut into, at least."""
_TAIL = 0.01


def plot_step(values: FloatArray) -> float:
    """The step that a plotted line is rounded to.

    Args:
        values: Samples of the line, any unit, shape (n,); NaN where there is none.

    Returns:
        A power of two, at most 1/500 of the range that holds all but the lowest and highest
        hundredth of the samples, so that rounding moves none by more than a thousandth of that
        range; 0, for none, where the line is flat.
    """
    known = values[np.isfinite(values)]
    if not known.size:
        return 0.0
    low, high = np.quantile(known, [_TAIL, 1.0 - _TAIL])
    span = float(high - low) or float(known.max() - known.min())
    return float(2.0 ** np.floor(np.log2(span / LEVELS))) if span > 0.0 else 0.0


def rounded(values: FloatArray, steps: Sequence[float] | FloatArray) -> FloatArray:
    """Round to multiples of a step.

    Args:
        values: Shape (n, k).
        steps: One a column, shape (k,); 0 leaves a column as it is.

    Returns:
        Shape (n, k); at most half a step from the values.
    """
    step = np.asarray(steps, dtype=np.float64)
    if not step.any():
        return values
    safe = np.where(step > 0.0, step, 1.0)
    return np.where(step > 0.0, np.round(values / safe) * safe, values)
