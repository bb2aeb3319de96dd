"""Runs that are local kicks around one gait, by their commands, and how much they differ.

With c the complex amplitudes of a run's commands and b those of the base gait, the run deviates by
delta_j = ln(c_j / b_j) - j theta, where theta is what all joints share: the run started at another
time. A kick is a run in which one joint alone deviates, in phase or in amplitude; a pattern is any
other run near the base.

A fit estimates the noise within its run. A servo that warms up, a cable, sand or a late clock moves
gain and lag of a whole run, and no residual shows it. It is estimated from combinations of runs
whose mean is known whatever the coupling is, y = psi or ln|a| of one joint:

* runs of the same commands, against their mean;
* the mean of a kick up and of the same kick down, against the mean of all those pairs: the coupling
  cancels. What is left of second order is that of a linear chain, ln(1 + L (e^z - 1)) - L z with
  L = P - j R or G + j S (taken off), that of a servo to its own kick (left out: one that saturates
  bends far more than its neighbours), and that of the others (left in: the estimate is too large
  where kicks are too large);
* the sum of all kicks of phase, up minus down: 1 for P and 0 for R, by time shift.

With these combinations as orthonormal rows Q, the rows of Q Y are k independent draws of one run's
errors, of all joints, phases and log amplitudes together: k S = (Q Y)' (Q Y), the covariance of a
run (Wishart). Joints may share their scatter, as a clock makes them; each joint's variance has k
degrees of freedom, and nothing is pooled over joints. Beneath the noise within runs it never falls.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from undulog.capture.common.arrays import BoolArray, ComplexArray, FloatArray

from ...response.fitting import GaitFit
from ...session.runs import SAME_FREQUENCY, GaitRun

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


class Kind(StrEnum):
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
    kind: Kind
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
    return Kick(joint, (Kind.PHASE, Kind.AMPLITUDE)[part], size)


def sort_kicks(command: ComplexArray) -> KickedRuns | None:
    """Find the base gait and the kicks around it.

    Args:
        command: Complex amplitudes of r runs' commands, shape (r, m).

    Returns:
        The runs sorted, by kicks of ``SAME`` to ``MOST_KICK``; only where there are none, by those
        of ``LEAST_KICK`` to ``MOST_PATTERN``, which are too small or too large for most robots.
        None where they are no kick experiment: see :func:`sort_kicks_within`.
    """
    found = sort_kicks_within(command, SAME, MOST_KICK)
    return sort_kicks_within(command, LEAST_KICK, MOST_PATTERN) if found is None else found


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
        if any(np.abs(deviation_of(model, one, same)).max() <= same for one in tried):
            continue
        tried.append(model)
        found = _around(command, model, same, most)
        if best is None or len(found.kicks) > len(best.kicks):
            best = found
    if best is None:
        return None
    different = {(one.joint, one.kind, one.size > 0) for one in best.kicks.values()}
    return best if len(different) > 1 else None


def missing_kicks(kicks: Sequence[Kick], kind: Kind, names: Sequence[str]) -> tuple[str, ...]:
    """List the kicks that are missing for central differences.

    Args:
        names: Of the m joints.

    Returns:
        One phrase for each joint that isn't kicked both ways alike, e.g. ``joint03 only up``.
    """
    lacking: list[str] = []
    for joint, name in enumerate(names):
        sizes = [one.size for one in kicks if one.kind is kind and one.joint == joint]
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
    deviation = np.stack([deviation_of(one, model, same) for one in command])
    base: list[int] = []
    kicks: dict[int, Kick] = {}
    patterns: list[int] = []
    for k, one in enumerate(deviation):
        kick = kick_of(one, same, most)
        largest = max(np.abs(one.real).max(), np.abs(one.imag).max())
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
        own, runs = self.index.index(k), self.runs
        parts = {"kick": runs.kicks, "held-out": runs.patterns, "base": runs.base}
        return next((name for name, members in parts.items() if own in members), None)


def find_kicks(runs: Sequence[GaitRun], gaits: Sequence[GaitFit | None]) -> KickExperiment | None:
    """Recognise a kick experiment by its commands.

    Args:
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


