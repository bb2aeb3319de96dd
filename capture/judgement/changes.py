"""When a joint's gain, lag, offset or noise changed: change points with a level.

The residual of a joint's response is regressed, in blocks of time, on one, on the response and on
its rate: offset, relative gain and lag of each block; the logarithm of what is left is its noise.
Where there are like joints, their median in the same block is taken off: what all do is no joint's
change. The estimates v_i of b blocks, of weights w_i, are a level and one run of blocks beside it,

    v_i = m + c 1(i in run) + s n_i / sqrt(w_i),                                             (1)

with n an autoregression of the correlation rho from block to block, of which the median over the
joints is taken, its bias of -(1 + 4 rho)/b put back (Marriott & Pope, Biometrika 41, 1954, doi
10.1093/biomet/41.3-4.390). Generalised least squares gives c and its error for each run (Prais &
Winsten, Cowles Commission 383, 1954); c over its error has Student's distribution. Level: half for
the lasting changes, of which there are about b a joint and quantity, half for the passing ones,
b^2/2 (Bonferroni).
"""

from __future__ import annotations

from dataclasses import dataclass
from math import inf

import numpy as np
from scipy.special import stdtrit

from ..common.arrays import BoolArray, FloatArray, IntArray
from .exposure import ENOUGH_LIKE, Exposure
from .motion import Course, cycle_s, is_sweep
from .stillness import FULL

LEVEL = 0.01
"""Chance of any change in a session of healthy joints."""

FEWEST = 8
"""Blocks that a comparison needs (with fewer, 1 % of all changes has no threshold)."""

MOST = 64
"""Blocks that a course is divided into at most: onsets to 1.6 % of the record."""

GAIN_MARGIN = 0.02
"""Relative gain that matters: the margin of "alike"."""

ANGLE_MARGIN_RAD = np.radians(1.0)
"""Angle that matters [rad]: the margin of "alike"."""

NOISE_MARGIN = np.log(2.0)
"""Logarithm of the ratio of noise that matters: twice as much."""

WIDTH = 1.96
"""Standard errors of a 95 % interval."""

QUANTITIES = ("offset", "gain", "lag", "noise")


@dataclass(frozen=True)
class Jump:
    """A change of one quantity of one joint.

    Attributes:
        joint: Its index.
        quantity: Of :data:`QUANTITIES`.
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
class _Run:
    """A run of blocks ``first`` to ``last`` (exclusive) and how it differs from the others."""

    change: float
    outside: float  # mean of the others
    error: float
    first: int
    last: int
    drop: float  # of the sum of squares


@dataclass(frozen=True)
class _Blocks:
    """Estimates of k joints in b blocks, with the weights of each, shape (q, k, b)."""

    values: FloatArray
    weights: FloatArray
    edges_s: FloatArray
    half_s: float  # half of the longest cycle; 0 where the commands are no rhythms
    lost_rad: FloatArray  # what the response leaves in half of the blocks, three deviations
    swept: tuple[bool, ...]  # whether the frequency of a command follows from the time

    @property
    def shortest(self) -> int:
        """Blocks of a change, at least."""
        block_s = float(self.edges_s[1] - self.edges_s[0])
        least_s = max(HALF_CYCLES * self.half_s, SHORTEST_S)
        return max(SHORTEST, int(np.ceil(least_s / block_s - 1e-6)))


def find_jumps(course: Course, exposure: Exposure, usable: BoolArray) -> list[Jump]:
    """Find the largest change of each joint and quantity.

    Args:
        usable: Steps that are looked at, shape (k, n): without those at which a joint stands.

    Returns:
        Those beyond the level and the size that matters, joint by joint.
    """
    blocks = _blocks(course, exposure, usable)
    if blocks is None:
        return []
    best: dict[int, tuple[float, Jump]] = {}
    for q, quantity in enumerate(QUANTITIES):
        values, weights = blocks.values[q], blocks.weights[q]
        values, weights = _without_common(values, weights, exposure)
        values, weights = _without_single(values, weights), _limited(weights)
        rho = _correlation(values, weights)
        tests = weights.shape[0] * len(QUANTITIES)
        for k in range(weights.shape[0]):
            compared = len(exposure.group(k)) >= ENOUGH_LIKE
            run = _largest(
                values[k], weights[k], rho, tests, blocks.shortest, compared=compared
            )
            if run is None or not _matters(quantity, k, exposure, run, blocks):
                continue
            # Noise is what no other quantity explains.
            drop = 0.0 if quantity == "noise" else run.drop
            if k not in best or drop > best[k][0]:
                best[k] = drop, _jump(k, quantity, run, blocks.edges_s)
    return [best[k][1] for k in sorted(best)]


def _jump(k: int, quantity: str, run: _Run, edges_s: FloatArray) -> Jump:
    """Turn a run of blocks into a change; one that begins the record is undone at its end."""
    change, before, first, last = run.change, run.outside, run.first, run.last
    count = edges_s.size - 1
    if first == 0:
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


def _matters(quantity: str, k: int, exposure: Exposure, run: _Run, blocks: _Blocks) -> bool:
    """Return whether a change is one that matters: its interval isn't within the margin.

    Without like joints, and where the motion is no rhythm, it is also beyond what a response leaves
    of the joint's motion, and the command is no sweep: play, stick and poles beyond two make another
    gain of every other motion.
    """
    compared = len(exposure.group(k)) >= ENOUGH_LIKE
    alone = not (compared and blocks.half_s)
    if quantity == "noise":  # of unlike joints it grows and falls with the motion
        return not alone and _reaches(run, float(NOISE_MARGIN))
    lost = float(blocks.lost_rad[k]) if alone else 0.0
    if quantity == "offset":
        return _reaches(run, float(ANGLE_MARGIN_RAD)) and abs(run.change) > lost
    inside = slice(run.first, run.last)
    _, motion, rate, count = blocks.weights[:, k]
    if blocks.swept[k] and not compared:  # another time is another frequency
        return False
    samples = max(float(count[inside].sum()), 1.0)
    amplitude = max((2 * float(motion[inside].sum()) / samples) ** 0.5, 1e-9)
    if quantity == "gain":
        return _reaches(run, GAIN_MARGIN) and abs(run.change) > lost / amplitude
    speed = max((2 * float(rate[inside].sum()) / samples) ** 0.5, 1e-9)
    # One degree of a cycle, as an angle of the wave of that amplitude and rate.
    margin = float(ANGLE_MARGIN_RAD) * amplitude / speed
    return _reaches(run, margin) and abs(run.change) > lost / speed


def _reaches(run: _Run, margin: float) -> bool:
    """Return whether the 95 % interval of a change, that excludes 0, isn't within a margin."""
    return abs(run.change) + WIDTH * run.error > margin


