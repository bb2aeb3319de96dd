"""Several runs of one gait in one direction, pooled into one response.

ln H of a joint in a run is that of the gait, plus what the run does (the robot is put down anew),
plus the noise within the run. The mean over r runs has the variance (tau^2 + sigma^2) / r. The
scatter from run to run estimates tau^2 + sigma^2 with r - 1 degrees of freedom, whatever its
distribution over the joints; where it happens to fall below the noise within the runs, which is
known better, that takes its place, with no more degrees of freedom: the interval of the mean then
covers at least 95 %.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import helmert

from undulog.capture.common.arrays import ComplexArray, FloatArray, frozen
from undulog.capture.common.errors import UsageError
from undulog.capture.judgement.fault import Judgement
from undulog.capture.robot.model import Robot

from ..common.answer import Answer, NotFollowing
from ..common.estimate import Interval
from ..parts.comparison.answer import Facts, compose
from ..parts.comparison.examine import Chain, examine
from ..parts.comparison.profile import Scatter
from ..parts.heterogeneity.measure import spread
from ..parts.heterogeneity.result import Index
from ..response.response import Response
from ..results.analysis import Analysis
from ..results.experiment import Reversal
from ..signals.columns import by_plane
from .mirror import MIN_RUNS, parts

_LABELS = {
    "mirror_response": ("1", "T of H1: identical modules, by reversal"),
    "module_share": ("1", "share of the spread due to the modules"),
    "boundary_share": ("1", "share of the spread that identical modules show, too"),
    "equivalence_mirror_gain": (
        "1",
        "largest difference of ln gain from the mirror; H1: all in 2 %",
    ),
    "equivalence_mirror_lag": (
        "rad",
        "largest difference of lag from the mirror; H1: all in 1 degree",
    ),
}
"""Unit and label of each index of a reversal."""


def experiment_indices(
    forward: ComplexArray, reverse: ComplexArray, reversal: Reversal | None
) -> dict[str, Index]:
    """Return H0, H1 and H2 as indices.

    Args:
        forward: y of the runs one way, shape (r1, m).
        reverse: y of the runs the other way, shape (r2, m).
        reversal: The test of both, or None.

    Returns:
        ``common_response`` (H0: the same gain and delay at every joint, in each way that has
        runs enough), ``mirror_response`` (H1: T of identical modules), ``module_share`` and
        ``boundary_share`` (H2), ``equivalence_mirror_gain`` and ``equivalence_mirror_lag``. None
        where they can't be computed.
    """
    values: dict[str, tuple[float | None, Interval | None, float | None]] = {}
    if reversal is not None:
        module, boundary = reversal.module_share, reversal.boundary_share
        gain = max(abs(joint.log_gain_difference.value or 0.0) for joint in reversal.joints)
        lag = max(abs(joint.lag_difference_rad.value or 0.0) for joint in reversal.joints)
        values = {
            "mirror_response": (reversal.statistic, None, reversal.p),
            "module_share": (module.value, module.ci95, reversal.p),
            "boundary_share": (boundary.value, boundary.ci95, None),
            "equivalence_mirror_gain": (gain, None, reversal.equivalence_gain_p),
            "equivalence_mirror_lag": (lag, None, reversal.equivalence_lag_p),
        }
    return {"common_response": _common_response([forward, reverse])} | {
        name: Index(*values.get(name, (None, None, None)), unit, label)
        for name, (unit, label) in _LABELS.items()
    }


def _common_response(ways: list[ComplexArray]) -> Index:
    """Return F of H0 over the means of each way's runs, each way about its own mean."""
    usable = [way for way in ways if len(way) >= MIN_RUNS and way.shape[1] > 1]
    ratio = p = None
    if usable:
        values = np.concatenate([parts(way.mean(axis=0)) for way in usable])
        variance = np.concatenate([parts(way).var(axis=0, ddof=1) / len(way) for way in usable])
        dof = np.full(usable[0].shape[1], min(len(way) for way in usable) - 1.0)
        test = spread(values, variance, dof, blocks=2 * len(usable))
        if test.expected != 0:
            ratio, p = test.ratio, test.p
    label = "F of H0: all joints have the same gain and delay, noise from run to run"
    return Index(ratio, None, p, "1", label)


@dataclass(frozen=True)
class PooledResponse:
    """Response of m joints over r runs of one direction; arrays are read-only.

    Attributes:
        names: Joints that every run has gain and lag of, head to tail, m.
        runs: How many runs, r.
        response: Mean ln H with the variances of the mean; degrees of freedom r - 1, of one run
            its own.
        log_response: ln H of each run, the phases of a joint within pi of their mean, shape (r, m).
        covariance: Of the mean's parts, ln|H| of all joints, then arg H [rad], shape (2 m, 2 m).
    """

    names: tuple[str, ...]
    runs: int
    response: Response
    log_response: ComplexArray
    covariance: FloatArray


