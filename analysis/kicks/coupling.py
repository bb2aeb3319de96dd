"""From the runs of a kick experiment to its coupling: orchestration of :mod:`.local`."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.special import stdtrit

from capture.arrays import ComplexArray

from ..reading import Warn
from ..response import CONFIDENCE
from ..results.analysis import Coupling, Estimate
from ..results.coupling import (
    LTI_LABEL,
    HeldOut,
    LocalCoupling,
    Lti,
    Matrix,
    RowCheck,
    rows_of,
)
from .experiment import KickExperiment
from .local import (
    Answers,
    Measured,
    answers_of,
    central_differences,
    nonlinearity,
    row_sums,
)
from .lti_reading import LtiReading, lti_reading
from .runs import Kind, missing_kicks
from .validity import Prediction, predict, valid_to

ROW_TOLERANCE = 1e-2
"""Central differences of 0.05 leave curvature of third order in a row's sum."""


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
    base = np.exp(np.log(experiment.ratio[list(experiment.runs.base)]).mean(axis=0))
    deviation = experiment.runs.deviation
    change = answers_of(deviation, experiment.ratio, base)
    chosen = list(kicks)
    answers = Answers(
        change[chosen],
        experiment.log_gain_variance[chosen],
        experiment.lag_variance[chosen],
        experiment.dof[chosen],
    )
    P, R = central_differences(list(kicks.values()), answers, Kind.PHASE)
    S, G = _of_amplitude(experiment, answers, warn) or (None, None)
    reading = lti_reading(P, R, base * experiment.command, experiment.command)
    held = _held_out(experiment, change, base, (P, R, G, S))
    reached = valid_to([one for _, one in held])
    rows = [
        *_rows(experiment.names, P, 1.0),
        *_rows(experiment.names, R, 0.0),
    ]
    checks = [one for one, _ in rows]
    passed = all(good for _, good in rows)
    if not passed:
        warn(
            "rows of P don't sum to 1, or rows of R to 0, within their errors, as shifting time "
            "demands of any settled gait: let each run settle longer before it is measured"
        )
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
        phase_rows=tuple(checks[:m]),
        gain_rows=tuple(checks[m:]),
        checks_pass=passed,
        nonlinearity=Estimate() if G is None or S is None else nonlinearity(P, R, G, S),
        lti=_lti(reading),
        held_out=tuple(
            HeldOut(experiment.labels[k], one.size, one.error, one.error_kept, one.noise)
            for k, one in held
        ),
        valid_to=reached,
    )


def _of_amplitude(
    experiment: KickExperiment, answers: Answers, warn: Warn
) -> tuple[Measured, Measured] | None:
    """S and G, or None with a warning where amplitudes were not kicked both ways."""
    kicks = list(experiment.runs.kicks.values())
    lacking = missing_kicks(kicks, Kind.AMPLITUDE, experiment.names)
    if not lacking:
        return central_differences(kicks, answers, Kind.AMPLITUDE)
    warn(
        "G, S and the nonlinearity are null: they need each joint's amplitude kicked both up and "
        f"down by the same size; kicked is {'; '.join(lacking)}"
    )
    return None


def _held_out(
    experiment: KickExperiment,
    change: ComplexArray,
    base: ComplexArray,
    measured: tuple[Measured, Measured, Measured | None, Measured | None],
) -> list[tuple[int, Prediction]]:
    """The held-out runs, by their place in the experiment."""
    P, R, G, S = measured
    matrices = (
        P.value,
        R.value,
        None if G is None else G.value,
        None if S is None else S.value,
    )
    variance = experiment.log_gain_variance + experiment.lag_variance
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


def _rows(names: Sequence[str], matrix: Measured, expected: float) -> list[tuple[RowCheck, bool]]:
    """Sums with their intervals, and whether each agrees, all of 2 m rows together at 95 %."""
    sums = row_sums(matrix)
    one_by_one = sums.error * stdtrit(sums.dof, 0.5 + CONFIDENCE / 2)
    together = sums.error * stdtrit(sums.dof, 1 - (1 - CONFIDENCE) / (4 * len(names)))
    return [
        (
            RowCheck(
                name,
                expected,
                Estimate(float(total), (float(total - half), float(total + half))),
                float(error),
            ),
            bool(abs(total - expected) <= ROW_TOLERANCE + bound),
        )
        for name, total, half, bound, error in zip(
            names, sums.value, one_by_one, together, sums.error, strict=True
        )
    ]


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
    return Matrix(rows_of(matrix.value), rows_of(matrix.error), rows_of(matrix.half))


def _finite(value: float) -> float | None:
    return value if np.isfinite(value) else None
