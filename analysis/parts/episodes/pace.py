"""Whether all joints of an episode are later, or the episode was recorded at another rate.

Seen at the stated rate, an episode that was recorded at rho times it has all delays and all time
constants rho times as long. Another delay, as of a loop that is a frame late, is the same for all
joints, and the time constants stay. What each leaves of the states decides; where all joints have
one lag and the motion is slow, it can't.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from undulog.capture.common.arrays import FloatArray
from undulog.capture.judgement.levels import TINY

from .record import Block
from .response import Response, centred, dot, followed

TRIED = np.linspace(0.6, 1.5, 10)
"""Parts of the first estimate that are tried: it comes from a straight line."""

DECIDED = 2 * float(np.log(100.0))
"""Of two models, one is taken to be right if it explains the data a hundred times better."""

WHOLE_FRAME = 1.0
"""Where neither is decided, what is a frame or more is a delay: loops are late by whole frames."""


@dataclass(frozen=True)
class Pace:
    """What explains the lags of an episode.

    Attributes:
        rate: The factor of the rate; 1 if it is a delay.
        delay: Of all joints [frames]; 0 if it is the rate.
        decided: Whether the other one explains much less.
    """

    rate: float
    delay: float
    decided: bool


def pace_of(
    block: Block, response: Response, rate: float, delay: float, inflation: FloatArray
) -> Pace:
    """Decide for one episode.

    Args:
        block: With the episode alone.
        rate: Factor of the rate, first estimate.
        delay: [frames], first estimate.
        inflation: What correlation makes of the variance of each joint's lag, shape (m,).
    """
    rates = np.maximum(1 + (rate - 1) * TRIED, 0.1)
    delays = delay * TRIED
    paced = [
        Response(response.delay * k, response.constant * k, response.play) for k in rates.tolist()
    ]
    moved = [
        Response(response.delay + d, response.constant, response.play) for d in delays.tolist()
    ]
    sizes_paced, sizes_moved = (
        np.array([_left(block, model, inflation) for model in models]) for models in (paced, moved)
    )
    better = float(sizes_moved.min() - sizes_paced.min())
    decided = abs(better) > DECIDED
    by_rate = better > 0 if decided else abs(delay) < WHOLE_FRAME
    if by_rate:
        return Pace(float(rates[sizes_paced.argmin()]), 0.0, decided)
    return Pace(1.0, float(delays[sizes_moved.argmin()]), decided)


def _left(block: Block, response: Response, inflation: FloatArray) -> float:
    """Return -2 log likelihood of an episode's states, with the best gain and offset."""
    weights = block.inside.astype(np.float64)
    weights[: min(response.settled, len(weights) // 4)] = 0.0
    x, y = centred(followed(block, response), weights), centred(block.states, weights)
    left = np.maximum(dot(y, y) - dot(x, y) ** 2 / np.maximum(dot(x, x), TINY), TINY)
    return float(np.sum(np.log(left / weights.sum()) * weights.sum() / inflation))