_ZERO = 1e-9
"""A combination of runs that is shorter, once those before it are taken off, is one of them."""


@dataclass(frozen=True)
class RunErrors:
    """Errors of one run, from k combinations of runs.

    Columns are psi of m joints [rad], then ln|a| of m joints.

    Attributes:
        draws: Draws of a run's errors, shape (k, 2 m).
        within: Variance expected of them from the noise within runs alone, shape (2 m,).
        dof: Degrees of freedom of each column: k less those of its joint's own kicks.
    """

    draws: FloatArray
    within: FloatArray
    dof: int

    @property
    def variance(self) -> FloatArray:
        """Of a run, noise and scatter together, shape (2 m,)."""
        return np.sum(np.square(self.draws), axis=0) / self.dof

    @property
    def between(self) -> FloatArray:
        """What scatter adds to the variance of a run, never negative, shape (2 m,)."""
        return np.maximum(self.variance - self.within, 0.0)

    @property
    def correlation(self) -> FloatArray:
        """Of a run's errors, shape (2 m, 2 m).

        Of two joints, each joint's own kicks are lacking: fewer products than squares.
        """
        size = np.sqrt(np.sum(np.square(self.draws), axis=0))
        unit = np.divide(self.draws, size, out=np.zeros_like(self.draws), where=size > 0)
        m = unit.shape[1] // 2
        more = self.dof / max(self.dof - (len(self.draws) - self.dof), 1)
        same = np.tile(np.eye(m, dtype=bool), (2, 2))
        found = np.clip((unit.T @ unit) * np.where(same, 1.0, more), -1.0, 1.0)
        np.fill_diagonal(found, 1.0)
        return found


def run_errors(
    kicks: Sequence[Kick | None],
    log: ComplexArray,
    variance: FloatArray,
    derivatives: tuple[ComplexArray, ComplexArray | None],
    *,
    pairs: bool = True,
    rows: bool = True,
) -> RunErrors:
    """Estimate a run's errors.

    Args:
        kicks: Of r runs, None of one of the base gait.
        log: Change of ln|a| + j psi against the base, shape (r, m).
        variance: Of psi, then of ln|a|, from the noise within each run, shape (r, 2 m).
        derivatives: P - j R, and G + j S or None, shapes (m, m).
        pairs: Use kicks up and down together; they carry the second order of the kicks.
        rows: Use the sums of rows.
    """
    values = np.hstack([log.imag, log.real])
    foreseen = _foreseen(kicks, log.shape[1], derivatives)
    even = _orthonormal(_repeats(kicks, values) + (_pairs(kicks) if pairs else []), len(kicks))
    left_out = sum(bool(sides(kicks, kind)) for kind in Kind) if pairs else 0
    level = values - np.hstack([foreseen.imag, foreseen.real])
    draws = even @ (_without_own(kicks, level) if pairs else level)
    if rows:
        weights = _row_weights(kicks)
        left = weights @ values - np.repeat((1.0, 0.0), log.shape[1])
        # Kicks that are repeated unequally make the sum depend on the pairs.
        along = even @ weights
        alone = weights - along @ even
        length = float(np.linalg.norm(alone))
        draws = np.vstack([draws, (left - along @ draws) / length])
        even = np.vstack([even, alone / length])
    return RunErrors(draws, np.mean(np.square(even) @ variance, axis=0), len(draws) - left_out)


def _without_own(kicks: Sequence[Kick | None], values: FloatArray) -> FloatArray:
    """Set a joint's own kicks, up and down together, to the mean of the others'.

    So they add nothing to the squares about that mean, and its joint has a degree of freedom less.
    """
    m = values.shape[1] // 2
    found = values.copy()
    for kind in Kind:
        pairs = sides(kicks, kind)
        if len(pairs) < 2:
            continue
        means = [
            (values[up].mean(axis=0), values[down].mean(axis=0)) for up, down in pairs.values()
        ]
        middle = np.array([(high + low) / 2 for high, low in means])
        for k, (joint, (up, down)) in enumerate(pairs.items()):
            own = [joint, m + joint]
            others = np.delete(middle[:, own], k, axis=0).mean(axis=0)
            found[np.ix_(up + down, own)] += others - middle[k, own]
    return found


