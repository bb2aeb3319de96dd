"""What the residual noise of a fit is worth: its variance by joint, and its memory.

Weighted residuals whose noise is stationary, of autocovariance g_j at equally spaced samples, give
scores J' W r of the covariance::

    B = sum_j J_j' G_j J_j / sigma_j^4,    G_j[t, u] = h(t - u) g_j(t - u)

with the trapezoid h, 1 up to L/2 and 0 from L on (Politis & Romano, *J. Time Series Analysis* 16,
1995). L is five times the integrated autocorrelation time of the residuals (Sokal, *Monte Carlo
Methods in Statistical Mechanics*, 1997, section 3). The autocovariance is that of the whole
residual: scores of a fit sum to zero, so their own long-run covariance would be far too small where
a gait's few harmonics are nearly used up by the parameters.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.signal import fftconvolve

from capture.arrays import FloatArray

FLOOR = 1e-7
"""No encoder is better than this [rad]; keeps the weights of a noiseless session finite."""

_WINDOW = 5.0


def deviations(residuals: Sequence[FloatArray]) -> FloatArray:
    """Standard deviation of each joint's residual.

    Args:
        residuals: [rad], shapes (n_j,).

    Returns:
        [rad], shape (r,).
    """
    return np.maximum([float(np.sqrt(np.mean(r**2))) for r in residuals], FLOOR)


def memory(residuals: Sequence[FloatArray]) -> float:
    """Integrated autocorrelation time, of all joints together.

    Args:
        residuals: [rad], shapes (n_j,).

    Returns:
        In samples; 1 for white noise, never less.
    """
    longest = max(min(len(r) for r in residuals) // 4, 1)
    total = np.zeros(longest + 1)
    for r in residuals:
        spectrum = np.fft.rfft(r, 2 * len(r))
        total += np.fft.irfft(np.abs(spectrum) ** 2)[: longest + 1] / max(float(r @ r), 1e-300)
    rho = total / len(residuals)
    tau = 1.0 + 2.0 * np.cumsum(rho[1:])
    ended = np.flatnonzero(np.arange(1, longest + 1) >= _WINDOW * tau)
    return max(float(tau[ended[0] if ended.size else -1]), 1.0)


def score_covariance(
    columns: Sequence[FloatArray], residuals: Sequence[FloatArray], sigma: FloatArray
) -> FloatArray:
    """B.

    Args:
        columns: J_j, shapes (n_j, K).
        residuals: [rad], shapes (n_j,).
        sigma: Shape (r,).

    Returns:
        Shape (K, K).
    """
    reach = int(np.ceil(_WINDOW * memory(residuals)))
    total = np.zeros((columns[0].shape[1], columns[0].shape[1]))
    for column, residual, s in zip(columns, residuals, sigma.tolist(), strict=True):
        n = len(residual)
        lags = np.arange(min(reach, n - 1) + 1)
        power = np.abs(np.fft.rfft(residual, 2 * n)) ** 2
        covariance = np.fft.irfft(power)[: lags.size] / (n - lags)
        half = covariance * np.clip(2.0 - 2.0 * lags / reach, 0.0, 1.0)
        kernel = np.concatenate([half[:0:-1], half])[:, None]
        total += column.T @ fftconvolve(column, kernel, mode="same", axes=0) / s**4
    return (total + total.T) / 2
