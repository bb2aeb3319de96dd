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

Joints whose samples share a stamp share its error, which acts on all of them at once, as their
rates go. So B is never less, in any direction, than the sum over instants of the squared scores
that the joints have together (Liang & Zeger, *Biometrika* 73, 1986)::

    sum_t s_t s_t',    s_t = sum_j J_j(t)' r_j(t) / sigma_j^2
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import accumulate, groupby, pairwise

import numpy as np
import scipy.linalg
from scipy.optimize import minimize_scalar
from scipy.signal import fftconvolve

from undulog.capture.common.arrays import FloatArray

FLOOR = 1e-7
"""No encoder is better than this [rad]; keeps the weights of a noiseless session finite."""

_WINDOW = 5.0
_MOST = 0.995  # largest phi: a memory of 400 samples


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
    tau = 1.0 + 2.0 * np.cumsum((total / len(residuals))[1:])
    ended = np.flatnonzero(np.arange(1, longest + 1) >= _WINDOW * tau)
    return max(float(tau[ended[0] if ended.size else -1]), 1.0)


@dataclass(frozen=True)
class LeastSquares:
    """The weighted problem to first order around x.

    Attributes:
        columns: J_j, shapes (n_j, K).
        residuals: r_j [rad], shapes (n_j,).
        sigma: Standard deviation of each joint's residual [rad], shape (r,).
        precision: Diagonal of P^-1, shape (K,).
    """

    columns: Sequence[FloatArray]
    residuals: Sequence[FloatArray]
    sigma: FloatArray
    precision: FloatArray

    @property
    def normal(self) -> FloatArray:
        """A, shape (K, K)."""
        return np.diag(self.precision) + sum(
            (c.T @ c / s**2 for c, s in zip(self.columns, self.sigma.tolist(), strict=True)),
            start=np.zeros((self.precision.size, self.precision.size)),
        )

    @property
    def slope(self) -> FloatArray:
        """J' W r, shape (K,)."""
        parts = zip(self.columns, self.residuals, self.sigma.tolist(), strict=True)
        return np.sum([c.T @ r / s**2 for c, r, s in parts], axis=0)

    def scores(self) -> FloatArray:
        """B, shape (K, K): of noise with a memory, or shared by the joints if that is more."""
        return larger(self._remembered(), self._shared())

    def _shared(self) -> FloatArray:
        """Sum of the squared scores of all instants, those of joints sampled together added first.

        Series that follow each other and are of one length are taken as sampled together.
        """
        rows = zip(self.columns, self.residuals, self.sigma.tolist(), strict=True)
        total = np.zeros((self.precision.size, self.precision.size))
        for _, series in groupby(rows, key=lambda row: len(row[1])):
            at_instants = np.sum([c * r[:, None] / s**2 for c, r, s in series], axis=0)
            total += at_instants.T @ at_instants
        return total

    def _remembered(self) -> FloatArray:
        """B of stationary noise with a memory, by joint, shape (K, K)."""
        weighted = _Weighted(self)
        phi = float(minimize_scalar(weighted.criterion, bounds=(0.0, _MOST), method="bounded").x)
        innovations = weighted.innovations(phi)
        reach = int(np.ceil(_WINDOW * memory(innovations)))
        total = np.zeros((self.precision.size, self.precision.size))
        for column, left, s in zip(self.columns, innovations, self.sigma.tolist(), strict=True):
            n = len(left)
            lags = np.arange(min(reach, n - 1) + 1)
            covariance = np.fft.irfft(np.abs(np.fft.rfft(left, 2 * n)) ** 2)[: lags.size] / n
            half = covariance * np.clip(2.0 - 2.0 * lags / reach, 0.0, 1.0)
            color = phi ** np.abs(np.arange(1 - n, n)) / (1.0 - phi**2)
            kernel = fftconvolve(np.concatenate([half[:0:-1], half]), color)[:, None]
            middle = len(kernel) // 2
            total += column.T @ fftconvolve(column, kernel, axes=0)[middle : middle + n] / s**2
        return (total + total.T) / 2

    def covariance(self) -> FloatArray:
        """A^-1 (B + P^-1) A^-1, no direction narrower than A^-1 has it."""
        scores = self.scores()
        values, vectors = np.linalg.eigh(self.normal)
        root = vectors / np.sqrt(values)  # columns: root' A root = 1
        share, turn = np.linalg.eigh(root.T @ (scores + np.diag(self.precision)) @ root)
        spread = root @ turn
        return (spread * np.maximum(share, 1.0)) @ spread.T

    @property
    def squares(self) -> float:
        """Weighted sum of squared residuals."""
        rows = zip(self.residuals, self.sigma.tolist(), strict=True)
        return sum(float(r @ r) / s**2 for r, s in rows)


def larger(covariance: FloatArray, other: FloatArray) -> FloatArray:
    """The larger of two covariances, direction by direction, shape (K, K).

    Args:
        other: Positive definite but for rounding.
    """
    values, vectors = np.linalg.eigh(other + 1e-12 * np.trace(other) * np.eye(len(other)))
    root = vectors * np.sqrt(values)
    back = vectors / np.sqrt(values)
    share, turn = np.linalg.eigh(back.T @ covariance @ back)
    spread = root @ turn
    return (spread * np.maximum(share, 1.0)) @ spread.T


@dataclass(frozen=True)
class LinearFit:
    """A fit to first order around x.

    Attributes:
        problem: What is left at x.
        x: Shape (K,).
    """

    problem: LeastSquares
    x: FloatArray

    def extended(self, column: Sequence[FloatArray], spread: float) -> LinearFit:
        """With one more parameter, fitted.

        Args:
            column: How it changes the angles, shapes (n_j,).
            spread: Its prior standard deviation, around 0.
        """
        before, precision = self.problem, np.append(self.problem.precision, spread**-2)
        columns = [np.column_stack(pair) for pair in zip(before.columns, column, strict=True)]
        problem = replace(before, columns=columns, precision=precision)
        x = np.append(self.x, 0.0)
        step = np.linalg.solve(problem.normal, problem.slope - precision * x)
        rest = [r - c @ step for r, c in zip(before.residuals, columns, strict=True)]
        return LinearFit(replace(problem, residuals=rest), x + np.asarray(step, dtype=np.float64))


class _Weighted:
    """Columns and residuals in units of each joint's deviation, with a mean for each joint."""

    def __init__(self, problem: LeastSquares) -> None:
        sigma, means = problem.sigma.tolist(), np.eye(len(problem.residuals))
        self._columns = [
            np.hstack([column / s, np.tile(mean, (len(column), 1))])
            for column, s, mean in zip(problem.columns, sigma, means, strict=True)
        ]
        self._residuals = [r / s for r, s in zip(problem.residuals, sigma, strict=True)]
        self._precision = np.concatenate([problem.precision, np.zeros(len(means))])

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