def pool_runs(names: Sequence[str], runs: Sequence[Response]) -> PooledResponse:
    """Pool the responses of several runs of the same gait.

    Args:
        names: Of the m joints, head to tail.
        runs: Response of the same joints in each run, r of them; NaN where a joint has none.

    Returns:
        The pooled response of the joints that all runs know.

    Raises:
        UsageError: If there is no run, or the runs are not of m joints.
    """
    if not runs or any(len(run.ratio) != len(names) for run in runs):
        raise UsageError(
            f"{[len(run.ratio) for run in runs]} joints in the runs, {len(names)} named: pooling "
            "needs at least one run, and the same joints in all"
        )
    sound = [
        np.isfinite(run.ratio) & np.isfinite(run.log_gain_variance) & np.isfinite(run.lag_variance)
        for run in runs
    ]
    shared = np.flatnonzero(np.all(sound, axis=0))
    chosen = [run.select(shared.tolist()) for run in runs]
    ratio = np.stack([run.ratio for run in chosen])
    turn: FloatArray = np.angle((ratio / np.abs(ratio)).sum(axis=0))
    phase = turn + np.angle(ratio * np.exp(-1j * turn))  # of a joint within pi of their mean
    log_response = (np.log(np.abs(ratio)) + 1j * phase).astype(np.complex128)
    mean = log_response.mean(axis=0)
    count, m = len(runs), len(shared)
    within = np.concatenate(
        [
            np.mean([run.log_gain_variance for run in chosen], axis=0),
            np.mean([run.lag_variance for run in chosen], axis=0),
        ]
    )
    if count > 1:
        centred = parts(log_response) - parts(log_response).mean(axis=0)
        scatter = centred.T @ centred / (count - 1)
        dof = np.full(m, count - 1.0)
    else:
        scatter = np.zeros((2 * m, 2 * m))
        dof = chosen[0].dof
    # Raised on the diagonal alone, which keeps the matrix positive semidefinite.
    raised = np.maximum(within - np.diag(scatter), 0.0)
    covariance = (scatter + np.diag(raised)) / count
    variance = np.diag(covariance)
    return PooledResponse(
        names=tuple(names[k] for k in shared.tolist()),
        runs=count,
        response=Response(
            ratio=frozen(np.exp(mean)),
            log_gain_variance=frozen(variance[:m].copy()),
            lag_variance=frozen(variance[m:].copy()),
            dof=frozen(dof),
        ),
        log_response=frozen(log_response),
        covariance=frozen(covariance),
    )


def pooled_answer(
    robot: Robot | None, pooled: PooledResponse, sessions: Sequence[Analysis]
) -> Answer:
    """Answer from several runs of one gait.

    Args:
        robot: The robot, or None; then all joints are one chain.
        pooled: The response over the runs, two or more of them.

    Returns:
        The answer; intervals contain the scatter from run to run.
    """
    faulty: dict[str, NotFollowing] = {}
    for session in sessions:
        for fault in session.answer.not_following:
            faulty.setdefault(fault.joint, fault)
    commanded = [joint.name for joint in sessions[0].joints if joint.command_amplitude_rad]
    gains = _scatter(pooled.log_response.real, pooled.response.log_gain_variance)
    lags = _scatter(pooled.log_response.imag, pooled.response.lag_variance)
    chains: list[Chain] = []
    for plane, names in by_plane(robot, commanded).items():
        sound = [name for name in names if name in pooled.names and name not in faulty]
        index = [pooled.names.index(name) for name in sound]
        scatter = (gains.select(index), lags.select(index))
        response = pooled.response.select(index)
        chains.append(Chain(plane, 0, tuple(names), tuple(sound), response, scatter=scatter))
    first = sessions[0]
    order: Mapping[str, int] = {joint.name: k for k, joint in enumerate(first.joints)}
    return compose(
        Facts(
            gait=first.gait,
            joints=first.joints,
            commanded=tuple(commanded),
            not_following=tuple(sorted(faulty.values(), key=lambda fault: order[fault.joint])),
            findings=examine(chains),
            judgement=_first_of_each_joint([session.answer for session in sessions]),
            warnings=first.warnings,
        )
    )


def _first_of_each_joint(answers: Sequence[Answer]) -> Judgement:
    """Return what the judgements of several sessions found, once a joint."""
    changes = {change.joint: change for answer in answers[::-1] for change in answer.changes}
    extra = {motion.joint: motion for answer in answers[::-1] for motion in answer.extra}
    rests = {rest.joint: rest for answer in answers[::-1] for rest in answer.rests}
    apart = {
        (deviation.joint, deviation.quantity): deviation
        for answer in answers[::-1]
        for deviation in answer.apart
    }
    return Judgement(
        changes=tuple(changes.values()),
        extra=tuple(extra.values()),
        rests=tuple(rests.values()),
        apart=tuple(apart.values()),
    )


def _scatter(values: FloatArray, variance: FloatArray) -> Scatter:
    """Return the scatter of the mean of values (r, m): r - 1 columns, and added noise (m,)."""
    runs = len(values)
    # Helmert's contrasts between the runs are orthonormal, so the columns are independent.
    columns = (helmert(runs) @ (values - values.mean(axis=0))).T / runs**0.5
    raised: FloatArray = np.maximum(variance - np.mean(columns**2, axis=1), 0.0)
    return Scatter(columns, raised, np.zeros_like(raised))
