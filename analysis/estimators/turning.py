"""Joints that turn without end, as a screw or a wheel does, beside joints that swing.

A command of many turns has a thousand times the variance of a gait, and no rhythm of joint angles:
whoever looks for the rhythm of the others leaves it out.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping

import numpy as np

from undulog.capture.common.arrays import FloatArray

from .series import moves

TURN = 2 * math.pi
SWING_TURNS = 2.0
"""Range that a joint with stops has at most: from -360 to 360 degrees, as the wrists of arms."""

MOST_REVERSALS = 5
"""A rhythm turns back twice in each of its three cycles or more: what does so less is none."""

WRAP = 0.75
"""A step by more than this share of a turn is a wrap: a joint that turns by less than a quarter of
a turn from sample to sample makes steps of more than three quarters where its angle begins anew."""


def turns_without_end(values: FloatArray) -> bool:
    """Whether a command goes on for turns.

    Args:
        values: Angles, wrapped to one turn or not [rad], finite, shape (n,).

    Returns:
        True if it covers more than :data:`SWING_TURNS` turns and turns back, by a turn or more, at
        most :data:`MOST_REVERSALS` times.
    """
    angle = unwrapped(values)
    if angle.size < 2 or np.ptp(angle) <= SWING_TURNS * TURN:
        return False
    level = np.floor((angle - angle[0]) / TURN)
    passed = level[1:][np.diff(level) != 0].tolist()
    return reversals(passed) <= MOST_REVERSALS


def turning_beside_others(commands: Mapping[str, FloatArray]) -> tuple[str, ...]:
    """Find the joints that turn without end beside others that swing.

    Args:
        commands: Angles by joint [rad], each of shape (n,).

    Returns:
        Their names, in the order of the commands; none where no other command moves.
    """
    turning = tuple(name for name, values in commands.items() if turns_without_end(values))
    others = (values for name, values in commands.items() if name not in turning)
    return turning if turning and any(moves(values) for values in others) else ()


def unwrapped(angle: FloatArray) -> FloatArray:
    """Undo the wraps of an angle that is given within one turn.

    Args:
        angle: [rad], shape (n,).

    Returns:
        The angle without steps of more than :data:`WRAP` of a turn if it stays within one turn,
        shape (n,); else the angle as it is.
    """
    if angle.size < 2 or np.ptp(angle) > TURN * (1 + np.finfo(float).eps):
        return angle
    step = np.diff(angle)
    wraps = np.where(np.abs(step) > WRAP * TURN, np.sign(step), 0.0)
    return angle - TURN * np.concatenate([[0.0], np.cumsum(wraps)])


def reversals(levels: Iterable[float]) -> int:
    """Count how often a sequence turns back by more than one level.

    Args:
        levels: Whole numbers: turns that were begun.

    Returns:
        The number of changes of direction; one level to and fro, as at the edge of a turn, is none.
    """
    count, way, top = 0, 0, 0.0
    for level in levels:
        if way == 0:
            way = 1 if level > top else -1
            top = level
        elif (level - top) * way > 0:
            top = level
        elif (top - level) * way > 1:
            count, way, top = count + 1, -way, level
    return count
