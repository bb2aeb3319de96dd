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

from undulog.capture.common.arrays import ComplexArray, FloatArray, IntArray, frozen
from undulog.capture.common.errors import UsageError
from undulog.capture.robot.model import Robot

from ..response.response import Response
from ..results.analysis import Analysis
from ..results.answer import Answer, NotFollowing
from ..segments.answer import Facts, compose
from ..segments.examine import Chain, examine
from ..segments.family import Scatter
from ..signals.reading import by_plane


@dataclass(frozen=True)
class PooledResponse:
    """Response of m joints over r runs of one direction; arrays are read-only.

    Attributes:
        names: Joints that every run has gain and lag of, head to tail, m.
        runs: How many runs, r.
        response: Mean ln H with the variances of the mean; degrees of freedom r - 1, of one run
            its own.
        each: ln H of each run, the phases of a joint within pi of their mean, shape (r, m).
        covariance: Of the mean's parts, ln|H| of all joints, then arg H [rad], shape (2 m, 2 m).
    """

    names: tuple[str, ...]
    runs: int
    response: Response
    each: ComplexArray
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
    if not runs or any(len(one.ratio) != len(names) for one in runs):
        raise UsageError(
            f"{[len(one.ratio) for one in runs]} joints in the runs, {len(names)} named: pooling "
            "needs at least one run, and the same joints in all"
        )
    sound = [
        np.isfinite(one.ratio) & np.isfinite(one.log_gain_variance) & np.isfinite(one.lag_variance)
        for one in runs
    ]
    known = np.flatnonzero(np.all(sound, axis=0))
    chosen = [one.select(known.tolist()) for one in runs]
    each = _log_response(np.stack([one.ratio for one in chosen]))
    mean = each.mean(axis=0)
    count, m = len(runs), len(known)
    within = np.concatenate(
        [
            np.mean([one.log_gain_variance for one in chosen], axis=0),
            np.mean([one.lag_variance for one in chosen], axis=0),
        ]
    )
    if count > 1:
        parts = np.concatenate([each.real, each.imag], axis=1)
        centred = parts - parts.mean(axis=0)
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
        names=tuple(names[k] for k in known.tolist()),
        runs=count,
        response=Response(
            ratio=frozen(np.exp(mean)),
            log_gain_variance=frozen(variance[:m].copy()),
            lag_variance=frozen(variance[m:].copy()),
            dof=frozen(dof),
        ),
        each=frozen(each),
        covariance=frozen(covariance),
    )


def _log_response(ratio: ComplexArray) -> ComplexArray:
    """Ln H of each run, the phases of a joint within pi of their mean, shape (r, m)."""
    turn: FloatArray = np.angle((ratio / np.abs(ratio)).sum(axis=0))
    phase = turn + np.angle(ratio * np.exp(-1j * turn))
    return (np.log(np.abs(ratio)) + 1j * phase).astype(np.complex128)


def pooled_answer(
    robot: Robot | None, pooled: PooledResponse, sessions: Sequence[Analysis]
) -> Answer:
    """Answer from several runs of one gait.

    Args:
        robot: The robot, or None; then all joints are one chain.
        pooled: The response over the runs, two or more of them.
        sessions: The runs' analyses.

    Returns:
        The answer; intervals contain the scatter from run to run.
    """
    faulty: dict[str, NotFollowing] = {}
    for session in sessions:
        for each in session.answer.not_following:
            faulty.setdefault(each.joint, each)
    commanded = [joint.name for joint in sessions[0].joints if joint.command_amplitude_rad]
    gains = _scatter(pooled.each.real, pooled.response.log_gain_variance)
    lags = _scatter(pooled.each.imag, pooled.response.lag_variance)
    chains: list[Chain] = []
    for plane, names in by_plane(robot, commanded).items():
        own = [name for name in names if name in pooled.names and name not in faulty]
        index = [pooled.names.index(name) for name in own]
        scatter = (gains.select(index), lags.select(index))
        response = pooled.response.select(index)
        chains.append(Chain(plane, 0, tuple(names), tuple(own), response, scatter=scatter))
    first = sessions[0]
    order: Mapping[str, int] = {joint.name: k for k, joint in enumerate(first.joints)}
    return compose(
        Facts(
            gait=first.gait,
            joints=first.joints,
            commanded=tuple(commanded),
            not_following=tuple(sorted(faulty.values(), key=lambda each: order[each.joint])),
            findings=examine(chains),
            warnings=first.warnings,
        )
    )


def _scatter(values: FloatArray, variance: FloatArray) -> Scatter:
    """Scatter of the mean of values (r runs, m joints): r - 1 columns, and what noise adds (m,)."""
    runs = len(values)
    centred = values - values.mean(axis=0)
    # Helmert's contrasts between the runs are orthonormal, so the columns are independent.
    size: IntArray = np.arange(1, runs, dtype=np.int64)
    lower = np.tril(np.ones((runs - 1, runs)))
    lower[np.arange(runs - 1), size] = -size
    basis = lower / np.sqrt(size * (size + 1.0))[:, None]
    columns = (basis @ centred).T / runs**0.5
    raised: FloatArray = np.maximum(variance - np.mean(columns**2, axis=1), 0.0)
    return Scatter(columns, raised, np.zeros_like(raised))
