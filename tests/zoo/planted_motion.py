"""Faults of joints that move otherwise than commanded: lines, noise, limits of range and rate."""

import numpy as np

from .healthy import Change
from .oracle import half_width
from .planted import (
    ANY,
    BEYOND_REST,
    LEAST_RAD,
    LIKE,
    LIMIT,
    LINE,
    PERIODIC,
    REPEATS,
    STOPPED,
    fault,
    onset,
    resolved,
    single,
    sized,
    way_and_rate,
)


def _line(healthy, j, angle, acts, least):
    """Return a change by a sine of a frequency, and its sizes."""
    nuisance = [*way_and_rate(healthy, j), np.cos(angle) * acts]
    half = half_width(healthy, j, np.sin(angle) * acts, within=True, nuisance=nuisance)
    margin = max(LEAST_RAD, BEYOND_REST * healthy.rest_error(j))
    sizes = sized(half, margin, least)
    return Change(j, position=healthy.way[:, j] + sizes[0] * np.sin(angle) * acts), sizes


def _vibration(healthy, rng):
    """Draw the angle of a vibration [rad], shape (n,); None if the sampling leaves no room.

    It has at least six samples a period and is 2.5 times as fast as the motion.
    """
    low, high = 2.5 / healthy.motion.period_s, 1 / (6 * healthy.step_s)
    if low > 0.9 * high:
        return None
    f = rng.uniform(max(low, min(2.0, 0.9 * high)), high)
    return 2 * np.pi * f * healthy.t_s + rng.uniform(-np.pi, np.pi)


@fault(LIKE)
def vibration(healthy, rng, joints, least):
    """The joint also moves at another frequency, faster than the motion."""
    j = int(rng.choice(joints))
    if (angle := _vibration(healthy, rng)) is None:
        return None
    change, sizes = _line(healthy, j, angle, np.ones(healthy.t_s.size), least)
    return single(change, **LINE, sizes=sizes)


@fault(ANY, change=True)
def vibration_from(healthy, rng, joints, least):
    """The same from a time on."""
    j = int(rng.choice(joints))
    if (angle := _vibration(healthy, rng)) is None:
        return None
    since, acts = onset(healthy, rng, j)
    change, sizes = _line(healthy, j, angle, 1.0 * acts, least)
    either = {"motion", "noise"}  # more of the residual's power, of a kind that isn't stated
    return single(change, **LINE | {"quantities": either}, sizes=sizes, since_s=since)


@fault(PERIODIC)
def subharmonic(healthy, rng, joints, least):
    """The joint also moves at half of the gait's frequency."""
    j = int(rng.choice(joints))
    angle = np.pi * healthy.t_s / healthy.motion.period_s + rng.uniform(-np.pi, np.pi)
    change, sizes = _line(healthy, j, angle, np.ones(healthy.t_s.size), least)
    return single(change, **LINE, sizes=sizes)


@fault(ANY, change=True)
def noisy(healthy, rng, joints, least):
    """From a time on the sensor is noisy.

    The variance of n whitened values has a relative standard deviation of (2 / n)^0.5.
    """
    j = int(rng.choice(joints))
    since, acts = onset(healthy, rng, j)
    both = np.count_nonzero(acts), np.count_nonzero(~acts)
    half = 3.0 * float(sum(2 / n for n in both) ** 0.5)
    usual = max(healthy.noise.deviation, healthy.step / 12**0.5)
    more = usual * float(np.expm1(least.halves * half)) ** 0.5
    margin = max(LEAST_RAD, BEYOND_REST / 3 * healthy.rest_error(j))
    deviation = max(least.margins * margin, more)
    noise = deviation * rng.normal(size=acts.size) * acts
    sizes = (deviation, half, deviation > more)
    change = Change(j, reading=lambda read: read + noise)
    allowed = {"intermittent", "vibrating"}
    return single(
        change, {"noisy_sensor"}, allowed, quantities={"noise"}, sizes=sizes, since_s=since
    )


def _limited(healthy, j, limit, least):
    """Return the position under the mildest limit that the oracle sees, or None.

    Args:
        healthy: The robot.
        j: The joint.
        limit: From a share of the motion, 1 down to 0, to the position [rad], shape (n,).
        least: Least size.
    """
    for share in np.arange(0.85, 0.15, -0.1):
        position = limit(share)
        if resolved(healthy, j, position - healthy.way[:, j], least, within=True):
            return position
    return None


@fault(LIKE)
def clipped(healthy, rng, joints, least):
    """The range ends before the motion, on one side or on both."""
    j, sides = int(rng.choice(joints)), int(rng.integers(3))
    way, _ = way_and_rate(healthy, j)
    top, bottom = float(way.max()), float(way.min())

    def limit(share):
        low = bottom if sides == 0 else share * bottom
        high = top if sides == 1 else share * top
        return healthy.middle[j] + np.clip(way, low, high)

    position = _limited(healthy, j, limit, least)
    if position is None:
        return None
    allowed = STOPPED | REPEATS | {"intermittent"}
    return single(Change(j, position=position), allowed=allowed, **LIMIT)


@fault(LIKE)
def torque_limit(healthy, rng, joints, least):
    """The joint yields to its load towards the ends of the motion: L tanh(x / L)."""
    j = int(rng.choice(joints))
    way, _ = way_and_rate(healthy, j)
    most = float(np.max(np.abs(way)))

    def limit(share):
        return healthy.middle[j] + share * most * np.tanh(way / (share * most))

    position = _limited(healthy, j, limit, least)
    if position is None:
        return None
    allowed = {"scaled_sensor", "weak", "stalled"}
    return single(Change(j, position=position), allowed=allowed, **LIMIT)


@fault(LIKE)
def rate_limit(healthy, rng, joints, least):
    """The joint can't be faster than a limit."""
    j = int(rng.choice(joints))
    way, rate = way_and_rate(healthy, j)
    most = float(np.percentile(np.abs(rate), 99))

    def limit(share):
        step = share * most * healthy.step_s
        out, last = np.empty_like(way), way[0]
        for k, aim in enumerate(way):
            last += min(max(aim - last, -step), step)
            out[k] = last
        return healthy.middle[j] + out

    position = _limited(healthy, j, limit, least)
    if position is None:
        return None
    names, quantities = {"rate_limit", "at_limit"}, {"gain", "lag"}
    allowed = {"weak", "late", "scaled_sensor"}
    return single(Change(j, position=position), names, allowed, quantities=quantities)
