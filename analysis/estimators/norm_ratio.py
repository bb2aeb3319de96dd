"""Ratios of norms of noisy matrices, with noise taken off and intervals that hold near zero.

A norm of noise is never zero: of D = truth + e the mean of ||D||^2 is ||truth||^2 + E||e||^2, so
E||e||^2 is subtracted. By the triangle inequality ||truth|| lies within ||D|| -+ ||e||, so with q
the quantile of ||e|| the interval ||D|| -+ q covers at least as often as q says, also where the
truth is zero and a bootstrap would not.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np
from scipy.special import chdtri

from undulog.capture.common.arrays import ComplexArray, FloatArray

from ..results.estimate import Estimate
from .intervals import CONFIDENCE

DRAWS = 400


class Noisy(Protocol):
    """A matrix with standard errors and their degrees of freedom, all of shape (n, m).

    ``correlation`` is that of a column's errors, shape (n, n), or None where they are independent.
    """

    @property
    def value(self) -> FloatArray: ...  # noqa: D102
    @property
    def error(self) -> FloatArray: ...  # noqa: D102
    @property
    def dof(self) -> FloatArray: ...  # noqa: D102
    @property
    def correlation(self) -> FloatArray | None: ...  # noqa: D102


def noise_draws(matrix: Noisy, seed: int) -> FloatArray:
    """Errors that a measured matrix may have.

    Args:
        matrix: With standard errors.
        seed: Of the draws.

    Returns:
        Student draws, shape (DRAWS, n, m). Where errors of a column are correlated their variances
        come from the same runs, so all are too small together.
    """
    random = np.random.default_rng(seed)
    if matrix.correlation is None:
        dof = np.broadcast_to(matrix.dof, (DRAWS, *matrix.dof.shape))
        return matrix.error * random.standard_t(dof)
    values, vectors = np.linalg.eigh(matrix.correlation)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    normal = root @ random.standard_normal((DRAWS, *matrix.error.shape))
    level = random.uniform(size=(DRAWS, 1, 1))
    return matrix.error * normal * np.sqrt(matrix.dof / chdtri(matrix.dof, level))


def norm_ratio(
    above: FloatArray | ComplexArray,
    above_noise: FloatArray | ComplexArray,
    below: FloatArray | ComplexArray,
    below_noise: FloatArray | ComplexArray,
) -> Estimate:
    """A ratio of two Frobenius norms.

    Args:
        above: Any shape.
        above_noise: Draws of its error, shape (draws, ...).
        below: Any shape.
        below_noise: Draws of its error.

    Returns:
        The ratio with its interval, at least 95 %; without a value where what is below can't be
        told from noise, without an interval where its norm's interval reaches zero.
    """
    (top, top_half), (bottom, bottom_half) = (
        _norm(*pair) for pair in ((above, above_noise), (below, below_noise))
    )
    plain = [float(np.linalg.norm(one)) for one in (above, below)]
    if bottom == 0:
        return Estimate()
    if plain[1] <= bottom_half:
        return Estimate(top / bottom)
    low = max(0.0, plain[0] - top_half) / (plain[1] + bottom_half)
    return Estimate(top / bottom, (low, (plain[0] + top_half) / (plain[1] - bottom_half)))


def _norm(
    value: FloatArray | ComplexArray, noise: FloatArray | ComplexArray
) -> tuple[float, float]:
    """The norm without what noise adds, and the quantile of the noise's own norm."""
    sizes: FloatArray = np.linalg.norm(noise.reshape(len(noise), -1), axis=1).astype(np.float64)
    squared = float(np.linalg.norm(value)) ** 2 - float(np.mean(sizes**2))
    # Two norms share the 5 %.
    return max(0.0, squared) ** 0.5, float(np.quantile(sizes, 1 - (1 - CONFIDENCE) / 2))
