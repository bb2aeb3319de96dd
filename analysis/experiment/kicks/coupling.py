"""From the runs of a kick experiment to its coupling: orchestration of :mod:`.local`."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.special import stdtrit

from undulog.capture.common.arrays import ComplexArray
from undulog.capture.common.console import Warn

from ...estimators.intervals import CONFIDENCE
from ...results.coupling import (
    LTI_LABEL,
    BaseResponse,
    Coupling,
    HeldOut,
    LocalCoupling,
    Lti,
    Matrix,
    RowCheck,
    RunScatter,
    rows_of,
)
from ...results.estimate import Estimate
from .experiment import KickExperiment
from .local import Answers, Measured, RowSums, answers_of, nonlinearity
from .lti_reading import LtiReading, lti_reading
from .matrices import LocalMatrices, local_matrices
from .runs import Kind, missing_kicks
from .scatter import RunErrors
from .size import kick_size
from .validity import Prediction, predict, valid_to


def kick_coupling(experiment: KickExperiment, warn: Warn) -> Coupling:
    """Estimate the local matrices, check them, and say how far they hold.

    Args:
        experiment: Its runs.
        warn: Takes one sentence for each thing that is missing or doubtful.

    Returns:
        A :class:`LocalCoupling`; or not identifiable, with the reason and what to record.
    """
    kicks = experiment.runs.kicks
    used = [*experiment.runs.base, *kicks]
    m = len(experiment.names)
    plan = f"phase-kicks around this gait ({4 * m} runs and one without a kick)"
    known = np.isfinite(experiment.ratio[used])
    lost = [name for i, name in enumerate(experiment.names) if not known[:, i].all()]
    if lost:
        return Coupling(
            identifiable=False,
            why=f"{', '.join(lost)}: gain and lag are not known in every run, so rows of the "
            "matrices are missing",
            record=plan,
        )
    lacking = missing_kicks(list(kicks.values()), Kind.PHASE, experiment.names)
    if lacking:
        return Coupling(
            identifiable=False,
            why="central differences need each joint's phase kicked both up and down by the same "
            f"size; kicked is {'; '.join(lacking)}",
            record=plan,
        )
    first = experiment.ratio[experiment.runs.base[0]]
    others = np.log(experiment.ratio[list(experiment.runs.base)] / first)
    base = (first * np.exp(others.mean(axis=0))).astype(np.complex128)
    deviation = experiment.runs.deviation
    change = answers_of(deviation, experiment.ratio, base)
    each = [kicks.get(k) for k in used]
    answers = Answers(
        change[used],
        experiment.log_gain_variance[used],
        experiment.lag_variance[used],
        experiment.dof[used],
    )
    found = local_matrices(each, answers, amplitude=_has_amplitude(experiment, warn))
    P, R, G, S = found.P, found.R, found.G, found.S
    correlation = found.errors.correlation
    size = kick_size(each, answers, found)
    reading = lti_reading(
        P, R, base * experiment.command, experiment.command, correlation=correlation
    )
    held = _held_out(experiment, change, base, found)
    reached = valid_to([one for _, one in held])
    passed = bool(found.agree.all())
    if not passed:
        warn(
            "rows of P don't sum to 1, or rows of R to 0, within their errors, as shifting time "
            "demands of any settled gait: let each run settle longer before it is measured; errors "
            f"are widened by up to {found.widened.max():.2g}"
        )
    if size.why is not None:
        warn(size.why)
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
    return LocalCoupling(
        identifiable=True,
        why=f"central differences of {len(kicks)} kicks around one gait",
        matrix=rows_of(P.value),
        condition_number=_finite(reading.condition_number),
        joints=experiment.names,
        base_runs=len(experiment.runs.base),
        kicked_runs=len(kicks),
        P=_matrix(P),
        R=_matrix(R),
        G=None if G is None else _matrix(G),
        S=None if S is None else _matrix(S),
        phase_rows=_rows(experiment.names, found.phase_rows, 1.0),
        gain_rows=_rows(experiment.names, found.gain_rows, 0.0),
        checks_pass=passed,
        nonlinearity=Estimate()
        if G is None or S is None
        else nonlinearity(P, R, G, S, correlation=correlation),
        lti=_lti(reading),
        held_out=tuple(
            HeldOut(experiment.labels[k], one.size, one.error, one.error_kept, one.noise)
            for k, one in held
        ),
        valid_to=reached,
        base=_base_response(experiment, base, found.errors),
        scatter=_scatter(found),
        kick_size=size,
    )


def _has_amplitude(experiment: KickExperiment, warn: Warn) -> bool:
    """Whether S and G can be told; warns where amplitudes were not kicked both ways."""
    lacking = missing_kicks(list(experiment.runs.kicks.values()), Kind.AMPLITUDE, experiment.names)
    if lacking:
        warn(
            "G, S and the nonlinearity are null: they need each joint's amplitude kicked both up "
            f"and down by the same size; kicked is {'; '.join(lacking)}"
        )
    return not lacking


def _held_out(
    experiment: KickExperiment,
    change: ComplexArray,
    base: ComplexArray,
    found: LocalMatrices,
) -> list[tuple[int, Prediction]]:
    """The held-out runs, by their place in the experiment."""
    P, R, G, S = found.P, found.R, found.G, found.S
    matrices = (
        P.value,
        R.value,
        None if G is None else G.value,
        None if S is None else S.value,
    )
    between = found.errors.between.reshape(2, -1).sum(axis=0)
    variance = experiment.log_gain_variance + experiment.lag_variance + between
    return [
        (
            k,
            predict(
                experiment.runs.deviation[k],
                change[k],
                variance[k],
                base * experiment.command,
                matrices,
            ),
        )
        for k in experiment.runs.patterns
        if np.isfinite(change[k]).all()
    ]


def _rows(names: Sequence[str], sums: RowSums, expected: float) -> tuple[RowCheck, ...]:
    """Sums with their intervals, one by one."""
    half = sums.error * stdtrit(sums.dof, 0.5 + CONFIDENCE / 2)
    return tuple(
        RowCheck(
            name,
            expected,
            Estimate(float(total), (float(total - wide), float(total + wide))),
            float(error),
        )
        for name, total, wide, error in zip(names, sums.value, half, sums.error, strict=True)
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


def _scatter(found: LocalMatrices) -> RunScatter:
    m = len(found.P.value)
    between, within = np.sqrt(found.errors.between), np.sqrt(found.errors.within)
    return RunScatter(
        tuple(between[:m].tolist()),
        tuple(between[m:].tolist()),
        tuple(within[:m].tolist()),
        tuple(within[m:].tolist()),
        found.errors.dof,
        rows_of(found.errors.correlation),
        float(found.widened.max()),
    )


def _lti(reading: LtiReading) -> Lti:
    return Lti(
        LTI_LABEL,
        rows_of(reading.H.real),
        rows_of(reading.H.imag),
        _finite(reading.condition_number),
        reading.asymmetry,
        *reading.band_energy,
    )


def _matrix(matrix: Measured) -> Matrix:
    return Matrix(
        rows_of(matrix.value),
        rows_of(matrix.error),
        rows_of(matrix.half),
        rows_of(matrix.half_together),
    )


def _finite(value: float) -> float | None:
    return value if np.isfinite(value) else None
