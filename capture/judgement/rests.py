"""Where a joint rests off its command, as soft servos under load do.

The command rests where it has moved less than an encoder would show for longer than the settling,
and than the slowest servo's time constant; the mean of the position less the command there, over
the rests of a session, is the rest's error. Of a command that never rests it is how far the
response is from the command at the command's median. It is a difference, no fault: proportional
control without an integral part leaves it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..common.arrays import FloatArray
from .exposure import Exposure, responds, window_ranges
from .levels import LARGEST_REST_RAD, LEAST_RANGE_RAD, QUARTER
from .motion import Course, runs_of
from .response import SLOWEST_S
from .stillness import Stillness


@dataclass(frozen=True)
class RestOff:
    """A joint that rests off its command.

    Attributes:
        joint: Its index.
        offset_rad: The largest position less command at rest [rad].
        range_rad: The least and the largest of the rests [rad].
        rests: Number of rests; 0 where the command never rests.
    """

    joint: int
    offset_rad: float
    range_rad: tuple[float, float]
    rests: int


def find_rests(course: Course, exposure: Exposure, stillness: Stillness) -> list[RestOff]:
    """Find the joints that rest off by more than healthy joints do."""
    resting: list[RestOff] = []
    for k in range(course.position.shape[0]):
        off = _rests(course, exposure, stillness, k)
        rests = len(off)
        if not off:
            off = [_middle(course, exposure, k)] if responds(exposure.responses[k]) else []
        most = max(off, key=abs, default=0.0)
        if abs(most) > LARGEST_REST_RAD:
            resting.append(RestOff(k, most, (min(off), max(off)), rests))
    return resting


def _middle(course: Course, exposure: Exposure, k: int) -> float:
    """Return how far a joint's response is from its command at the middle of the command [rad]."""
    response = exposure.responses[k]
    return response.offset_rad + (response.gain - 1) * float(np.median(course.command[k]))


def _rests(course: Course, exposure: Exposure, stillness: Stillness, k: int) -> list[float]:
    """Return the mean error of each rest, its beginning left out [rad]."""
    command = course.command[k]
    longest_s = max(float(exposure.settling_s[k]), SLOWEST_S)
    settled = min(int(np.ceil(longest_s / course.step_s)) + 1, command.size)
    still = np.zeros(command.size, dtype=np.bool_)
    # A slow gait moves little from step to step near its turns, and doesn't rest there.
    still[settled - 1 :] = window_ranges(command, [settled])[0] <= LEAST_RANGE_RAD
    off: list[float] = []
    for first, last in runs_of(still):
        if last - first >= QUARTER * settled:
            there = slice(first, last)
            kept = course.present[k, there] & ~stillness.stands[k, there]
            error: FloatArray = (course.position[k] - command)[there][kept]
            if error.size:
                off.append(float(np.mean(error)))
    return off
