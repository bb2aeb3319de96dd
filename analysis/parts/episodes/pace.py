"""Whether all joints of an episode are later, or the episode was recorded at another rate.

Seen at the stated rate, an episode that was recorded at rho times it has all lags and all time
constants rho times as long. Another delay, as of a loop that is a frame late, is the same for all
joints, and the time constants stay. How far the motion shows the time constants, sound episodes
tell: they are measured as they are with their states delayed, and as they are at the other rate.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from undulog.capture.common.arrays import FloatArray
from undulog.capture.judgement.levels import FEWEST, ROBUST, TINY

from ...estimators.intervals import t_factor
from .deviations import regress
from .record import EpisodeBlock
from .response import EpisodeResponses, centred, dot, lowpass

WHOLE_FRAME = 1.0
"""Where neither is decided, what is a frame or more is a delay: loops are late by whole frames."""

CLOSER = 2.0
"""One is decided if the time constants are so many times as close to what it makes of them."""


@dataclass(frozen=True)
class EpisodePace:
    """What explains the lags of an episode.

    Attributes:
        is_rate: Whether it is the rate.
        decided: Whether the other one explains much less.
    """

    is_rate: bool
    decided: bool


def pace_of(
    block: EpisodeBlock,
    sample: EpisodeBlock,
    response: EpisodeResponses,
    slower: float,
    later: float,
) -> EpisodePace:
    """Decide for one episode.

    Args:
        block: With the episode alone.
        sample: Sound episodes, most of them.
        slower: Factor of the lags less 1.
        later: Median of the joints' delays [frames].
    """
    moved = replace(response, delay=response.delay + later)
    longer = float(constants_of(block, moved)[0])
    to_delay = _distance(longer, constants_of(shifted(sample, later), moved))
    to_rate = _distance(longer, constants_of(paced(sample, 1 + slower), moved))
    near, far = sorted((to_delay, to_rate))
    count = sample.episodes.size
    decided = count >= FEWEST and far > max(t_factor(count - 1), CLOSER * near)
    return EpisodePace(to_rate < to_delay if decided else abs(later) < WHOLE_FRAME, decided)


def _distance(value: float, sound: FloatArray) -> float:
    """Return how far a value is from those of sound episodes, in their standard deviations."""
    middle = float(np.median(sound))
    scatter = ROBUST * float(np.median(np.abs(sound - middle)))
    return abs(value - middle) / (scatter * float(np.sqrt(1 + 1 / sound.size)) + TINY)


def shifted(block: EpisodeBlock, later: float) -> EpisodeBlock:
    """Return episodes whose states are later [frames]."""
    times: FloatArray = np.arange(len(block.states), dtype=np.float64) - later
    return replace(block, states=_at(block.states, times))


def paced(block: EpisodeBlock, rate: float) -> EpisodeBlock:
    """Return episodes as they are at another rate, times the one that they have."""
    times: FloatArray = np.arange(len(block.states), dtype=np.float64) / rate
    whole = np.minimum(np.ceil(times), len(times) - 1).astype(np.int64)
    inside = block.inside[whole] & (times <= len(times) - 1)[:, None]
    return replace(
        block,
        inside=inside,
        commands=_at(block.commands, times),
        states=_at(block.states, times),
    )


def _at(values: FloatArray, times: FloatArray) -> FloatArray:
    """Return values at times between the frames, by lines, shape (t, k, m)."""
    places = np.clip(times, 0, len(values) - 1)
    first = np.minimum(places.astype(np.int64), max(len(values) - 2, 0))
    part = (places - first)[:, None, None]
    return values[first] * (1 - part) + values[np.minimum(first + 1, len(values) - 1)] * part


def constants_of(block: EpisodeBlock, response: EpisodeResponses) -> FloatArray:
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
