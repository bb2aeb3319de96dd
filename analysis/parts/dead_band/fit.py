"""Least squares of the model, and how far its parameters are determined.

Whether a joint catches up at the onset (b > 0) shows in few samples, and a slow follower hides it.
So the model without it is taken unless one with it explains clearly more; and what W could be is
read off the profile of the misfit over b, beside the scatter from cycle to cycle.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from undulog.capture.common.arrays import BoolArray, FloatArray, IntArray

from ...estimators.intervals import t_factor
from .model import BOTTOM, DELAY, LAG, PARAMETERS, TOP, WIDTH, BandMisfit, WholeCycles, misfit

_SHARES = np.array([0.0, 0.15, 0.4, 1.0])
"""b over w along the profile."""

_WIDTHS = np.array([0.005, 0.01, 0.02, 0.04, 0.07, 0.1, 0.15, 0.2, 0.3, 0.4, 0.5, 0.7])
"""Starting values of w, as a share of twice the amplitude."""

_LAGS = (0.2, 0.8)
"""Starting values of the follower's part of the lag that w leaves over."""

_FACTORS = np.array([0.03, 1.0, 30.0])
_ITERATIONS = 15
_IDLE = 2
"""Iterations without gain after which a row is done."""

_SAME = 1e-3
_SEGMENTS = 16
"""Parts of a cycle whose repeated residuals are taken as independent."""

_INSIDE = 6.0
"""Loss of log likelihood, times two, within which a value of the profile is possible: 3.84 is the
95 % point of chi-squared with one degree of freedom, and the model is not exact."""

_NEEDED = (6.0, 12.0)
"""The same that a step at the onset needs to be taken, and that one of another size at either end
needs."""

_AHEAD = -0.25
"""Delay, in sampling intervals, below which a joint would be ahead of its command."""

_TIES = (np.eye(PARAMETERS)[:, :3], np.vstack((np.eye(4), np.eye(4)[3:])), np.eye(PARAMETERS))
"""From what is fitted to all parameters: no step, one step, two steps."""


@dataclass(frozen=True)
class FittedBand:
    """One joint's fit.

    Attributes:
        parameters: As :data:`.analysis.parts.dead_band.model.PARAMETERS`, shape (5,).
        gain: Of the position over the follower.
        travel: W after top and bottom, with lower and upper end [rad], shape (2, 3).
        step: b of both, the same [rad of the command], shape (2, 3).
        cost: Residual sum of squares [rad^2].
        rests: Where the model rests, the warm-up included, shape (k, n).
        follower: z [rad], the same.
    """

    parameters: FloatArray
    gain: float
    travel: FloatArray
    step: FloatArray
    cost: float
    independent: float
    rests: BoolArray
    follower: FloatArray


