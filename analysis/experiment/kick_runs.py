"""Find runs that are local kicks around one gait, from the phasors of their commands.

With c the complex amplitudes of a run's commands and b those of the base gait, the run deviates by
delta_j = ln(c_j / b_j) - j theta, where theta is what all joints share: the run started at another
time. A kick is a run in which one joint alone deviates, in phase or in amplitude; a pattern is any
other run near the base.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from undulog.capture.common.arrays import BoolArray, ComplexArray, FloatArray

from ..session.runs import SAME_FREQUENCY, GaitRun

SAME = 0.01
"""A command that deviates by less, in phase [rad] or log amplitude, is the base's still."""

MOST_KICK = 0.12
"""The largest deviation of a kick; one joint that deviates by more is no local kick."""

MOST_PATTERN = 0.6
"""The largest deviation of a pattern [rad]; beyond it is another gait."""

LEAST_KICK = 1e-3
"""A deviation of one joint alone that is smaller isn't looked for [rad or log amplitude]."""

LOPSIDED = 0.1
"""Kicks up and down may differ by this share of their span: what differs leaves curvature in."""


class KickKind(StrEnum):
    """What of a command is kicked."""

    PHASE = "phase"
    AMPLITUDE = "amplitude"


@dataclass(frozen=True)
class Kick:
    """One joint's command off the base gait.

    Attributes:
        size: Signed: d psi_c [rad] or d ln|c|.
    """

    joint: int
    kind: KickKind
    size: float


@dataclass(frozen=True)
class KickedRuns:
    """The runs of a kick experiment, by index.

    Attributes:
        base: Runs of the base gait, at least one.
        patterns: Runs in which several joints deviate.
        deviation: Of all runs from the first base run, ln|c| + j psi_c, NaN where a run is of
            another gait, shape (r, m).
    """

    base: tuple[int, ...]
    kicks: dict[int, Kick]
    patterns: tuple[int, ...]
    deviation: ComplexArray


def deviation_of(command: ComplexArray, base: ComplexArray, same: float = SAME) -> ComplexArray:
    """Return the deviation of a run's commands from the base gait, whenever it started.

    Args:
        command: Complex amplitudes, shape (m,), m > 2.
        base: Those of the base gait, shape (m,).
        same: Phases that differ by less agree [rad].

    Returns:
        d ln|c| + j d psi_c, shape (m,). The phase is counted from what the joints that agree with
        their median share, so that one kicked joint doesn't move the others.
    """
    change: ComplexArray = command / base
    change = change * np.exp(-1j * np.angle(change.sum()))
    phase = np.angle(change)
    agree: BoolArray = np.abs(phase - np.median(phase)) <= same
    phase = phase - phase[agree].mean() if agree.any() else phase - np.median(phase)
    return (np.log(np.abs(change)) + 1j * phase).astype(np.complex128)


def kick_of(deviation: ComplexArray, same: float = SAME, most: float = MOST_KICK) -> Kick | None:
    """Return the kick that makes a deviation.

    Args:
        deviation: From :func:`deviation_of`, shape (m,).
        same: What deviates by less is the base's still.

    Returns:
        The kick, or None where none, or more than one, part of a command deviates.
    """
    parts = np.stack([deviation.imag, deviation.real])
    off = np.argwhere(np.abs(parts) > same)
    if len(off) != 1:
        return None
    part, joint = (int(k) for k in off[0])
    size = float(parts[part, joint])
    if abs(size) > most:
        return None
    return Kick(joint, (KickKind.PHASE, KickKind.AMPLITUDE)[part], size)


def sort_kicks(command: ComplexArray) -> KickedRuns | None:
    """Find the base gait and the kicks around it.

    Args:
        command: Complex amplitudes of r runs' commands, shape (r, m).

    Returns:
        The runs sorted, by kicks of ``SAME`` to ``MOST_KICK``; only where there are none, by those
        of ``LEAST_KICK`` to ``MOST_PATTERN``, which are too small or too large for most robots.
        None where they are no kick experiment: see :func:`sort_kicks_within`.
    """
    kicked = sort_kicks_within(command, SAME, MOST_KICK)
    return sort_kicks_within(command, LEAST_KICK, MOST_PATTERN) if kicked is None else kicked