def _blocks(course: Course, exposure: Exposure, usable: BoolArray) -> _Blocks | None:
    """Regress the residual of each joint in each block, of half cycles where there are cycles."""
    length_s = float(course.t_s[-1] - course.t_s[0])
    cycles = [cycle_s(command, course.step_s) / 2 for command in course.command]
    half = max((cycle for cycle in cycles if np.isfinite(cycle)), default=0.0)
    shortest = max(length_s / MOST, 2 * _correlation_s(course, exposure, usable))
    whole = max(1.0, np.ceil(shortest / half)) * half if half else shortest
    count = min(int(length_s / whole), MOST)
    if count < FEWEST:
        return None
    width = course.t_s.size // count
    starts = width * np.arange(count, dtype=np.int64)
    joints = course.position.shape[0]
    values = np.zeros((len(QUANTITIES), joints, count))
    weights = np.zeros_like(values)
    lost = np.zeros(joints)
    for k in range(joints):
        residual = course.position[k] - exposure.fitted[k]
        rate = np.gradient(exposure.fitted[k], course.step_s)
        there = usable[k].astype(np.float64)
        level = float(exposure.fitted[k] @ there) / max(float(there.sum()), 1.0)
        residual, scatter = _tamed(residual, there, count, width)
        rows = np.stack([np.ones_like(rate), exposure.fitted[k] - level, -rate, residual])
        values[:3, k], weights[:, k] = _regressed(rows * there, rows, starts, width)
        lost[k] = 3 * float(np.median(scatter[weights[3, k] > 0])) if weights[3, k].any() else 0.0
        # Below the usual noise no change is of interest.
        values[3, k] = np.log(np.hypot(scatter, exposure.rest_rad[k] / 2 + 1e-12))
    edges = course.t_s[0] + width * course.step_s * np.arange(count + 1)
    swept = tuple(is_sweep(command) for command in course.command)
    return _Blocks(values, weights, np.asarray(edges, dtype=np.float64), half, lost, swept)


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


ROBUST = 1.4826
"""Standard deviation of normal values in their median distance from the middle."""

TAME = 4
"""Robust standard deviations of a block beyond which a sample has no more weight: of normal noise
6 in 100,000 are, and single samples of heavy tails decide nothing (Huber)."""


