"""The fit: weighted least squares with a prior, by Levenberg and Marquardt.

With r_j = measured minus twin's angles of joint j and P the prior covariance of x, the fit
minimises::

    Q(x) = sum_j |r_j(x)|^2 / sigma_j^2 + x' P^-1 x

The twin is deterministic and its laws are smooth, so derivatives are central differences of runs,
of a batch where that can make them; its engine differs from the twin's by far less than the steps.
The weights are those of the last residuals (iteratively reweighted). With A = J' W J + P^-1 and B
of :mod:`.replay.calibrate.least_squares` the covariance of the estimate is A^-1 (B + P^-1) A^-1,
where noise never counts as less than white.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from undulog.capture.common.arrays import FloatArray
from undulog.capture.common.errors import SimulationError

from .answers import Answers
from .least_squares import LeastSquares, LinearFit, deviations, memory
from .parameters import Unknown

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

    @property
    def local(self) -> LinearFit:
        """The same to first order."""
        problem = LeastSquares(self.columns, self.after, self.sigma, self.precision)
        return LinearFit(problem, self.x)


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
    parameters = tuple(unknowns)
    x = np.zeros(len(parameters)) if start is None else start.copy()
    residuals = before = _residuals(answers, parameters, x)
    precision = _precision(parameters)
    columns: tuple[FloatArray, ...] = ()
    damping, iterations, converged = 0.0, 0, False
    while True:
        sigma = deviations(residuals)
        if not converged:  # the last step is too small to change them
            columns = derivatives(answers, parameters, x)
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
                there = _residuals(answers, parameters, x + step)
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
        unknowns=parameters,
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
    answers: Answers,
    parameters: Sequence[Unknown],
    x: FloatArray,
    only: Sequence[int] | None = None,
) -> tuple[FloatArray, ...]:
    """J: how the twin's angles change with x.

    Args:
        answers: The twin under the commands.
        parameters: K unknowns.
        x: Shape (K,).
        only: Indices of the k entries to differentiate by; all if None.

    Returns:
        [rad], shapes (n_j, k).
    """
    shifts = STEP * np.eye(len(parameters))[slice(None) if only is None else list(only)]
    points = [x + s * shift for shift in shifts for s in (1.0, -1.0)]
    angles = iter(answers.near(parameters, points))
    slopes = [
        tuple((a - b) / (2 * STEP) for a, b in zip(up, down, strict=True))
        for up, down in zip(angles, angles, strict=True)
    ]
    return tuple(np.stack(parts, axis=1) for parts in zip(*slopes, strict=True))


def _residuals(
    answers: Answers, parameters: Sequence[Unknown], x: FloatArray
) -> tuple[FloatArray, ...]:
    there = answers.at(parameters, x)
    return tuple(a - b for a, b in zip(answers.measured.angles, there, strict=True))


def _precision(parameters: Sequence[Unknown]) -> FloatArray:
    """Diagonal of P^-1."""
    return np.array([parameter.spread**-2 for parameter in parameters])


def _cost(
    residuals: Sequence[FloatArray], sigma: FloatArray, precision: FloatArray, x: FloatArray
) -> float:
    misfit = sum(float(r @ r) / s**2 for r, s in zip(residuals, sigma.tolist(), strict=True))
    return misfit + float(precision @ x**2)
