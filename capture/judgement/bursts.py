"""Samples far from where a joint can be, more of them than its like joints have: a noisy sensor.

A sample is far where the residual of the joint's response is beyond what a healthy joint loses and
eight robust standard deviations of its own. Heavy-tailed noise that all joints have makes such
samples of all of them; the count is tested against the median share of the like joints (binomial).
"""

from __future__ import annotations

import numpy as np
from scipy.special import bdtrc

from ..common.arrays import BoolArray, FloatArray
from .exposure import Exposure
from .levels import (
    ENOUGH_LIKE,
    FEWEST,
    HALF,
    LARGEST_REST_RAD,
    NEGLIGIBLE,
    RARE,
    ROBUST,
    TAME,
)
from .motion import Course, cycle_s


def find_bursts(course: Course, exposure: Exposure, usable: BoolArray) -> dict[int, float]:
    """Find the joints with more far samples than their like joints.

    Args:
        usable: Steps that are looked at, shape (k, n).

    Returns:
        Index of a joint to the share of its samples that are far; none unless all commands are
        rhythms, of half cycles enough for a comparison.
    """
    length_s = float(course.t_s[-1] - course.t_s[0])
    cycles = [cycle_s(command, course.step_s) for command in course.command]
    if not max(cycles) < 2 * length_s / FEWEST:
        return {}
    residual = course.position - exposure.fitted
    count = usable.sum(axis=1)
    far = np.array([_far(residual[k][usable[k]]) for k in range(len(residual))], dtype=np.float64)
    share = far / np.maximum(count, 1)
    bursts: dict[int, float] = {}
    for k in range(len(residual)):
        others = [j for j in exposure.group(k) if j != k and count[j]]
        if len(others) < ENOUGH_LIKE - 1:
            continue
        usual = min(NEGLIGIBLE + 2 * float(np.median(share[others])), 1.0)
        if far[k] and bdtrc(far[k] - 1, count[k], usual) < RARE:
            bursts[k] = float(share[k])
    return bursts


def _far(residual: FloatArray) -> int:
    if residual.size == 0:
        return 0
    residual = residual - np.median(residual)
    away = np.abs(residual)
    far = np.flatnonzero(away > max(LARGEST_REST_RAD, 2 * TAME * ROBUST * np.median(away)))
    inner = far[far < residual.size - 1]
    power = float(residual[inner] @ residual[inner])
    # A joint that vibrates is where it was a sample before; noise is not.
    return 0 if float(residual[inner] @ residual[inner + 1]) > HALF * power else far.size
