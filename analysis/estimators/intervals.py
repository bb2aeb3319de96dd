"""Gain and lag of each joint: its response's complex amplitude over its command's.

With H = a / c at the gait frequency, the gain is |H| and the lag is -arg H; ln H is what is
averaged and compared, since its two parts have the same variance (Händel, IEEE Trans. Instrum.
Meas. 49, 2000, doi 10.1109/19.893254; for the ratio the variances of both channels add).
"""

from __future__ import annotations

import numpy as np
from scipy.special import stdtrit

from undulog.capture.common.arrays import FloatArray

from ..results.estimate import Interval

CONFIDENCE = 0.95


def welch_satterthwaite(variances: FloatArray, dof: FloatArray) -> FloatArray:
    """Degrees of freedom of a sum of estimated variances (Welch, Biometrika 34, 1947).

    Args:
        variances: Shape (parts, ...).
        dof: Degrees of freedom of each, same shape.

    Returns:
        Shape (...); the smallest of the parts where all variances are zero.
    """
    total = np.sum(variances, axis=0)
    scatter = np.sum(variances**2 / dof, axis=0)
    return np.divide(total**2, scatter, out=np.min(dof, axis=0), where=scatter > 0)


def t_factor(dof: float, confidence: float = CONFIDENCE) -> float:
    """Two-sided Student factor.

    Args:
        dof: Degrees of freedom.
        confidence: E.g. 0.95.

    Returns:
        The factor on the standard error.
    """
    return float(stdtrit(dof, 0.5 + confidence / 2))


def around(value: float, half: float) -> Interval:
    """The interval of a value with a half width.

    Args:
        value: Centre.
        half: Half width.

    Returns:
        Low and high end.
    """
    return value - half, value + half
