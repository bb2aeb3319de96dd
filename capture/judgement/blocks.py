"""What a joint's response leaves, in blocks of time: offset, gain, lag and noise of each block.

The residual of each response is regressed, in blocks, on one, on the response and on its rate:
offset, relative gain and lag of each block; the logarithm of what is left is its noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from ..common.arrays import BoolArray, FloatArray, IntArray
from .exposure import Exposure
from .levels import (
    ENOUGH_LIKE,
    FEWEST,
    FULL,
    NEGLIGIBLE,
    REST_ERRORS,
    ROBUST,
    TAME,
    TINY,
)
from .motion import Course, cycle_s, is_sweep

MOST = FEWEST * FEWEST
"""Blocks that a course is divided into at most: onsets to 1.6 % of the record."""

SHORTEST_S = 2.0
"""Time on either side of a change, at least [s]; also so many blocks: one alone may hold a step of
the command that no response fits."""

RIDGE = NEGLIGIBLE * NEGLIGIBLE
"""Ridge on gain and lag, relative to the median block: less than 0.1 % of them is lost."""

INFORMED = 1 - FULL
"""Share of the information of the best blocks below which a block is left out."""

EPS = float(np.finfo(np.float64).eps)

QUANTITIES = ("offset", "gain", "lag", "noise")
TERMS = len(QUANTITIES) - 1
"""Of the regression: one, the response, and its negative rate."""


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
class Blocks:
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


def blocks_of(course: Course, exposure: Exposure, usable: BoolArray) -> Blocks | None:
    """Regress the residual of each joint in each block, of half cycles where there are cycles."""
    length_s = float(course.t_s[-1] - course.t_s[0])
    cycles = [cycle_s(command, course.step_s) / 2 for command in course.command]
    rhythms = tuple(FEWEST * cycle <= length_s for cycle in cycles)
    half = max((cycle for cycle in cycles if FEWEST * cycle <= length_s), default=0.0)
    shortest = max(length_s / MOST, 2 * correlation_s(course, exposure, usable, rhythms))
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
        rows = rows_of(course, exposure, usable[k], k)
        rows[-1], scatter = _tamed(rows[-1], usable[k], count, width)
        moments = moments_of(rows * usable[k], rows, starts, width)
        values[:TERMS, k], weights[:, k], left[k] = _regressed(moments, width)
        lost[k] = REST_ERRORS * _middle(scatter[weights[TERMS, k] > 0])
        # Below the usual noise no change is of interest.
        values[TERMS, k] = np.log(np.hypot(scatter, exposure.rest_rad[k] / 2) + EPS)
    weights[:TERMS] /= _excess_noise(left, weights[TERMS], exposure)
    best = np.quantile(weights, FULL, axis=2, keepdims=True)
    weights[weights < INFORMED * best] = 0
    edges = course.t_s[0] + width * course.step_s * np.arange(count + 1)
    swept = tuple(is_sweep(command) for command in course.command)
    return Blocks(values, weights, np.asarray(edges, dtype=np.float64), half, lost, rhythms, swept)


def rows_of(course: Course, exposure: Exposure, usable: BoolArray, k: int) -> FloatArray:
    """Return one, a response about its mean, its negative rate and the residual, shape (4, n).

    Args:
        usable: Steps of the joint that are looked at, shape (n,).
        k: The joint.

    Returns:
        Without unit, [rad], [rad/s] and [rad].
    """
    response = exposure.fitted[k]
    rate = np.gradient(response, course.step_s)
    level = float(response @ usable) / max(int(usable.sum()), 1)
    return np.stack([np.ones_like(rate), response - level, -rate, course.position[k] - response])


def moments_of(weighted: FloatArray, rows: FloatArray, starts: IntArray, width: int) -> FloatArray:
    """Return the sums of the products of rows in each block.

    Args:
        weighted: The rows times the weight of each sample, shape (4, n).
        rows: Of :func:`rows_of`, shape (4, n).
        starts: First sample of each block, shape (b,).
        width: Samples of a block.

    Returns:
        Shape (b, 4, 4).
    """
    stop = int(starts[-1]) + width
    products = weighted[:, None, :stop] * rows[None, :, :stop]
    return np.moveaxis(np.add.reduceat(products, starts, axis=2), 2, 0)


def _excess_noise(left: FloatArray, weights: FloatArray, exposure: Exposure) -> FloatArray:
    """Return by how much what is left of a joint exceeds that of like joints in the same time.

    Args:
        left: Mean squares of k joints in b blocks, shape (k, b).
        weights: Of their logarithms, shape (k, b).

    Returns:
        Ratios of mean squares, 1 or more, shape (k, b): against the joint's own usual one, and
        without that of a few blocks, which a motion that no response fits may have.
    """
    noise, remaining = without_common(np.log(left + EPS**2), weights, exposure)
    for k in range(len(noise)):
        if len(exposure.group(k)) < ENOUGH_LIKE:
            noise[k] = 0.0
            continue
        noise[k] = np.where(remaining[k] > 0, noise[k] - _middle(noise[k, remaining[k] > 0]), 0.0)
    around = np.pad(noise, ((0, 0), (REST_ERRORS, REST_ERRORS)), mode="edge")
    lasting = np.median(sliding_window_view(around, 2 * REST_ERRORS + 1, axis=1), axis=2)
    return np.exp(np.maximum(lasting, 0.0))


def _middle(values: FloatArray) -> float:
    """Return the median; 0 of none."""
    return float(np.median(values)) if values.size else 0.0


def _tamed(
    residual: FloatArray, there: BoolArray, count: int, width: int
) -> tuple[FloatArray, FloatArray]:
    """Bring what is far from the middle of its block to the limit of :data:`TAME` deviations.

    Returns:
        The residual, shape (n,), and the robust standard deviation of each block, shape (b,).
    """
    blocks = np.where(there, residual, np.nan)[: count * width].reshape(count, width)
    filled = np.isfinite(blocks).any(axis=1)
    middle, scale = np.zeros((2, count, 1))
    middle[filled] = np.nanmedian(blocks[filled], axis=1, keepdims=True)
    scale[filled] = ROBUST * np.nanmedian(np.abs(blocks - middle)[filled], axis=1, keepdims=True)
    limited = np.clip(blocks, middle - TAME * scale, middle + TAME * scale)
    result = residual.copy()
    result[: count * width] = np.nan_to_num(limited).ravel()
    return result, scale[:, 0]


def _regressed(moments: FloatArray, width: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Regress the residual in each block.

    Returns:
        Offset, gain and lag, shape (q - 1, b), weights, shape (q, b), and the mean square of what
        is left, shape (b,).
    """
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


def correlation_s(
    course: Course, exposure: Exposure, usable: BoolArray, in_parts: Sequence[bool]
) -> float:
    """Return the median time over the joints after which the residual's correlation is below 1/e.

    Args:
        usable: Steps that are looked at, shape (k, n).
        in_parts: Of which joints it is that within parts of the record, so that a change doesn't
            make it longer, k.
    """
    times: list[float] = []
    for k in range(course.position.shape[0]):
        residual = (course.position[k] - exposure.fitted[k])[usable[k]]
        parts = FEWEST if in_parts[k] else 1
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


def without_common(
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
        measured = np.where(weights[others] > 0, values[others], np.nan)
        enough = np.sum(weights[others] > 0, axis=0) >= ENOUGH_LIKE - 1
        result[k, enough] -= np.nanmedian(measured[:, enough], axis=0)
        compared[k, ~enough] = 0
    return result, compared
