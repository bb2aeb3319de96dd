"""An encoder that wraps around, or loses its place: steps that no joint can make.

Steps of one common size P, up and down, are the wrap of a counter: the position is right again
but for whole turns of P. Any other such step is a jump: from then on the position is another one,
or one sample was wrong.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from undulog.capture.common.arrays import BoolArray, FloatArray, IntArray

from ..estimators.series import Series
from ..results.artefact import Span
from .spans import inside, spans_of

ABOVE_NEIGHBOURS = 8.0
"""A step this many times those beside it stands alone."""

ABOVE_USUAL = 20.0
"""A step this many times the median one is unlike any other."""

SAME_SIZE = 0.02
"""Relative spread of the sizes of one counter's wraps."""

_BESIDE = 3
_TURNS = (np.pi, 2 * np.pi, 4 * np.pi)
"""Sizes [rad] by which a single step is known as a wrap."""


@dataclass(frozen=True)
class Jumps:
    """What a position does that no joint can do.

    Attributes:
        wrapped: Stretches in which it is off by whole turns of the counter.
        turn_rad: Size of that turn [rad]; 0 where there is none.
        jumped: Instants of other steps, from the sample before to the sample after.
    """

    wrapped: tuple[Span, ...]
    turn_rad: float
    jumped: tuple[Span, ...]


def find_jumps(position: Series, most_rate: float, released: tuple[Span, ...] = ()) -> Jumps:
    """Look for wraps and jumps.

    Args:
        position: Measured positions.
        most_rate: Rate that the joint can't exceed [rad/s].
        released: Stretches in which the position was frozen: the step at the end of one is the
            way that the joint has gone meanwhile.

    Returns:
        What was found.
    """
    t_s, value = position.t_s, position.values
    nothing = Jumps((), 0.0, ())
    if value.size < 16:
        return nothing
    step, dt = np.diff(value), np.diff(t_s)
    at = np.flatnonzero(_alone(step, dt, most_rate))
    if released:
        held = inside(t_s, released)
        near = np.minimum(at[:, None] + np.arange(-1, 3), value.size - 1)
        at = at[~held[near].any(axis=1)]
    if at.size == 0:
        return nothing
    own = step[at] - _beside(step, at)  # without what the joint itself did meanwhile
    turn = float(np.median(np.abs(own)))
    ordinary = float(np.median(np.abs(step)))
    spread = SAME_SIZE * turn + 2 * ordinary
    alike = bool(np.all(np.abs(np.abs(own) - turn) < spread))
    # Lone steps of any size may be a jump; a counter's single wrap is known by its size.
    known = any(abs(turn - one) < spread for one in _TURNS)
    if not alike or not (known or (at.size > 2 and np.ptp(value) < 2 * turn)):
        return Jumps((), 0.0, tuple((float(t_s[k]), float(t_s[k + 1])) for k in at))
    turns = np.zeros(value.size)
    turns[at + 1] = np.rint(own / turn)
    count = np.cumsum(turns)
    levels, index = np.unique(count, return_inverse=True)
    usual = levels[np.argmax(np.bincount(index))]
    return Jumps(spans_of(t_s, count != usual), turn, ())


def _alone(step: FloatArray, dt: FloatArray, most_rate: float) -> BoolArray:
    size = np.abs(step)
    possible = most_rate * dt
    alone = size > possible
    if not np.any(alone):
        return alone
    # Over a gap a joint goes further; the usual step grows with it.
    usual = np.median(size[size > 0])
    alone &= size > ABOVE_USUAL * usual * np.maximum(dt / np.median(dt), 1.0)
    for k in np.flatnonzero(alone):
        near = np.concatenate((size[max(k - _BESIDE, 0) : k], size[k + 1 : k + 1 + _BESIDE]))
        calm = near[near <= possible[k]]
        alone[k] = calm.size > 1 and size[k] > ABOVE_NEIGHBOURS * float(calm.max())
    return alone


def _beside(step: FloatArray, at: IntArray) -> FloatArray:
    """Mean of the steps just before and after each."""
    before, after = np.maximum(at - 1, 0), np.minimum(at + 1, step.size - 1)
    return (step[before] + step[after]) / 2
