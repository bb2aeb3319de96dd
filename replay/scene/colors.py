"""Colour of mechanical power: who drives whom.

A joint that works on the body (torque along velocity) glows vermilion, a joint that the body
drives turns cyan, an idle one is grey. Both ends are as light as the map along the body, and
neither is on it, so power is not mistaken for place.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from undulog.capture.arrays import FloatArray

NAMED = (255, 95, 190, 255)
"""Pink of a module that a test names: on none of the maps."""

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


def power_limit(power_w: FloatArray) -> float:
    """The power at which the colour is full: the 99th percentile of its magnitude.

    Args:
        power_w: Mechanical power [W], any shape; NaN where it isn't known.

    Returns:
        [W], rounded up to two digits so that it can be written beside the picture; 1 where no
        power is known or all of it is zero.
    """
    known = np.abs(power_w[np.isfinite(power_w)])
    limit = float(np.percentile(known, 99.0)) if known.size else 0.0
    if limit <= 0.0:
        return 1.0
    unit = 10.0 ** (np.floor(np.log10(limit)) - 1.0)
    return float(np.ceil(limit / unit) * unit)
