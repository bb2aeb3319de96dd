"""Which episodes differ from the others by more than their scatter and their errors explain.

A value's deviation from the mean of the others, over their standard deviation, has Student's
distribution (Grubbs, Technometrics 11, 1969, doi 10.1080/00401706.1969.10490657). The values are
taken in the order of their deviation from the median, and all from the first on that stands out
against those before it do so, as several hide each other (Rosner, Technometrics 25, 1983, doi
10.2307/1268549). Values that are the largest of many have Gumbel's distribution, whose upper tail
is longer.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import stdtrit

from undulog.capture.common.arrays import BoolArray, FloatArray, IntArray
from undulog.capture.judgement.levels import ENOUGH_LIKE, ROBUST, TINY, WHOLE

ROUNDS = 12
"""Steps of the scatter's bisection: to a part in 4,000."""

FURTHEST = 1e6
"""Standard deviations beyond which it doesn't matter how far a value is out."""


@dataclass(frozen=True)
class Outliers:
    """Deviations of e episodes in q quantities, shape (e, q) each; NaN where nothing is known.

    Attributes:
        deviation: From the mean of the others.
        half: Half of the interval that sound ones have at the level of all tests.
        error: Standard deviation of a sound one, with its own error.
        outside: Whether it stands out.
    """

    deviation: FloatArray
    half: FloatArray
    error: FloatArray
    outside: BoolArray


def outliers_of(
    values: FloatArray,
    errors: FloatArray,
    margins: FloatArray | float,
    level: float,
    *,
    largest: bool = False,
) -> Outliers:
    """Find the values that stand out in their column.

    Args:
        values: Shape (e, q); NaN where nothing is known.
        errors: Standard errors, shape (e, q).
        margins: A deviation that matters, (e, q) or what broadcasts to it.
        level: Chance that any of the values stands out where none should.
        largest: Whether the values are maxima.
    """
    count = np.isfinite(values).sum(axis=0)
    middle = median_of(values)
    spread = np.sqrt(scatter_of(values - middle, errors) ** 2 + errors**2) + TINY
    scaled = np.clip((values - middle) / spread, -FURTHEST, FURTHEST)
    ranked = np.take_along_axis(scaled, np.argsort(np.abs(scaled), axis=0), axis=0)  # NaN last
    mean, deviation = _before(np.nan_to_num(ranked))
    before = np.arange(len(values) + 1, dtype=np.float64)[:, None]
    factor = _factors(before, level / max(int(count.sum()), 1), largest=largest)
    limits = factor * deviation * np.sqrt(1 + 1 / np.maximum(before, 1))
    eligible = (before >= np.maximum(WHOLE * count, ENOUGH_LIKE - 1)) & (before < count)
    stands = eligible[:-1] & (np.abs(ranked - mean[:-1]) > limits[:-1])
    sound: IntArray = np.argmax(stands, axis=0, keepdims=True).astype(np.int64)
    sound[~stands.any(axis=0, keepdims=True)] = count[~stands.any(axis=0)]
    sound_mean, limit, sd = (
        np.take_along_axis(array, sound, axis=0) for array in (mean, limits, deviation)
    )
    size, half = values - middle - sound_mean * spread, limit * spread
    comparable = np.isfinite(size) & (count >= ENOUGH_LIKE)
    outside = comparable & (np.abs(size) > np.maximum(half, margins))
    return Outliers(size, half, np.maximum(sd, TINY) * spread, outside)


def _before(ranked: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return mean and standard deviation of the values before each place, shape (e + 1, q)."""
    none = np.zeros_like(ranked[:1])
    sums = np.concatenate([none, np.cumsum(ranked, axis=0)])
    squares = np.concatenate([none, np.cumsum(ranked**2, axis=0)])
    count = np.arange(len(ranked) + 1, dtype=np.float64)[:, None]
    mean = sums / np.maximum(count, 1)
    variance = (squares - count * mean**2) / np.maximum(count - 1, 1)
    return mean, np.sqrt(np.maximum(variance, 0.0))


def _factors(before: FloatArray, tail: float, *, largest: bool) -> FloatArray:
    """Return standard deviations of which a sound value is beyond with a chance of the tail."""
    student = np.asarray(stdtrit(np.maximum(before - 1, 1), 1 - tail / 2), dtype=np.float64)
    if not largest:
        return student
    gumbel = (-np.log(tail) - np.euler_gamma) * np.sqrt(6) / np.pi
    return np.maximum(student, gumbel)


def median_of(values: FloatArray) -> FloatArray:
    """Return the median of each column, 0 where nothing is known, shape (q,)."""
    if np.isfinite(values).all():
        return np.median(values, axis=0)
    filled = np.isfinite(values).any(axis=0)
    return np.nan_to_num(np.nanmedian(np.where(filled, values, 0.0), axis=0))


def scatter_of(deviations: FloatArray, errors: FloatArray) -> FloatArray:
    """Return the standard deviation that values have besides their errors, shape (q,).

    With it half of the deviations are within the median of a normal distribution; it is 0 where
    the errors explain as much.
    """
    size = np.abs(deviations)
    high = ROBUST * median_of(size)
    low = np.zeros_like(high)
    for _ in range(ROUNDS):
        middle = (low + high) / 2
        more = ROBUST * median_of(size / (np.hypot(middle, errors) + TINY)) > 1
        low, high = np.where(more, middle, low), np.where(more, high, middle)
    return low


def weighted_median(values: FloatArray, weights: FloatArray) -> FloatArray:
    """Return the weighted median of each row; NaN where no weight is, shape (e,)."""
    order = np.argsort(values, axis=1)
    ranked = np.take_along_axis(values, order, axis=1)
    sums = np.cumsum(np.take_along_axis(weights, order, axis=1), axis=1)
    total = sums[:, -1:]
    at = (sums >= total / 2).argmax(axis=1)
    middle = np.take_along_axis(ranked, at[:, None], axis=1)[:, 0]
    return np.where(total[:, 0] > 0, middle, np.nan)
