"""When a joint's gain, lag, offset or noise changed: change points with a level.

A course is divided into blocks of time (:mod:`.blocks`). Where there are like joints, their median
in the same block is taken off: what all do is no joint's change. A change is a shift of offset,
gain, lag or noise for a run of blocks, or a drift of the offset (:mod:`.shifts`), or a break of one
regression over the record (:mod:`.breaks`).
"""

from __future__ import annotations

from math import inf

import numpy as np

from ..common.arrays import BoolArray, FloatArray
from .blocks import QUANTITIES, Blocks, Jump, blocks_of, without_common
from .breaks import find_breaks
from .exposure import LIKE_LAG_S, Exposure
from .levels import (
    ANGLE_MARGIN_RAD,
    ENOUGH_LIKE,
    GAIN_MARGIN,
    LEAST_RANGE_RAD,
    QUARTER,
    TINY,
    WIDTH,
    reaches,
)
from .motion import Course
from .shifts import (
    Shift,
    common_noise,
    correlation_of,
    drift_of,
    largest_shift,
    limited_weights,
    noise_of,
    without_single,
)

NOISE_MARGIN = float(np.log(2.0))
"""Logarithm of the ratio of noise that matters: twice as much."""


def find_jumps(course: Course, exposure: Exposure, usable: BoolArray) -> list[Jump]:
    """Find the largest change of each joint and quantity.

    Args:
        usable: Steps that are looked at, shape (k, n): without those at which a joint stands.

    Returns:
        Those beyond the level and the size that matters, joint by joint.
    """
    usable = usable & _running(course, exposure)
    blocks = blocks_of(course, exposure, usable)
    jumps = [] if blocks is None else _jumps(blocks, exposure)
    jumps += find_breaks(course, exposure, usable)
    best: dict[int, tuple[float, Jump]] = {}
    for drop, jump in jumps:
        if jump.joint not in best or drop > best[jump.joint][0]:
            best[jump.joint] = drop, jump
    return [best[k][1] for k in sorted(best)]


def _jumps(blocks: Blocks, exposure: Exposure) -> list[tuple[float, Jump]]:
    """Return changes and the part of the sum of squares that each explains."""
    jumps: list[tuple[float, Jump]] = []

    def offer(k: int, quantity: str, shift: Shift | None) -> None:
        if shift is not None and _matters(quantity, k, exposure, shift, blocks):
            drop = 0.0 if quantity == "noise" else shift.drop  # it is what nothing else explains
            jumps.append((drop, _jump(k, quantity, shift, blocks.edges_s)))

    for q, quantity in enumerate(QUANTITIES):
        values, weights = without_common(blocks.values[q], blocks.weights[q], exposure)
        weights = limited_weights(without_single(values, weights))
        rho = correlation_of(values, weights)
        tests = weights.shape[0] * len(QUANTITIES)
        noises = [noise_of(*row, rho) for row in zip(values, weights, strict=True)]
        for k, (value, weight) in enumerate(zip(values, weights, strict=True)):
            compared = len(exposure.group(k)) >= ENOUGH_LIKE
            like = common_noise([noises[j] for j in exposure.group(k) if j != k], noises[k])
            shift = largest_shift(
                value, weight, rho, tests, blocks.shortest, compared=compared, like=like
            )
            offer(k, quantity, shift)
            if quantity == "offset":
                offer(k, "drift", drift_of(value, weight, rho, tests))
    return jumps


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


def _matters(quantity: str, k: int, exposure: Exposure, run: Shift, blocks: Blocks) -> bool:
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
