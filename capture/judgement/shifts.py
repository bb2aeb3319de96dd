"""Level shifts and drifts in a series of estimates: one run of values, or a line, beside a level.

The estimates v_i of b blocks, of weights w_i, are

    v_i = m + c x_i + s n_i / sqrt(w_i),                                                     (1)

with x_i = 1 in one run of blocks and 0 elsewhere, or rising evenly from 0 to 1, and n an
autoregression of the correlation rho from block to block, of which the median over the joints is
taken, its bias of -(1 + 4 rho)/b put back (Marriott & Pope, Biometrika 41, 1954, doi
10.1093/biomet/41.3-4.390). Generalised least squares gives c and its error (Prais & Winsten, Cowles
Commission 383, 1954); c over its error has Student's distribution. Like joints have a similar
noise: as far as their s^2 agree, s^2 is taken from theirs besides, with more degrees of freedom
(Smyth, Stat. Appl. Genet. Mol. Biol. 3, 2004, doi 10.2202/1544-6115.1027). Level: half for the
lasting changes, of which there are about b a series, half for the passing ones, b^2/2 (Bonferroni).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import chdtri, digamma, fdtri, polygamma, stdtrit

from ..common.arrays import FloatArray, IntArray
from .levels import COVERAGE, ENOUGH_LIKE, FEWEST, FULL, LEVEL, ROBUST, TAME, TINY, WHOLE


@dataclass(frozen=True)
class Shift:
    """A run of blocks and how it differs from the others; or a drift, whose run is all of them.

    Attributes:
        change: c of equation (1), between blocks that hold no change themselves.
        outside: m.
        error: Standard error of c.
        first: First block of the run.
        last: The one behind its last.
        drop: Of the weighted sum of squares.
    """

    change: float
    outside: float
    error: float
    first: int
    last: int
    drop: float


@dataclass(frozen=True)
class ShiftNoise:
    """The noise of equation (1).

    Attributes:
        variance: (1 - rho^2) s^2, of what is new from block to block.
        freedom: Degrees of freedom that it is known with.
    """

    variance: float
    freedom: float


UNKNOWN = ShiftNoise(0.0, 0.0)
"""Of joints that have no like ones."""


def noise_of(values: FloatArray, weights: FloatArray, rho: float) -> ShiftNoise:
    """Return the noise of one series of shape (b,), whether or not its level shifts.

    A shift is in one difference of neighbours alone. Half the mean square of all is the variance,
    with two thirds of the degrees of freedom (von Neumann et al., Ann. Math. Stat. 12, 1941, doi
    10.1214/aoms/1177731746).
    """
    weighed = weights > 0
    if int(weighed.sum()) <= 2:
        return UNKNOWN
    scale = np.sqrt(weights[weighed])
    whole, target = _whitened(scale, rho), _whitened(scale * values[weighed], rho)
    steps = np.diff(target - float(whole @ target) / float(whole @ whole) * whole)
    return ShiftNoise(max(float(np.mean(steps**2)) / 2, TINY), WHOLE * steps.size)


def common_noise(noises: Sequence[ShiftNoise], joint_noise: ShiftNoise = UNKNOWN) -> ShiftNoise:
    """Estimate the noise of a joint from that of several like it (Smyth, section 6.2).

    The joints' own scatter is taken at its upper limit of 90 %; that of few joints weighs little,
    and not at all for one whose own noise is beyond theirs at the level of the judgement.
    """
    estimates = [noise for noise in noises if noise.freedom > 0]
    if len(estimates) < ENOUGH_LIKE - 1:
        return UNKNOWN
    half = np.array([noise.freedom for noise in estimates]) / 2
    logs = np.log([noise.variance for noise in estimates]) - digamma(half) + np.log(half)
    middle = float(np.median(logs))
    # The median distance isn't that of a joint which changed.
    scatter = (ROBUST * float(np.median(np.abs(logs - middle)))) ** 2
    most = scatter * (len(estimates) - 1) / float(chdtri(len(estimates) - 1, FULL))
    excess = most - float(np.mean(polygamma(1, half)))
    pooled = 2 * float(half.sum())
    # trigamma(x) is above 1/x + 1/(2 x^2).
    freedom = pooled if excess <= 0 else min(pooled, (1 + np.sqrt(1 + 2 * excess)) / excess)
    variance = float(np.exp(middle + digamma(freedom / 2) - np.log(freedom / 2)))
    beyond = joint_noise.variance > variance * float(
        fdtri(max(joint_noise.freedom, 1), freedom, 1 - LEVEL)
    )
    return UNKNOWN if beyond else ShiftNoise(variance, float(freedom))


def without_single(values: FloatArray, weights: FloatArray) -> FloatArray:
    """Return weights without those of a block that is far from both its neighbours.

    Alone it is no change. Far is beyond :data:`TAME` robust standard deviations of what blocks
    differ from the median of three, the first and the last three at the ends.
    """
    result = weights.copy()
    for row, weight in zip(values, result, strict=True):
        weighed = np.flatnonzero(weight > 0)
        if weighed.size >= FEWEST:
            value = row[weighed]
            middle = np.pad(np.median([value[:-2], value[1:-1], value[2:]], axis=0), 1, "edge")
            away = np.abs(value - middle)
            if away.any():
                far = away > TAME * ROBUST * np.median(away[away > 0])
                weight[weighed[far]] = 0.0
    return result


def limited_weights(weights: FloatArray) -> FloatArray:
    """Limit weights: what a model leaves doesn't fall with what a block tells.

    With the variance of the median block's noise in each block beside its own.
    """
    usual = np.array([np.median(row[row > 0]) if row.any() else 1.0 for row in weights])[:, None]
    return weights * usual / (weights + usual)


def correlation_of(values: FloatArray, weights: FloatArray) -> float:
    """Return the correlation from block to block of the median joint.

    Of one or two joints it is that of the half of the record with less: a change of one of them
    correlates the blocks around it.
    """
    halves = 1 if len(values) > 2 else 2
    correlations: list[float] = []
    for value, weight in zip(values, weights, strict=True):
        parts = np.array_split(value[weight > 0], halves)
        if sum(part.size for part in parts) >= FEWEST:
            correlations.append(min(_correlation(part) for part in parts))
    return min(max(float(np.median(correlations)), 0.0), COVERAGE) if correlations else 0.0


def _correlation(values: FloatArray) -> float:
    """Return the correlation from one value to the next, without its bias in few values."""
    away = values - np.median(values)
    away = np.clip(away, *np.quantile(away, (1 - COVERAGE, COVERAGE)))
    power = float(away @ away)
    rho = float(away[1:] @ away[:-1]) / power if power > 0 else 0.0
    return rho + (1 + 4 * max(rho, 0.0)) / values.size


def largest_shift(
    values: FloatArray,
    weights: FloatArray,
    rho: float,
    tests: int,
    shortest: int,
    *,
    compared: bool,
    like: ShiftNoise = UNKNOWN,
) -> Shift | None:
    """Return the most certain run of blocks, or None if none is beyond the level.

    Args:
        like: Its noise as estimated from like joints.
        compared: Whether like joints have taken off what a model leaves: then what is left is
            chance, and the plain difference of means must be beyond it, too.
    """
    weighed = np.flatnonzero(weights > 0)
    v, w = values[weighed], weights[weighed]
    # So many blocks of one weight know as much.
    if weighed.size < FEWEST or float(w.sum()) ** 2 < FEWEST * float(w @ w):
        return None
    best: tuple[float, Shift] | None = None
    for lasting in (True, False):
        first, last = _runs(weighed, values.size, shortest, lasting=lasting)
        if not first.size:
            continue
        change, outside, error = _fitted(v, w, first, last, rho, like=like)
        if compared:
            error = np.maximum(error, _plain_error(v, w, first, last, rho, like=like))
        freedom = weighed.size - 2 - 1 + like.freedom  # two means, and where the run is
        limit = -float(stdtrit(freedom, LEVEL / 2 / 2 / tests / first.size))
        t = np.abs(change) / error
        k = int(np.argmax(t))
        if t[k] > limit and (best is None or t[k] / limit > best[0]):
            start = 0 if first[k] == 0 else int(weighed[first[k]])
            stop = values.size if last[k] == weighed.size else int(weighed[last[k] - 1]) + 1
            inner = float(w[first[k] : last[k]].sum())
            drop = float(change[k]) ** 2 / (1 / inner + 1 / max(float(w.sum()) - inner, TINY))
            means = _means(v, w, int(first[k]), int(last[k]))
            size = float(change[k]) if means is None else means[0] - means[1]
            run = Shift(size, float(outside[k]), float(error[k]), start, stop, drop)
            best = t[k] / limit, run
    return None if best is None else best[1]


def drift_of(values: FloatArray, weights: FloatArray, rho: float, tests: int) -> Shift | None:
    """Return the even drift of a series, or None if it isn't beyond the level.

    Args:
        rho: Correlation from block to block.
        tests: Number of series that are looked at.
    """
    weighed = np.flatnonzero(weights > 0)
    if weighed.size < FEWEST:
        return None
    v, w = values[weighed], weights[weighed]
    along = weighed / max(values.size - 1, 1)
    x = along - float(w @ along) / float(w.sum())
    power = float(w @ x**2)
    change = float(w @ (x * v)) / power
    left = v - float(w @ v) / float(w.sum()) - change * x
    freedom = max(v.size - 2, 1) * (1 - rho) / (1 + rho)
    error = float(np.sqrt(max(float(w @ left**2) / freedom / power, TINY)))
    limit = -float(stdtrit(max(freedom, 1.0), LEVEL / 2 / tests))
    # Heavy tails make slopes, and no order of ranks.
    rank = abs(rank_correlation(v))
    by_rank = rank * float(np.sqrt(freedom / max(1 - rank**2, TINY)))
    if min(abs(change) / error, by_rank) < limit:
        return None
    return Shift(change, float(w @ v) / float(w.sum()), error, 0, values.size, change**2 * power)


def rank_correlation(values: FloatArray) -> float:
    """Return the correlation of the ranks of values with their order (Spearman), -1 to 1.

    Equal values share the middle of their ranks; 0 where all are equal.
    """
    _, which, counts = np.unique(values, return_inverse=True, return_counts=True)
    if counts.size < 2:
        return 0.0
    ranks = (np.cumsum(counts) - counts / 2)[which]
    return float(np.corrcoef(ranks, np.arange(values.size))[0, 1])


def _means(v: FloatArray, w: FloatArray, first: int, last: int) -> tuple[float, float] | None:
    """Return the means in and out of a run, without the blocks at its ends, which hold both.

    None where too few blocks are left.
    """
    begins, ends = first > 0, last < v.size
    inside = np.zeros(v.size, dtype=np.bool_)
    inside[first + begins : last - ends] = True
    outside = np.ones(v.size, dtype=np.bool_)
    outside[max(first - begins, 0) : last + ends] = False
    if not (inside.any() and outside.any()):
        return None
    within, beyond = (float(w[part] @ v[part] / w[part].sum()) for part in (inside, outside))
    return within, beyond


def _runs(
    weighed: IntArray, blocks: int, shortest: int, *, lasting: bool
) -> tuple[IntArray, IntArray]:
    """Return first block and the one after the last of runs to one end, or within.

    Of the blocks that are known; a run to one end is shortest in time, and half of it is known: in
    the first blocks a response settles.
    """
    count = weighed.size
    if lasting:
        least = max(2, shortest // 2)
        cuts = np.arange(least, count - least + 1)
        cuts = cuts[(weighed[cuts] >= shortest) & (weighed[cuts - 1] < blocks - shortest)]
        half = cuts * 2 > count  # the shorter part is what changed
        first = np.where(half, cuts, 0)
        last = np.where(half, count, cuts)
        return first, last
    first, last = np.triu_indices(count, shortest)
    inner = (first > 0) & (last < count) & ((last - first) * 2 <= count)
    return first[inner], last[inner]


def _fitted(
    v: FloatArray,
    w: FloatArray,
    first: IntArray,
    last: IntArray,
    rho: float,
    *,
    like: ShiftNoise = UNKNOWN,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return c and m of equation (1), and the standard error of c, of runs."""
    scale = np.sqrt(w)
    whole = _whitened(scale, rho)
    target = _whitened(scale * v, rho)
    # A whitened run is that of all blocks inside, and differs where it begins and after its end.
    begin = scale * np.where(np.arange(v.size) == 0, np.sqrt(1 - rho**2), 1.0)
    sums = np.pad(np.cumsum([whole**2, whole * target], axis=1), ((0, 0), (1, 0)))
    after = np.minimum(last, v.size - 1)
    behind = np.where(last < v.size, -rho * scale[last - 1], 0.0)
    inside, of_target = sums[:, last] - sums[:, first + 1]
    power = inside + begin[first] ** 2 + behind**2
    along = inside + begin[first] * whole[first] + behind * whole[after]
    moment = of_target + begin[first] * target[first] + behind * target[after]
    level, total = sums[0, -1], sums[1, -1]
    free = np.maximum(power - along**2 / level, TINY)
    change = (moment - along * total / level) / free
    left = float(target @ target) - total**2 / level - change**2 * free
    left = np.maximum(left, TINY) + like.freedom * like.variance
    variance = left / (max(v.size - 2 - 1, 1) + like.freedom) / free
    return change, (total - change * along) / level, np.sqrt(variance)


def _plain_error(
    v: FloatArray,
    w: FloatArray,
    first: IntArray,
    last: IntArray,
    rho: float,
    *,
    like: ShiftNoise = UNKNOWN,
) -> FloatArray:
    """Return the standard error of the difference of means in and out of runs."""
    sums = np.pad(np.cumsum([w, w * v, w * v**2], axis=1), ((0, 0), (1, 0)))
    inside = sums[:, last] - sums[:, first]
    (wi, vi, si), (wo, vo, so) = inside, sums[:, -1:] - inside
    squares = np.maximum(si - vi**2 / wi, 0) + np.maximum(so - vo**2 / wo, 0)
    squares += like.freedom * like.variance / (1 - rho**2)
    freedom = (max(v.size - 2, 1) + like.freedom) * (1 - rho) / (1 + rho)
    return np.sqrt(np.maximum(squares / freedom * (1 / wi + 1 / wo), TINY))


def _whitened(values: FloatArray, rho: float) -> FloatArray:
    """Take the autoregression off, the first value scaled as all before would have made it."""
    result = values.copy()
    result[1:] -= rho * values[:-1]
    result[0] *= np.sqrt(1 - rho**2)
    return result
