"""From the runs of a kick experiment to its coupling: orchestration of :mod:`.local_coupling`.

Are the kicks too small for the noise, or too large for a derivative?

Small ones leave P open: an element off the diagonal must exceed its interval, all elements
together, to be shown. Large ones leave its third order in a central difference. With y+ and y- what
a kick up and a kick down changed, (y+ + y-)/2 is of second order and (y+ - y-)/2 of first; where
their ratio is q, the third order is some q^2 of the first.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from scipy.special import stdtrit

from undulog.capture.common.arrays import ComplexArray, FloatArray
from undulog.capture.common.console import Warn

from ..common.estimate import Estimate
from ..estimators.intervals import CONFIDENCE, NoisyMatrix, around
from ..results.coupling import (
    BaseResponse,
    Coupling,
    HeldOut,
    KickSize,
    LocalCoupling,
    Matrix,
    RowCheck,
    RunScatter,
    rows_of,
)
from .kick_runs import MOST_KICK, Kick, KickExperiment, KickKind, missing_kicks
from .local_coupling import (
    LocalMatrices,
    ResponseMatrices,
    local_matrices,
    lti_reading,
    nonlinearity,
)
from .run_scatter import RunErrors, sides

RESOLVED = 0.1
"""Coupling between joints that kicks should be able to show: what the robot's body brings back with
more counts as strong (:data:`.analysis.oscillators.laplacian.STRONG`)."""

CURVED = 0.3
"""Second order over first order, from which the third may be a tenth of the first."""

BETTER = 2.0
"""P holds where it predicts so many times better than 'each joint keeps its H_i'."""


def kick_size(
    kicks: Sequence[Kick | None], answers: ResponseMatrices, matrices: LocalMatrices
) -> KickSize:
    """Judge the size of the kicks.

    Args:
        kicks: Of r runs, None of one of the base gait.
    """
    sizes = {
        kind: [abs(kick.size) for kick in kicks if kick is not None and kick.kind is kind]
        for kind in KickKind
    }
    phase = float(np.mean(sizes[KickKind.PHASE]))
    amplitude = float(np.mean(sizes[KickKind.AMPLITUDE])) if sizes[KickKind.AMPLITUDE] else None
    m = len(matrices.P.value)
    resolved = float(np.median(matrices.P.half_together[~np.eye(m, dtype=bool)]))
    curvature = _curvature(kicks, answers, matrices)
    verdict, why = "fits", None
    largest = max(phase, amplitude or 0.0)
    if largest > MOST_KICK:
        verdict = "too large"
        why = (
            f"kicks of {largest:.2g} are too large for a derivative (at most {MOST_KICK:g} rad or "
            "log amplitude): record kicks of 0.05"
        )
    elif curvature > CURVED:
        verdict = "too large"
        why = (
            f"kicks of {phase:.2g} rad are too large: what they do is "
            f"{100 * curvature:.0f} % of second order; record kicks of "
            f"{_rounded_down(phase * CURVED / (2 * curvature)):.2g} rad"
        )
    elif resolved > RESOLVED:
        verdict = "too small"
        why = (
            f"kicks of {phase:.2g} rad are too small for the noise and the scatter between runs: "
            f"they show couplings of {resolved:.2g} and more; to show {RESOLVED:g}, record "
            f"{_larger(phase, resolved / RESOLVED)}"
        )
    return KickSize(phase, amplitude, resolved, curvature, verdict, why)


def _larger(size: float, factor: float) -> str:
    """Describe the kicks that make intervals narrower by a factor."""
    if size * factor <= MOST_KICK:
        return f"kicks of {math.ceil(100 * size * factor) / 100:.2g} rad"
    largest = max(size, 0.1)
    repeats = math.ceil((factor * size / largest) ** 2)
    return f"kicks of {largest:.2g} rad, each {repeats} times"


def _rounded_down(size: float) -> float:
    digits = 1 - math.floor(math.log10(size))
    return math.floor(size * 10**digits) / 10**digits


def _curvature(
    kicks: Sequence[Kick | None], answers: ResponseMatrices, matrices: LocalMatrices
) -> float:
    """Return second over first order of the phase kicks, Frobenius norms over all joints."""
    errors = matrices.steady_errors
    variance = float(np.maximum(errors.variance, errors.within).sum())
    base = [k for k, kick in enumerate(kicks) if kick is None]
    middle = answers.log[base].mean(axis=0)
    even = odd = noise = 0.0
    for up, down in sides(kicks, KickKind.PHASE).values():
        high, low = answers.log[up].mean(axis=0), answers.log[down].mean(axis=0)
        even += float(np.sum(np.abs((high + low) / 2 - middle) ** 2))
        odd += float(np.sum(np.abs(high - low) ** 2)) / 4
        noise += variance * (0.25 / len(up) + 0.25 / len(down) + 1 / len(base))
    return (max(0.0, even - noise) / odd) ** 0.5 if odd > 0 else 0.0


def predict(
    deviation: ComplexArray,
    answered: ComplexArray,
    variance: FloatArray,
    response: ComplexArray,
    matrices: tuple[FloatArray, FloatArray, FloatArray | None, FloatArray | None],
    *,
    session: str = "",
) -> HeldOut:
    """Predict a run from its commands, and compare.

    Args:
        deviation: Of its commands, d ln|c| + j d psi_c, shape (m,).
        answered: d ln|a| + j d psi as measured, shape (m,).
        variance: Of ln|a| plus that of psi, shape (m,).
        response: Complex amplitudes of the base's responses, shape (m,).
        matrices: P, R, G, S; without G and S changes of amplitude are taken as G = P, S = -R.
    """
    P, R, gain, cross = matrices
    G, S = P if gain is None else gain, -R if cross is None else cross
    phase = P @ deviation.imag + S @ deviation.real
    log_amplitude = R @ deviation.imag + G @ deviation.real
    measured = response * np.exp(answered)
    whole = float(np.linalg.norm(measured))
    return HeldOut(
        session=session,
        size=float(max(np.abs(deviation.real).max(), np.abs(deviation.imag).max())),
        error=float(np.linalg.norm(response * np.exp(log_amplitude + 1j * phase) - measured))
        / whole,
        error_kept=float(np.linalg.norm(response * np.exp(deviation) - measured)) / whole,
        noise=float(np.sum(np.abs(measured) ** 2 * variance)) ** 0.5 / whole,
    )


def valid_to(predictions: Sequence[HeldOut]) -> float | None:
    """Return the largest deviation up to which all held-out runs are predicted well.

    Returns:
        The size of the last good run before the first bad one; None where the smallest is bad, or
        there is none.
    """
    reached: float | None = None
    for prediction in sorted(predictions, key=lambda p: p.size):
        if prediction.error * BETTER > prediction.error_kept:
            break
        reached = prediction.size
    return reached


def kick_coupling(experiment: KickExperiment, warn: Warn) -> Coupling:
    """Estimate the local matrices, check them, and find how far they hold.

    Args:
        warn: Receives a sentence for each missing or doubtful value.

    Returns:
        A :class:`LocalCoupling`; or not identifiable, with the reason and what to record.
    """
    kicks = experiment.runs.kicks
    used = [*experiment.runs.base, *kicks]
    m = len(experiment.names)
    plan = f"phase-kicks around this gait ({4 * m} runs and one without a kick)"
    finite = np.isfinite(experiment.ratio[used])
    if lost := [name for i, name in enumerate(experiment.names) if not finite[:, i].all()]:
        return Coupling(
            identifiable=False,
            why=f"{', '.join(lost)}: gain and lag are not known in every run, so rows of the "
            "matrices are missing",
            record=plan,
        )
    if lacking := missing_kicks(list(kicks.values()), KickKind.PHASE, experiment.names):
        return Coupling(
            identifiable=False,
            why="central differences need each joint's phase kicked both up and down by the same "
            f"size; kicked is {'; '.join(lacking)}",
            record=plan,
        )
    first = experiment.ratio[experiment.runs.base[0]]
    others = np.log(experiment.ratio[list(experiment.runs.base)] / first)
    base = (first * np.exp(others.mean(axis=0))).astype(np.complex128)
    # ln a = ln c + ln H, and both of a run's phases are counted from the same instant.
    change = experiment.runs.deviation + np.log(experiment.ratio / base)
    used_kicks = [kicks.get(k) for k in used]
    answers = ResponseMatrices(
        change, experiment.log_gain_variance, experiment.lag_variance, experiment.dof
    ).select(used)
    matrices = local_matrices(used_kicks, answers, amplitude=_has_amplitude(experiment, warn))
    P, R, G, S = matrices.P, matrices.R, matrices.G, matrices.S
    correlation = matrices.errors.correlation
    size = kick_size(used_kicks, answers, matrices)
    reading = lti_reading(
        P, R, base * experiment.command, experiment.command, correlation=correlation
    )
    held = _held_out(experiment, change, base, matrices)
    reached = valid_to(held)
    passed = bool(matrices.agree.all())
    if not passed:
        warn(
            "rows of P don't sum to 1, or rows of R to 0, within their errors, as shifting time "
            "demands of any settled gait: let each run settle longer before it is measured; errors "
            f"are widened by up to {matrices.widened.max():.2g}"
        )
    if size.why is not None:
        warn(size.why)
    _warn_of_range(held, reached, warn)
    return LocalCoupling(
        identifiable=True,
        why=f"central differences of {len(kicks)} kicks around one gait",
        matrix=rows_of(P.value),
        condition_number=reading.condition_number,
        joints=experiment.names,
        base_runs=len(experiment.runs.base),
        kicked_runs=len(kicks),
        P=_matrix(P),
        R=_matrix(R),
        G=None if G is None else _matrix(G),
        S=None if S is None else _matrix(S),
        phase_rows=_rows(experiment.names, matrices.phase_rows, 1.0),
        gain_rows=_rows(experiment.names, matrices.gain_rows, 0.0),
        checks_pass=passed,
        nonlinearity=Estimate()
        if G is None or S is None
        else nonlinearity(P, R, G, S, correlation=correlation),
        lti=reading,
        held_out=held,
        valid_to=reached,
        base=_base_response(experiment, base, matrices.errors),
        scatter=_scatter(matrices),
        kick_size=size,
    )


def _warn_of_range(held: Sequence[HeldOut], reached: float | None, warn: Warn) -> None:
    """Warn where it isn't known how far from the gait the matrices hold, or it is nowhere.

    Args:
        reached: Largest deviation up to which they predict [rad]; None for none.
    """
    if not held:
        warn(
            "how far from the gait the matrices hold isn't known: record held-out runs in which "
            "all joints' phases deviate by random amounts up to 0.15 rad"
        )
    elif reached is None:
        warn(
            "the matrices don't predict the smallest held-out pattern twice as well as 'each joint "
            "keeps its response'"
        )


def _has_amplitude(experiment: KickExperiment, warn: Warn) -> bool:
    """Return whether S and G can be estimated; warn of amplitudes not kicked both ways."""
    lacking = missing_kicks(
        list(experiment.runs.kicks.values()), KickKind.AMPLITUDE, experiment.names
    )
    if lacking:
        warn(
            "G, S and the nonlinearity are null: they need each joint's amplitude kicked both up "
            f"and down by the same size; kicked is {'; '.join(lacking)}"
        )
    return not lacking


def _held_out(
    experiment: KickExperiment, change: ComplexArray, base: ComplexArray, local: LocalMatrices
) -> tuple[HeldOut, ...]:
    """Predict the held-out runs."""
    G, S = local.G, local.S
    matrices = (
        local.P.value,
        local.R.value,
        None if G is None else G.value,
        None if S is None else S.value,
    )
    between = local.errors.between.reshape(2, -1).sum(axis=0)
    variance = experiment.log_gain_variance + experiment.lag_variance + between
    response = base * experiment.command
    deviation = experiment.runs.deviation
    return tuple(
        predict(
            deviation[k], change[k], variance[k], response, matrices, session=experiment.labels[k]
        )
        for k in experiment.runs.patterns
        if np.isfinite(change[k]).all()
    )


def _rows(names: Sequence[str], sums: NoisyMatrix, expected: float) -> tuple[RowCheck, ...]:
    """Return sums with their intervals, one by one."""
    half = sums.error * stdtrit(sums.dof, 0.5 + CONFIDENCE / 2)
    numbers = (values.tolist() for values in (sums.value, half, sums.error))
    return tuple(
        RowCheck(name, expected, Estimate(total, around(total, wide)), error)
        for name, total, wide, error in zip(names, *numbers, strict=True)
    )


def _base_response(
    experiment: KickExperiment, base: ComplexArray, errors: RunErrors
) -> BaseResponse:
    m, count = len(base), len(experiment.runs.base)
    error = np.sqrt(np.maximum(errors.variance, errors.within) / count)
    return BaseResponse(
        experiment.frequency_hz,
        tuple(np.abs(base).tolist()),
        tuple((-np.angle(base)).tolist()),
        tuple((np.abs(base) * error[m:]).tolist()),
        tuple(error[:m].tolist()),
    )


def _scatter(matrices: LocalMatrices) -> RunScatter:
    m = len(matrices.P.value)
    between, within = np.sqrt(matrices.errors.between), np.sqrt(matrices.errors.within)
    return RunScatter(
        tuple(between[:m].tolist()),
        tuple(between[m:].tolist()),
        tuple(within[:m].tolist()),
        tuple(within[m:].tolist()),
        matrices.errors.dof,
        rows_of(matrices.errors.correlation),
        float(matrices.widened.max()),
    )


def _matrix(matrix: NoisyMatrix) -> Matrix:
    parts = matrix.value, matrix.error, matrix.half, matrix.half_together
    return Matrix(*map(rows_of, parts))
