"""Frames that are missing, or there twice, though the stamps are regular.

A frame that was lost moves all joints at once by what they go in a frame. The four frames on either
side of a transition show a joint's rate, and its jump: that of a step beside a parabola by least
squares. What the command explains is no loss, so the jump is that of the residual of
:mod:`.response`. If the recorder lost a frame, it lost the command's, too, and what that does to the
residual is known: a step less the step response. With the residual's usual jump e the time that is
missing between two frames is, over all joints j,

    tau = sum(jump rate / e^2) / i,    i = sum(rate^2 / e^2)   [frames]                     (1)

and a frame that is lost is more likely than none by the factor exp(u - i / 2), u = tau i. The
statistic is its exponent over its standard error: (u - i / 2) / sqrt(i) exceeds 0 only where tau is
nearer to 1 than to 0. For a frame that is there twice tau is -1.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from undulog.capture.common.arrays import FloatArray, IntArray
from undulog.capture.judgement.levels import TINY

from .deviations import Regression
from .record import Block
from .response import Response, delayed, lowpass

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


def seen_of(response: Response) -> FloatArray:
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
        usual: Root mean square of e, shape (m,).
        seen: Part of a lost frame's jump, shape (m,).
        residual: Whether the residuals are looked at, or else the states.
    """

    usual: FloatArray
    seen: FloatArray
    residual: bool


def scale_of(block: Block, regression: Regression, response: Response) -> JumpScale:
    """Return what jumps are, from a sample of the episodes."""
    seen = seen_of(response)
    residual = bool(np.median(seen) > LEAST_SEEN)
    seen = np.maximum(seen, 0.0) if residual else np.ones_like(seen)
    jumps = _jumps(block, regression, residual=residual)
    count = np.maximum(_inside(block).sum(axis=0), 1)[:, None]
    usual = np.sqrt(np.median(np.einsum("tkm,tkm->km", jumps, jumps) / count, axis=0))
    return JumpScale(usual, seen, residual)


@dataclass(frozen=True)
class Jumps:
    """Of e episodes, shape (e,) each.

    Attributes:
        lost: The largest statistic of a lost frame.
        after: The frame before which it is.
        time: tau of the states there [frames].
        error: Its standard error [frames].
        twice: The largest statistic of a frame that is there twice.
        twice_after: The frame before that.
    """

    lost: FloatArray
    after: IntArray
    time: FloatArray
    error: FloatArray
    twice: FloatArray
    twice_after: IntArray

    @classmethod
    def empty(cls, episodes: int) -> Jumps:
        """Return what no frame is looked at for."""
        none = [np.full(episodes, np.nan) for _ in range(4)]
        numbers = [np.zeros(episodes, np.int64) for _ in range(2)]
        return cls(none[0], numbers[0], none[1], none[2], none[3], numbers[1])

    def put(self, episodes: IntArray, measured: Jumps) -> None:
        """Fill in some episodes."""
        for name, values in vars(measured).items():
            getattr(self, name)[episodes] = values


def jumps_of(block: Block, regression: Regression, scale: JumpScale) -> Jumps:
    """Look for the frames of each episode that are most likely lost, or there twice."""
    joints = np.flatnonzero(scale.usual > 0)
    if len(block.inside) < 2 * SIDE + 1 or not joints.size:
        return Jumps.empty(block.episodes.size)
    weight = np.zeros_like(scale.usual)
    weight[joints] = 1 / scale.usual[joints] ** 2
    jumps = _jumps(block, regression, residual=scale.residual)
    rates = windowed(block.states, RATE)
    # The information is limited by the share of a rate that its window doesn't know.
    along = np.einsum("tkm,tkm,m->tk", jumps, rates, weight * scale.seen)
    power = np.einsum("tkm,tkm,m->tk", rates, rates, weight * scale.seen**2)
    root = np.sqrt(power) + TINY
    inside = _inside(block)
    lost = np.where(inside, (along - power / 2) / root, -np.inf)
    twice = np.where(inside, (-along - power / 2) / root, -np.inf)
    k, columns = lost.argmax(axis=0), np.arange(block.episodes.size)
    raw = windowed(block.states, JUMP)[k, columns] if scale.residual else jumps[k, columns]
    there = rates[k, columns]
    information = (there**2) @ weight + TINY
    again = twice.argmax(axis=0)
    return Jumps(
        lost[k, columns], k + SIDE, (raw * there) @ weight / information,
        1 / np.sqrt(information), twice[again, columns], again + SIDE,
    )  # fmt: skip


def _jumps(block: Block, regression: Regression, *, residual: bool) -> FloatArray:
    if not residual:
        values = block.states
    else:
        # Residual with the episode's gain, also where the joints aren't settled.
        values = block.states - regression.deviations.gain * regression.x
    return windowed(values, JUMP) * _inside(block)[:, :, None]


def _inside(block: Block) -> FloatArray:
    """Return whether all frames of a window are inside, shape (t - 2 SIDE + 1, k)."""
    return block.inside[2 * SIDE - 1 :]
