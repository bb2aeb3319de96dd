"""How a wave starts, and how it is kept within the joints' limits."""

from __future__ import annotations

import numpy as np

from undulog.capture.common.arrays import FloatArray


def smoothstep(x: float) -> float:
    """Rise from 0 to 1 with no slope at either end, 3 x^2 - 2 x^3.

    Args:
        x: Where; clipped to 0 to 1.

    Returns:
        The value.
    """
    x = min(max(x, 0.0), 1.0)
    return x * x * (3.0 - 2.0 * x)


def started(time_s: float, ramp_s: float) -> float:
    """Share of amplitude and offset that has come by a time: nothing before the start, then all.

    Args:
        time_s: Time since the start [s]; negative before it.
        ramp_s: How long the rise takes [s]; 0: no time at all.

    Returns:
        0 to 1, smooth where ``ramp_s`` is positive.
    """
    if ramp_s > 0.0:
        return smoothstep(time_s / ramp_s)
    return 1.0 if time_s >= 0.0 else 0.0


def within_limits(
    amplitude: FloatArray, offset: FloatArray, lower: FloatArray, upper: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Cut offset, then amplitude, so that offset +- amplitude stays within the limits.

    Each joint is cut by its own limits. The wave keeps its shape: a cut sine would have flat tops,
    and harmonics that no one commanded.

    Args:
        amplitude: Wanted; a negative one is half a turn of phase [rad], shape (n,).
        offset: Wanted [rad], shape (n,).
        lower: Lower limits [rad], shape (n,).
        upper: Upper limits [rad], shape (n,).

    Returns:
        Amplitude and offset [rad], each of shape (n,).
    """
    offset = np.minimum(np.maximum(offset, lower), upper)
    room = np.minimum(upper - offset, offset - lower)
    return np.minimum(np.maximum(amplitude, -room), room), offset