def _regressed(
    weighted: FloatArray, rows: FloatArray, starts: IntArray, width: int
) -> tuple[FloatArray, FloatArray]:
    """Return offset, gain and lag of each block, shape (3, b), and weights, shape (q, b)."""
    stop = int(starts[-1]) + width
    products = weighted[:, None, :stop] * rows[None, :, :stop]
    moments = np.moveaxis(np.add.reduceat(products, starts, axis=2), 2, 0)
    gram, target = moments[:, :3, :3], moments[:, :3, 3]
    count = gram[:, 0, 0]
    typical = np.median(np.diagonal(gram, axis1=1, axis2=2), axis=0)
    scale = np.sqrt(np.where(typical > 0, typical, 1.0))
    scaled = gram / scale[:, None] / scale[None, :]
    # A block without motion knows its offset only: the ridge keeps the rest at 0, weightless.
    ridge = np.diag([0.0, RIDGE, RIDGE])
    inverse = np.linalg.inv(scaled + ridge + 1e-9 * np.eye(3)) / np.outer(scale, scale)
    estimate = np.einsum("bij,bj->bi", inverse, target)
    weights = np.concatenate(
        [1 / np.maximum(np.diagonal(inverse, axis1=1, axis2=2).T, 1e-300), [count]]
    )
    weights[:, count < FULL * width] = 0
    weights[weights < INFORMED * np.quantile(weights, FULL, axis=1, keepdims=True)] = 0
    return estimate.T, weights


HALF_CYCLES = 6
"""Half cycles on either side of a change, at least: three cycles."""

SHORTEST_S = 2.0
"""Time on either side of a change, at least [s]."""

SHORTEST = 2
"""Blocks of a change, at least: one alone may hold a step of the command that no response fits."""

RIDGE = 1e-3
"""Ridge on gain and lag, relative to the median block: 0.1 % of what is known of them is lost."""

INFORMED = 0.1
"""Share of the information of the best blocks below which a block is left out."""


def _correlation_s(course: Course, exposure: Exposure, usable: BoolArray) -> float:
    """Return the median time after which the residuals' correlation is below 1/e."""
    times: list[float] = []
    for k in range(course.position.shape[0]):
        residual = (course.position[k] - exposure.fitted[k])[usable[k]]
        if residual.size < 2 * FEWEST:
            continue
        residual = residual - residual.mean()
        spectrum = np.abs(np.fft.rfft(residual, 2 * residual.size)) ** 2
        correlation = np.fft.irfft(spectrum)[: residual.size]
        below = np.flatnonzero(correlation < correlation[0] / np.e)
        times.append(float(below[0] if below.size else residual.size) * course.step_s)
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


def _without_single(values: FloatArray, weights: FloatArray) -> FloatArray:
    """Replace each block by the median of it and its neighbours: one alone is no change."""
    result = values.copy()
    for row, weight in zip(result, weights, strict=True):
        known = np.flatnonzero(weight > 0)
        if known.size >= FEWEST:
            inner = row[known]
            three = np.stack([inner[:-2], inner[1:-1], inner[2:]])
            middle = np.median(three, axis=0)
            row[known] = np.concatenate([middle[:1], middle, middle[-1:]])
    return result


def _limited(weights: FloatArray) -> FloatArray:
    """Limit weights: what a model leaves doesn't fall with what a block tells.

    With the variance of the median block's noise in each block beside its own.
    """
    usual = np.array([np.median(row[row > 0]) if row.any() else 1.0 for row in weights])[:, None]
    return weights * usual / (weights + usual)


def _correlation(values: FloatArray, weights: FloatArray) -> float:
    """Return the correlation from block to block of the median joint."""
    found: list[float] = []
    for value, weight in zip(values, weights, strict=True):
        kept = value[weight > 0]
        if kept.size >= FEWEST:
            away = kept - np.median(kept)
            away = np.clip(away, *(np.quantile(away, (0.05, 0.95))))
            power = float(away @ away)
            rho = float(away[1:] @ away[:-1]) / power if power > 0 else 0.0
            found.append(rho + (1 + 4 * max(rho, 0.0)) / kept.size)
    return min(max(float(np.median(found)), 0.0), 0.95) if found else 0.0


