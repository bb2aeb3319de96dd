"""P, R, G and S with errors that hold whether or not runs differ by more than their own noise.

Rows of P must sum to 1 and rows of R to 0. That is checked against errors which know nothing of
those sums; where it fails in spite of the scatter between runs, something else is wrong in every
run (most often they had not settled), and the errors are widened until the sums agree (the scale
factor of the Particle Data Group, Review of Particle Physics, Introduction, section 5.2.2).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import stdtrit

from undulog.capture.common.arrays import BoolArray, FloatArray

from ...estimators.intervals import CONFIDENCE
from .local import Answers, Measured, RowSums, central_differences, row_sums
from .runs import Kick, Kind
from .scatter import RunErrors, run_errors

ROW_TOLERANCE = 1e-2
"""Central differences of 0.05 leave curvature of third order in a row's sum."""


@dataclass(frozen=True)
class LocalMatrices:
    """What kicks around one gait say.

    Attributes:
        P: d psi / d psi_c.
        R: d ln|a| / d psi_c.
        G: d ln|a| / d ln|c|, or None.
        S: d psi / d ln|c|, or None.
        errors: How much runs differ.
        steady_errors: The same from combinations of runs that no second order of a kick enters.
        phase_rows: Sums of rows of P, with errors that know nothing of these sums.
        gain_rows: Of R.
        agree: Whether each sum of P, then of R, is 1 or 0 within its error, all together at 95 %,
            shape (2, m).
        widened: Factor on the errors of each joint's phase, then log amplitude, shape (2, m).
    """

    P: Measured
    R: Measured
    G: Measured | None
    S: Measured | None
    errors: RunErrors
    steady_errors: RunErrors
    phase_rows: RowSums
    gain_rows: RowSums
    agree: BoolArray
    widened: FloatArray


def local_matrices(
    kicks: Sequence[Kick | None], answers: Answers, *, amplitude: bool
) -> LocalMatrices:
    """Estimate the matrices.

    Args:
        kicks: Of r runs, None of one of the base gait.
        answers: Of the same runs.
        amplitude: Whether amplitudes are kicked both ways, too.

    Returns:
        The matrices.
    """
    kicked = [k for k, one in enumerate(kicks) if one is not None]
    each = [one for one in kicks if one is not None]
    of_kicks = Answers(
        answers.log[kicked],
        answers.log_gain_variance[kicked],
        answers.phase_variance[kicked],
        answers.dof[kicked],
    )

    def differences(errors: RunErrors | None, kind: Kind) -> tuple[Measured, Measured]:
        return central_differences(each, replace(of_kicks, errors=errors), kind)

    phase, log_gain = differences(None, Kind.PHASE)
    derivatives = ((phase.value - 1j * log_gain.value).astype(np.complex128), None)
    if amplitude:
        phase, log_gain = differences(None, Kind.AMPLITUDE)
        derivatives = (derivatives[0], (log_gain.value + 1j * phase.value).astype(np.complex128))
    variance = np.hstack([answers.phase_variance, answers.log_gain_variance])
    without, errors, steady = (
        run_errors(kicks, answers.log, variance, derivatives, pairs=pairs, rows=rows)
        for pairs, rows in ((True, False), (True, True), (False, True))
    )
    sums = [row_sums(one) for one in differences(without, Kind.PHASE)]
    agree = np.stack([_agree(one, to) for one, to in zip(sums, (1.0, 0.0), strict=True)])
    widened = np.stack(
        [_widening(one, to, good) for one, to, good in zip(sums, (1.0, 0.0), agree, strict=True)]
    )
    P, R = _widen(differences(errors, Kind.PHASE), widened)
    S, G = _widen(differences(errors, Kind.AMPLITUDE), widened) if amplitude else (None, None)
    return LocalMatrices(P, R, G, S, errors, steady, sums[0], sums[1], agree, widened)


def _agree(sums: RowSums, expected: float) -> BoolArray:
    """Whether each sum is as expected, all 2 m of P and R together at 95 %."""
    quantile = stdtrit(sums.dof, 1 - (1 - CONFIDENCE) / (4 * len(sums.value)))
    return np.abs(sums.value - expected) <= ROW_TOLERANCE + sums.error * quantile


def _widening(sums: RowSums, expected: float, agree: BoolArray) -> FloatArray:
    """Factor on each row's errors; 1 where all sums agree."""
    if agree.all():
        return np.ones(len(agree))
    off = np.abs(sums.value - expected) / np.maximum(sums.error, np.finfo(float).tiny)
    return np.maximum(np.where(agree, 1.0, off), max(1.0, float(np.sqrt(np.mean(off**2)))))


def _widen(pair: tuple[Measured, Measured], factor: FloatArray) -> tuple[Measured, Measured]:
    """Errors times each row's factor, which so many sums tell."""
    m = len(factor[0])

    def wider(one: Measured, by: FloatArray) -> Measured:
        if np.all(by == 1.0):
            return one
        return replace(one, error=one.error * by[:, None], dof=np.minimum(one.dof, m))

    return wider(pair[0], factor[0]), wider(pair[1], factor[1])
