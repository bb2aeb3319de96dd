"""Colour of mechanical power: who drives whom.

A joint that works on the body (torque along velocity) glows vermilion, a joint that the body
drives turns cyan, an idle one is grey. Both ends are as light as the map along the body, and
neither is on it, so power is not mistaken for place.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from undulog.capture.common.arrays import FloatArray

_DRIVEN = np.array([0, 205, 220])
_IDLE = np.array([112, 112, 120])
_DRIVES = np.array([255, 84, 48])
_UNKNOWN = np.array([70, 70, 74, 255], dtype=np.uint8)


def power_colors(power_w: FloatArray, limit_w: float) -> NDArray[np.uint8]:
    """Colours of power, symmetric about zero.

    Args:
        power_w: Mechanical power [W], any shape; NaN where it isn't known.
        limit_w: Power at which the colour is full [W], above 0.

    Returns:
        sRGB and opacity, shape (..., 4); dark grey where the power isn't known.
    """
    known = np.isfinite(power_w)
    share = np.clip(np.where(known, power_w, 0.0) / limit_w, -1.0, 1.0)[..., None]
    end = np.where(share < 0.0, _DRIVEN, _DRIVES)
    colors = np.full((*power_w.shape, 4), 255, dtype=np.uint8)
    colors[..., :3] = np.round(_IDLE + np.abs(share) * (end - _IDLE))
    colors[~known] = _UNKNOWN
    return colors
