"""A joint that stands although it had to move, and how much of its time it had to.

In windows of dyadic length, a joint stands if a healthy one would have moved by more than three
rest errors, settling taken off, and it moved by less than a quarter of that. A joint whose own
response explains that it moved so little (it is late, its gain is smaller) follows.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..common.arrays import BoolArray, FloatArray
from .exposure import Exposure, covered, window_ranges
from .levels import FULL, QUARTER
from .motion import Course, cycle_s
from .response import SETTLED


@dataclass(frozen=True)
class Stillness:
    """Where k joints had to move on n steps, and where they stood all the same.

    Attributes:
        exposed: Shape (k, n).
        stands: Shape (k, n).
    """

    exposed: BoolArray
    stands: BoolArray


def stillness_of(course: Course, exposure: Exposure) -> Stillness:
    """Find where joints stand although they had to move."""
    count, size = course.position.shape
    exposed, stands = np.zeros((2, count, size), dtype=np.bool_)
    for k in range(count):
        exposed[k], stands[k] = _of_joint(course, exposure, k)
    return Stillness(exposed & course.present, stands & course.present)


def _of_joint(course: Course, exposure: Exposure, k: int) -> tuple[BoolArray, BoolArray]:
    size = course.t_s.size
    settling = int(np.ceil(exposure.settling_s[k] / course.step_s))
    lengths = [1 << level for level in range(1, size.bit_length())]
    lengths = [length for length in lengths if length + 2 * settling <= size]
    exposed, stands = np.zeros((2, size), dtype=np.bool_)
    asked = window_ranges(exposure.healthy[k], lengths)
    # A model may be late or early: the joint has the settling on both sides to move in.
    moved = window_ranges(course.position[k], [length + 2 * settling for length in lengths])
    of_fit = window_ranges(exposure.fitted[k], lengths) if _follows(exposure, k) else asked
    least = exposure.least_rad[k]
    absent = np.concatenate([[0], np.cumsum(~course.present[k])])
    for length, healthy, seen, fitted in zip(lengths, asked, moved, of_fit, strict=True):
        inner = slice(settling, settling + seen.size)
        expected: FloatArray = np.minimum(healthy, fitted)[inner]
        wide = length + 2 * settling
        complete = absent[wide:] - absent[:-wide] <= (1 - FULL) * wide
        had_to = (healthy[inner] > least) & complete
        still = had_to & (seen < QUARTER * expected) & (expected > least)
        exposed |= covered(had_to, wide, size)
        stands |= covered(still, wide, size)
    return exposed, stands


def _follows(exposure: Exposure, k: int) -> bool:
    """Return whether a joint's own response is that of a joint that follows."""
    return exposure.responses[k].gain > QUARTER * _gain(exposure, k)


def _gain(exposure: Exposure, k: int) -> float:
    """Return the gain of healthy joints like one."""
    asked, fitted = np.ptp(exposure.healthy[k]), np.ptp(exposure.fitted[k])
    gain = abs(exposure.responses[k].gain)
    return float(gain * asked / fitted) if fitted > 0 else 1.0


def usable_steps(course: Course, exposure: Exposure, stillness: Stillness) -> BoolArray:
    """Return where a joint can be compared with its response, shape (k, n).

    Not where it stands, nor before its response to what was commanded before the record, or in a
    gap of it, is over, nor in the first cycle, in which play takes its side.
    """
    settled_s = [
        r.delay_s + SETTLED * r.constant_s * max(r.order, 1) + _first_cycle_s(command, course)
        for r, command in zip(exposure.responses, course.command, strict=True)
    ]
    begun = course.t_s - course.t_s[0] >= np.array(settled_s)[:, None]
    unknown = np.stack(
        [
            covered(~asked, int(settled / course.step_s) + 1, course.t_s.size)
            for asked, settled in zip(course.asked, settled_s, strict=True)
        ]
    )
    return np.asarray(course.present & begun & ~unknown & ~stillness.stands, dtype=np.bool_)


def _first_cycle_s(command: FloatArray, course: Course) -> float:
    cycle = cycle_s(command, course.step_s)
    return cycle if cycle < (course.t_s[-1] - course.t_s[0]) / SETTLED else 0.0
