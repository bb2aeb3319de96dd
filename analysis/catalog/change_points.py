r"""Change points of joints over sessions.

Each joint's series, less the median of the joints of its session, is held against the model

.. math:: y_i = X_i \beta + \delta \, b_i(k) + e_i

in which X has the conditions (one column each) and b(k) rises from 0 to 1 from session k on: at
once, over a part of the time that is left, or until the last session. The statistic is the largest
:math:`t^2` over k and these shapes. Its null distribution is that of sessions in random order:
residuals of the reduced model are permuted (Freedman and Lane, 1983), with the maximum over all
joints and quantities, so that the level holds for the family (Westfall and Young, 1993).

The interval of k is the set of those that the likelihood ratio doesn't reject; its critical value
is simulated at the fit, as no limit distribution holds for change points in short series.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from undulog.capture.common.arrays import FloatArray, IntArray

LEVEL = 0.01
"""Family-wise level at which a joint is named: a wrong name costs somebody a repair."""
_CONFIDENCE = 0.95
LEAST_SESSIONS = 8
"""Sessions of a robot from which on change points are looked for."""
_LEAST_BESIDE = 3  # sessions before and after a change
_PARTS = (0.125, 0.25, 0.5, 1.0)  # of the time that is left, which a change may take
_PERMUTATIONS = 999
_SIMULATIONS = 499


@dataclass(frozen=True)
class ChangePoint:
    """A joint that responds differently from a session on.

    Attributes:
        joint: Column of the series.
        session: Index of the first session after the change.
        first: Index of the earliest session that the 95 % interval includes.
        last: Index of the latest one.
        gradual: Whether the change takes time; else it is a step.
        change: From before the change to its end.
        t: Size over its standard error, of the shape and session that fit best.
        p: Family-wise p-value over all series that were given.
    """

    joint: int
    session: int
    first: int
    last: int
    gradual: bool
    change: float
    t: float
    p: float


@dataclass(frozen=True)
class _Shapes:
    """Shapes that a change may have.

    Attributes:
        starts: Index of the first session after the change, shape (n_shapes,).
        gradual: Whether it takes time, shape (n_shapes,).
        raw: Values, shape (n_shapes, n_sessions).
        unit: Orthogonal to the conditions and of norm 1, shape (n_shapes, n_sessions).
    """

    starts: IntArray
    gradual: NDArray[np.bool_]
    raw: FloatArray
    unit: FloatArray


def relative_to_others(values: FloatArray, conditions: IntArray) -> FloatArray:
    """Subtract what all joints of a session have in common.

    It is the median, over the joints, of their deviations from their own medians in sessions of the
    same condition: a joint that changes doesn't move it.

    Args:
        values: Shape (n_sessions, n_joints), NaN where unknown.
        conditions: Number of each session's condition, shape (n_sessions,).
    """
    own = np.empty_like(values)
    for condition in np.unique(conditions):
        rows = conditions == condition
        own[rows] = np.nanmedian(values[rows], axis=0)
    return values - np.nanmedian(values - own, axis=1, keepdims=True)


def find_change_points(
    series: Sequence[FloatArray], times_s: FloatArray, conditions: IntArray
) -> list[list[ChangePoint]]:
    """Find joints whose series change, at most one change a series.

    Args:
        series: Quantities, each of shape (n_sessions, n_joints), as :func:`relative_to_others`
            gives them; a joint with a NaN is passed over.
        times_s: Of the sessions, in increasing order [s], shape (n_sessions,).
        conditions: Number of each session's condition, shape (n_sessions,).

    Returns:
        For each quantity the changes whose family-wise p-value is at most :data:`LEVEL`, the
        largest t first; none from fewer than :data:`LEAST_SESSIONS` sessions.
    """
    n = len(times_s)
    found: list[list[ChangePoint]] = [[] for _ in series]
    if n < LEAST_SESSIONS:
        return found
    design = (conditions[:, None] == np.unique(conditions)[None, :]).astype(float)
    basis = np.linalg.svd(design, full_matrices=False)[0]
    shapes = _shapes(times_s, basis)
    freedom = n - basis.shape[1] - 1
    columns = [
        (quantity, joint)
        for quantity, values in enumerate(series)
        for joint in range(values.shape[1])
        if np.isfinite(values[:, joint]).all() and np.ptp(values[:, joint]) > 0
    ]
    if not columns or not len(shapes.starts) or freedom < 2:
        return found
    raw = np.stack([series[quantity][:, joint] for quantity, joint in columns], axis=1)
    residuals = _residuals(raw, basis)
    observed = _largest(residuals, shapes, freedom).max(axis=0)
    rng = np.random.default_rng(0)
    dealt = (_residuals(residuals[rng.permutation(n)], basis) for _ in range(_PERMUTATIONS))
    null = np.array([_largest(one, shapes, freedom).max() for one in dealt])
    for column, (quantity, joint) in enumerate(columns):
        p = (1 + np.count_nonzero(null >= observed[column])) / (1 + len(null))
        if p <= LEVEL:
            fitted = _fit(residuals[:, column], basis, shapes, rng)
            t = math.sqrt(observed[column])
            found[quantity].append(replace(fitted, joint=joint, t=t, p=float(p)))
    for changes in found:
        changes.sort(key=lambda change: -change.t)
    return found


def _shapes(times_s: FloatArray, basis: FloatArray) -> _Shapes:
    n = len(times_s)
    starts = np.arange(_LEAST_BESIDE, n - _LEAST_BESIDE + 1)
    steps = (np.arange(n)[None, :] >= starts[:, None]).astype(float)
    begin_s = times_s[starts - 1][:, None]
    left_s = np.maximum(times_s[-1] - begin_s, np.finfo(float).tiny)
    since_s = times_s[None, :] - begin_s
    ramps = [np.clip(since_s / (part * left_s), 0.0, 1.0) for part in _PARTS]
    raw = np.concatenate([steps, *ramps])
    across = _residuals(raw.T, basis).T
    norm = np.linalg.norm(across, axis=1)
    kept = norm > 1e-6 * np.linalg.norm(raw, axis=1)
    return _Shapes(
        starts=np.tile(starts, 1 + len(_PARTS))[kept],
        gradual=np.repeat(np.arange(1 + len(_PARTS)) > 0, len(starts))[kept],
        raw=raw[kept],
        unit=across[kept] / norm[kept, None],
    )


def _residuals(values: FloatArray, basis: FloatArray) -> FloatArray:
    """Subtract the projection on the conditions; shape (n_sessions, any)."""
    return values - basis @ (basis.T @ values)


def _largest(residuals: FloatArray, shapes: _Shapes, freedom: int) -> FloatArray:
    """Return t squared of each shape and series, shape (n_shapes, n_series)."""
    explained = (shapes.unit @ residuals) ** 2
    total = np.sum(residuals**2, axis=0)
    return freedom * explained / np.maximum(total - explained, 1e-12 * total)


def _left(residual: FloatArray, shapes: _Shapes) -> FloatArray:
    """Return the residual sum of squares with each shape; shape (n_shapes, n_series)."""
    total = np.sum(residual**2, axis=0)
    return np.maximum(total - (shapes.unit @ residual) ** 2, 1e-12 * total)


def _fit(
    residual: FloatArray, basis: FloatArray, shapes: _Shapes, rng: np.random.Generator
) -> ChangePoint:
    """Fit a change; its joint, t and p-value are not known here."""
    n = len(residual)
    left = _left(residual, shapes)
    best = int(left.argmin())
    signal: FloatArray = (shapes.unit[best] @ residual) * shapes.unit[best]
    noise = residual - signal
    noise *= np.sqrt(n / max(1, n - basis.shape[1] - 2))
    # The likelihood ratio of the true shape, where there is such a change in such noise.
    simulated = signal[:, None] + _residuals(noise[rng.integers(n, size=(n, _SIMULATIONS))], basis)
    left_simulated = _left(simulated, shapes)
    ratio = n * np.log(left_simulated[best] / left_simulated.min(axis=0))
    starts = shapes.starts[n * np.log(left / left[best]) <= np.quantile(ratio, _CONFIDENCE)]
    unit, raw = shapes.unit[best], shapes.raw[best]
    size = float(unit @ residual) / float(unit @ raw)
    return ChangePoint(
        joint=-1,
        session=int(shapes.starts[best]),
        first=int(starts.min()),
        last=int(starts.max()),
        gradual=bool(shapes.gradual[best]),
        change=size,
        t=math.nan,
        p=math.nan,
    )
