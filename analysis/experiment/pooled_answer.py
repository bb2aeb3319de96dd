"""The comparison of the joints over several runs of one gait in one direction."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from undulog.capture.common.arrays import FloatArray, IntArray
from undulog.capture.robot.model import Robot

from ..results.analysis import Analysis
from ..results.answer import Answer, NotFollowing
from ..segments.answer import Facts, compose
from ..segments.examine import Chain, examine
from ..segments.family import Scatter
from ..signals.reading import by_plane
from .pooling import PooledResponse


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
