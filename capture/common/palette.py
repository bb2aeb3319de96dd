"""The one colour map along the body: a joint keeps its colour in report, docs and Rerun.

The map is a curve in OKLab (Ottosson 2020, https://bottosson.github.io/posts/oklab/) from blue
at the head over green to orange at the tail, sampled at equal steps of arc length, so neighbours
differ equally everywhere. Lightness rises all the way, so the order survives colour blindness
and grey print, and stays between 0.48 and 0.67, so that each colour has a contrast of 3 to white
and to black (WCAG 2.2, success criterion 1.4.11). Maps of values share the ends of their scale.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .arrays import FloatArray, frozen

# Control points of a quadratic Bezier curve in OKLab (lightness, a, b): blue, green, orange.
_CURVE = np.array([[0.483, 0.022, -0.15], [0.603, -0.218, -0.009], [0.671, 0.089, 0.139]])

# OKLab -> cube roots of cone responses -> linear sRGB (Ottosson 2020).
_LAB_TO_CONE = np.array(
    [
        [1.0, 0.3963377774, 0.2158037573],
        [1.0, -0.1055613458, -0.0638541728],
        [1.0, -0.0894841775, -1.2914855480],
    ]
)
_CONE_TO_RGB = np.array(
    [
        [4.0767416621, -3.3077115913, 0.2309699292],
        [-1.2684380046, 2.6097574011, -0.3413193965],
        [-0.0041960863, -0.7034186147, 1.7076147010],
    ]
)


def joint_colors(count: int) -> NDArray[np.uint8]:
    """Return colours of the joints (or links) of a chain, head to tail.

    Args:
        count: Number of joints, at least 1.

    Returns:
        sRGB and opacity 255, shape (count, 4).
    """
    place = np.linspace(0.0, 1.0, count) if count > 1 else np.array([0.5])
    colors = np.full((count, 4), 255, dtype=np.uint8)
    colors[:, :3] = np.round(255.0 * _srgb(_oklab(place))).astype(np.uint8)
    return frozen(colors)


def joint_hex(count: int) -> tuple[str, ...]:
    """Return the same colours as ``#rrggbb``, one a joint."""
    return tuple("#" + bytes(color[:3]).hex() for color in joint_colors(count))


def scale_ends(values: FloatArray, least: float, *, signed: bool) -> tuple[float, float]:
    """Return the values at the ends of a map's colours.

    Args:
        values: Those that are drawn, any shape; NaN counts as none.
        least: Distance of the ends, at least.
        signed: Whether the middle of the scale is 0.
    """
    low, high = float(np.nanmin(values)), float(np.nanmax(values))
    if signed:
        high = max(abs(low), abs(high), least / 2)
        return -high, high
    short_by = max(0.0, least - (high - low)) / 2
    return low - short_by, high + short_by


def _oklab(place: FloatArray) -> FloatArray:
    """Return points of the curve at equal steps of arc length; ``place`` in [0, 1], shape (n,)."""
    t = np.linspace(0.0, 1.0, 513)[:, None]
    curve = (1 - t) ** 2 * _CURVE[0] + 2 * t * (1 - t) * _CURVE[1] + t**2 * _CURVE[2]
    step = np.linalg.norm(np.diff(curve, axis=0), axis=1)
    arc = np.concatenate([[0.0], np.cumsum(step)]) / step.sum()
    channels: list[FloatArray] = [np.interp(place, arc, curve[:, k]) for k in range(3)]
    return np.stack(channels, axis=1)


def _srgb(lab: FloatArray) -> FloatArray:
    """Convert OKLab to gamma-encoded sRGB in [0, 1] (IEC 61966-2-1), shape (n, 3)."""
    linear = np.clip((lab @ _LAB_TO_CONE.T) ** 3 @ _CONE_TO_RGB.T, 0.0, 1.0)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
