"""Sums of samples over cycles, all cycles at once, and the time that each sample counts for."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from undulog.capture.common.arrays import BoolArray, ComplexArray, FloatArray, IntArray

from .harmonic import cos_sin
from .series import Series, sample_weights

_EDGE = 1e-6
"""Of a cycle: a sample at its edge but for rounding is the first of the one that begins there."""


@dataclass(frozen=True)
class Weighed:
    """What samples count in a window of c cycles.

    Attributes:
        t_s: Their times, shape (n,).
        weights: Time that each stands for, gaps not bridged [s], shape (n,).
        starts: Where the cycles begin and the last one ends, shape (c + 1,).
        covered: Fraction of each cycle that has samples, shape (c,).
    """

    t_s: FloatArray
    weights: FloatArray
    starts: IntArray
    covered: FloatArray
    coverage: float


def weigh(t_s: FloatArray, start_s: float, stop_s: float, cycles: int) -> Weighed:
    """Weigh samples and tell them apart by cycles.

    Args:
        t_s: Times within the window, strictly increasing [s], shape (n,).
        start_s: Start of the window [s].
        stop_s: End of the window, not included [s].
        cycles: Parts of equal length that it is cut into, c.

    Returns:
        The weights and what they cover.
    """
    weights = sample_weights(t_s, start_s, stop_s)
    period_s = (stop_s - start_s) / cycles
    inner = start_s + (np.arange(1.0, cycles) - _EDGE) * period_s
    starts = starts_of(t_s, np.concatenate(([-np.inf], inner, [np.inf])))
    filled = cycle_sums(weights, starts)
    share = min(1.0, float(filled.sum()) / (stop_s - start_s))
    return Weighed(t_s, weights, starts, np.minimum(filled / period_s, 1.0), share)


def starts_of(t_s: FloatArray, edges_s: FloatArray) -> IntArray:
    """Where cycles begin among samples.

    Args:
        t_s: Sampling times, increasing [s], shape (n,).
        edges_s: Edges of the cycles, increasing [s], shape (c + 1,).

    Returns:
        Index of the first sample at or after each edge, shape (c + 1,).
    """
    return np.searchsorted(t_s, edges_s).astype(np.int64)


def cycle_sums(values: FloatArray, starts: IntArray) -> FloatArray:
    """Return the sums over the samples of each cycle.

    Args:
        values: Samples in their last axis, shape (..., n).
        starts: Where the cycles begin and the last one ends, not decreasing, shape (c + 1,).

    Returns:
        Shape (..., c); 0 where a cycle has no samples.
    """
    filled = np.diff(starts) > 0
    sums = np.zeros((*values.shape[:-1], filled.size))
    if np.any(filled):
        inner = values[..., : int(starts[-1])]
        sums[..., filled] = np.add.reduceat(inner, starts[:-1][filled], axis=-1)
    return sums


_LEAST_SAMPLES = 6
"""Samples that a cycle's amplitude needs."""


def amplitudes(series: Series, starts: IntArray, omega: float) -> ComplexArray:
    """Complex amplitude of each cycle, from its samples alone.

    Args:
        starts: Where c cycles begin among them and the last one ends, shape (c + 1,).
        omega: Angular frequency [rad/s].

    Returns:
        Amplitudes at t = 0, shape (c,); NaN where a cycle has too few samples.
    """
    cosine, sine = cos_sin(omega * series.t_s)
    basis = np.stack([np.ones(series.count), cosine, -sine])
    gram = np.stack([cycle_sums(basis * row, starts) for row in basis])
    right = cycle_sums(basis * series.values, starts)
    known: BoolArray = np.diff(starts) >= _LEAST_SAMPLES
    result = np.full(known.size, np.nan, dtype=np.complex128)
    solved = np.linalg.solve(gram.T[known], right.T[known, :, None])[..., 0]
    result[known] = solved[:, 1] + 1j * solved[:, 2]
    return result
