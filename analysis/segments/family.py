"""Critical value for many contrasts at once: simultaneous intervals of the max-t type.

All statements of one answer share one family-wise level: the largest studentised contrast of all
of them is compared with the distribution that it has without any difference. That distribution
is simulated from the estimated covariance of the joints' errors, with the covariance estimated
anew in each draw, so that noise which joints share, and how few bins estimate it, are both in it
(max-t: Westfall & Young, Resampling-Based Multiple Testing, 1993; Hothorn, Bretz & Westfall,
Biometrical J. 50, 2008). Bins are fewer than joints, so their covariance is shrunk towards its
diagonal (Ledoit & Wolf, J. Multivariate Analysis 88, 2004).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from undulog.capture.common.arrays import FloatArray

from ..estimators.contrasts import ResponseErrors

LEVEL = 0.05
"""Family-wise level of all statements together."""

DRAWS = 2000
SEED = 20110901
"""Of the simulation, fixed: the same data give the same intervals."""

_TINY = 1e-300


@dataclass(frozen=True)
class Scatter:
    """Errors of one quantity of m joints.

    Attributes:
        columns: Realisations whose mean square is the variance of the estimates, of any weighted
            sum of joints too, shape (m, K); K is the number of degrees of freedom.
        own: Variance that is not in the columns and that no two joints share, shape (m,).
        turn: Error that all joints have in common up to this factor, shape (m,).
    """

    columns: FloatArray
    own: FloatArray
    turn: FloatArray

    def variance(self, weights: FloatArray) -> FloatArray:
        """Variance of weighted sums of the joints.

        Args:
            weights: Shape (c, m).

        Returns:
            Shape (c,).
        """
        found = np.mean((weights @ self.columns) ** 2, axis=-1)
        return found + weights**2 @ self.own + (weights @ self.turn) ** 2

    def select(self, chosen: Sequence[int]) -> Scatter:
        """Some of the joints."""
        index = np.asarray(chosen, dtype=np.int64)
        return Scatter(self.columns[index], self.own[index], self.turn[index])


def scatter_of(errors: ResponseErrors) -> tuple[Scatter, Scatter]:
    """Scatter of log gain and of lag, from the bins beside the gait frequency.

    Args:
        errors: Errors of ln H of m joints.

    Returns:
        Of log gain and of lag [rad]. Their columns are the real and imaginary parts of the bins:
        near the gait frequency the noise of both is the same.
    """
    columns = np.concatenate([errors.bins.real, errors.bins.imag], axis=1)
    nothing = np.zeros_like(errors.turn)
    return (
        Scatter(columns, errors.rounding[:, 0, 0], nothing),
        Scatter(columns, errors.rounding[:, 1, 1], errors.turn),
    )


@dataclass(frozen=True)
class Member:
    """The contrasts of one quantity that belong to a family.

    Attributes:
        weights: Shape (c, m).
        scatter: Of the m joints.
    """

    weights: FloatArray
    scatter: Scatter


def critical_value(members: Sequence[Member], level: float = LEVEL, draws: int = DRAWS) -> float:
    """Factor on the standard error of simultaneous intervals.

    Args:
        members: All contrasts of the family; members are drawn independently.
        level: Family-wise level.
        draws: Draws of the simulation.

    Returns:
        The (1 - level) quantile of the largest studentised contrast; infinity for no contrasts.
    """
    rng = np.random.default_rng(SEED)
    largest = np.zeros(draws)
    some = False
    for member in members:
        if member.weights.size:
            np.maximum(largest, _largest(member, rng, draws), out=largest)
            some = True
    return float(np.quantile(largest, 1 - level)) if some else float("inf")


def _largest(member: Member, rng: np.random.Generator, draws: int) -> FloatArray:
    """Largest studentised contrast of each draw, shape (draws,)."""
    scatter, weights = member.scatter, member.weights
    columns = scatter.columns
    joints, count = columns.shape
    shrink = _shrinkage(columns)
    sigma = np.sqrt(np.mean(columns**2, axis=1))
    shared, single = (1 - shrink) ** 0.5, shrink**0.5
    blocks = columns @ (rng.standard_normal((draws, count, count + 1)) / count**0.5)
    blocks *= shared
    blocks += single * sigma[:, None] * rng.standard_normal((draws, joints, count + 1))
    error = blocks[:, :, -1] + np.sqrt(scatter.own) * rng.standard_normal((draws, joints))
    error = error + scatter.turn * rng.standard_normal((draws, 1))
    variance = np.mean((weights @ blocks[:, :, :-1]) ** 2, axis=-1)
    variance += weights**2 @ scatter.own + (weights @ scatter.turn) ** 2
    studentised = np.abs(error @ weights.T) / np.sqrt(np.maximum(variance, _TINY))
    return np.max(studentised, axis=1)


def _shrinkage(columns: FloatArray) -> float:
    """Share of the diagonal in the shrunk covariance, 0 to 1."""
    joints, count = columns.shape
    sigma = np.sqrt(np.maximum(np.mean(columns**2, axis=1), _TINY))
    correlation = (columns / sigma[:, None]) @ (columns / sigma[:, None]).T / count
    off = ~np.eye(joints, dtype=np.bool_)
    squares = float(np.sum(correlation[off] ** 2))
    if squares == 0:
        return 1.0
    noise = float(np.sum((1 + correlation[off] ** 2) / count))
    return float(np.clip(noise / squares, 0.0, 1.0))
