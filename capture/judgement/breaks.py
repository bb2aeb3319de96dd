"""A lasting change of a joint's gain, lag or offset: a break of one regression over the record.

Ordinary work shows a gain or a lag only where it moves, so that few blocks of time know either
(:mod:`.shifts` needs eight). The residual of a joint's response is regressed over the whole record,

    r(t) = b0 + b1 p(t) - b2 p'(t) + d [t >= t0] + c z(t) [t >= t0] + e(t),                    (1)

on one, on the response p and on its rate p', with a change c of one of the three, z, at t0, and of
a gain or a lag beside a change d of the offset: of two postures these are the same (Chow,
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
    HALF,
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
        drop: Of the sum of squares, of gain and lag beside that of a change of the offset.
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
    breaks = [breaks_of(moment) for moment in moments]
    block_s = width * course.step_s
    jumps: list[tuple[float, Jump]] = []
    for k, candidate in enumerate(breaks):
        others = [breaks[j].change for j in exposure.group(k) if j != k]
        change, error = _beside(candidate, others)
        shown = (candidate.freedom >= 1) & (candidate.drop > candidate.left)
        shown &= np.abs(change) > error * _limit(candidate.freedom, TERMS * joints * (count - 1))
        shown &= _unexpected(candidate, change, len(others) >= ENOUGH_LIKE - 1, course.command[k])
        if not shown.any():
            continue
        q, cut = np.unravel_index(int(np.argmax(np.where(shown, candidate.drop, 0.0))), shown.shape)
        size, half = float(change[q, cut]), float(error[q, cut])
        if not _matters(int(q), size, half, moments[k]):
            continue
        if _rests_on_one_block(int(q), int(cut), moments[k]):
            continue
        if QUANTITIES[q] == "gain":  # relative to before, when the joint responded at all
            before = max(1 + float(candidate.before[q, cut]), QUARTER)
            size, half = size / before, half / before
        at_s = float(course.t_s[0]) + (int(cut) + 1) * block_s
        jump = Jump(k, QUANTITIES[q], size, half, at_s, inf, block_s)
        jumps.append((float(candidate.drop[q, cut]), jump))
    return jumps


def _beside(breaks: Breaks, others: list[FloatArray]) -> tuple[FloatArray, FloatArray]:
    """Return changes and their errors, without what like joints do at the same time."""
    if len(others) < ENOUGH_LIKE - 1:
        return breaks.change, breaks.error
    middle = np.median(others, axis=0)
    spread = ROBUST * np.median(np.abs(others - middle), axis=0)
    return breaks.change - middle, np.hypot(breaks.error, spread / np.sqrt(len(others)))


def _unexpected(
    breaks: Breaks, change: FloatArray, compared: bool, command: FloatArray
) -> BoolArray:
    """Mark the changes that healthy joints don't have, shape (3, b - 1)."""
    unexpected = np.ones(change.shape, dtype=np.bool_)
    if not compared:  # a soft servo rests elsewhere in another posture
        unexpected[0] = np.abs(change[0]) > LARGEST_REST_RAD
    if is_sweep(command):  # another time is another frequency, to which each joint responds
        least = np.array([[QUARTER], [LIKE_LAG_S]])
        unexpected[1:] = (np.abs(change[1:]) > least) & (breaks.freedom[1:] >= FEWEST) & compared
    return unexpected


def _matters(q: int, change: float, error: float, moments: FloatArray) -> bool:
    """Return whether a change reaches the margin: of an angle by what it makes of the motion."""
    total = moments.sum(axis=0)
    effective = np.sqrt(total[q, q] / max(float(total[0, 0]), 1.0))
    margin = GAIN_MARGIN if QUANTITIES[q] == "gain" else ANGLE_MARGIN_RAD / max(effective, TINY)
    return reaches(abs(change), WIDTH * error, margin)


def _rests_on_one_block(q: int, cut: int, moments: FloatArray) -> bool:
    """Return whether a change is another, or hardly known, without one of the blocks.

    Where steps are the only motion, a sample or two between a command and its response decide what
    is a change and what isn't, and they agree with themselves.
    """
    terms = [*range(TERMS), *sorted({0, q}), TERMS]
    behind = np.arange(len(moments)) > cut
    later = np.arange(len(terms)) >= TERMS
    later[-1] = False
    kept = np.where(behind[:, None, None] | ~(later[:, None] | later[None, :]), 1.0, 0.0)
    parts = moments[:, terms][:, :, terms] * kept
    total = parts.sum(axis=0)
    change, power = _last_of(total[None])
    changes, powers = _last_of(total - parts)
    return bool(np.any(powers < QUARTER * power) or np.any(changes / change < HALF))


