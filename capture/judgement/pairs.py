"""How much of each joint's motion the command of each joint explains, by delay.

Joint i follows the command of joint j by a delay d and a gain g that all joints share,

    p_i(t) = b_i + g c_j(t - d) + e_i(t),

and the share of its variance that this explains is

    E_ij(d) = 1 - |p_i - g c_j(. - d)|^2 / |p_i|^2 = 1 - (P_i - 2 g X_ij(d) + g^2 C_j) / P_i,

with the powers P and C of positions and commands about their means and their cross power X; below 0
it counts as 0. One gain for all keeps what amplitudes tell. It is the median ratio of the sorted
amplitudes, which no permutation changes and a few faulty joints hardly. Delays go up to half a
period of the commands, as a servo of two poles lags by 180 degrees at most, or to the longest dead
time of a bus.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..common.arrays import BoolArray, FloatArray, IntArray
from ..common.errors import DataError
from .levels import NEGLIGIBLE
from .response import LATEST_S

MOVES = NEGLIGIBLE
"""A joint whose standard deviation is below this share of the largest stands still: the share by
which the analysis tells driven joints (``DRIVEN_SHARE``)."""

PER_PERIOD = 16
"""Samples a period that are looked at, at least; finer records are thinned out. Any number above
the two of the sampling theorem will do: 16 leave room for what is faster than the median."""

DELAYS = 2 * PER_PERIOD + 1
"""Delays that are tried in half a period: 5.6 degrees of phase apart, so that the nearest
is within 2.8 degrees, which costs sin^2 = 0.24 % of the explained share."""

LEAST_PERIODS = 2.0
"""Periods that a record must have: over less than two, any two smooth motions are alike."""


CUBIC = 2 + 2
"""Samples that a cubic goes through, two on each side: at 16 a period it errs by a thousandth."""


@dataclass(frozen=True)
class Pairs:
    """What each command explains of each joint.

    Attributes:
        delay_s: Delays [s], shape (k,).
        explained: By delay, joint and command, shape (k, m, m).
        opposite: The same with the opposite gain.
        judged: Joints that move, or are commanded to, shape (m,).
    """

    delay_s: FloatArray
    explained: FloatArray
    opposite: FloatArray
    judged: BoolArray


def _check(commands: FloatArray, positions: FloatArray, step_s: float) -> None:
    if commands.ndim != 2 or commands.shape != positions.shape:
        raise DataError(
            f"commands of shape {commands.shape} and positions of shape {positions.shape}: both "
            "take samples times joints"
        )
    if not (np.isfinite(commands).all() and np.isfinite(positions).all()):
        raise DataError("commands and positions must be finite")
    if not 0 < step_s < np.inf:
        raise DataError(f"a sampling interval of {step_s:g} s is none")


def explained_pairs(commands: FloatArray, positions: FloatArray, step_s: float) -> Pairs | None:
    """Return what each command explains of each joint; None where too little moves.

    Args:
        commands: Of m joints at even times [rad], shape (n, m).
        positions: At the same times [rad], shape (n, m).
        step_s: Sampling interval [s].

    Raises:
        DataError: If the shapes differ, a value isn't finite, or the interval isn't positive.
    """
    _check(commands, positions, step_s)
    count, joints = commands.shape
    if joints < 2 or count < 2 * LEAST_PERIODS * PER_PERIOD:
        return None
    asked, given = moving(commands), moving(positions)
    period_s = _median_period_s(commands, step_s)
    if np.count_nonzero(asked) < 2 or not given.any():
        return None
    if not 2 * step_s < period_s <= count * step_s / LEAST_PERIODS:
        return None
    longest_s = max(period_s / 2, min(period_s, LATEST_S))
    tried = int(np.ceil(DELAYS * longest_s / (period_s / 2)))
    delay_s = np.linspace(0.0, longest_s, tried)
    skipped = int(np.ceil(delay_s[-1] / step_s))
    stride = max(1, int(period_s / (PER_PERIOD * step_s)))
    rows: IntArray = np.arange(skipped, count, stride, dtype=np.int64)
    given_values = positions[rows] - positions[rows].mean(axis=0)
    power = np.sum(given_values**2, axis=0)
    gain = _common_gain(commands[:, asked], positions[:, given])
    explained = np.empty((delay_s.size, joints, joints))
    opposite = np.empty_like(explained)
    for k, delay in enumerate(delay_s):
        late = _earlier(commands, rows, delay / step_s)
        late -= late.mean(axis=0)
        both = gain * (given_values.T @ late)
        left = power[:, None] + gain**2 * np.sum(late**2, axis=0)
        explained[k] = _share(left - 2 * both, power)
        opposite[k] = _share(left + 2 * both, power)
    for table in (explained, opposite):
        table[:, ~given[:, None] | ~asked] = 0.0
        table[:, ~given[:, None] & ~asked] = 1.0
    return Pairs(delay_s, explained, opposite, asked | given)


def _earlier(values: FloatArray, rows: IntArray, steps: float) -> FloatArray:
    """Return values some steps before rows, by the cubic through the four that are next."""
    whole = int(np.ceil(steps))
    u = whole - steps  # after the row that is a whole number of steps before
    first: IntArray = np.clip(rows - whole - 1, 0, len(values) - CUBIC)
    place = (rows - whole - first) + u  # 1 to 2, but at the ends
    result = np.zeros((rows.size, values.shape[1]))
    for k in range(CUBIC):
        weight = np.ones(rows.size)
        for j in range(CUBIC):
            if j != k:
                weight *= (place - j) / (k - j)
        result += weight[:, None] * values[first + k]
    return result


def _share(left: FloatArray, power: FloatArray) -> FloatArray:
    """Explained share of each row, at least 0."""
    whole = np.maximum(power, np.finfo(float).tiny)[:, None]
    return 1 - np.minimum(left, whole) / whole


def moving(values: FloatArray) -> BoolArray:
    """Mark the columns that vary by a share of the largest's standard deviation, shape (m,)."""
    size = values.std(axis=0)
    return size > max(MOVES * float(size.max(initial=0.0)), np.finfo(float).eps)


def _common_gain(commands: FloatArray, positions: FloatArray) -> float:
    """Return the median ratio of the sorted amplitudes of what is asked and what is given."""
    asked, given = np.sort(commands.std(axis=0)), np.sort(positions.std(axis=0))
    few = min(asked.size, given.size)  # the largest ones of both
    return float(np.median(given[-few:] / asked[-few:]))


def _median_period_s(commands: FloatArray, step_s: float) -> float:
    """Return one over the frequency below which half of the commands' power is [s]."""
    count = len(commands)
    taper: FloatArray = np.hanning(count)[:, None]
    centred: FloatArray = commands - commands.mean(axis=0)
    power: FloatArray = np.sum(np.abs(np.fft.rfft(taper * centred, axis=0)) ** 2, axis=1)
    half = int(np.count_nonzero(np.cumsum(power) < power.sum() / 2))
    return count * step_s / max(half, 1)
