"""Whether all joints of an episode are later, or the episode was recorded at another rate.

Seen at the stated rate, an episode that was recorded at rho times it has all lags and all time
constants rho times as long. Another delay, as of a loop that is a frame late, is the same for all
joints, and the time constants stay. So the time constants decide, as far as they scatter less
between sound episodes than the two differ by.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from undulog.capture.common.arrays import FloatArray
from undulog.capture.judgement.levels import FEWEST, ROBUST, TINY

from ...estimators.intervals import t_factor
from .deviations import regress
from .record import Block
from .response import Response, centred, dot, lowpass

WHOLE_FRAME = 1.0
"""Where neither is decided, what is a frame or more is a delay: loops are late by whole frames."""

CLOSER = 2.0
"""One is decided if the time constants are so many times as close to what it makes of them."""


@dataclass(frozen=True)
class Pace:
    """What explains the lags of an episode.

    Attributes:
        is_rate: Whether it is the rate.
        decided: Whether the other one explains much less.
    """

    is_rate: bool
    decided: bool


def pace_of(block: Block, sample: Block, response: Response, slower: float, later: float) -> Pace:
    """Decide for one episode.

    Args:
        block: With the episode alone.
        sample: Sound episodes, most of them.
        slower: Factor of the lags less 1.
        later: Median of the joints' delays [frames].
    """
    moved = Response(response.delay + later, response.constant, response.play)
    longer = float(constants_of(block, moved)[0])
    sound = constants_of(sample, response)
    usual = float(np.median(sound))
    scatter = ROBUST * float(np.median(np.abs(sound - usual))) + TINY
    limit = t_factor(max(sound.size - 1, 1)) * scatter * float(np.sqrt(1 + 1 / sound.size))
    to_delay, to_rate = abs(longer - usual), abs(longer - usual - slower)
    near, far = sorted((to_delay, to_rate))
    decided = sound.size >= FEWEST and far > max(limit, CLOSER * near)
    return Pace(to_rate < to_delay if decided else abs(later) < WHOLE_FRAME, decided)


def constants_of(block: Block, response: Response) -> FloatArray:
    """Return by what part the time constants of each episode are longer, over its joints, (k,).

    A step of Gauss and Newton in the time constants, with gains, offsets and delays free.
    """
    regression = regress(block, response)
    x, late = regression.columns
    slow = centred(lowpass(late, response.constant), regression.weights)
    xx, dd, dx = dot(x, x), dot(late, late), dot(late, x)
    determinant = np.maximum(xx * dd - dx**2, TINY)
    sx, sd = dot(slow, x), dot(slow, late)
    by_x, by_d = (sx * dd - sd * dx) / determinant, (sd * xx - sx * dx) / determinant
    free = slow - by_x * x - by_d * late
    unit = response.constant * regression.deviations.gain * free
    noise = np.maximum(regression.deviations.left, TINY)
    power = np.sum(dot(unit, unit) / noise, axis=1)
    return np.sum(dot(unit, regression.residual) / noise, axis=1) / np.maximum(power, TINY)