def fit_dead_bands(
    cycles: WholeCycles,
    omega: float,
    amplitude: FloatArray,
    lag: FloatArray,
    resolution: FloatArray,
) -> list[FittedBand]:
    """Fit the model to some joints, all in step.

    Args:
        omega: Of the gait [rad/s].
        amplitude: Of the commands [rad], shape (j,).
        lag: Of the fundamentals, in [0, 2 pi) [rad], shape (j,).
        resolution: Smallest step that each sensor shows [rad], shape (j,).
    """
    joints = np.arange(len(amplitude), dtype=np.int64)
    scales = _Scales(cycles.period_s, omega, amplitude, resolution)
    starts = _starts(cycles.period_s, omega, amplitude, lag)
    misfits = misfit(cycles.some(5), np.repeat(joints, starts.shape[1]), starts.reshape(-1, 5))
    first = starts[joints, misfits.cost.reshape(starts.shape[:2]).argmin(axis=1)]
    # The profile over b: d, T and w are fitted, b is a share of w.
    rows = np.repeat(joints, _SHARES.size)
    ties = np.zeros((rows.size, PARAMETERS, 3))
    ties[:, [DELAY, LAG, WIDTH], [0, 1, 2]] = 1.0
    ties[:, TOP, 2] = ties[:, BOTTOM, 2] = np.tile(_SHARES, joints.size)
    values = np.repeat(first[:, :3], _SHARES.size, axis=0)
    values[:, WIDTH] /= 1 + np.tile(_SHARES, joints.size)
    values = _levenberg(cycles, rows, values, ties, scales)
    profile = np.einsum("rpn,rn->rp", ties, values)
    costs = misfit(cycles, rows, profile).cost.reshape(joints.size, -1)
    profile = profile.reshape(joints.size, -1, PARAMETERS)
    candidates = [
        _Candidates(profile[j], [_Candidate(profile[j, 0], _TIES[0])], costs[j]) for j in joints
    ]
    # b of its own, the same at both ends; then one at each.
    start = profile[joints, 1 + costs[:, 1:].argmin(axis=1)]
    for tie in _TIES[1:]:
        n = tie.shape[1]
        fitted = _levenberg(
            cycles, joints, start[:, :n], np.broadcast_to(tie, (joints.size, *tie.shape)), scales
        )
        start = fitted @ tie.T
        for candidate, parameters in zip(candidates, start, strict=True):
            candidate.fits.append(_Candidate(parameters, tie))
    # All joints in step here, too: a call takes as long for one as for many.
    lefts = [
        misfit(cycles, joints, np.array([candidate.fits[k].parameters for candidate in candidates]))
        for k in range(len(_TIES))
    ]
    moved = _moved(cycles, joints.tolist(), [candidate.fits[0] for candidate in candidates], scales)
    return [
        _chosen(cycles, j, candidate, scales, lefts=[left.row(j) for left in lefts], moved=moved[j])
        for j, candidate in enumerate(candidates)
    ]


class _Candidate(NamedTuple):
    """Parameters, and which of them were fitted."""

    parameters: FloatArray
    tie: FloatArray


class _Candidates(NamedTuple):
    """What was fitted to one joint: the profile over b, and models with ever more parameters."""

    profile: FloatArray
    fits: list[_Candidate]
    costs: FloatArray


def _chosen(
    cycles: WholeCycles,
    joint: int,
    candidates: _Candidates,
    scales: _Scales,
    *,
    lefts: Sequence[BandMisfit],
    moved: FloatArray,
) -> FittedBand:
    """Return the simplest model that none explains more than, with its intervals.

    Args:
        lefts: What each of the fits leaves over.
        moved: Of the first fit, see :func:`_moved`.
    """
    independent = _independent(lefts[-1].residual[0])
    least = min(float(candidates.costs.min()), *(float(left.cost[0]) for left in lefts))
    taken = 0
    error = _errors(cycles, joint, candidates.fits[0], scales, lefts[0], nudged=moved)
    for k, needed in zip((1, 2), _NEEDED, strict=True):
        gained = independent * np.log(lefts[taken].cost[0] / lefts[k].cost[0])
        # Ahead of its command no joint is: it would speed up by its inertia, which isn't a step.
        if gained > needed and candidates.fits[k].parameters[DELAY] >= _AHEAD * cycles.period_s:
            (more,) = _moved(cycles, [joint], [candidates.fits[k]], scales)
            wider = _errors(cycles, joint, candidates.fits[k], scales, lefts[k], nudged=more)
            if np.any(candidates.fits[k].parameters[[TOP, BOTTOM]] > wider[2:]):
                taken, error = k, wider
    chosen, left = candidates.fits[taken].parameters, lefts[taken]
    travel = np.stack([chosen[WIDTH] + chosen[[TOP, BOTTOM]]] * 3, axis=1)
    step = np.stack([chosen[[TOP, BOTTOM]]] * 3, axis=1)
    travel[:, 1:] += np.outer(error[:2], [-1, 1])
    step[:, 1:] += np.outer(error[2:], [-1, 1])
    if taken < len(_NEEDED):
        low, high, most = _possible(
            candidates.profile, independent * np.log(candidates.costs / least)
        )
        travel[:, 1] = np.minimum(travel[:, 1], low - error[:2])
        travel[:, 2] = np.maximum(travel[:, 2], high + error[:2])
        step[:, 2] = np.maximum(step[:, 2], most)
    return FittedBand(
        parameters=chosen,
        gain=float(left.gain[0]),
        travel=np.maximum(travel, 0.0),
        step=np.maximum(step, 0.0),
        cost=float(left.cost[0]),
        independent=independent,
        rests=left.rests[0],
        follower=left.follower[0],
    )


