"""Several runs of one gait in one direction, pooled into one response.

ln H of a joint in a run is that of the gait, plus what the run does (the robot is put down anew),
plus the noise within the run. The mean over r runs has the variance (tau^2 + sigma^2) / r. The
scatter from run to run estimates tau^2 + sigma^2 with r - 1 degrees of freedom, whatever its
distribution over the joints; where it happens to fall below the noise within the runs, which is
known better, that takes its place, with no more degrees of freedom: the interval of the mean then
covers at least 95 %.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from undulog.capture.common.arrays import ComplexArray, FloatArray, frozen
from undulog.capture.common.errors import UsageError

from ..response.response import Response


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
