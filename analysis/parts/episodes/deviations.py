"""Gain, level and lag of each episode's joints, against the response that all episodes share.

A regression on x of :mod:`.response` and its derivative by the delay, one for each episode and
joint: a step of Gauss and Newton from the common delay. The errors are those of white residuals,
times what their correlation over time makes of them, which sums over blocks of time show (Liang &
Zeger, Biometrika 73, 1986, doi 10.1093/biomet/73.1.13).
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np

from undulog.capture.common.arrays import BoolArray, FloatArray, IntArray
from undulog.capture.judgement.levels import TINY

from .record import EpisodeBlock
from .response import EpisodeResponses, centred, dot, followed, rate_of

BLOCK_S = 0.5
"""Length of the blocks of time [s]: time constants of servos, reactions of a person who teaches."""


@dataclass(frozen=True)
class Deviations:
    """Of e episodes and m joints, shape (e, m) each; NaN where nothing is measured.

    Attributes:
        gain: g of the response.
        middle: Mean of x.
        mean: Mean of the states.
        lag: Later than the common response [frames].
        gain_unit: Standard error of the gain for a residual of 1.
        lag_unit: Standard error of the lag for a residual of 1, times the gain [frames].
        left: Mean square of the residual.
        power: Variance of the states.
        asked: Variance of x.
        count: Frames that are used.
        gain_error: Standard error of the gain by the episode's own residual, where it was searched;
            else 0.
        lag_error: The same of the lag [frames].
    """

    gain: FloatArray
    middle: FloatArray
    mean: FloatArray
    lag: FloatArray
    gain_unit: FloatArray
    lag_unit: FloatArray
    left: FloatArray
    power: FloatArray
    asked: FloatArray
    count: FloatArray
    gain_error: FloatArray
    lag_error: FloatArray

    @classmethod
    def empty(cls, episodes: int, joints: int) -> Deviations:
        """Return deviations of which none is measured."""
        return cls(*(np.full((episodes, joints), np.nan) for _ in fields(cls)))

    def with_better(self, other: Deviations, better: BoolArray) -> Deviations:
        """Return these, with others where those are better, shape (e, m)."""
        arrays: list[FloatArray] = [
            np.where(better, getattr(other, field.name), getattr(self, field.name))
            for field in fields(self)
        ]
        return Deviations(*arrays)

    def put(self, episodes: IntArray, measured: Deviations) -> None:
        """Fill in some episodes."""
        for field in fields(self):
            getattr(self, field.name)[episodes] = getattr(measured, field.name)


@dataclass(frozen=True)
class Regression:
    """A block's regression.

    Attributes:
        weights: 1 where frames are used, shape (t, k).
        x: Of the response, not centred, shape (t, k, m).
        columns: x and its derivative by the delay, less their means, shape (t, k, m) each.
        residual: 0 outside, shape (t, k, m).
    """

    deviations: Deviations
    weights: FloatArray
    x: FloatArray
    columns: tuple[FloatArray, FloatArray]
    residual: FloatArray


def regress(block: EpisodeBlock, response: EpisodeResponses, frames: int = 0) -> Regression:
    """Fit gain, level and lag of a block's episodes.

    Args:
        frames: Of a block of time, where errors by each episode's own residual are asked for.
    """
    weights = block.inside.astype(np.float64)
    weights[: min(response.settled, len(weights) // 4)] = 0.0
    count = np.maximum(weights.sum(axis=0), 1.0)[:, None]
    raw = followed(block, response)
    x, y = centred(raw, weights), centred(block.states, weights)
    late = rate_of(x, weights)
    xx, dx, dd = np.maximum(dot(x, x), TINY), dot(late, x), dot(late, late)
    xy, dy = dot(x, y), dot(late, y)
    free = np.maximum(dd - dx**2 / xx, TINY)  # the derivative less its part along x
    step = (dy - dx * xy / xx) / free
    gain = (xy - step * dx) / xx
    residual = y - gain * x - step * late
    gain_error, lag_error = np.zeros_like(gain), np.zeros_like(gain)
    if frames > 0:
        along = x - late * (dx / np.maximum(dd, TINY))
        gain_error = _own_error(residual * along, dot(along, along), frames)
        across = late - x * (dx / xx)
        lag_error = _own_error(residual * across, free, frames) / np.maximum(np.abs(gain), TINY)
    deviations = Deviations(
        gain=gain,
        middle=np.einsum("tk,tkm->km", weights, raw) / count,
        mean=np.einsum("tk,tkm->km", weights, block.states) / count,
        lag=step / np.where(gain == 0, TINY, gain),
        gain_unit=np.sqrt(1 / xx + (dx / xx) ** 2 / free),
        lag_unit=1 / np.sqrt(free),
        left=dot(residual, residual) / count,
        power=dot(y, y) / count,
        asked=xx / count,
        count=np.broadcast_to(count, gain.shape),
        gain_error=gain_error,
        lag_error=lag_error,
    )
    return Regression(deviations, weights, raw, (x, late), residual)


def _own_error(scores: FloatArray, power: FloatArray, frames: int) -> FloatArray:
    """Return a standard error by sums over blocks of time, shape (k, m).

    Args:
        scores: The free part of a column times the residual, shape (t, k, m).
        power: Of the free part, shape (k, m).
    """
    sums = np.add.reduceat(scores, np.arange(0, len(scores), frames), axis=0)
    return np.sqrt(dot(sums, sums)) / np.maximum(power, TINY)


def inflation_of(regression: Regression, fps: float) -> FloatArray:
    """Return what correlation makes of the variances of level, gain and lag, shape (3, m)."""
    frames = max(round(BLOCK_S * fps), 1)
    residual = regression.residual
    starts = np.arange(0, len(residual), frames)
    ratios: list[FloatArray] = []
    for scores in (residual, *(residual * column for column in regression.columns)):
        sums = np.add.reduceat(scores, starts, axis=0)
        ratios.append(
            dot(sums, sums).sum(axis=0) / np.maximum(dot(scores, scores).sum(axis=0), TINY)
        )
    return np.maximum(np.stack(ratios), 1.0)


def searched(block: EpisodeBlock, response: EpisodeResponses, most: int, fps: float) -> Deviations:
    """Search the lags of a block's episodes frame by frame, and return what fits best.

    A joint at its largest speed is later in some motions than in others: the errors are those of
    each episode's own residual.

    Args:
        most: Frames on either side of the common delay.
    """
    frames = max(round(BLOCK_S * fps), 1)
    best = regress(block, response, frames).deviations
    for shift in range(-most, most + 1):
        moved = EpisodeResponses(response.delay + shift, response.constant, response.play)
        tried = regress(block, moved, frames).deviations
        tried = replace(tried, lag=tried.lag + shift)
        forward = tried.gain > 0
        better = forward & ((tried.left < best.left) | (best.gain <= 0))
        best = best.with_better(tried, better)
    return best
