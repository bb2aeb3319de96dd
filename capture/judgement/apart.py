"""A joint whose response lies apart from those of the others, further than the others spread.

It is the only comparison that joints of several kinds allow, as those of an arm: each has a gain
and a lag of its own, and the spread of the others is what such joints differ by. It is a
difference, no fault. Joints of one kind in a gait are compared more closely, with intervals.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from .exposure import LIKE_LAG_S, Exposure, responds
from .fault import Apart
from .levels import ENOUGH_LIKE, QUARTER


def find_apart(exposure: Exposure, names: Sequence[str], left_out: Sequence[bool]) -> list[Apart]:
    """Find the joints whose gain or lag lies apart from those of the others.

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
    found: list[Apart] = []
    for quantity in ("lag", "gain"):
        values = {
            k: response.lag_s if quantity == "lag" else response.gain
            for k, response in enumerate(exposure.responses)
            if k in kept
        }
        for k, value in values.items():
            others = np.array([values[j] for j in kept if j != k])
            middle = float(np.median(others))
            if others.size >= ENOUGH_LIKE:  # one of them may be apart, too
                others = np.delete(others, np.argmax(np.abs(others - middle)))
            low, high = float(others.min()), float(others.max())
            away = max(value - high, low - value)
            margin = QUARTER * middle
            margin = max(margin, LIKE_LAG_S) if quantity == "lag" else margin
            if away > max(2 * (high - low), margin):
                found.append(Apart(names[k], quantity, value, (low, high)))
    return found