def _row_weights(kicks: Sequence[Kick | None]) -> FloatArray:
    weights = np.zeros(len(kicks))
    for up, down in sides(kicks, Kind.PHASE).values():
        span = _mean_size(kicks, up) - _mean_size(kicks, down)
        weights[up] += 1 / (len(up) * span)
        weights[down] -= 1 / (len(down) * span)
    return weights


def _foreseen(
    kicks: Sequence[Kick | None],
    m: int,
    derivatives: tuple[ComplexArray, ComplexArray | None],
) -> ComplexArray:
    """Return the response of a linear chain with these derivatives, shape (r, m)."""
    found = np.zeros((len(kicks), m), dtype=np.complex128)
    of_phase, of_amplitude = derivatives
    for k, kick in enumerate(kicks):
        if kick is None:
            continue
        phase = kick.kind is Kind.PHASE
        L = of_phase if phase else of_amplitude
        if L is not None:
            found[k] = np.log1p(L[:, kick.joint] * np.expm1(kick.size * (1j if phase else 1.0)))
    return found


def _repeats(kicks: Sequence[Kick | None], values: FloatArray) -> list[FloatArray]:
    """Compare each run with the mean of all runs of its commands; copied files don't count."""
    groups: dict[tuple[int, Kind, bool] | None, list[int]] = {}
    seen: set[bytes] = set()
    for k, one in enumerate(kicks):
        numbers = values[k].tobytes()
        if numbers in seen:
            continue
        seen.add(numbers)
        key = None if one is None else (one.joint, one.kind, one.size > 0)
        groups.setdefault(key, []).append(k)
    rows = np.eye(len(kicks))
    for group in groups.values():
        rows[np.ix_(group, group)] -= 1 / len(group)
    return [rows[k] for group in groups.values() for k in group[1:]]


def _pairs(kicks: Sequence[Kick | None]) -> list[FloatArray]:
    """Compare kicks up and down together with the mean of all of them, for each kind."""
    found: list[FloatArray] = []
    for kind in Kind:
        pairs: list[FloatArray] = []
        for up, down in sides(kicks, kind).values():
            row = np.zeros(len(kicks))
            row[up] = 0.5 / len(up)
            row[down] = 0.5 / len(down)
            pairs.append(row)
        mean = np.mean(pairs, axis=0) if pairs else np.zeros(len(kicks))
        found += [row - mean for row in pairs[1:]]
    return found


def sides(kicks: Sequence[Kick | None], kind: Kind) -> dict[int, tuple[list[int], list[int]]]:
    """Return the runs that kick a joint up and those that kick it down.

    Args:
        kicks: Of r runs, None of one of the base gait.

    Returns:
        Indices of runs for each joint that is kicked both ways.
    """
    runs: dict[int, tuple[list[int], list[int]]] = {}
    for k, one in enumerate(kicks):
        if one is not None and one.kind is kind:
            up, down = runs.setdefault(one.joint, ([], []))
            (up if one.size > 0 else down).append(k)
    return {joint: runs[joint] for joint in sorted(runs) if all(runs[joint])}


def _mean_size(kicks: Sequence[Kick | None], chosen: Sequence[int]) -> float:
    return float(np.mean([one.size for k in chosen if (one := kicks[k]) is not None]))


def _orthonormal(rows: Sequence[FloatArray], count: int) -> FloatArray:
    """Return an orthonormal basis of what the rows span, shape (k, count)."""
    if not rows:
        return np.zeros((0, count))
    _, sizes, basis = np.linalg.svd(np.array(rows), full_matrices=False)
    return basis[sizes > _ZERO * sizes[0]].astype(np.float64)
