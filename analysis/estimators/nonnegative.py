"""Least squares with unknowns that aren't negative, many small problems at once."""

from __future__ import annotations

import numpy as np

from undulog.capture.common.arrays import BoolArray, FloatArray

_PATIENCE = 3
"""Exchanges of whole sets without progress, after which one unknown at a time is exchanged, which
always ends (Judice and Pires 1994; 3 is their value)."""

_ROUNDING = 1e-12
"""Share of the largest right side below which a gradient is rounding."""


def nonnegative_least_squares(normal: FloatArray, right: FloatArray) -> FloatArray:
    """Return x >= 0 that minimises x N x / 2 - b x, by block principal pivoting.

    Source: Judice and Pires, "A block principal pivoting algorithm for large-scale strictly
    monotone linear complementarity problems", Computers and Operations Research 21 (1994) 587-596.

    Args:
        normal: N of each problem, positive definite: A'A, shape (k, n, n).
        right: b of each problem: A'y, shape (k, n).

    Returns:
        x, shape (k, n).
    """
    count = right.shape[1]
    free = np.zeros(right.shape, dtype=np.bool_)
    x, tolerance = np.zeros_like(right), _ROUNDING * np.abs(right).max(axis=1, keepdims=True)
    wrong: BoolArray = right > tolerance
    least = np.full(len(right), count + 1)
    patience = np.full(len(right), _PATIENCE)
    while (open_ := np.flatnonzero(wrong.any(axis=1))).size:
        number = wrong[open_].sum(axis=1)
        better = number < least[open_]
        least[open_] = np.where(better, number, least[open_])
        patience[open_] = np.where(better, _PATIENCE, patience[open_] - 1)
        single = np.zeros((open_.size, count), dtype=np.bool_)
        single[np.arange(open_.size), count - 1 - wrong[open_, ::-1].argmax(axis=1)] = True
        free[open_] ^= np.where(patience[open_, np.newaxis] >= 0, wrong[open_], single)
        kept = free[open_]
        both = kept[:, :, np.newaxis] & kept[:, np.newaxis]
        matrix = np.where(both, normal[open_], np.eye(count))
        values = np.linalg.solve(matrix, np.where(kept, right[open_], 0.0)[..., np.newaxis])
        x[open_] = values[..., 0]
        gradient = (normal[open_] @ values)[..., 0] - right[open_]
        wrong[open_] = np.where(kept, x[open_] < 0, gradient < -tolerance[open_])
    return x
