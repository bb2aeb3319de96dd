"""When a joint's gain, lag, offset or noise changed: change points with a level.

The residual of a joint's response is regressed, in blocks of time, on one, on the response and on
its rate: offset, relative gain and lag of each block; the logarithm of what is left is its noise.
Where there are like joints, their median in the same block is taken off: what all do is no joint's
change. A change is a shift of one of the four for a run of blocks, or a drift of the offset
(:mod:`.shifts`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import inf

import numpy as np
from scipy.ndimage import median_filter

from ..common.arrays import BoolArray, FloatArray, IntArray
from .exposure import LIKE_LAG_S, Exposure
from .levels import (
    ANGLE_MARGIN_RAD,
    ENOUGH_LIKE,
    FEWEST,
    FULL,
    GAIN_MARGIN,
    LEAST_RANGE_RAD,
    NEGLIGIBLE,
    QUARTER,
    REST_ERRORS,
    ROBUST,
    TAME,
    TINY,
    WIDTH,
    reaches,
)
from .motion import Course, cycle_s, is_sweep
from .shifts import (
    Shift,
    correlation_of,
    drift_of,
    largest_shift,
    limited_weights,
    without_single,
)

MOST = FEWEST * FEWEST
"""Blocks that a course is divided into at most: onsets to 1.6 % of the record."""

SHORTEST_S = 2.0
"""Time on either side of a change, at least [s]; also so many blocks: one alone may hold a step of
the command that no response fits."""

RIDGE = NEGLIGIBLE * NEGLIGIBLE
"""Ridge on gain and lag, relative to the median block: less than 0.1 % of them is lost."""

INFORMED = 1 - FULL
"""Share of the information of the best blocks below which a block is left out."""

NOISE_MARGIN = float(np.log(2.0))
"""Logarithm of the ratio of noise that matters: twice as much."""

EPS = float(np.finfo(np.float64).eps)

QUANTITIES = ("offset", "gain", "lag", "noise")
TERMS = len(QUANTITIES) - 1  # of the regression


@dataclass(frozen=True)
class Jump:
    """A change of one quantity of one joint.

    Attributes:
        joint: Its index.
        quantity: Of :data:`QUANTITIES`, or ``drift`` of the offset.
        change: From before to after: [rad], relative to before, [s], logarithm of the ratio.
        error: Its standard error.
        first_s: When it changed [s].
        last_s: When it was as before again [s]; inf for a lasting change.
        block_s: Length of a block [s]: the times are known to half of it at best.
    """

    joint: int
    quantity: str
    change: float
    error: float
    first_s: float
    last_s: float
    block_s: float


@dataclass(frozen=True)
class _Blocks:
    """Estimates of k joints in b blocks, with the weights of each, shape (q, k, b)."""

    values: FloatArray
    weights: FloatArray
    edges_s: FloatArray
    half_s: float  # half of the longest cycle; 0 where the commands are no rhythms
    lost_rad: FloatArray  # what the response leaves in half of the blocks, three deviations
    rhythms: tuple[bool, ...]  # whether a command repeats
    swept: tuple[bool, ...]  # whether the frequency of a command follows from the time

    @property
    def shortest(self) -> int:
        """Blocks of a change, at least."""
        block_s = float(self.edges_s[1] - self.edges_s[0])
        least_s = max(2 * REST_ERRORS * self.half_s, SHORTEST_S)
        return max(int(SHORTEST_S), int(np.ceil(least_s / block_s - NEGLIGIBLE)))


def find_jumps(course: Course, exposure: Exposure, usable: BoolArray) -> list[Jump]:
    """Find the largest change of each joint and quantity.

    Args:
        usable: Steps that are looked at, shape (k, n): without those at which a joint stands.

    Returns:
        Those beyond the level and the size that matters, joint by joint.
    """
    blocks = _blocks(course, exposure, usable & _running(course, exposure))
    if blocks is None:
        return []
    best: dict[int, tuple[float, Jump]] = {}

    def offer(k: int, quantity: str, shift: Shift | None) -> None:
        if shift is None or not _matters(quantity, k, exposure, shift, blocks):
            return
        drop = 0.0 if quantity == "noise" else shift.drop  # it is what no other quantity explains
        if k not in best or drop > best[k][0]:
            best[k] = drop, _jump(k, quantity, shift, blocks.edges_s)

    for q, quantity in enumerate(QUANTITIES):
        values, weights = _without_common(blocks.values[q], blocks.weights[q], exposure)
        weights = limited_weights(without_single(values, weights))
        rho = correlation_of(values, weights)
        tests = weights.shape[0] * len(QUANTITIES)
        for k, (value, weight) in enumerate(zip(values, weights, strict=True)):
            compared = len(exposure.group(k)) >= ENOUGH_LIKE
            shift = largest_shift(value, weight, rho, tests, blocks.shortest, compared=compared)
            offer(k, quantity, shift)
            if quantity == "offset":
                offer(k, "drift", drift_of(value, weight, rho, tests))
    return [best[k][1] for k in sorted(best)]


def _running(course: Course, exposure: Exposure) -> BoolArray:
    """Mark the steps from the first motion of a command to the last one and its settling."""
    runs = np.zeros(course.t_s.size, dtype=np.bool_)
    begins, ends = (
        np.flatnonzero(np.any(np.abs(course.command - course.command[:, [k]]) > LEAST_RANGE_RAD, 0))
        for k in (0, -1)
    )
    if begins.size and ends.size:
        settling = int(np.max(exposure.settling_s) / course.step_s)
        runs[max(int(begins[0]) - 1, 0) : int(ends[-1]) + 2 + settling] = True
    return runs


def _jump(k: int, quantity: str, run: Shift, edges_s: FloatArray) -> Jump:
    """Turn a run of blocks into a change; one that begins the record is undone at its end."""
    change, before, first, last = run.change, run.outside, run.first, run.last
    count = edges_s.size - 1
    if first == 0 and last < count:
        change, before, first, last = -change, before + change, last, count
    if quantity == "gain":
        change /= 1 + before
    return Jump(
        k,
        quantity,
        change,
        run.error,
        float(edges_s[first]),
        inf if last == count else float(edges_s[last]),
        float(edges_s[1] - edges_s[0]),
    )


def _matters(quantity: str, k: int, exposure: Exposure, run: Shift, blocks: _Blocks) -> bool:
    """Return whether a change is one that matters: its interval isn't within the margin.

    Where the command is no rhythm, and no like joints have one, it is also beyond what a response
    leaves of the joint's motion, and the command is no sweep: play, stick and poles beyond two make
    another gain of every other motion.
    """
    compared = len(exposure.group(k)) >= ENOUGH_LIKE
    alone = not (compared and blocks.half_s)
    if quantity == "noise":  # of unlike joints it grows and falls with the motion
        margin = 2 * NOISE_MARGIN if alone else NOISE_MARGIN
        return compared and not blocks.swept[k] and _reaches(run, margin)
    repeats = blocks.rhythms[k] or not alone
    lost = 0.0 if repeats else float(blocks.lost_rad[k])
    if quantity in ("offset", "drift"):
        return _reaches(run, ANGLE_MARGIN_RAD) and abs(run.change) > lost
    inside = slice(run.first, run.last)
    _, motion, rate, count = blocks.weights[:, k]
    lasting = run.first == 0 or run.last == count.size
    if blocks.swept[k]:  # another time is another frequency, to which each joint responds
        least = QUARTER if quantity == "gain" else LIKE_LAG_S
        if not (compared and lasting and abs(run.change) > least):
            return False
    samples = max(float(count[inside].sum()), 1.0)
    amplitude = max(np.sqrt(2 * float(motion[inside].sum()) / samples), TINY)
    if quantity == "gain":
        return _reaches(run, GAIN_MARGIN) and abs(run.change) > lost / amplitude
    speed = max(np.sqrt(2 * float(rate[inside].sum()) / samples), TINY)
    # One degree of a cycle; without one, as an angle of the wave of that amplitude and rate.
    margin = ANGLE_MARGIN_RAD * (blocks.half_s / np.pi or amplitude / speed)
    return _reaches(run, margin) and abs(run.change) > lost / speed


def _reaches(run: Shift, margin: float) -> bool:
    """Return whether a change, by its 95 % interval, reaches a margin."""
    return reaches(abs(run.change), WIDTH * run.error, margin)


def _blocks(course: Course, exposure: Exposure, usable: BoolArray) -> _Blocks | None:
    """Regress the residual of each joint in each block, of half cycles where there are cycles."""
    length_s = float(course.t_s[-1] - course.t_s[0])
    cycles = [cycle_s(command, course.step_s) / 2 for command in course.command]
    half = max((cycle for cycle in cycles if np.isfinite(cycle)), default=0.0)
    rhythms = tuple(bool(np.isfinite(cycle)) for cycle in cycles)
    shortest = max(length_s / MOST, 2 * _correlation_s(course, exposure, usable, rhythms))
    whole = max(1.0, np.ceil(shortest / half)) * half if half else shortest
    count = min(int(length_s / whole), MOST)
    if count < FEWEST:
        return None
    width = course.t_s.size // count
    starts = width * np.arange(count, dtype=np.int64)
    joints = course.position.shape[0]
    values = np.zeros((len(QUANTITIES), joints, count))
    weights = np.zeros_like(values)
    left = np.zeros((joints, count))
    lost = np.zeros(joints)
    for k in range(joints):
        residual = course.position[k] - exposure.fitted[k]
        rate = np.gradient(exposure.fitted[k], course.step_s)
        there = usable[k].astype(np.float64)
        level = float(exposure.fitted[k] @ there) / max(float(there.sum()), 1.0)
        residual, scatter = _tamed(residual, there, count, width)
        rows = np.stack([np.ones_like(rate), exposure.fitted[k] - level, -rate, residual])
        values[:TERMS, k], weights[:, k], left[k] = _regressed(rows * there, rows, starts, width)
        lost[k] = REST_ERRORS * _middle(scatter[weights[TERMS, k] > 0])
        # Below the usual noise no change is of interest.
        values[TERMS, k] = np.log(np.hypot(scatter, exposure.rest_rad[k] / 2) + EPS)
    weights[:TERMS] /= _excess_noise(left, weights[TERMS], exposure)
    best = np.quantile(weights, FULL, axis=2, keepdims=True)
    weights[weights < INFORMED * best] = 0
    edges = course.t_s[0] + width * course.step_s * np.arange(count + 1)
    swept = tuple(is_sweep(command) for command in course.command)
    return _Blocks(values, weights, np.asarray(edges, dtype=np.float64), half, lost, rhythms, swept)


def _excess_noise(left: FloatArray, weights: FloatArray, exposure: Exposure) -> FloatArray:
    """Return by how much what is left of a joint exceeds that of like joints in the same time.

    Args:
        left: Mean squares of k joints in b blocks, shape (k, b).
        weights: Of their logarithms, shape (k, b).

    Returns:
        Ratios of mean squares, 1 or more, shape (k, b): against the joint's own usual one, and
        without that of a few blocks, which a motion that no response fits may have.
    """
    noise, known = _without_common(np.log(left + EPS**2), weights, exposure)
    for k in range(len(noise)):
        if len(exposure.group(k)) < ENOUGH_LIKE:
            noise[k] = 0.0
            continue
        noise[k] = np.where(known[k] > 0, noise[k] - _middle(noise[k, known[k] > 0]), 0.0)
    lasting = median_filter(noise, (1, 2 * REST_ERRORS + 1), mode="nearest")
    return np.exp(np.maximum(lasting, 0.0))


def _middle(values: FloatArray) -> float:
    """Return the median; 0 of none."""
    return float(np.median(values)) if values.size else 0.0


def _tamed(
    residual: FloatArray, there: FloatArray, count: int, width: int
) -> tuple[FloatArray, FloatArray]:
    """Bring what is far from the middle of its block to the limit of :data:`TAME` deviations.

    Returns:
        The residual, shape (n,), and the robust standard deviation of each block, shape (b,).
    """
    blocks = np.where(there > 0, residual, np.nan)[: count * width].reshape(count, width)
    known = np.isfinite(blocks).any(axis=1)
    middle, scale = np.zeros((2, count, 1))
    middle[known] = np.nanmedian(blocks[known], axis=1, keepdims=True)
    scale[known] = ROBUST * np.nanmedian(np.abs(blocks - middle)[known], axis=1, keepdims=True)
    limited = np.clip(blocks, middle - TAME * scale, middle + TAME * scale)
    result = residual.copy()
    result[: count * width] = np.nan_to_num(limited).ravel()
    return result, scale[:, 0]


def _regressed(
    weighted: FloatArray, rows: FloatArray, starts: IntArray, width: int
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Regress the residual in each block.

    Returns:
        Offset, gain and lag, shape (q - 1, b), weights, shape (q, b), and the mean square of what
        is left, shape (b,).
    """
    stop = int(starts[-1]) + width
    products = weighted[:, None, :stop] * rows[None, :, :stop]
    moments = np.moveaxis(np.add.reduceat(products, starts, axis=2), 2, 0)
    gram, target = moments[:, :TERMS, :TERMS], moments[:, :TERMS, TERMS]
    count = gram[:, 0, 0]
    typical = np.median(np.diagonal(gram, axis1=1, axis2=2), axis=0)
    scale = np.sqrt(np.where(typical > 0, typical, 1.0))
    scaled = gram / scale[:, None] / scale[None, :]
    # A block without motion knows its offset only: the ridge keeps the rest at 0, weightless.
    ridge = np.full(TERMS, RIDGE)
    ridge[0] = EPS
    inverse = np.linalg.inv(scaled + np.diag(ridge))
    inverse /= scale[:, None] * scale[None, :]
    estimate = np.einsum("bij,bj->bi", inverse, target)
    weights = np.concatenate(
        [1 / np.maximum(np.diagonal(inverse, axis1=1, axis2=2).T, TINY), [count]]
    )
    weights[:, count < FULL * width] = 0
    squares = moments[:, TERMS, TERMS] - np.einsum("bi,bi->b", estimate, target)
    left = np.maximum(squares, 0) / np.maximum(count, 1)
    return estimate.T, weights, left