def _last_of(products: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the last coefficient of least squares, and the power of what only it explains.

    Args:
        products: Of the columns with each other, the target last, shape (b, p + 1, p + 1).
    """
    scale = np.sqrt(np.maximum(np.diagonal(products, axis1=1, axis2=2), TINY))[:, :-1]
    gram = products[:, :-1, :-1] / (scale[:, :, None] * scale[:, None, :])
    inverse = np.linalg.inv(gram + EPS * np.eye(scale.shape[1]))
    solved = np.einsum("bij,bj->bi", inverse, products[:, :-1, -1] / scale) / scale
    return solved[:, -1], scale[:, -1] ** 2 / inverse[:, -1, -1]


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
    changes = [_change_of(q, moments, after, inverse, common) for q in range(TERMS)]
    change, before, error, freedom, drop = (np.stack(rows) for rows in zip(*changes, strict=True))
    explained = drop + drop[0] * (np.arange(TERMS) > 0)[:, None]
    return Breaks(change, before, error, freedom, drop, np.maximum(most - explained, 0.0))


def _change_of(
    q: int, moments: FloatArray, after: FloatArray, inverse: FloatArray, common: FloatArray
) -> tuple[FloatArray, ...]:
    """Return change, coefficient before, error, freedom and drop of one term, each (b - 1,)."""
    gram, target = moments[:, :TERMS, :TERMS], moments[:, :TERMS, TERMS]
    behind = np.arange(len(moments)) >= np.arange(1, len(moments))[:, None]  # (cut, block)
    # Free parts of 1 [t >= t0] and of z [t >= t0], as factors of the terms from t0 on and always.
    step, change = (_Free.of(term, after, inverse) for term in (0, q))
    if q > 0:  # a joint that rests elsewhere from t0 on has neither another gain nor another lag
        change = change.beside(step, gram, behind)
    part = change.parts(behind)
    free: FloatArray = np.einsum("cbi,bij,cbj->c", part, gram, part)
    determined = free > np.sqrt(EPS) * float(moments[:, q, q].sum())
    free = np.where(determined, free, 1.0)
    size = np.where(determined, np.einsum("cbi,bi->c", part, target) / free, 0.0)
    # Of each block: the sum of the free part of z [t >= t0] times what (1) leaves, and its power.
    terms: FloatArray = np.broadcast_to(common, part.shape) + size[:, None, None] * part
    if q > 0:
        parts = step.parts(behind)
        power = np.einsum("cbi,bij,cbj->c", parts, gram, parts)
        offset = np.einsum("cbi,bi->c", parts, target) / np.maximum(power, TINY)
        terms = terms + offset[:, None, None] * parts
    scores = np.einsum("cbi,cbi->cb", part, target - np.einsum("bij,cbj->cbi", gram, terms))
    power = np.einsum("cbi,bij,cbj->cb", part, gram, part)
    blocks = free**2 / np.maximum(np.sum(power**2, axis=1), TINY)
    freedom = np.where(determined, blocks - 2, 0.0)  # a mean before and one after
    squares = np.maximum(np.sum(scores**2, axis=1), TINY)
    rho = np.clip(np.sum(scores[:, 1:] * scores[:, :-1], axis=1) / squares, 0, COVERAGE)
    squares *= (1 + rho) / (1 - rho) * blocks / np.maximum(freedom, 1)
    return size, terms[:, 0, q], np.sqrt(squares) / free, freedom, size**2 * free


@dataclass(frozen=True)
class _Free:
    """What other terms don't make of a term from t0 on, for b - 1 times t0.

    Attributes:
        always: Factors of one, p and -p' in it, shape (b - 1, 3).
        later: Factors of the same from t0 on, shape (b - 1, 3).
    """

    always: FloatArray
    later: FloatArray

    @classmethod
    def of(cls, term: int, after: FloatArray, inverse: FloatArray) -> _Free:
        """Take off what one, p and -p' make of it."""
        always = -after[:, :TERMS, term] @ inverse
        return cls(always, np.tile(np.eye(TERMS)[term], (len(always), 1)))

    def parts(self, behind: BoolArray) -> FloatArray:
        """Return the factors of one, p and -p' in each block, shape (b - 1, b, 3)."""
        return self.always[:, None] + behind[:, :, None] * self.later[:, None]

    def beside(self, other: _Free, gram: FloatArray, behind: BoolArray) -> _Free:
        """Take off what another makes of it, too."""
        mine, others = self.parts(behind), other.parts(behind)
        both = np.einsum("cbi,bij,cbj->c", mine, gram, others)
        power = np.einsum("cbi,bij,cbj->c", others, gram, others)
        share = (both / np.maximum(power, TINY))[:, None]
        return _Free(self.always - share * other.always, self.later - share * other.later)


def _limit(freedom: FloatArray, tests: int) -> FloatArray:
    """Return how many errors a change must have."""
    return np.asarray(-stdtrit(np.maximum(freedom, 1.0), LEVEL / 2 / tests), dtype=np.float64)