def sort_kicks_within(command: ComplexArray, same: float, most: float) -> KickedRuns | None:
    """Find the base gait and kicks of given sizes around it.

    Args:
        command: Complex amplitudes of r runs' commands, shape (r, m).

    Returns:
        The runs sorted, or None where they are no kick experiment: fewer than two different kicks
        around one recorded base, or fewer than three joints (of two, a kick of one's phase is a
        kick of the other's at another time).
    """
    if command.shape[1] < 3:
        return None
    best: KickedRuns | None = None
    tried: list[ComplexArray] = []
    for model in command:
        if any(np.abs(deviation_of(model, earlier, same)).max() <= same for earlier in tried):
            continue
        tried.append(model)
        kicked = _around(command, model, same, most)
        if best is None or len(kicked.kicks) > len(best.kicks):
            best = kicked
    if best is None:
        return None
    different = {(kick.joint, kick.kind, kick.size > 0) for kick in best.kicks.values()}
    return best if len(different) > 1 else None


def missing_kicks(kicks: Sequence[Kick], kind: KickKind, names: Sequence[str]) -> tuple[str, ...]:
    """List the kicks that are missing for central differences.

    Args:
        names: Of the m joints.

    Returns:
        One phrase for each joint that isn't kicked both ways alike, e.g. ``joint03 only up``.
    """
    lacking: list[str] = []
    for joint, name in enumerate(names):
        sizes = [kick.size for kick in kicks if kick.kind is kind and kick.joint == joint]
        up, down = [x for x in sizes if x > 0], [x for x in sizes if x < 0]
        if not sizes:
            lacking.append(f"{name} not at all")
        elif not up or not down:
            lacking.append(f"{name} only {'up' if up else 'down'}")
        else:
            high, low = float(np.mean(up)), float(np.mean(down))
            if abs(high + low) > LOPSIDED * (high - low):
                lacking.append(f"{name} by {high:+.3f} and {low:+.3f}")
    return tuple(lacking)


def _around(command: ComplexArray, model: ComplexArray, same: float, most: float) -> KickedRuns:
    deviation = np.stack([deviation_of(row, model, same) for row in command])
    base: list[int] = []
    kicks: dict[int, Kick] = {}
    patterns: list[int] = []
    for k, row in enumerate(deviation):
        kick = kick_of(row, same, most)
        largest = max(np.abs(row.real).max(), np.abs(row.imag).max())
        if kick is not None:
            kicks[k] = kick
        elif largest <= same:
            base.append(k)
        elif largest <= MOST_PATTERN:
            patterns.append(k)
    return KickedRuns(tuple(base), kicks, tuple(patterns), deviation)


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
        """Return a run's role: ``base``, ``kick``, ``held-out`` or None."""
        if k not in self.index:
            return None
        place, runs = self.index.index(k), self.runs
        parts = {"kick": runs.kicks, "held-out": runs.patterns, "base": runs.base}
        return next((name for name, members in parts.items() if place in members), None)


def find_kicks(runs: Sequence[GaitRun]) -> KickExperiment | None:
    """Recognise a kick experiment by its commands.

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
        kicked = sort_kicks(np.stack([runs[k].command for k in index]))
        if kicked is not None and (best is None or len(kicked.kicks) > len(best.runs.kicks)):
            best = _experiment(index, kicked, [runs[k] for k in index])
    return best


def _same_drive(run: GaitRun, model: GaitRun) -> bool:
    return (
        bool(run.names)
        and (run.names, run.robot, run.wave) == (model.names, model.robot, model.wave)
        and abs(run.frequency_hz - model.frequency_hz) <= SAME_FREQUENCY * model.frequency_hz
    )


def _experiment(
    index: tuple[int, ...], kicked: KickedRuns, runs: Sequence[GaitRun]
) -> KickExperiment:
    base, responses = runs[kicked.base[0]], [run.response for run in runs]
    return KickExperiment(
        index=index,
        runs=kicked,
        names=base.names,
        command=base.command,
        ratio=np.stack([response.ratio for response in responses]),
        log_gain_variance=np.stack([response.log_gain_variance for response in responses]),
        lag_variance=np.stack([response.lag_variance for response in responses]),
        dof=np.stack([response.dof for response in responses]),
        labels=tuple(run.label for run in runs),
        frequency_hz=base.frequency_hz,
    )
