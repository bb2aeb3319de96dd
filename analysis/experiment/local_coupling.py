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

The coupling of a chain, read from kicks as if it were linear and time-invariant.

Then a = H c with H_ij = (a_i / c_j)(P_ij - j R_ij), and X = H^-1 is, up to the servos on its
diagonal and a scaling of its rows, the impedance that couples the joints. Asymmetry of P is not
directed coupling: a reciprocal H (H = H') has an asymmetric P, too. Hence asymmetry and reach are
computed of X. Where the nonlinearity index isn't small, this is a reading and not a measurement.

P, R, G and S with errors that hold whether or not runs differ by more than their own noise.

Rows of P must sum to 1 and rows of R to 0. That is checked against errors estimated without
those sums; where it fails in spite of the scatter between runs, something else is wrong in every
run (most often they had not settled), and the errors are widened until the sums agree (the scale
factor of the Particle Data Group, Review of Particle Physics, Introduction, section 5.2.2).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import stdtrit

from undulog.capture.common.arrays import BoolArray, ComplexArray, FloatArray
from undulog.capture.common.errors import UsageError

from ..common.estimate import Estimate
from ..estimators.intervals import (
    CONFIDENCE,
    NoisyMatrix,
    noise_draws,
    norm_ratio,
    welch_satterthwaite,
)
from ..results.coupling import LTI_LABEL, Lti, rows_of
from .kick_runs import Kick, KickKind
from .run_scatter import RunErrors, run_errors, sides

BANDS = (1, 2, 3)

UNKNOWN_SHAPE = (Estimate(), Estimate(), Estimate(), Estimate())
"""Asymmetry and bands of a matrix that can't be inverted."""

SINGULAR = 1e10
"""Condition number beyond which H isn't inverted."""

ROW_TOLERANCE = 1e-2
"""Central differences of 0.05 leave curvature of third order in a row's sum."""


@dataclass(frozen=True)
class ResponseMatrices:
    """Responses of r runs.

    Attributes:
        log: Change of ln|a| + j psi against the base, whenever each run started, shape (r, m).
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

    def select(self, chosen: Sequence[int]) -> ResponseMatrices:
        """Return some of the runs."""
        index = list(chosen)
        numbers = ("log", "log_gain_variance", "phase_variance", "dof")
        return replace(self, **{name: getattr(self, name)[index] for name in numbers})


def central_differences(
    kicks: Sequence[Kick], answers: ResponseMatrices, kind: KickKind
) -> tuple[NoisyMatrix, NoisyMatrix]:
    """Return derivatives of phase and of log amplitude with respect to one kind of kick.

    Args:
        kicks: Of r runs.

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
    both_ways = sides(kicks, kind)
    for j in range(m):
        if j not in both_ways:
            raise UsageError(
                f"joint {j + 1} of {m}: its command's {kind.value} is not kicked both up and down; "
                "record both, a difference to one side keeps the curvature"
            )
        up, down = both_ways[j]
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
    both = None if errors is None else errors.correlation
    shared = (None, None) if both is None else (both[:m, :m], both[m:, m:])
    phase, log_gain = map(NoisyMatrix, value, error, dof, shared)
    return phase, log_gain


def row_sums(matrix: NoisyMatrix) -> NoisyMatrix:
    """Return sums over the columns: 1 for P, 0 for R, by time shift.

    Args:
        matrix: P or R.

    Returns:
        Sums with their errors; the columns' runs are different ones, so variances add. Their
        degrees of freedom add only where each column's error is estimated by itself.
    """
    parts = matrix.error.T**2
    shared = matrix.correlation is not None
    dof = matrix.dof.min(axis=1) if shared else welch_satterthwaite(parts, matrix.dof.T)
    return NoisyMatrix(matrix.value.sum(axis=1), np.sqrt(parts.sum(axis=0)), dof)


def nonlinearity(
    P: NoisyMatrix,
    R: NoisyMatrix,
    G: NoisyMatrix,
    S: NoisyMatrix,
    *,
    correlation: FloatArray | None = None,
) -> Estimate:
    """Return the departure from a linear time-invariant system.

    Args:
        P: d psi / d psi_c.
        R: d ln|a| / d psi_c.
        G: d ln|a| / d ln|c|.
        S: d psi / d ln|c|.
        correlation: Of one run's errors, psi of all joints and then ln|a|, shape (2 m, 2 m); None
            where they are independent.

    Returns:
        ||(G - P, S + R)|| / ||(P, R)|| (Frobenius), with what noise adds taken off; interval by
        :func:`.analysis.estimators.intervals.norm_ratio`.
    """
    m = len(P.value)
    noise = noise_draws(stacked(((P, S), (R, G)), correlation), 1)
    halves = (slice(m), slice(m, None))
    of_p, of_s, of_r, of_g = (noise[:, rows, columns] for rows in halves for columns in halves)
    return norm_ratio(
        np.stack([G.value - P.value, S.value + R.value]),
        np.stack([of_g - of_p, of_s + of_r], axis=1),
        np.stack([P.value, R.value]),
        np.stack([of_p, of_r], axis=1),
    )


def stacked(blocks: Sequence[Sequence[NoisyMatrix]], correlation: FloatArray | None) -> NoisyMatrix:
    """Return one matrix of several, for errors that they have in common.

    Args:
        blocks: Rows of matrices; those of one row answer the same way, those of one column are of
            the same kicks.
        correlation: Of a column's errors.
    """

    def block(part: str) -> FloatArray:
        return np.block([[getattr(matrix, part) for matrix in row] for row in blocks])

    return NoisyMatrix(block("value"), block("error"), block("dof"), correlation)


def lti_reading(
    P: NoisyMatrix,
    R: NoisyMatrix,
    response: ComplexArray,
    command: ComplexArray,
    *,
    correlation: FloatArray | None = None,
) -> Lti:
    """Read P and R as those of a linear time-invariant system.

    Args:
        P: d psi / d psi_c.
        R: d ln|a| / d psi_c.
        response: Complex amplitudes a of the base gait, shape (m,).
        command: Complex amplitudes c of the base gait, shape (m,).
        correlation: Of one run's errors, psi of all joints and then ln|a|, or None.

    Returns:
        The reading; asymmetry and bands are empty where H is singular.
    """
    scale = response[:, None] / command[None, :]
    H = (scale * (P.value - 1j * R.value)).astype(np.complex128)
    condition = float(np.linalg.cond(H))
    shape = UNKNOWN_SHAPE
    if condition < SINGULAR:
        X: ComplexArray = np.linalg.inv(H).astype(np.complex128)
        draws = noise_draws(stacked(((P,), (R,)), correlation), 11)
        noise = scale * (draws[:, : len(H)] - 1j * draws[:, len(H) :])
        shape = reciprocity(X, np.linalg.inv(H + noise).astype(np.complex128) - X)
    finite = condition if np.isfinite(condition) else None
    return Lti(LTI_LABEL, rows_of(H.real), rows_of(H.imag), finite, *shape)


def reciprocity(
    X: ComplexArray, error: ComplexArray
) -> tuple[Estimate, Estimate, Estimate, Estimate]:
    """Return asymmetry and reach of a matrix off its diagonal.

    Args:
        X: An impedance, or what stands for one, shape (m, m).
        error: Errors that it may have, shape (DRAWS, m, m).

    Returns:
        ||X - X'|| / ||X||, and the share of the energy within each of ``BANDS``.
    """
    place = np.arange(len(X))
    distance = np.abs(place[:, None] - place[None, :])
    outside: FloatArray = (distance > 0).astype(np.float64)
    off: ComplexArray = X * outside
    off_error: ComplexArray = error * outside
    asymmetry = norm_ratio(off - off.T, off_error - off_error.swapaxes(1, 2), off, off_error)
    within_1, within_2, within_3 = (
        squared(norm_ratio(off * (distance <= b), off_error * (distance <= b), off, off_error))
        for b in BANDS
    )
    return asymmetry, within_1, within_2, within_3


def squared(share: Estimate) -> Estimate:
    """Return the energy from a ratio of norms.

    Args:
        share: Of a norm in the whole's.

    Returns:
        Share of the energy, at most 1.
    """
    if share.value is None:
        return share
    value, *ends = (min(1.0, ratio**2) for ratio in (share.value, *(share.ci95 or ())))
    return Estimate(value, (ends[0], ends[1]) if ends else None)


@dataclass(frozen=True)
class LocalMatrices:
    """Matrices of kicks around one gait.

    Attributes:
        P: d psi / d psi_c.
        R: d ln|a| / d psi_c.
        G: d ln|a| / d ln|c|, or None.
        S: d psi / d ln|c|, or None.
        steady_errors: The same from combinations of runs that no second order of a kick enters.
        phase_rows: Sums of rows of P, with errors estimated without these sums.
        gain_rows: Of R.
        agree: Whether each sum of P, then of R, is 1 or 0 within its error, all together at 95 %,
            shape (2, m).
        widened: Factor on the errors of each joint's phase, then log amplitude, shape (2, m).
    """

    P: NoisyMatrix
    R: NoisyMatrix
    G: NoisyMatrix | None
    S: NoisyMatrix | None
    errors: RunErrors
    steady_errors: RunErrors
    phase_rows: NoisyMatrix
    gain_rows: NoisyMatrix
    agree: BoolArray
    widened: FloatArray


def local_matrices(
    kicks: Sequence[Kick | None], answers: ResponseMatrices, *, amplitude: bool
) -> LocalMatrices:
    """Estimate the matrices.

    Args:
        kicks: Of r runs, None of one of the base gait.
        amplitude: Whether amplitudes are kicked both ways, too.
    """
    kicked = [k for k, kick in enumerate(kicks) if kick is not None]
    used = [kick for kick in kicks if kick is not None]
    of_kicks = answers.select(kicked)

    def differences(errors: RunErrors | None, kind: KickKind) -> tuple[NoisyMatrix, NoisyMatrix]:
        return central_differences(used, replace(of_kicks, errors=errors), kind)

    phase, log_gain = differences(None, KickKind.PHASE)
    derivatives = ((phase.value - 1j * log_gain.value).astype(np.complex128), None)
    if amplitude:
        phase, log_gain = differences(None, KickKind.AMPLITUDE)
        derivatives = (derivatives[0], (log_gain.value + 1j * phase.value).astype(np.complex128))
    variance = np.hstack([answers.phase_variance, answers.log_gain_variance])
    without, errors, steady = (
        run_errors(kicks, answers.log, variance, derivatives, pairs=pairs, rows=rows)
        for pairs, rows in ((True, False), (True, True), (False, True))
    )
    sums = [row_sums(difference) for difference in differences(without, KickKind.PHASE)]
    agree = np.stack([_agree(total, to) for total, to in zip(sums, (1.0, 0.0), strict=True)])
    widened = np.stack(list(map(_widening, sums, (1.0, 0.0), agree)))
    P, R = _widen(differences(errors, KickKind.PHASE), widened)
    S, G = _widen(differences(errors, KickKind.AMPLITUDE), widened) if amplitude else (None, None)
    return LocalMatrices(P, R, G, S, errors, steady, sums[0], sums[1], agree, widened)


def _agree(sums: NoisyMatrix, expected: float) -> BoolArray:
    """Return whether each sum is as expected, all 2 m of P and R together at 95 %."""
    quantile = stdtrit(sums.dof, 1 - (1 - CONFIDENCE) / (4 * len(sums.value)))
    return np.abs(sums.value - expected) <= ROW_TOLERANCE + sums.error * quantile


def _widening(sums: NoisyMatrix, expected: float, agree: BoolArray) -> FloatArray:
    """Return the factor on each row's errors; 1 where all sums agree."""
    if agree.all():
        return np.ones(len(agree))
    off = np.abs(sums.value - expected) / np.maximum(sums.error, np.finfo(float).tiny)
    return np.maximum(np.where(agree, 1.0, off), max(1.0, float(np.sqrt(np.mean(off**2)))))


def _widen(
    pair: tuple[NoisyMatrix, NoisyMatrix], factor: FloatArray
) -> tuple[NoisyMatrix, NoisyMatrix]:
    """Multiply the errors by each row's factor, which as many sums determine."""
    m = len(factor[0])

    def wider(matrix: NoisyMatrix, by: FloatArray) -> NoisyMatrix:
        if np.all(by == 1.0):
            return matrix
        return replace(matrix, error=matrix.error * by[:, None], dof=np.minimum(matrix.dof, m))

    return wider(pair[0], factor[0]), wider(pair[1], factor[1])
