"""Frames that are missing, or there twice, though the stamps are regular.

A frame that was lost moves all joints at once by what they go in a frame. The four frames on either
side of a transition show a joint's rate, and its jump: that of a step beside a parabola by least
squares. What the command explains is no loss, so the jump is that of the residual of
:mod:`.response`. If the recorder lost a frame, it lost the command's, too, and what that makes of
the residual is known: a step less the step response. Over all joints, the missing time is

    tau = sum(jump rate / e^2) / i,    i = sum(rate^2 / e^2),    e^2 = s^2 + (r rate)^2     (1)

in frames, where s is a joint's usual jump while it stands, and r that in parts of its rate while it
moves: a sensor that is read more rarely than the others always jumps, and shows nothing.

and a frame that is lost is more likely than none by the factor exp(u - i / 2), u = tau i. The
statistic is its exponent over its standard error: (u - i / 2) / sqrt(i) exceeds 0 only where tau is
nearer to 1 than to 0. For a frame that is there twice tau is -1.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from undulog.capture.common.arrays import BoolArray, FloatArray, IntArray
from undulog.capture.judgement.levels import HALF, TINY

from .deviations import Regression
from .outliers import weighted_median
from .record import EpisodeBlock
from .response import EpisodeResponses, delayed, dot, lowpass

SIDE = 4
"""Frames on either side: fewer show no parabola, with more a quick move is none."""

LEAST_SEEN = 0.2
"""Part of a lost frame's jump that the residual shows at least; joints without any lag show none,
and the states alone are looked at then."""


def _kernels() -> tuple[FloatArray, FloatArray]:
    """Return weights of 2 SIDE frames that give a jump between the middle two, and the rate."""
    t = np.arange(2 * SIDE) - SIDE + 0.5
    step = np.where(t > 0, 1.0, 0.0)
    within = np.where(t < 0, t + SIDE / 2, t - SIDE / 2)
    design = np.stack([np.ones_like(t), t, t**2, step], axis=1)
    return np.linalg.pinv(design)[3], within / (within @ within)


JUMP, RATE = _kernels()


def windowed(values: FloatArray, kernel: FloatArray) -> FloatArray:
    """Return the sum of a kernel times the frames from each one on, shape (t - 2 SIDE + 1, ...)."""
    count = len(values) - kernel.size + 1
    total = kernel[0] * values[:count]
    for k in range(1, kernel.size):
        total += kernel[k] * values[k : k + count]
    return total


def seen_of(response: EpisodeResponses) -> FloatArray:
    """Return the part of a lost frame's jump that the residual of each joint shows, shape (m,)."""
    step = np.zeros((4 * SIDE, response.delay.size))
    step[2 * SIDE :] = 1.0
    passed = delayed(
        step, lowpass(step, response.constant), np.maximum(response.delay, 0.0), response.constant
    )
    return np.einsum("t,tm->m", JUMP, (step - passed)[SIDE : 3 * SIDE])


@dataclass(frozen=True)
class JumpScale:
    """What the jumps of sound joints are.

    Attributes:
        usual: s of equation (1), shape (m,).
        relative: r of equation (1) [frames], shape (m,).
        seen: Part of a lost frame's jump, shape (m,).
        gain: Of sound episodes, shape (m,).
        residual: Whether the residuals are looked at, or else the states.
    """

    usual: FloatArray
    relative: FloatArray
    seen: FloatArray
    gain: FloatArray
    residual: bool


def scale_of(block: EpisodeBlock, regression: Regression, response: EpisodeResponses) -> JumpScale:
    """Return what jumps are, from a sample of the episodes."""
    seen = seen_of(response)
    residual = bool(np.median(seen) > LEAST_SEEN)
    seen = np.maximum(seen, 0.0) if residual else np.ones_like(seen)
    jumps = _jumps(block, regression, residual=residual)
    rates = windowed(block.states, RATE) * _inside(block)[:, :, None]
    count = np.maximum(_inside(block).sum(axis=0), 1)[:, None]
    usual = np.median(dot(jumps, jumps) / count, axis=0)
    power = rates**2
    relative = np.median(dot(jumps**2, power) / (dot(power, power) + TINY), axis=0)
    gain = np.abs(np.median(regression.deviations.gain, axis=0))
    return JumpScale(np.sqrt(usual), np.sqrt(relative), seen, gain, residual)


