"""A joint whose response lies apart from those of the others, further than the others spread.

It is the only comparison that joints of several kinds allow, as those of an arm: each has a gain
and a lag of its own, and the spread of the others is what such joints differ by. It is a
difference, no fault. Joints of one kind in a gait are compared more closely, with intervals.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..common.arrays import FloatArray
from .exposure import LIKE_LAG_S, Exposure, median_response, responds
from .fault import Apart
from .levels import ENOUGH_LIKE, QUARTER, TINY
from .motion import Course
from .response import Filtered, JointResponse


def find_apart(
    course: Course, exposure: Exposure, names: Sequence[str], left_out: Sequence[bool]
) -> list[Apart]:
    """Find the joints whose gain or lag lies apart from those of the others.

    A gain does so by the joint's own response and by the slope of its position over what the
    others' median response makes of its command: a response of few rests takes their errors for
    a gain and a slow motion.

    Apart is further from the nearest of them than twice their spread, and further than joints
    differ that count as like (:func:`.exposure.agrees`). Of five and more joints the spread is that
    without the one that is furthest from the middle.

    Args:
        names: Of the k joints.
        left_out: Joints that something else is stated of; they are no measure of the others.

    Returns:
        First those of the lag, then those of the gain.
    """
    kept = [
        k for k, response in enumerate(exposure.responses) if responds(response) and not left_out[k]
    ]
    if len(kept) < ENOUGH_LIKE:
        return []
    lags = _apart(np.array([exposure.responses[k].lag_s for k in kept]), LIKE_LAG_S)
    gains = _apart(np.array([exposure.responses[k].gain for k in kept]), 0.0)
    common = median_response([exposure.responses[k] for k in kept])
    slopes = _apart(np.array([_slope(course, common, k) for k in kept]), 0.0)
    outliers = [Apart(names[kept[i]], "lag", *lag) for i, lag in lags.items()]
    outliers += [Apart(names[kept[i]], "gain", *gains[i]) for i in gains if i in slopes]
    return outliers


def _apart(values: FloatArray, least: float) -> dict[int, tuple[float, tuple[float, float]]]:
    """Return the values that lie apart by index, each with the least and largest of the others."""
    outliers: dict[int, tuple[float, tuple[float, float]]] = {}
    for i, value in enumerate(values.tolist()):
        others = np.delete(values, i)
        middle = float(np.median(others))
        if others.size >= ENOUGH_LIKE:  # one of them may be apart, too
            others = np.delete(others, np.argmax(np.abs(others - middle)))
        low, high = float(others.min()), float(others.max())
        away = max(value - high, low - value)
        if away > max(2 * (high - low), QUARTER * middle, least):
            outliers[i] = value, (low, high)
    return outliers


def _slope(course: Course, common: JointResponse, k: int) -> float:
    """Return the slope of a joint's position over what a response makes of its command."""
    present = course.present[k]
    asked = Filtered(course.command[k][None, :], course.step_s).output(common)[0][present]
    asked = asked - asked.mean()
    return float(asked @ course.position[k][present]) / max(float(asked @ asked), TINY)
