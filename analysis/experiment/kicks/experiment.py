"""Sessions that are runs of one kick experiment, with what their fits say of noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from undulog.capture.common.arrays import ComplexArray, FloatArray

from ...response.fitting import GaitFit
from ...session.runs import SAME_FREQUENCY, GaitRun
from .runs import KickedRuns, sort_kicks


@dataclass(frozen=True)
class KickExperiment:
    """Sessions that are runs of one kick experiment.

    Attributes:
        index: Which of all runs they are, shape (r,).
        runs: Sorted, indices into ``index``.
        names: Driven joints, head to tail, m.
        command: Of the base gait, shape (m,).
        ratio: a/c of each run, NaN where unknown, shape (r, m).
        log_gain_variance: Shape (r, m).
        lag_variance: Shape (r, m).
        dof: Shape (r, m).
        labels: File names, r.
        frequency_hz: Of the base gait.
    """

    index: tuple[int, ...]
    runs: KickedRuns
    names: tuple[str, ...]
    command: ComplexArray
    ratio: ComplexArray
    log_gain_variance: FloatArray
    lag_variance: FloatArray
    dof: FloatArray
    labels: tuple[str, ...]
    frequency_hz: float

    def role(self, k: int) -> str | None:
        """What a run of all runs is here: ``base``, ``kick``, ``held-out`` or None."""
        if k not in self.index:
            return None
        own = self.index.index(k)
        if own in self.runs.kicks:
            return "kick"
        if own in self.runs.patterns:
            return "held-out"
        return "base" if own in self.runs.base else None


def find_kicks(runs: Sequence[GaitRun], gaits: Sequence[GaitFit | None]) -> KickExperiment | None:
    """Recognise a kick experiment by its commands.

    Args:
        runs: All runs.
        gaits: Their fits, in the same order.

    Returns:
        The experiment, or None where the runs are none.
    """
    best: KickExperiment | None = None
    seen: list[tuple[int, ...]] = []
    for model in runs:
        index = tuple(k for k, run in enumerate(runs) if _same_drive(run, model))
        if index in seen or len(model.names) < 3 or len(model.frequencies_hz) > 1:
            continue
        seen.append(index)
        found = sort_kicks(np.stack([runs[k].command for k in index]))
        if found is not None and (best is None or len(found.kicks) > len(best.runs.kicks)):
            best = _experiment(index, found, runs, gaits)
    return best


def _same_drive(run: GaitRun, model: GaitRun) -> bool:
    return (
        bool(run.names)
        and (run.names, run.robot, run.wave) == (model.names, model.robot, model.wave)
        and abs(run.frequency_hz - model.frequency_hz) <= SAME_FREQUENCY * model.frequency_hz
    )


def _experiment(
    index: tuple[int, ...],
    found: KickedRuns,
    runs: Sequence[GaitRun],
    gaits: Sequence[GaitFit | None],
) -> KickExperiment:
    names = runs[index[0]].names
    noise = np.full((3, len(index), len(names)), np.nan)
    for row, k in enumerate(index):
        gait = gaits[k]
        if gait is None or gait.response is None:
            continue
        at = [names.index(name) for name in gait.answered]
        one = gait.response
        noise[:, row, at] = one.log_gain_variance, one.lag_variance, one.dof
    return KickExperiment(
        index=index,
        runs=found,
        names=names,
        command=runs[index[found.base[0]]].command,
        ratio=np.stack([runs[k].ratio for k in index]),
        log_gain_variance=noise[0],
        lag_variance=noise[1],
        dof=noise[2],
        labels=tuple(runs[k].label for k in index),
        frequency_hz=runs[index[found.base[0]]].frequency_hz,
    )
