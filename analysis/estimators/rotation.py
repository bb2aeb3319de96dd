"""Cosine and sine of many angles, fast."""

from __future__ import annotations

import numpy as np

from undulog.capture.common.arrays import FloatArray


def cos_sin(angle: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Cosine and sine of one set of angles.

    From the tangent q of the half angle, (1 - q^2) / (1 + q^2) and 2 q / (1 + q^2): NumPy has the
    tangent in the processor's vectors, six times as fast as cosine and sine, and a sample's share
    of a fit is little more than these two.

    Args:
        angle: [rad], any shape.

    Returns:
        Both, right to a few units of rounding, each of the angles' shape.
    """
    half = np.tan(0.5 * angle)
    square = half * half
    share = 1.0 / (1.0 + square)
    half *= 2.0
    half *= share
    np.subtract(1.0, square, out=square)
    square *= share
    return square, half
