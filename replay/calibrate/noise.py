"""What the residual noise of a fit is worth: its variance by joint, and its memory.

Weighted residuals whose noise is stationary, of autocovariance g_j at equally spaced samples, give
scores J' W r of the covariance::

    B = sum_j J_j' G_j J_j / sigma_j^4,    G_j[t, u] = g_j(t - u)

A fit takes the slowest part of the noise into its parameters, so the residual's own autocovariance
is too small. Hence g in two steps (prewhitening: Andrews & Monahan, *Econometrica* 60, 1992):

1. phi of noise e_t = phi e_{t-1} + w_t, the same for all joints, by restricted maximum likelihood,
   which counts what the parameters took (Patterson & Thompson, *Biometrika* 58, 1971). With
   ' for whitened by phi, p parameters and means, N samples of r joints and S the sum of squares
   that generalised least squares leaves, phi minimises::

       (N - p) ln S + ln det(J'' J' + P^-1) - r ln(1 - phi^2)

2. The autocovariance of what is left of w, times the trapezoid h, 1 up to L/2 and 0 from L on
   (Politis & Romano, *J. Time Series Analysis* 16, 1995), and coloured by phi again. L is five
   times the integrated autocorrelation time (Sokal, *Monte Carlo Methods in Statistical
   Mechanics*, 1997, section 3).
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import accumulate, pairwise

import numpy as np
import scipy.linalg
from scipy.optimize import minimize_scalar
from scipy.signal import fftconvolve

from undulog.capture.common.arrays import FloatArray

FLOOR = 1e-7
"""No encoder is better than this [rad]; keeps the weights of a noiseless session finite."""

_WINDOW = 5.0
_MOST = 0.995
"""Largest phi: a memory of 400 samples."""


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
    columns: Sequence[FloatArray],
    residuals: Sequence[FloatArray],
    sigma: FloatArray,
    precision: FloatArray,
) -> FloatArray:
    """B.

    Args:
        columns: J_j, shapes (n_j, K).
        residuals: [rad], shapes (n_j,).
        sigma: Shape (r,).
        precision: Diagonal of P^-1, shape (K,).

    Returns:
        Shape (K, K).
    """
    weighted = _Weighted(columns, residuals, sigma, precision)
    found = minimize_scalar(weighted.criterion, bounds=(0.0, _MOST), method="bounded")
    phi = float(found.x)
    innovations = weighted.innovations(phi)
    reach = int(np.ceil(_WINDOW * memory(innovations)))
    total = np.zeros((precision.size, precision.size))
    for column, left, s in zip(columns, innovations, sigma.tolist(), strict=True):
        n = len(left)
        lags = np.arange(min(reach, n - 1) + 1)
        power = np.abs(np.fft.rfft(left, 2 * n)) ** 2
        covariance = np.fft.irfft(power)[: lags.size] / n
        half = covariance * np.clip(2.0 - 2.0 * lags / reach, 0.0, 1.0)
        color = phi ** np.abs(np.arange(1 - n, n)) / (1.0 - phi**2)
        kernel = fftconvolve(np.concatenate([half[:0:-1], half]), color)[:, None]
        middle = len(kernel) // 2
        smooth = fftconvolve(column, kernel, axes=0)[middle : middle + n]
        total += column.T @ smooth / s**2
    return (total + total.T) / 2


class _Weighted:
    """Columns and residuals in units of each joint's deviation, with a mean for each joint."""

    def __init__(
        self,
        columns: Sequence[FloatArray],
        residuals: Sequence[FloatArray],
        sigma: FloatArray,
        precision: FloatArray,
    ) -> None:
        means = np.eye(len(residuals))
        self._columns = [
            np.hstack([column / s, np.tile(mean, (len(column), 1))])
            for column, s, mean in zip(columns, sigma.tolist(), means, strict=True)
        ]
        self._residuals = [r / s for r, s in zip(residuals, sigma.tolist(), strict=True)]
        self._precision = np.concatenate([precision, np.zeros(len(residuals))])

    def criterion(self, phi: float) -> float:
        """-2 ln of the restricted likelihood, less a constant."""
        columns, values = self._whitened(phi)
        normal, taken = self._solved(columns, values, phi)
        squares = float(values @ values - (columns.T @ values) @ taken)
        restricted = (values.size - normal.shape[0]) * np.log(max(squares, 1e-300))
        joints = len(self._residuals)
        return restricted + np.linalg.slogdet(normal)[1] - joints * np.log1p(-(phi**2))

    def innovations(self, phi: float) -> list[FloatArray]:
        """What is left of w, in deviations, for the degrees of freedom that the fit took."""
        columns, values = self._whitened(phi)
        normal, taken = self._solved(columns, values, phi)
        left = (values - columns @ taken) * np.sqrt(values.size / (values.size - normal.shape[0]))
        ends = list(accumulate(len(residual) for residual in self._residuals))
        return [left[start:end] for start, end in pairwise([0, *ends])]

    def _whitened(self, phi: float) -> tuple[FloatArray, FloatArray]:
        return (
            np.concatenate([_whiten(column, phi) for column in self._columns]),
            np.concatenate([_whiten(residual, phi) for residual in self._residuals]),
        )

    def _solved(
        self, columns: FloatArray, values: FloatArray, phi: float
    ) -> tuple[FloatArray, FloatArray]:
        # w varies by 1 - phi^2 where e varies by 1: the prior is in units of e.
        normal = columns.T @ columns + np.diag(self._precision * (1.0 - phi**2))
        return normal, scipy.linalg.solve(normal, columns.T @ values, assume_a="pos")


def _whiten(series: FloatArray, phi: float) -> FloatArray:
    """e_t - phi e_{t-1}, and e_0 with the same variance; along the first axis."""
    white = series.copy()
    white[0] *= np.sqrt(1.0 - phi**2)
    white[1:] -= phi * series[:-1]
    return white
