"""Two nodes that publish one topic: every other sample belongs to another series.

Of one series neighbours are nearer to each other than samples two apart, but for noise, of which
both are as far, and for rhythms of about two samples a cycle, of which every other sample is the
mirror image of the rest. Of two series in turn neighbours are as far apart as the series are, and
samples two apart are neighbours.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from ..common.arrays import FloatArray
from ..log.read.sample_times import LARGEST
from .levels import ANGLE_MARGIN_RAD, FEWEST, HALF, QUARTER


def are_of_two_nodes(series: Iterable[FloatArray]) -> bool:
    """Return whether the samples of most joints are of two series in turn.

    Args:
        series: Values of each joint in their order, those of one time, too, shape (n_j,) each.
    """
    votes = [_in_turn(values[np.abs(values) <= LARGEST]) for values in series]
    moving = [vote for vote in votes if vote is not None]
    return 2 * sum(moving) > len(moving) > 1


def _in_turn(values: FloatArray) -> bool | None:
    """Return whether neighbours are further apart than every other one; None without motion."""
    if values.size < 2 * FEWEST or np.ptp(values) < ANGLE_MARGIN_RAD:
        return None
    near, next_but_one = (np.median(np.abs(values[k:] - values[:-k])) for k in (1, 2))
    if near < QUARTER * np.std(values) or next_but_one > HALF * near:
        return False
    covariance = np.cov(values[: values.size // 2 * 2 : 2], values[1::2])
    even, odd = (float(size) for size in np.sqrt(np.diagonal(covariance)))
    mirrored = float(covariance[0, 1]) < -HALF * even * odd
    return max(even, odd) > QUARTER * float(near) and not mirrored
