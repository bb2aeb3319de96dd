"""Which joints follow their commands otherwise than the others do, in any motion.

Joints of one kind differ by what their loads, postures and frictions differ by. A joint stands out
where its gain, lag or offset is further from the mean of the others than their scatter explains:
the deviation over its standard error, of the others' scatter and of the joint's own error, has
Student's distribution with n - 2 degrees of freedom (Grubbs, Technometrics 11, 1969, doi
10.1080/00401706.1969.10490657), at a level of 5 % over all joints and quantities. One joint after
the other is taken out, up to a third of them, and those up to the last one that stands out do so,
as two hide each other (Rosner, Technometrics 25, 1983, doi 10.2307/1268549).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np
from scipy.special import stdtrit

from undulog.capture.common.arrays import FloatArray
from undulog.capture.judgement.levels import (
    ANGLE_MARGIN_RAD,
    COVERAGE,
    ENOUGH_LIKE,
    GAIN_MARGIN,
    HALF,
    QUARTER,
    TINY,
    WHOLE,
    reaches,
)

from ...common.answer import StandOut
from .estimate import Tracking

QUANTITIES = ("gain", "delay", "offset")


def unlike(
    trackings: Mapping[str, Tracking], groups: Iterable[Sequence[str]]
) -> tuple[StandOut, ...]:
    """Find the joints that follow otherwise than those like them.

    Args:
        trackings: By joint.
        groups: Names of joints that may be compared.

    Returns:
        Those that stand out by more than the margins, of each group those furthest out first:
        the gain relative to the others' mean, the delay in seconds, the offset in rad.
    """
    responding = {name for name, tracking in trackings.items() if _responds(tracking)}
    compared = [[name for name in group if name in responding] for group in groups]
    tests = sum(map(len, compared)) * len(QUANTITIES)
    return tuple(
        joint
        for names in compared
        for quantity in QUANTITIES
        for joint in _of_quantity(quantity, {name: trackings[name] for name in names}, tests)
    )


def _responds(tracking: Tracking) -> bool:
    """Return whether a joint follows at all, with an error that is known."""
    enough = tracking.explained >= HALF and tracking.gain.value >= QUARTER
    return enough and tracking.gain.ci95 is not None


def _of_quantity(quantity: str, trackings: Mapping[str, Tracking], tests: int) -> list[StandOut]:
    names = list(trackings)
    values, errors, margins = _values(quantity, list(trackings.values()))
    level = 1 - (1 - COVERAGE) / 2 / max(tests, 1)

    def deviation(k: int, others: Sequence[int]) -> tuple[float, float]:
        """Return a joint's deviation from others and half of its interval."""
        scatter = float(values[others].std(ddof=1)) * np.sqrt(1 + 1 / len(others))
        quantile = float(stdtrit(len(others) - 1, level))
        return float(values[k] - values[others].mean()), quantile * float(
            np.hypot(scatter, errors[k])
        )

    def stands_out(k: int, others: Sequence[int]) -> bool:
        size, half = deviation(k, others)
        return abs(size) > half and reaches(abs(size), 0.0, margins[k])

    left, taken, outside = list(range(len(names))), list[int](), 0
    while len(left) > max(ENOUGH_LIKE - 1, WHOLE * len(names)):
        k = max(left, key=lambda index: abs(values[index] - np.median(values[left])))
        left = [index for index in left if index != k]
        taken.append(k)
        if stands_out(k, left):  # those that were taken out before hid behind it
            outside = len(taken)
    rest = [index for index in range(len(names)) if index not in taken[:outside]]
    stand_out: list[StandOut] = []
    for k in (k for k in taken[:outside] if stands_out(k, rest)):
        size, half = deviation(k, rest)
        ends = np.array([size - half, size + half])
        if quantity == "gain":
            size, ends = float(np.expm1(size)), np.expm1(ends)
        ci95 = (float(ends[0]), float(ends[1]))
        rank = len(stand_out) + 1
        stand_out.append(StandOut(names[k], "chain", 0, rank, quantity, size, ci95))
    return stand_out


def _values(
    quantity: str, trackings: Sequence[Tracking]
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return values, standard errors and margins, shape (n,) each; of gains their logarithms."""
    if quantity == "gain":
        values = np.log([tracking.gain.value for tracking in trackings])
        errors = [tracking.gain.error / tracking.gain.value for tracking in trackings]
        margins = [GAIN_MARGIN for _ in trackings]
    elif quantity == "delay":
        values = np.array([tracking.lag_s.value for tracking in trackings])
        errors = [tracking.lag_s.error for tracking in trackings]
        # A lag matters by the angle that it makes of the motion.
        margins = [ANGLE_MARGIN_RAD / max(tracking.speed_rad_s, TINY) for tracking in trackings]
    else:
        values = np.array([tracking.offset_rad.value for tracking in trackings])
        errors = [tracking.offset_rad.error for tracking in trackings]
        margins = [ANGLE_MARGIN_RAD for _ in trackings]
    return np.asarray(values, np.float64), np.array(errors), np.array(margins)