class _Scales:
    """Bounds and steps of the parameters, one row a joint."""

    def __init__(
        self, period_s: float, omega: float, amplitude: FloatArray, resolution: FloatArray
    ) -> None:
        ones = np.ones_like(amplitude)
        fine = np.maximum(resolution / 8, 5e-4 * amplitude)
        coarse = np.maximum(resolution, 0.01 * amplitude)
        self.unit = np.stack([ones / omega, ones / omega, *[2 * amplitude] * 3], axis=1)
        self.nudge = np.stack([ones * period_s / 20] * 2 + [fine] * 3, axis=1)
        self.least_move = np.stack([ones * period_s / 2] * 2 + [coarse] * 3, axis=1)
        self.lower = np.array([-period_s / 2, period_s / 10, 0.0, 0.0, 0.0])
        self.resolution = resolution


def _starts(period_s: float, omega: float, amplitude: FloatArray, lag: FloatArray) -> FloatArray:
    """Sets of parameters with the right lag, shape (j, p, 5)."""
    sets: list[FloatArray] = []
    for share in _WIDTHS:
        # Describing function of the play operator (Gelb and Vander Velde 1968): its lag.
        across = 1 - 2 * share
        inphase = 0.5 + (np.arcsin(across) + across * np.sqrt(1 - across**2)) / np.pi
        band_lag = np.arctan2((1 - across**2) / np.pi, inphase)
        rest_s = np.maximum(lag - band_lag, 0.0) / omega
        for part in _LAGS:
            follower_s = np.maximum(part * rest_s, period_s / 4)
            parameters = np.zeros((amplitude.size, PARAMETERS))
            parameters[:, DELAY], parameters[:, LAG] = (1 - part) * rest_s, follower_s
            parameters[:, WIDTH] = 2 * share * amplitude
            sets.append(parameters)
    return np.stack(sets, axis=1)


def _levenberg(
    cycles: WholeCycles, joint: IntArray, values: FloatArray, ties: FloatArray, scales: _Scales
) -> FloatArray:
    """Levenberg-Marquardt steps on rows of parameters ``ties @ values`` with bounds, in step."""
    rows, n = values.shape
    lower = scales.lower[:n]
    damping, idle = np.full(rows, 1e-3), np.zeros(rows, dtype=np.int64)
    values = np.maximum(values, lower)
    left = misfit(cycles, joint, np.einsum("rpn,rn->rp", ties, values)).residual
    slopes = np.empty((rows, n, *left.shape[1:]))
    tried = np.empty((rows, _FACTORS.size, n))
    moved = np.arange(rows, dtype=np.int64)
    for _ in range(_ITERATIONS):
        if moved.size:
            slopes[moved] = _slopes(
                cycles, joint[moved], values[moved], ties[moved], scales, left=left[moved]
            )
        active = np.flatnonzero(idle < _IDLE)
        for r in active:
            unit, slope = scales.unit[joint[r], :n], slopes[r].reshape(n, -1)
            normal, pull = slope @ slope.T, slope @ left[r].ravel()
            free = ~((values[r] <= lower + 1e-12) & (pull > 0))
            part = normal[np.ix_(free, free)]
            for m, factor in enumerate(_FACTORS):
                step = np.zeros(n)
                more = damping[r] * factor * np.diag(part) + 1e-12 * np.trace(part) + 1e-300
                step[free] = -np.linalg.solve(part + np.diag(more), pull[free])
                step *= unit
                most = np.maximum(0.4 * np.abs(values[r]), scales.least_move[joint[r], :n])
                step /= max(1.0, float(np.max(np.abs(step) / most)))
                tried[r, m] = np.maximum(values[r] + step, lower)
        full = np.einsum("rpn,rmn->rmp", ties[active], tried[active]).reshape(-1, PARAMETERS)
        misfits = misfit(cycles, np.repeat(joint[active], _FACTORS.size), full)
        costs = misfits.cost.reshape(active.size, -1)
        best = costs.argmin(axis=1)
        here = np.arange(active.size, dtype=np.int64)
        before = np.square(left[active]).sum(axis=(1, 2))
        better = costs[here, best] < before * (1 - _SAME)
        damping[active] = np.where(
            better, np.clip(damping[active] * _FACTORS[best], 1e-6, 1e4), 100 * damping[active]
        )
        idle[active] = np.where(better, 0, idle[active] + 1)
        if np.all(idle >= _IDLE):
            break
        moved = active[better]
        values[moved] = tried[moved, best[better]]
        left[moved] = misfits.residual[(_FACTORS.size * here + best)[better]]
    return values


