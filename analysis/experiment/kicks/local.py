"""How each joint's motion answers every joint's command, locally around one gait.

With ``a_i = |a_i| exp(j psi_i)`` the response and c_j the command, one joint's command at a time is
kicked, up and down, and central differences give four m x m matrices::

    P = d psi / d psi_c      S = d psi / d ln|c|
    R = d ln|a| / d psi_c    G = d ln|a| / d ln|c|

Shifting all commands in time shifts all responses: every row of P sums to 1 and every row of R to
0, whatever the system. If it is linear and time-invariant, a = H c, then

    P_ij - j R_ij = H_ij c_j / a_i = G_ij + j S_ij

so G = P and S = -R, and how far they are from that measures nonlinearity without a model. In
contact a chain isn't linear: every gait is its own operating point, and a complex H isn't enough.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import stdtrit

from undulog.capture.common.arrays import ComplexArray, FloatArray
from undulog.capture.common.errors import UsageError

from ...estimators.intervals import CONFIDENCE, noise_draws, norm_ratio, welch_satterthwaite
from ...results.estimate import Estimate
from .runs import Kick, Kind
from .scatter import RunErrors


@dataclass(frozen=True)
class Answers:
    """What r runs answered.

    Attributes:
        log: Change of ln|a| + j psi against the base, shape (r, m).
        log_gain_variance: Of its real part, from the noise within each run, shape (r, m).
        phase_variance: Of its imaginary part [rad^2], shape (r, m).
        dof: Degrees of freedom of both, shape (r, m).
        errors: How much runs differ from each other; None counts the noise within runs alone.
    """

    log: ComplexArray
    log_gain_variance: FloatArray
    phase_variance: FloatArray
    dof: FloatArray
    errors: RunErrors | None = None


@dataclass(frozen=True)
class Measured:
    """A matrix of derivatives, row = responding joint, column = commanded joint.

    Attributes:
        value: Shape (m, m).
        error: Standard errors, same shape; columns are independent of each other.
        dof: Degrees of freedom of the errors, same shape.
        correlation: Of a column's errors, shape (m, m); None where they are independent.
    """

    value: FloatArray
    error: FloatArray
    dof: FloatArray
    correlation: FloatArray | None = None

    @property
    def half(self) -> FloatArray:
        """Half widths of the 95 % intervals, one by one, shape (m, m)."""
        return self.error * stdtrit(self.dof, 0.5 + CONFIDENCE / 2)

    @property
    def half_together(self) -> FloatArray:
        """Half widths that hold for all elements off the diagonal together (Bonferroni)."""
        m = len(self.value)
        return self.error * stdtrit(self.dof, 1 - (1 - CONFIDENCE) / (2 * m * (m - 1)))


@dataclass(frozen=True)
class RowSums:
    """Sums over the columns.

    Attributes:
        value: Shape (m,).
        error: Standard errors, shape (m,).
        dof: Their degrees of freedom, shape (m,).
    """

    value: FloatArray
    error: FloatArray
    dof: FloatArray


def answers_of(deviation: ComplexArray, ratio: ComplexArray, base: ComplexArray) -> ComplexArray:
    """Change of the responses against the base, whenever each run started.

    ln a = ln c + ln H, and both of a run's phases are counted from the same instant.

    Args:
        deviation: Of the commands, d ln|c| + j d psi_c, shape (..., m).
        ratio: H = a/c of the same runs, shape (..., m).
        base: H of the base gait, shape (m,).

    Returns:
        d ln|a| + j d psi, shape (..., m).
    """
    return deviation + np.log(ratio / base)


def central_differences(
    kicks: Sequence[Kick], answers: Answers, kind: Kind
) -> tuple[Measured, Measured]:
    """Derivatives of phase and of log amplitude with respect to one kind of kick.

    Args:
        kicks: Of r runs.
        answers: Of the same runs.
        kind: Which kicks are used.

    Returns:
        d psi and d ln|a|: P and R for ``Kind.PHASE``, S and G for ``Kind.AMPLITUDE``.

    Raises:
        UsageError: If a joint isn't kicked both up and down.
    """
    m = answers.log.shape[1]
    value, variance, dof = np.zeros((3, 2, m, m))
    parts = np.stack([answers.log.imag, answers.log.real])
    noise = np.stack([answers.phase_variance, answers.log_gain_variance])
    errors = answers.errors
    between = np.zeros((2, m)) if errors is None else errors.between.reshape(2, m)
    for j in range(m):
        sides = [
            [k for k, one in enumerate(kicks) if _is(one, j, kind) and (one.size > 0) is up]
            for up in (True, False)
        ]
        if not all(sides):
            raise UsageError(
                f"joint {j + 1} of {m}: its command's {kind.value} is not kicked both up and down; "
                "record both, a difference to one side keeps the curvature"
            )
        up, down = sides
        span = np.mean([kicks[k].size for k in up]) - np.mean([kicks[k].size for k in down])
        value[:, :, j] = (parts[:, up].mean(axis=1) - parts[:, down].mean(axis=1)) / span
        weight = np.array([1 / len(up)] * len(up) + [1 / len(down)] * len(down)) / span
        of_runs = noise[:, up + down] * weight[:, None] ** 2
        of_dof = np.stack([answers.dof[up + down]] * 2)
        variance[:, :, j] = of_runs.sum(axis=1) + between * np.sum(weight**2)
        within = welch_satterthwaite(of_runs.swapaxes(0, 1), of_dof.swapaxes(0, 1))
        # All runs share the estimate of what is between them: its freedom doesn't add up.
        dof[:, :, j] = within if errors is None else np.where(between > 0, errors.dof, within)
    error = np.sqrt(variance)
    shared = (None, None)
    if errors is not None:
        shared = (errors.correlation[:m, :m], errors.correlation[m:, m:])
    return Measured(value[0], error[0], dof[0], shared[0]), Measured(
        value[1], error[1], dof[1], shared[1]
    )


def row_sums(matrix: Measured) -> RowSums:
    """Sums over the columns: 1 for P, 0 for R, by time shift.

    Args:
        matrix: P or R.

    Returns:
        Sums with their errors; the columns' runs are different ones, so variances add. Their
        degrees of freedom add only where each column's error is estimated by itself.
    """
    parts = matrix.error.T**2
    shared = matrix.correlation is not None
    dof = matrix.dof.min(axis=1) if shared else welch_satterthwaite(parts, matrix.dof.T)
    return RowSums(matrix.value.sum(axis=1), np.sqrt(parts.sum(axis=0)), dof)


def nonlinearity(
    P: Measured,
    R: Measured,
    G: Measured,
    S: Measured,
    seed: int = 1,
    *,
    correlation: FloatArray | None = None,
) -> Estimate:
    """Defect from what a linear time-invariant system shows.

    Args:
        P: d psi / d psi_c.
        R: d ln|a| / d psi_c.
        G: d ln|a| / d ln|c|.
        S: d psi / d ln|c|.
        seed: Of the noise draws.
        correlation: Of one run's errors, psi of all joints and then ln|a|, shape (2 m, 2 m); None
            where they are independent.

    Returns:
        ||(G - P, S + R)|| / ||(P, R)|| (Frobenius), with what noise adds taken off; interval by
        :func:`.analysis.estimators.intervals.norm_ratio`.
    """
    m = len(P.value)
    noise = noise_draws(stacked(((P, S), (R, G)), correlation), seed)
    of_p, of_s, of_r, of_g = (
        noise[:, rows, columns]
        for rows in (slice(m), slice(m, None))
        for columns in (slice(m), slice(m, None))
    )
    return norm_ratio(
        np.stack([G.value - P.value, S.value + R.value]),
        np.stack([of_g - of_p, of_s + of_r], axis=1),
        np.stack([P.value, R.value]),
        np.stack([of_p, of_r], axis=1),
    )


def stacked(blocks: Sequence[Sequence[Measured]], correlation: FloatArray | None) -> Measured:
    """One matrix of several, for errors that they have in common.

    Args:
        blocks: Rows of matrices; those of one row answer the same way, those of one column are of
            the same kicks.
        correlation: Of a column's errors.

    Returns:
        The matrix.
    """
    value, error, dof = (
        np.block([[getattr(one, part) for one in row] for row in blocks])
        for part in ("value", "error", "dof")
    )
    return Measured(value, error, dof, correlation)


def _is(kick: Kick, joint: int, kind: Kind) -> bool:
    return kick.joint == joint and kick.kind is kind
