"""A lasting change of a joint's gain, lag or offset: a break of one regression over the record.

Ordinary work shows a gain or a lag only where it moves, so that few blocks of time know either
(:mod:`.shifts` needs eight). The residual of a joint's response is regressed over the whole record,

    r(t) = b0 + b1 p(t) - b2 p'(t) + c z(t) [t >= t0] + e(t),                                  (1)

on one, on the response p and on its rate p', with a change c of one of the three, z, at t0 (Chow,
Econometrica 28, 1960, doi 10.2307/1910133; t0 by search: Andrews, Econometrica 61, 1993, doi
10.2307/2951764). The error of c is that of sums over blocks of time, each as large as what (1)
leaves in it (Liang & Zeger, Biometrika 73, 1986, doi 10.1093/biomet/73.1.13), with Student's
distribution for as many blocks as would have the weight of all, each with the same. Level:
Bonferroni over the joints, times and quantities. As play and stick make another gain of every other
motion, a break explains besides at least half of what the response leaves.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import inf

import numpy as np
from scipy.special import stdtrit

from ..common.arrays import BoolArray, FloatArray
from .blocks import EPS, MOST, QUANTITIES, TERMS, Jump, correlation_s, moments_of, rows_of
from .exposure import LIKE_LAG_S, Exposure
from .levels import (
    ANGLE_MARGIN_RAD,
    COVERAGE,
    ENOUGH_LIKE,
    FEWEST,
    GAIN_MARGIN,
    LARGEST_REST_RAD,
    LEVEL,
    QUARTER,
    ROBUST,
    TINY,
    WIDTH,
    reaches,
)
from .motion import Course, is_sweep


@dataclass(frozen=True)
class Breaks:
    """Changes of one, p and -p' of one joint at b - 1 times; all arrays have shape (3, b - 1).

    Attributes:
        change: c of equation (1).
        before: b0, b1 or b2, the coefficient until then.
        error: Standard error of c.
        freedom: Degrees of freedom of the error; below 1 where too little is known.
        drop: Of the sum of squares.
        left: Sum of squares that is left.
    """

    change: FloatArray
    before: FloatArray
    error: FloatArray
    freedom: FloatArray
    drop: FloatArray
    left: FloatArray


def find_breaks(course: Course, exposure: Exposure, usable: BoolArray) -> list[tuple[float, Jump]]:
    """Find the break of each joint that explains most.

    Args:
        usable: Steps that are looked at, shape (k, n).

    Returns:
        Those beyond the level that explain half or more of what the response leaves, and that
        matter, each with the part of the sum of squares that it explains [rad^2].
    """
    joints = len(course.command)
    length_s = float(course.t_s[-1] - course.t_s[0])
    longest_s = 2 * correlation_s(course, exposure, usable, [True] * joints)
    count = min(int(length_s / max(longest_s, length_s / MOST)), MOST)
    if count < FEWEST:
        return []
    width = course.t_s.size // count
    starts = width * np.arange(count, dtype=np.int64)
    rows = [rows_of(course, exposure, usable[k], k) for k in range(joints)]
    moments = [moments_of(r * usable[k], r, starts, width) for k, r in enumerate(rows)]
    breaks = [breaks_of(each) for each in moments]
    block_s = width * course.step_s
    found: list[tuple[float, Jump]] = []
    for k, own in enumerate(breaks):
        others = [breaks[j].change for j in exposure.group(k) if j != k]
        change, error = _beside(own, others)
        shown = (own.freedom >= 1) & (own.drop > own.left)
        shown &= np.abs(change) > error * _limit(own.freedom, TERMS * joints * (count - 1))
        shown &= _unexpected(own, change, len(others) >= ENOUGH_LIKE - 1, course.command[k])
        if not shown.any():
            continue
        q, cut = np.unravel_index(int(np.argmax(np.where(shown, own.drop, 0.0))), shown.shape)
        size, half = float(change[q, cut]), float(error[q, cut])
        if not _matters(int(q), size, half, moments[k]):
            continue
        if QUANTITIES[q] == "gain":  # relative to before, when the joint responded at all
            before = max(1 + float(own.before[q, cut]), QUARTER)
            size, half = size / before, half / before
        at_s = float(course.t_s[0]) + (int(cut) + 1) * block_s
        jump = Jump(k, QUANTITIES[q], size, half, at_s, inf, block_s)
        found.append((float(own.drop[q, cut]), jump))
    return found


def _beside(own: Breaks, others: list[FloatArray]) -> tuple[FloatArray, FloatArray]:
    """Return changes and their errors, without what like joints do at the same time."""
    if len(others) < ENOUGH_LIKE - 1:
        return own.change, own.error
    middle = np.median(others, axis=0)
    spread = ROBUST * np.median(np.abs(others - middle), axis=0)
    return own.change - middle, np.hypot(own.error, spread / np.sqrt(len(others)))


def _unexpected(own: Breaks, change: FloatArray, compared: bool, command: FloatArray) -> BoolArray:
    """Mark the changes that healthy joints don't have, shape (3, b - 1)."""
    unexpected = np.ones(change.shape, dtype=np.bool_)
    if not compared:  # a soft servo rests elsewhere in another posture
        unexpected[0] = np.abs(change[0]) > LARGEST_REST_RAD
    if is_sweep(command):  # another time is another frequency, to which each joint responds
        least = np.array([[QUARTER], [LIKE_LAG_S]])
        unexpected[1:] = (np.abs(change[1:]) > least) & (own.freedom[1:] >= FEWEST) & compared
    return unexpected


