"""The adaptive control laws of Meister, Stepanenko & Kernbach 2011: distance in, gait out.

Each takes the distance d >= 0 to an obstacle [m]; +inf, nothing in range, changes nothing.
``docs/control.md`` says where they depart from the printed form, and why.
"""

from __future__ import annotations

import math

import numpy as np

from undulog.capture.common.arrays import FloatArray


def bend(distance: float, side: float, f0: float, k: float) -> float:
    """Offset Y that bends the body away from an obstacle, f(d) = sgn f0 exp(-k d), Y ~ f(d).

    Args:
        distance: d, to the nearest obstacle [m].
        side: sgn, +1 turns right and -1 turns left.
        f0: Offset at contact [rad].
        k: How fast the law fades with distance [1/m].

    Returns:
        f(d) [rad].
    """
    return side * f0 * math.exp(-k * distance)


def amplitude(distance: FloatArray, largest: float, smallest: float, k: float) -> FloatArray:
    """Amplitude that shrinks near a wall, A~(d) = A_max - (A_max - A_min) exp(-k d).

    The paper prints A~(d) = exp(k d) - A_max, which grows without bound; its stated intent, an
    amplitude that falls smoothly near a wall, is kept: A_min at contact, A_max far away.

    Args:
        distance: d, to the wall beside each joint [m], any shape.
        largest: A_max, far from walls.
        smallest: A_min, at contact; in the unit of ``largest``.
        k: How fast the law fades with distance [1/m].

    Returns:
        A~(d), in the unit of ``largest``, the shape of ``distance``.
    """
    return largest - (largest - smallest) * np.exp(-k * distance)


def frequency(distance: float, gain: float, k: float) -> float:
    """Factor of omega that pulls the tail away from an obstacle, omega~(d)/omega.

    omega~(d) = omega (1 + g exp(-k d)), bounded by omega (1 + g).

    Args:
        distance: d, from the tail to the obstacle [m].
        gain: g > 0, the share added at contact.
        k: How fast the law fades with distance [1/m].

    Returns:
        The factor, 1 to 1 + g.
    """
    return 1.0 + gain * math.exp(-k * distance)
