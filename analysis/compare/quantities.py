"""Estimates of two sides, and their differences.

Two single sessions differ by B minus A, each with the standard error of its own noise; groups of
runs by the difference of their means, after Welch (Biometrika 34, 1947), or, run by run, by the
mean of the paired differences. All quantities of a comparison are one family: decisions are
Holm's (Scand. J. Stat. 6, 1979), and the intervals hold together at 95 % after Bonferroni, so an
interval may contain 0 where Holm's sharper procedure decides.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import stdtr, stdtrit

from undulog.capture.common.arrays import FloatArray
from undulog.capture.common.errors import UsageError

from ..estimators.intervals import CONFIDENCE, welch_satterthwaite

Key = tuple[str, str]
"""Quantity and where it is: a joint's name or ``body``."""

Known = tuple[float, float, float]
"""Value, variance, degrees of freedom."""

MIN_RUNS = 2
"""Runs a side below which nothing is known of their scatter."""

_ROUNDING = 1e-9
"""Scatter of runs that agree, relative to their values: simulated runs may differ by rounding."""


@dataclass(frozen=True)
class Quantities:
    """Estimates of k quantities from one side.

    Attributes:
        value: Shape (k,).
        variance: Of the estimates, shape (k,).
        dof: Degrees of freedom of the variances, shape (k,).
    """

    value: FloatArray
    variance: FloatArray
    dof: FloatArray


@dataclass(frozen=True)
class Differences:
    """B minus A.

    Attributes:
        value: Shape (k,).
        error: Standard errors, shape (k,).
        dof: Their degrees of freedom, shape (k,).
    """

    value: FloatArray
    error: FloatArray
    dof: FloatArray

    @property
    def p(self) -> FloatArray:
        """Two-sided p-value of each by itself, shape (k,); 1 for 0 without any error."""
        size = np.abs(self.value)
        certain = np.where(size > 0, np.inf, 0.0)
        score = np.divide(size, self.error, out=certain, where=self.error > 0)
        return np.asarray(2 * stdtr(self.dof, -score), dtype=np.float64)

    @property
    def half(self) -> FloatArray:
        """Half widths of intervals that hold together at 95 %, shape (k,)."""
        level = (1 - CONFIDENCE) / max(self.value.size, 1)
        return np.asarray(stdtrit(self.dof, 1 - level / 2) * self.error, dtype=np.float64)


def from_runs(runs: FloatArray) -> Quantities:
    """Return a side's means over its runs.

    Args:
        runs: Shape (r, k), r at least 2.

    Returns:
        Means, their variances from the scatter of the runs, r - 1 degrees of freedom.

    Raises:
        UsageError: If there are fewer than 2 runs.
    """
    if len(runs) < MIN_RUNS:
        raise UsageError(
            f"{len(runs)} run on one side: groups need {MIN_RUNS} runs a side at least; two single "
            "sessions are compared without --a and --b"
        )
    mean: FloatArray = runs.mean(axis=0)
    rounding = _ROUNDING * np.abs(runs).max(axis=0)
    return Quantities(
        value=mean,
        variance=np.maximum(runs.var(axis=0, ddof=1), rounding**2) / len(runs),
        dof=np.full_like(mean, len(runs) - 1.0),
    )


def independent(a: Quantities, b: Quantities) -> Differences:
    """Return B minus A of independent sides (Welch).

    Args:
        a: One side, k quantities.
    """
    variances = np.stack([a.variance, b.variance])
    return Differences(
        value=b.value - a.value,
        error=np.sqrt(variances.sum(axis=0)),
        dof=welch_satterthwaite(variances, np.stack([a.dof, b.dof])),
    )


def paired(a: FloatArray, b: FloatArray) -> Differences:
    """Return the mean of B minus A, run by run.

    Args:
        a: Shape (r, k).
        b: Shape (r, k); run i belongs to run i of ``a``.

    Raises:
        UsageError: If there are fewer than 2 pairs, or the runs don't pair up.
    """
    if len(a) != len(b):
        raise UsageError(f"{len(a)} and {len(b)} runs don't make pairs; leave out --paired")
    means = from_runs(b - a)
    # Rounding is that of the values, not of their small difference.
    rounding = _ROUNDING * np.abs([a, b]).max(axis=(0, 1))
    variance = np.maximum(means.variance, rounding**2 / len(a))
    return Differences(means.value, np.sqrt(variance), means.dof)


def holm(p: FloatArray) -> FloatArray:
    """Return step-down p-values that hold for the whole family (Holm 1979).

    Args:
        p: Of each by itself, shape (k,).

    Returns:
        Adjusted, shape (k,).
    """
    order = np.argsort(p, kind="stable")
    steps = np.maximum.accumulate(p[order] * np.arange(p.size, 0, -1))
    adjusted = np.empty_like(p)
    adjusted[order] = np.minimum(steps, 1.0)
    return adjusted