@dataclass(frozen=True)
class Jumps:
    """Of e episodes, shape (e,) each.

    Attributes:
        lost: The largest statistic of a lost frame.
        after: The frame before which it is.
        time: tau of the states there [frames].
        error: Its standard error [frames].
        middle: The median of the joints' times [frames], weighted by what each shows.
        twice: The largest statistic of a frame that is there twice.
        twice_after: The frame before that.
    """

    lost: FloatArray
    after: IntArray
    time: FloatArray
    error: FloatArray
    middle: FloatArray
    twice: FloatArray
    twice_after: IntArray

    @classmethod
    def empty(cls, episodes: int) -> Jumps:
        """Return what no frame is looked at for."""
        lost, time, error, middle, twice = (np.full(episodes, np.nan) for _ in range(5))
        after, twice_after = (np.zeros(episodes, np.int64) for _ in range(2))
        return cls(lost, after, time, error, middle, twice, twice_after)

    def put(self, episodes: IntArray, measured: Jumps) -> None:
        """Fill in some episodes."""
        for name, values in vars(measured).items():
            getattr(self, name)[episodes] = values


def jumps_of(block: EpisodeBlock, regression: Regression, scale: JumpScale) -> Jumps:
    """Look for the frames of each episode that are most likely lost, or there twice."""
    if len(block.inside) < 2 * SIDE + 1 or not scale.usual.any():
        return Jumps.empty(block.episodes.size)
    jumps = _jumps(block, regression, residual=scale.residual)
    rates = windowed(block.states, RATE)
    usable = scale.usual > 0
    # In a signal that is scaled, noise is, too.
    scaled = np.maximum(np.abs(regression.deviations.gain) / (scale.gain + TINY), 1.0)
    errors = np.where(usable, (scale.usual * scaled) ** 2, np.inf)
    errors = errors + (scale.relative * rates) ** 2
    informing = rates * (scale.seen / errors)
    along = dot_joints(jumps, informing)
    power = dot_joints(rates * scale.seen, informing)
    root = np.sqrt(power) + TINY
    inside = _inside(block)
    lost = np.where(inside, (along - power / 2) / root, -np.inf)
    twice = np.where(inside, (-along - power / 2) / root, -np.inf)
    k, columns = lost.argmax(axis=0), np.arange(block.episodes.size)
    raw = windowed(block.states, JUMP)[k, columns] if scale.residual else jumps[k, columns]
    there = rates[k, columns]
    weight = 1 / errors[k, columns]
    information = np.sum(there**2 * weight, axis=1) + TINY
    shares = raw / np.where(there == 0, TINY, there)
    again = twice.argmax(axis=0)
    misfit = _misfit(jumps[k, columns], there * scale.seen, weight)
    return Jumps(
        lost=lost[k, columns] / misfit,
        after=k + SIDE,
        time=np.sum(raw * there * weight, axis=1) / information,
        error=1 / np.sqrt(information),
        middle=weighted_median(shares, there**2 * weight),
        twice=twice[again, columns],
        twice_after=again + SIDE,
    )


def _misfit(jumps: FloatArray, rates: FloatArray, weight: FloatArray) -> FloatArray:
    """Return by how much the joints' times scatter more than their errors, at least 1, shape (k,).

    The root of chi-squared over its degrees of freedom (Birge, Phys. Rev. 40, 1932). Half of what a
    joint goes by is no misfit: its rate isn't constant over several frames.

    Args:
        jumps: Shape (k, m).
        rates: What a lost frame makes of them, shape (k, m).
        weight: Inverse variances, shape (k, m).
    """
    power = np.sum(rates**2 * weight, axis=1) + TINY
    time = np.sum(jumps * rates * weight, axis=1) / power
    expected = time[:, None] * rates
    errors = 1 / np.maximum(weight, TINY) + (HALF * expected) ** 2
    left = np.sum((jumps - expected) ** 2 / errors, axis=1)
    freedom = np.maximum(np.count_nonzero(weight, axis=1) - 1, 1)
    return np.maximum(np.sqrt(left / freedom), 1.0)


def dot_joints(left: FloatArray, right: FloatArray) -> FloatArray:
    """Return the sum of products over the joints, shape (t, k)."""
    return np.einsum("tkm,tkm->tk", left, right)


def _jumps(block: EpisodeBlock, regression: Regression, *, residual: bool) -> FloatArray:
    if not residual:
        values = block.states
    else:
        # Residual with the episode's gain, also where the joints aren't settled.
        values = block.states - regression.deviations.gain * regression.x
    return windowed(values, JUMP) * _inside(block)[:, :, None]


def _inside(block: EpisodeBlock) -> BoolArray:
    """Return whether all frames of a window are inside, shape (t - 2 SIDE + 1, k)."""
    return block.inside[2 * SIDE - 1 :]
