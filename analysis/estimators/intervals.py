"""95 % intervals, equivalence tests, and ratios of norms with noise.

Two one-sided tests: only they can support the claim that joints are alike.

Schuirmann, J. Pharmacokinetics and Biopharmaceutics 15 (1987), doi 10.1007/BF01068419; claimed for
all joints at once, so the largest p counts and needs no correction (intersection-union test,
Berger, Technometrics 24, 1982).

Ratios of norms of noisy matrices, with noise taken off and intervals that hold near zero.

A norm of noise is never zero: of D = truth + e the mean of ||D||^2 is ||truth||^2 + E||e||^2, so
E||e||^2 is subtracted. By the triangle inequality ||truth|| lies within ||D|| -+ ||e||, so with q
the quantile of ||e|| the interval ||D|| -+ q covers at least as often as q says, also where the
truth is zero and a bootstrap would not.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np
from scipy.special import chdtri, stdtr, stdtrit

from undulog.capture.common.arrays import ComplexArray, FloatArray

from ..results.estimate import Estimate, Interval

EQUIVALENT_GAIN = 0.02
EQUIVALENT_LAG_RAD = np.pi / 180
"""Default margins: 2 % in gain, 1 degree in lag."""


def equivalence_p(
    deviation: FloatArray, error: FloatArray, dof: FloatArray | float, margin: float
) -> float:
    """p-value against 'some deviation is as large as the margin'.

    Args:
        deviation: Estimates, shape (m,).
        error: Their standard errors, in the same unit, shape (m,).
        dof: Degrees of freedom of the errors, shape (m,) or one for all.
        margin: Positive, in the same unit.

    Returns:
        Small where all m deviations are shown to lie within the margin.
    """
    room = margin - np.abs(deviation)
    score = np.divide(room, error, out=np.sign(room) * np.inf, where=error > 0)
    return float(np.max(stdtr(dof, -score)))


CONFIDENCE = 0.95


def welch_satterthwaite(variances: FloatArray, dof: FloatArray) -> FloatArray:
    """Degrees of freedom of a sum of estimated variances (Welch, Biometrika 34, 1947).

    Args:
        variances: Shape (parts, ...).
        dof: Degrees of freedom of each, same shape.

    Returns:
        Shape (...); the smallest of the parts where all variances are zero.
    """
    total = np.sum(variances, axis=0)
    scatter = np.sum(variances**2 / dof, axis=0)
    return np.divide(total**2, scatter, out=np.min(dof, axis=0), where=scatter > 0)


def t_factor(dof: float, confidence: float = CONFIDENCE) -> float:
    """Two-sided Student factor.

    Args:
        dof: Degrees of freedom.
        confidence: E.g. 0.95.

    Returns:
        The factor on the standard error.
    """
    return float(stdtrit(dof, 0.5 + confidence / 2))


def around(value: float, half: float) -> Interval:
    """The interval of a value with a half width.

    Args:
        value: Centre.
        half: Half width.

    Returns:
        Low and high end.
    """
    return value - half, value + half


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
