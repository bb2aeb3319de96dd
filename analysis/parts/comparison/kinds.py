"""Two kinds of joints in one chain: other servos, or another load, of a part of them.

Before a shape along the body is looked for, the values are sorted: where the widest gap is many
times the scatter within both sides, and each side has joints enough, the joints are of two kinds
(odd and even ones, two batches, two planes that nobody described) and each is compared with those
of its own kind.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from undulog.capture.common.arrays import FloatArray, IntArray
from undulog.capture.judgement.levels import ENOUGH_LIKE, HALF, ROBUST

from .outliers import FAR

FEWEST = ENOUGH_LIKE - 1
"""Joints of a kind, at least: of two, one may be a fault and the other chance."""


@dataclass(frozen=True)
class Split:
    """Two kinds of joints.

    Attributes:
        first: Indices of the joints of the kind that the first joint belongs to.
        second: Indices of the others.
        sure: Gap in robust standard deviations within the kinds.
    """

    first: IntArray
    second: IntArray
    sure: float


def split_of(values: FloatArray, margin: float) -> Split | None:
    """Look for two kinds of joints.

    Args:
        values: One quantity of the joints, in the order of the chain, shape (m,).
        margin: Difference that matters.

    Returns:
        The kinds; None where the values are one group, or where a shape explains them: in parts
        along the chain, but for two parts that are level on both sides of a step.
    """
    order = np.argsort(values)
    best: Split | None = None
    for size in range(FEWEST, values.size - FEWEST + 1):
        low, high = order[:size], order[size:]
        gap = float(values[high[0]] - values[low[-1]])
        away = [np.abs(values[side] - np.median(values[side])) for side in (low, high)]
        scatter = ROBUST * float(np.median(np.concatenate(away)))
        sure = gap / max(scatter, margin / (2 * FAR))
        if gap > margin and sure > 2 * FAR and (best is None or sure > best.sure):
            first, second = (low, high) if 0 in low else (high, low)
            best = Split(np.sort(first), np.sort(second), sure)
    if best is None:
        return None
    changes = int(np.count_nonzero(np.diff(np.isin(np.arange(values.size), best.first))))
    sides = values[best.first], values[best.second]
    gap = max(sides[0].min() - sides[1].max(), sides[1].min() - sides[0].max())
    is_step = changes == 1 and max(float(np.ptp(side)) for side in sides) < HALF * float(gap)
    return best if changes > 2 or is_step else None