def _slopes(
    cycles: WholeCycles,
    joint: IntArray,
    values: FloatArray,
    ties: FloatArray,
    scales: _Scales,
    *,
    left: FloatArray,
) -> FloatArray:
    """Return the derivatives of the residuals a unit, shape (r, m, k, n).

    Args:
        left: The residuals, shape (r, k, n).
    """
    rows, n = values.shape
    nudge = scales.nudge[joint, :n]
    sets = values[:, np.newaxis] + nudge[:, :, np.newaxis] * np.eye(n)
    full = np.einsum("rpn,rmn->rmp", ties, sets).reshape(-1, PARAMETERS)
    nudged = misfit(cycles, np.repeat(joint, n), full).residual.reshape(rows, n, *left.shape[1:])
    share = nudge / scales.unit[joint, :n]
    return (nudged - left[:, np.newaxis]) / share[:, :, np.newaxis, np.newaxis]


def _independent(residual: FloatArray) -> float:
    """How many independent residuals there are, from their correlation along and across cycles."""
    centred: FloatArray = residual - residual.mean()
    square = _mean(centred**2)
    if square == 0:
        return float(residual.size)
    along = max(0.0, _mean(centred[:, 1:] * centred[:, :-1]) / square)
    share = _mean(residual.mean(axis=0) ** 2) / square * _repeated(residual)
    cycles, samples = residual.shape
    return samples * (1 - along) / (1 + along) / (share + (1 - share) / cycles)


def _mean(values: FloatArray) -> float:
    return float(values.sum()) / values.size


def _repeated(residual: FloatArray) -> float:
    """Return the share of the mean cycle's residual that is the same in every cycle, 0 to 1."""
    mean = _mean(residual.mean(axis=0) ** 2)
    chance = _mean(residual.var(axis=0, ddof=1)) / len(residual)
    return max(0.0, 1 - chance / mean) if mean > 0 else 0.0


def _possible(profile: FloatArray, loss: FloatArray) -> tuple[float, float, float]:
    """Least and greatest W, and the greatest b, that the profile leaves possible."""
    fine = float(_SHARES[-1]) * np.arange(401, dtype=np.float64) / 400
    losses: FloatArray = np.interp(fine, _SHARES, loss)
    inside: BoolArray = losses <= _INSIDE
    if not inside.any():
        inside[int(losses.argmin())] = True
    travels: FloatArray = np.interp(fine, _SHARES, profile[:, WIDTH] + profile[:, TOP])
    steps: FloatArray = np.interp(fine, _SHARES, profile[:, TOP])
    could = travels[inside]
    return float(could.min()), float(could.max()), float(steps[inside].max())