def _largest(
    values: FloatArray,
    weights: FloatArray,
    rho: float,
    tests: int,
    shortest: int,
    *,
    compared: bool,
) -> _Run | None:
    """Return the most certain run of blocks, or None if none is beyond the level.

    Args:
        compared: Whether like joints have taken off what a model leaves: then what is left is
            chance, and the plain difference of means must be beyond it, too.
    """
    known = np.flatnonzero(weights > 0)
    v, w = values[known], weights[known]
    # So many blocks of one weight know as much.
    if known.size < FEWEST or float(w.sum()) ** 2 < FEWEST * float(w @ w):
        return None
    best: tuple[float, _Run] | None = None
    for lasting in (True, False):
        first, last = _runs(known.size, shortest, lasting=lasting)
        if not first.size:
            continue
        change, outside, error = _fitted(v, w, first, last, rho)
        if compared:
            error = np.maximum(error, _plain_error(v, w, first, last, rho))
        limit = -float(stdtrit(known.size - 3, LEVEL / 4 / tests / first.size))
        t = np.abs(change) / error
        k = int(np.argmax(t))
        if t[k] > limit and (best is None or t[k] / limit > best[0]):
            start = 0 if first[k] == 0 else int(known[first[k]])
            stop = values.size if last[k] == known.size else int(known[last[k] - 1]) + 1
            inner = float(w[first[k] : last[k]].sum())
            drop = float(change[k]) ** 2 / (1 / inner + 1 / max(float(w.sum()) - inner, 1e-300))
            means = _means(v, w, int(first[k]), int(last[k]))
            size = float(change[k]) if means is None else means[0] - means[1]
            run = _Run(size, float(outside[k]), float(error[k]), start, stop, drop)
            best = t[k] / limit, run
    return None if best is None else best[1]


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


def _runs(count: int, shortest: int, *, lasting: bool) -> tuple[IntArray, IntArray]:
    """Return first block and the one after the last of runs to one end, or within."""
    if lasting:
        cuts = np.arange(shortest, count - shortest + 1)
        half = cuts * 2 > count  # the shorter part is what changed
        first = np.where(half, cuts, 0)
        last = np.where(half, count, cuts)
        return first, last
    first, last = np.triu_indices(count, shortest)
    inner = (first > 0) & (last < count) & ((last - first) * 2 <= count)
    return first[inner], last[inner]


def _fitted(
    v: FloatArray, w: FloatArray, first: IntArray, last: IntArray, rho: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return c and m of equation (1), and the standard error of c, of runs."""
    scale = np.sqrt(w)
    whole = _whitened(scale, rho)
    target = _whitened(scale * v, rho)
    # A whitened run is that of all blocks inside, and differs where it begins and after its end.
    begin = scale * np.where(np.arange(v.size) == 0, (1 - rho**2) ** 0.5, 1.0)
    sums = np.concatenate([np.zeros((2, 1)), np.cumsum([whole**2, whole * target], axis=1)], axis=1)
    after = np.minimum(last, v.size - 1)
    behind = np.where(last < v.size, -rho * scale[last - 1], 0.0)
    own, of_target = sums[:, last] - sums[:, first + 1]
    power = own + begin[first] ** 2 + behind**2
    along = own + begin[first] * whole[first] + behind * whole[after]
    moment = of_target + begin[first] * target[first] + behind * target[after]
    level, total = sums[0, -1], sums[1, -1]
    free = np.maximum(power - along**2 / level, 1e-300)
    change = (moment - along * total / level) / free
    left = float(target @ target) - total**2 / level - change**2 * free
    variance = np.maximum(left, 1e-300) / max(v.size - 3, 1) / free
    return change, (total - change * along) / level, np.sqrt(variance)


def _plain_error(
    v: FloatArray, w: FloatArray, first: IntArray, last: IntArray, rho: float
) -> FloatArray:
    """Return the standard error of the difference of means in and out of runs."""
    sums = np.concatenate([np.zeros((3, 1)), np.cumsum([w, w * v, w * v**2], axis=1)], axis=1)
    inside = sums[:, last] - sums[:, first]
    (wi, vi, si), (wo, vo, so) = inside, sums[:, -1:] - inside
    squares = np.maximum(si - vi**2 / wi, 0) + np.maximum(so - vo**2 / wo, 0)
    freedom = max(v.size - 2, 1) * (1 - rho) / (1 + rho)
    return np.sqrt(np.maximum(squares / freedom * (1 / wi + 1 / wo), 1e-300))


def _whitened(values: FloatArray, rho: float) -> FloatArray:
    """Take the autoregression off, the first value scaled as all before would have made it."""
    result = values.copy()
    result[1:] -= rho * values[:-1]
    result[0] *= (1 - rho**2) ** 0.5
    return result
