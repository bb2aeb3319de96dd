"""The numbers that the judgement's parts share: levels, shares, and sizes that matter."""

from __future__ import annotations

import numpy as np
from scipy.special import ndtri

LEVEL = 0.01
"""Chance of any accusation or change in a session of healthy joints."""

RARE = LEVEL * LEVEL * LEVEL
"""Chance of a count of one joint's samples from which it is no chance: one in a million joints."""

COVERAGE = 0.95
"""Of intervals, and the share of values that counts as all of them."""

WIDTH = float(ndtri((1 + COVERAGE) / 2))
"""Standard errors of an interval of that coverage."""

QUARTER = 1 / 4
"""A joint responds with this share of the gain: play within the rest error leaves a third of the
least motion that is judged. It is also what joints of one kind may differ by along a body."""

ROBUST = 1 / float(ndtri(1 - QUARTER))
"""Standard deviation of normal values in their median distance from the middle."""

HALF = 1 / 2
"""Share of a motion that is its command's if most of it is."""

WHOLE = 2 / 3
"""Share of a record that a fit takes, of joints that agree, of a time in which a fault holds
throughout: a third may be faulty."""

FOLLOWS = 0.8
"""Explained share of a joint that follows, as of a gait; a phase error of 27 degrees leaves it."""

FULL = 0.9
"""Share of its samples or blocks that a time window needs: of fewer it isn't known what was."""

NEGLIGIBLE = 0.01
"""Share that decides nothing: a serial bus with retries drops ten of a thousand samples."""

GAIN_MARGIN = 0.02
"""Relative gain that matters: the margin of "alike"."""

ANGLE_MARGIN_RAD = float(np.radians(1.0))
"""Angle that matters [rad]: the margin of "alike"."""

LEAST_RANGE_RAD = (1 - FULL) * ANGLE_MARGIN_RAD
"""A command that moves less is held still [rad]: a step of a 12-bit encoder is 0.09 degrees."""

REST_ERRORS = 3
"""Rest errors beyond which a motion is asked for: one at either end is lost in a dead band, and one
is noise; also standard deviations of what is no chance, and cycles on either side of a change."""

LARGEST_REST_RAD = REST_ERRORS * ANGLE_MARGIN_RAD
"""Largest rest error without a description [rad]: play and steps of hobby servos are below."""

ENOUGH_LIKE = 4
"""Joints that a common response needs, so that one faulty joint doesn't move their median."""

FEWEST = 8
"""Blocks, cycles or samples that a comparison needs: with fewer, 1 % has no threshold."""

TAME = 4
"""Robust standard deviations beyond which a sample has no more weight: of normal noise 6 in 100,000
are, and single samples of heavy tails decide nothing (Huber)."""

MISSING = 1.5
"""Sampling intervals from which one lacks a sample: with less, jitter and rounding decide."""

TINY = float(np.sqrt(np.finfo(np.float64).tiny))
"""What stands for 0 in a denominator; its inverse may be squared."""


def reaches(size: float, half: float, margin: float) -> bool:
    """Return whether a difference is stated: its interval excludes 0 and isn't within the margin.

    What comes within a twentieth of the margin reaches it: sampling and quantisation move an
    estimate by so much beside its interval.

    Args:
        size: The difference, positive.
        half: Half the interval.
        margin: What matters, in the same unit.
    """
    return size > max(half, COVERAGE * margin - half)