def _correlation_s(
    course: Course, exposure: Exposure, usable: BoolArray, rhythms: Sequence[bool]
) -> float:
    """Return the median time after which the residuals' correlation is below 1/e.

    Of a rhythm it is that within parts of the record, so that a change doesn't make it longer.
    """
    times: list[float] = []
    for k in range(course.position.shape[0]):
        residual = (course.position[k] - exposure.fitted[k])[usable[k]]
        parts = FEWEST if rhythms[k] else 1
        width = residual.size // parts
        if residual.size < 2 * FEWEST:
            continue
        rows: FloatArray = residual[: parts * width].reshape(parts, width)
        rows = rows - rows.mean(axis=1, keepdims=True)
        correlation = np.fft.irfft(np.abs(np.fft.rfft(rows, 2 * width)) ** 2)[:, :width]
        below = correlation < correlation[:, :1] / np.e
        steps = below.argmax(axis=1).astype(np.float64)
        steps[~below.any(axis=1)] = width
        times.append(float(np.median(steps)) * course.step_s)
    return float(np.median(times)) if times else 0.0


def _without_common(
    values: FloatArray, weights: FloatArray, exposure: Exposure
) -> tuple[FloatArray, FloatArray]:
    """Take off each block the median of the like joints that are known in it.

    Returns:
        Values and weights; a block in which too few are known has no weight.
    """
    result, compared = values.copy(), weights.copy()
    for k in range(values.shape[0]):
        others = [j for j in exposure.group(k) if j != k]
        if len(others) < ENOUGH_LIKE - 1:
            continue
        known = np.where(weights[others] > 0, values[others], np.nan)
        enough = np.sum(weights[others] > 0, axis=0) >= ENOUGH_LIKE - 1
        result[k, enough] -= np.nanmedian(known[:, enough], axis=0)
        compared[k, ~enough] = 0
    return result, compared
