"""How precisely the best judge could measure a planted change: one that knows the noise.

The oracle knows the spectrum of the noise, the healthy response and the time of a change. Its
estimate of the size of a known departure d(t) is generalised least squares beside what may be
anything, e(t) = s d(t) + N b + noise: after whitening, the variance of s is 1 / |d - P d|^2, with
the projection P onto the nuisance columns N (Gauss-Markov; Seber and Lee, Linear Regression
Analysis, 2003, section 3.10). Half of the simultaneous 95 % interval is z times its root, with
z by Bonferroni over three quantities of each joint.
"""

import numpy as np
from scipy.ndimage import maximum_filter1d, minimum_filter1d
from scipy.stats import norm

from .disturbances import step_deviation
from .robot import leverage

LEVEL = 0.05
"""Of the simultaneous intervals: the level of statements of difference."""

QUANTITIES = 3
"""Of a joint: gain, lag and offset."""

COMPARABLE = 4
"""Moved joints from which one can be told from the others."""

CYCLES = 3.0
"""Exposed cycles on both sides of a change, at least."""

SECONDS = 2.0
"""Exposed time on both sides of a change [s], at least."""

EXPOSED = 3.0
"""Rest errors that a joint has to move to be exposed."""


def half_width(healthy, joint, departure, *, within=False, nuisance=()):
    """Return half of the oracle's simultaneous 95 % interval of a departure's size.

    Args:
        healthy: The healthy robot.
        joint: The joint that departs.
        departure: What the change adds to its position at size 1 [rad], shape (n,).
        within: Whether the joint is compared with its other times rather than with other joints.
        nuisance: What else may be anything [rad], each of shape (n,); a constant always is, but
            for a departure that is constant itself.

    Returns:
        In sizes.
    """
    way = healthy.way[:, joint] - healthy.middle[joint]
    rounding = step_deviation(healthy.step, way)
    rows = [departure, *nuisance]
    if np.ptp(departure) > 0:
        rows.append(np.ones_like(departure))
    white = healthy.noise.whitened(np.stack(rows), way, rounding)
    first, others = white[0], white[1:].T
    left = first
    if others.size:
        fit, *_ = np.linalg.lstsq(others, first)
        left = first - others @ fit
    compared = compared_variance(healthy, joint, within=within)
    power = float(left @ left)
    factor = norm.ppf(1 - LEVEL / (2 * QUANTITIES * healthy.moved.size))
    return float(factor * (compared / power) ** 0.5) if power > 0 else np.inf


def compared_variance(healthy, joint, *, within):
    """Return the variance of a comparison, in variances of the joint itself.

    Beside its own there is that of what the other moved joints predict: of their mean, or of a
    smooth profile through them; with too few of them nothing is told from a comparison.
    """
    moved = healthy.moved
    if within:
        return 1 + 1 / max(moved.size - 1, 1)
    if moved.size < COMPARABLE:
        return np.inf
    return 1 + leverage(moved.size, int(np.searchsorted(moved, joint)))


def exposed(healthy, joint):
    """Return when a joint has to move so far that it can be judged, shape (n,).

    Within half a period around, the healthy position moves more than three rest errors.
    """
    way = healthy.way[:, joint]
    size = max(int(healthy.motion.period_s / healthy.step_s), 3) | 1
    reach = maximum_filter1d(way, size) - minimum_filter1d(way, size)
    return reach > EXPOSED * healthy.rest_error(joint)


def change_times(healthy, joint):
    """Return when a change may begin, shape (n,).

    It has so much exposed time on both sides as a judge is entitled to, and lies between 10 and
    90 % of the record.
    """
    seconds = np.cumsum(exposed(healthy, joint)) * healthy.step_s
    needed = needed_s(healthy)
    share = healthy.t_s / healthy.t_s[-1]
    enough = (seconds >= needed) & (seconds[-1] - seconds >= needed)
    return enough & (share >= 0.1) & (share <= 0.9)


def needed_s(healthy):
    """Return the exposed time on a side of a change that a judge is entitled to [s]."""
    return max(CYCLES * healthy.motion.period_s, SECONDS)


def judged_joints(healthy, *, change):
    """Return joints in which a fault can be seen.

    Args:
        healthy: The robot.
        change: Whether the fault begins within the record.

    Returns:
        Indices of joints that are exposed for long enough.
    """
    if change:
        return [j for j in healthy.moved.tolist() if change_times(healthy, j).any()]
    needed = needed_s(healthy)
    long = [float(np.sum(exposed(healthy, j))) * healthy.step_s for j in healthy.moved.tolist()]
    return [j for j, seconds in zip(healthy.moved.tolist(), long, strict=True) if seconds >= needed]