def _free(fitted: _Candidate, scales: _Scales) -> IntArray:
    """Which of the fitted parameters are not at their bounds."""
    n = fitted.tie.shape[1]
    return np.flatnonzero(~(fitted.parameters[:n] <= scales.lower[:n] + 1e-12))


def _moved(
    cycles: WholeCycles, joints: Sequence[int], fits: Sequence[_Candidate], scales: _Scales
) -> list[FloatArray]:
    """Return the followers of each joint with each of its free parameters nudged [rad]."""
    free = [_free(fit, scales) for fit in fits]
    sets = [
        fit.parameters + fit.tie[:, which].T * scales.nudge[joint, which, np.newaxis]
        for joint, fit, which in zip(joints, fits, free, strict=True)
    ]
    counts = [which.size for which in free]
    if not any(counts):
        return [np.empty((0, *cycles.t_s[:, cycles.first :].shape)) for _ in joints]
    rows = np.repeat(np.array(joints, dtype=np.int64), counts)
    followers = misfit(cycles, rows, np.concatenate(sets)).follower[:, :, cycles.first :]
    return np.split(followers, np.cumsum(counts)[:-1])


def _errors(
    cycles: WholeCycles,
    joint: int,
    fitted: _Candidate,
    scales: _Scales,
    band_misfit: BandMisfit,
    *,
    nudged: FloatArray,
) -> FloatArray:
    """Half widths of W after top and bottom and of both b [rad], shape (4,).

    Delete-one jackknife over the cycles; what repeats in all of them, as an encoder's steps do,
    over segments of the mean cycle. The level of a plateau is known to an encoder's step at best.
    """
    tie = fitted.tie
    n = tie.shape[1]
    nudge, unit = scales.nudge[joint, :n], scales.unit[joint, :n]
    free = _free(fitted, scales)
    still = band_misfit.follower[0, :, cycles.first :]
    moved = nudged - still
    gain = float(band_misfit.gain[0])
    z: FloatArray = still - still.mean()
    columns = [gain * moved[k] * unit[m] / nudge[m] for k, m in enumerate(free)]
    design = np.stack([*columns, z, np.full_like(z, _mean(z**2) ** 0.5)])
    residual = band_misfit.residual[0]
    count, samples = residual.shape
    within = np.einsum("akn,bkn->kab", design, design)
    spread = _jackknife(within, np.einsum("akn,kn->ka", design, residual))
    mean, common = design.mean(axis=1), residual.mean(axis=0)
    segment = np.arange(samples, dtype=np.int64) * _SEGMENTS // samples
    parts = [mean[:, segment == s] for s in range(_SEGMENTS)]
    spread += _repeated(residual) * _jackknife(
        np.stack([part @ part.T for part in parts]),
        np.stack([part @ common[segment == s] for s, part in enumerate(parts)]),
    )
    covariance = np.zeros((PARAMETERS, PARAMETERS))
    inner = spread[: free.size, : free.size] * np.outer(unit[free], unit[free])
    into = tie[:, free]
    covariance += into @ inner @ into.T
    covariance[WIDTH, WIDTH] += (scales.resolution[joint] / max(gain, 0.1)) ** 2 / 12
    selection = np.zeros((4, PARAMETERS))
    selection[:2, WIDTH] = 1.0
    selection[[0, 2], TOP] = selection[[1, 3], BOTTOM] = 1.0
    variance = np.einsum("ap,pq,aq->a", selection, covariance, selection)
    return t_factor(min(count - 1, _SEGMENTS - PARAMETERS)) * np.sqrt(variance)


def _jackknife(normals: FloatArray, pulls: FloatArray) -> FloatArray:
    """Return the covariance from leaving out one group at a time, linearised; groups first."""
    total: FloatArray = normals.sum(axis=0)
    groups = len(normals)
    ridge = 1e-9 * np.diag(np.diag(total))
    change: FloatArray = np.linalg.solve(total - normals + ridge, pulls[:, :, np.newaxis]).astype(
        np.float64
    )[:, :, 0]
    return (groups - 1) / groups * change.T @ change
