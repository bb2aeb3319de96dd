"""How much runs differ from each other beyond what the noise within each of them explains.

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

import numpy as np

from undulog.capture.common.arrays import ComplexArray, FloatArray

from .kick_runs import Kick, KickKind

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
        correlation = np.clip((unit.T @ unit) * np.where(same, 1.0, more), -1.0, 1.0)
        np.fill_diagonal(correlation, 1.0)
        return correlation


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
    left_out = sum(bool(sides(kicks, kind)) for kind in KickKind) if pairs else 0
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
    adjusted = values.copy()
    for kind in KickKind:
        pairs = sides(kicks, kind)
        if len(pairs) < 2:
            continue
        means = [
            (values[up].mean(axis=0), values[down].mean(axis=0)) for up, down in pairs.values()
        ]
        middle = np.array([(high + low) / 2 for high, low in means])
        for k, (joint, (up, down)) in enumerate(pairs.items()):
            columns = [joint, m + joint]
            others = np.delete(middle[:, columns], k, axis=0).mean(axis=0)
            adjusted[np.ix_(up + down, columns)] += others - middle[k, columns]
    return adjusted


def _row_weights(kicks: Sequence[Kick | None]) -> FloatArray:
    weights = np.zeros(len(kicks))
    for up, down in sides(kicks, KickKind.PHASE).values():
        span = _mean_size(kicks, up) - _mean_size(kicks, down)
        weights[up] += 1 / (len(up) * span)
        weights[down] -= 1 / (len(down) * span)
    return weights


def _foreseen(
    kicks: Sequence[Kick | None], m: int, derivatives: tuple[ComplexArray, ComplexArray | None]
) -> ComplexArray:
    """Return the response of a linear chain with these derivatives, shape (r, m)."""
    foreseen = np.zeros((len(kicks), m), dtype=np.complex128)
    of_phase, of_amplitude = derivatives
    for k, kick in enumerate(kicks):
        if kick is None:
            continue
        phase = kick.kind is KickKind.PHASE
        L = of_phase if phase else of_amplitude
        if L is not None:
            foreseen[k] = np.log1p(L[:, kick.joint] * np.expm1(kick.size * (1j if phase else 1.0)))
    return foreseen


def _repeats(kicks: Sequence[Kick | None], values: FloatArray) -> list[FloatArray]:
    """Compare each run with the mean of all runs of its commands; copied files don't count."""
    groups: dict[tuple[int, KickKind, bool] | None, list[int]] = {}
    seen: set[bytes] = set()
    for k, kick in enumerate(kicks):
        numbers = values[k].tobytes()
        if numbers in seen:
            continue
        seen.add(numbers)
        key = None if kick is None else (kick.joint, kick.kind, kick.size > 0)
        groups.setdefault(key, []).append(k)
    rows = np.eye(len(kicks))
    for group in groups.values():
        rows[np.ix_(group, group)] -= 1 / len(group)
    return [rows[k] for group in groups.values() for k in group[1:]]


def _pairs(kicks: Sequence[Kick | None]) -> list[FloatArray]:
    """Compare kicks up and down together with the mean of all of them, for each kind."""
    contrasts: list[FloatArray] = []
    for kind in KickKind:
        pairs: list[FloatArray] = []
        for up, down in sides(kicks, kind).values():
            row = np.zeros(len(kicks))
            row[up] = 0.5 / len(up)
            row[down] = 0.5 / len(down)
            pairs.append(row)
        mean = np.mean(pairs, axis=0) if pairs else np.zeros(len(kicks))
        contrasts += [row - mean for row in pairs[1:]]
    return contrasts


def sides(kicks: Sequence[Kick | None], kind: KickKind) -> dict[int, tuple[list[int], list[int]]]:
    """Return the runs that kick a joint up and those that kick it down.

    Args:
        kicks: Of r runs, None of one of the base gait.

    Returns:
        Indices of runs for each joint that is kicked both ways.
    """
    runs: dict[int, tuple[list[int], list[int]]] = {}
    for k, kick in enumerate(kicks):
        if kick is not None and kick.kind is kind:
            up, down = runs.setdefault(kick.joint, ([], []))
            (up if kick.size > 0 else down).append(k)
    return {joint: runs[joint] for joint in sorted(runs) if all(runs[joint])}


def _mean_size(kicks: Sequence[Kick | None], chosen: Sequence[int]) -> float:
    return float(np.mean([kick.size for k in chosen if (kick := kicks[k]) is not None]))


def _orthonormal(rows: Sequence[FloatArray], count: int) -> FloatArray:
    """Return an orthonormal basis of what the rows span, shape (k, count)."""
    if not rows:
        return np.zeros((0, count))
    _, sizes, basis = np.linalg.svd(np.array(rows), full_matrices=False)
    return basis[sizes > _ZERO * sizes[0]].astype(np.float64)
