"""The fit: weighted least squares with a prior, by Levenberg and Marquardt.

With r_j = measured minus twin's angles of joint j and P the prior covariance of x, the fit
minimises::

    Q(x) = sum_j |r_j(x)|^2 / sigma_j^2 + x' P^-1 x

The twin is deterministic and its laws are smooth, so derivatives are central differences of runs,
of a batch where that can make them; its engine differs from the twin's by far less than the steps.
The weights are those of the last residuals (iteratively reweighted). With A = J' W J + P^-1 and B
of :mod:`.replay.calibrate.solve` the covariance of the estimate is A^-1 (B + P^-1) A^-1, where
noise never counts as less than white.

What the residual noise of a fit is worth: its variance by joint, and its memory.

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

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import accumulate, pairwise

import numpy as np
import scipy.linalg
from scipy.optimize import minimize_scalar
from scipy.signal import fftconvolve

from undulog.capture.common.arrays import FloatArray
from undulog.capture.common.errors import SimulationError

from .parameters import Answers, Unknown

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
        """B, shape (K, K)."""
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

    def step(self, prior: FloatArray) -> tuple[FloatArray, FloatArray]:
        """One step of a fit, shape (K,), and the covariance there, shape (K, K).

        Args:
            prior: P^-1 x where the residuals were taken, shape (K,).
        """
        step = np.linalg.solve(self.normal, self.slope - prior)
        left = [r - c @ step for c, r in zip(self.columns, self.residuals, strict=True)]
        return np.asarray(step, dtype=np.float64), replace(self, residuals=left).covariance()


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


STEP = 1e-3
"""Of the differences, in x."""

LONGEST = 0.7
"""No entry of x changes by more in one iteration."""

# A step this small against the standard errors ends the fit: the next would be far smaller.
_DONE = 0.1

_TRIES = 6


@dataclass(frozen=True)
class Solution:
    """Where a fit ended.

    Attributes:
        unknowns: K of them.
        x: Shape (K,).
        covariance: Shape (K, K).
        before, after: Residuals at the start and at x [rad], shapes (n_j,).
        columns: J at x, shapes (n_j, K).
        sigma: Standard deviation of each joint's residual [rad], shape (r,).
        memory: Autocorrelation time of the residuals, in samples.
        converged: Whether the last step was small against the standard errors.
    """

    unknowns: tuple[Unknown, ...]
    x: FloatArray
    covariance: FloatArray
    before: tuple[FloatArray, ...]
    after: tuple[FloatArray, ...]
    columns: tuple[FloatArray, ...]
    sigma: FloatArray
    memory: float
    iterations: int
    converged: bool

    @property
    def precision(self) -> FloatArray:
        """Diagonal of P^-1, shape (K,)."""
        return _precision(self.unknowns)


def solve(
    answers: Answers,
    unknowns: Sequence[Unknown],
    *,
    start: FloatArray | None = None,
    most: int = 12,
    on_iteration: Callable[[int, float], None] = lambda _k, _rms: None,
) -> Solution:
    """Fit.

    Args:
        answers: The twin under the commands.
        unknowns: K of them.
        start: x to start from; theta_0 if None.
        on_iteration: Told each iteration and the residuals' RMS [rad].

    Raises:
        SimulationError: If the twin fails at the start.
    """
    wanted = tuple(unknowns)
    x = np.zeros(len(wanted)) if start is None else start.copy()
    residuals = before = _residuals(answers, wanted, x)
    precision = _precision(wanted)
    columns: tuple[FloatArray, ...] = ()
    damping, iterations, converged = 0.0, 0, False
    while True:
        sigma = deviations(residuals)
        if not converged:  # the last step is too small to change them
            columns = derivatives(answers, wanted, x)
        problem = LeastSquares(columns, residuals, sigma, precision)
        if converged or iterations >= most:
            break
        iterations += 1
        on_iteration(iterations, float(np.sqrt(np.mean(np.concatenate(residuals) ** 2))))
        normal, slope = problem.normal, problem.slope - precision * x
        errors = np.sqrt(np.diag(np.linalg.inv(normal)))
        cost = _cost(residuals, sigma, precision, x)
        for _ in range(_TRIES):
            step = np.linalg.solve(normal + damping * np.diag(np.diag(normal)), slope)
            step *= min(1.0, LONGEST / float(np.abs(step).max()))
            try:
                there = _residuals(answers, wanted, x + step)
            except SimulationError:  # too far: too stiff or too soft for the physics step
                damping = max(30.0 * damping, 1e-2)
                continue
            converged = bool(np.all(np.abs(step) <= _DONE * errors))
            if _cost(there, sigma, precision, x + step) <= cost:
                x, residuals = x + step, there
                # None where none is needed: it would stop the way along a ridge.
                damping = damping / 10.0 if damping > 1e-4 else 0.0
                break
            if converged:  # nothing to gain but rounding
                break
            damping *= 10.0
        else:
            most = iterations
    return Solution(
        unknowns=wanted,
        x=x,
        covariance=problem.covariance(),
        before=before,
        after=residuals,
        columns=columns,
        sigma=sigma,
        memory=memory(residuals),
        iterations=iterations,
        converged=converged,
    )


def derivatives(
    answers: Answers, wanted: Sequence[Unknown], x: FloatArray, only: Sequence[int] | None = None
) -> tuple[FloatArray, ...]:
    """J: how the twin's angles change with x.

    Args:
        answers: The twin under the commands.
        wanted: K unknowns.
        x: Shape (K,).
        only: Indices of the k entries to differentiate by; all if None.

    Returns:
        [rad], shapes (n_j, k).
    """
    shifts = STEP * np.eye(len(wanted))[slice(None) if only is None else list(only)]
    points = [x + s * shift for shift in shifts for s in (1.0, -1.0)]
    angles = iter(answers.near(wanted, points))
    found = [
        tuple((a - b) / (2 * STEP) for a, b in zip(up, down, strict=True))
        for up, down in zip(angles, angles, strict=True)
    ]
    return tuple(np.stack(parts, axis=1) for parts in zip(*found, strict=True))


def _residuals(
    answers: Answers, wanted: Sequence[Unknown], x: FloatArray
) -> tuple[FloatArray, ...]:
    there = answers.at(wanted, x)
    return tuple(a - b for a, b in zip(answers.measured.angles, there, strict=True))


def _precision(wanted: Sequence[Unknown]) -> FloatArray:
    """Diagonal of P^-1."""
    return np.array([one.spread**-2 for one in wanted])


def _cost(
    residuals: Sequence[FloatArray], sigma: FloatArray, precision: FloatArray, x: FloatArray
) -> float:
    misfit = sum(float(r @ r) / s**2 for r, s in zip(residuals, sigma.tolist(), strict=True))
    return misfit + float(precision @ x**2)
