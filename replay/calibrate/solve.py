"""The fit: weighted least squares with a prior, by Levenberg and Marquardt.

With r_j = measured minus twin's angles of joint j and P the prior covariance of x, the fit
minimises::

    Q(x) = sum_j |r_j(x)|^2 / sigma_j^2 + x' P^-1 x

The twin is deterministic and its laws are smooth, so derivatives are central differences of runs.
The weights are those of the last residuals (iteratively reweighted). With A = J' W J + P^-1 and B
of :mod:`.replay.calibrate.noise` the covariance of the estimate is A^-1 (B + P^-1) A^-1, where
noise never counts as less than white.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from undulog.capture.common.arrays import FloatArray
from undulog.capture.common.errors import SimulationError

from .answers import Answers
from .noise import deviations, memory, score_covariance
from .parameters import Unknown

STEP = 1e-3
"""Of the differences, in x."""

LONGEST = 0.7
"""No entry of x changes by more in one iteration."""

_DONE = 0.1
"""A step this small against the standard errors ends the fit: the next would be far smaller."""

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
        iterations: How many there were.
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

    @property
    def normal(self) -> FloatArray:
        """A, shape (K, K)."""
        return _normal(self.columns, self.sigma, self.precision)


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
        most: Iterations.
        on_iteration: Told each iteration and the residuals' RMS [rad].

    Returns:
        The solution.

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
        normal = _normal(columns, sigma, precision)
        if converged or iterations >= most:
            break
        iterations += 1
        on_iteration(iterations, float(np.sqrt(np.mean(np.concatenate(residuals) ** 2))))
        slope = _slope(columns, residuals, sigma) - precision * x
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
            if _cost(there, sigma, precision, x + step) <= cost:
                x, residuals = x + step, there
                # None where none is needed: it would stop the way along a ridge.
                damping = damping / 10.0 if damping > 1e-4 else 0.0
                converged = bool(np.all(np.abs(step) <= _DONE * errors))
                break
            if np.all(np.abs(step) <= _DONE * errors):  # nothing to gain but rounding
                converged = True
                break
            damping *= 10.0
        else:
            most = iterations
    return Solution(
        unknowns=wanted,
        x=x,
        covariance=_covariance(
            score_covariance(columns, residuals, sigma, precision),
            normal,
            precision,
        ),
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
    found: list[tuple[FloatArray, ...]] = []
    for i in range(len(wanted)) if only is None else only:
        shift = np.zeros(len(wanted))
        shift[i] = STEP
        up, down = answers.at(wanted, x + shift), answers.at(wanted, x - shift)
        found.append(tuple((a - b) / (2 * STEP) for a, b in zip(up, down, strict=True)))
    return tuple(np.stack(parts, axis=1) for parts in zip(*found, strict=True))


def covariance_with(
    columns: Sequence[FloatArray],
    residuals: Sequence[FloatArray],
    sigma: FloatArray,
    precision: FloatArray,
    prior: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """One step of a fit with other columns, and the covariance there.

    Args:
        columns: Derivatives, shapes (n_j, K).
        residuals: [rad], shapes (n_j,).
        sigma: Deviation of each joint's residual [rad], shape (r,).
        precision: Diagonal of P^-1, shape (K,).
        prior: P^-1 x where the residuals were taken, shape (K,).

    Returns:
        The step, shape (K,), and the covariance, shape (K, K).
    """
    normal = _normal(columns, sigma, precision)
    step = np.linalg.solve(normal, _slope(columns, residuals, sigma) - prior)
    left = [r - c @ step for c, r in zip(columns, residuals, strict=True)]
    scores = score_covariance(columns, left, sigma, precision)
    return np.asarray(step, dtype=np.float64), _covariance(scores, normal, precision)


def _residuals(
    answers: Answers, wanted: Sequence[Unknown], x: FloatArray
) -> tuple[FloatArray, ...]:
    there = answers.at(wanted, x)
    return tuple(a - b for a, b in zip(answers.measured.angles, there, strict=True))


def _precision(wanted: Sequence[Unknown]) -> FloatArray:
    """Diagonal of P^-1."""
    return np.array([one.spread**-2 for one in wanted])


def _normal(columns: Sequence[FloatArray], sigma: FloatArray, precision: FloatArray) -> FloatArray:
    return np.diag(precision) + sum(
        (c.T @ c / s**2 for c, s in zip(columns, sigma.tolist(), strict=True)),
        start=np.zeros((precision.size, precision.size)),
    )


def _slope(
    columns: Sequence[FloatArray], residuals: Sequence[FloatArray], sigma: FloatArray
) -> FloatArray:
    parts = zip(columns, residuals, sigma.tolist(), strict=True)
    return np.sum([c.T @ r / s**2 for c, r, s in parts], axis=0)


def _cost(
    residuals: Sequence[FloatArray], sigma: FloatArray, precision: FloatArray, x: FloatArray
) -> float:
    misfit = sum(float(r @ r) / s**2 for r, s in zip(residuals, sigma.tolist(), strict=True))
    return misfit + float(precision @ x**2)


def _covariance(scores: FloatArray, normal: FloatArray, precision: FloatArray) -> FloatArray:
    """A^-1 (B + P^-1) A^-1 of B = ``scores``, no direction narrower than A^-1 has it."""
    values, vectors = np.linalg.eigh(normal)
    root = vectors / np.sqrt(values)  # columns: root' A root = 1
    share, turn = np.linalg.eigh(root.T @ (scores + np.diag(precision)) @ root)
    spread = root @ turn
    return (spread * np.maximum(share, 1.0)) @ spread.T