def _matters(q: int, change: float, error: float, moments: FloatArray) -> bool:
    """Return whether a change reaches the margin: of an angle by what it makes of the motion."""
    total = moments.sum(axis=0)
    effective = np.sqrt(total[q, q] / max(float(total[0, 0]), 1.0))
    margin = GAIN_MARGIN if QUANTITIES[q] == "gain" else ANGLE_MARGIN_RAD / max(effective, TINY)
    return reaches(abs(change), WIDTH * error, margin)


def breaks_of(moments: FloatArray) -> Breaks:
    """Regress equation (1) for a change at each border of two blocks.

    Args:
        moments: Sums over the samples of each block of the products of one, p, -p' and r, shape
            (b, 4, 4); p and r in [rad].
    """
    total = moments.sum(axis=0)
    after = total - np.cumsum(moments, axis=0)[:-1]
    gram, target = total[:TERMS, :TERMS], total[:TERMS, TERMS]
    scale = np.sqrt(np.maximum(np.diagonal(gram), TINY))
    scaled: FloatArray = gram / np.outer(scale, scale)
    inverse = np.linalg.inv(scaled + EPS * np.eye(TERMS)) / np.outer(scale, scale)
    common = inverse @ target
    most = float(total[TERMS, TERMS] - common @ target)
    each = [_change_of(q, moments, after, inverse, common) for q in range(TERMS)]
    change, before, error, freedom, drop = (np.stack(rows) for rows in zip(*each, strict=True))
    return Breaks(change, before, error, freedom, drop, np.maximum(most - drop, 0.0))


def _change_of(
    q: int, moments: FloatArray, after: FloatArray, inverse: FloatArray, common: FloatArray
) -> tuple[FloatArray, ...]:
    """Return change, coefficient before, error, freedom and drop of one term, each (b - 1,)."""
    gram, target = moments[:, :TERMS, :TERMS], moments[:, :TERMS, TERMS]
    along = after[:, :TERMS, q] @ inverse  # what the common terms make of z [t >= t0], (cut, 3)
    free = after[:, q, q] - np.einsum("ci,ci->c", along, after[:, :TERMS, q])
    known = free > np.sqrt(EPS) * float(moments[:, q, q].sum())
    free = np.where(known, free, 1.0)
    change = np.where(known, (after[:, q, TERMS] - after[:, :TERMS, q] @ common) / free, 0.0)
    terms = common - change[:, None] * along
    behind = np.arange(len(moments)) >= np.arange(1, len(moments))[:, None]  # (cut, block)
    # Of each block: the sum of the free part of z [t >= t0] times what (1) leaves, and its power.
    part = behind[:, :, None] * np.eye(TERMS)[q] - along[:, None, :]
    left = target - np.einsum("bij,cj->cbi", gram, terms)
    left -= (change[:, None] * behind)[:, :, None] * gram[:, :, q]
    scores = np.einsum("cbi,cbi->cb", part, left)
    power = np.einsum("cbi,bij,cbj->cb", part, gram, part)
    blocks = free**2 / np.maximum(np.sum(power**2, axis=1), TINY)
    freedom = np.where(known, blocks - 2, 0.0)  # a mean before and one after
    squares = np.maximum(np.sum(scores**2, axis=1), TINY)
    rho = np.clip(np.sum(scores[:, 1:] * scores[:, :-1], axis=1) / squares, 0, COVERAGE)
    squares *= (1 + rho) / (1 - rho) * blocks / np.maximum(freedom, 1)
    return change, terms[:, q], np.sqrt(squares) / free, freedom, change**2 * free


def _limit(freedom: FloatArray, tests: int) -> FloatArray:
    """Return how many errors a change must have."""
    return np.asarray(-stdtrit(np.maximum(freedom, 1.0), LEVEL / 2 / tests), dtype=np.float64)
