"""Faults of joints that follow by another gain, lag or zero, alone or at mirror positions."""

import numpy as np

from .healthy import DEGREE, Change
from .oracle import half_width
from .planted import (
    ANY,
    BEYOND_REST,
    GAIN,
    LATE,
    LEAST_GAIN,
    LEAST_RAD,
    LIKE,
    MOST,
    SCATTERS,
    ZERO,
    Planted,
    PlantedJoint,
    fault,
    onset,
    single,
    sized,
    way_and_rate,
)


def _gain_size(healthy, j, acts, least, *, within):
    way, rate = way_and_rate(healthy, j)
    nuisance = [way, rate] if within else [rate]
    half = half_width(healthy, j, way * acts, within=within, nuisance=nuisance)
    if not within:
        half = float(np.hypot(half, SCATTERS * healthy.scatter[0]))
    sizes = sized(half, LEAST_GAIN, least)
    return sizes if sizes[0] <= MOST else None


def _with_gain(healthy, j, sign, size, acts=1.0):
    """Return a change of gain; less than a fifth of it isn't left: that is no gain any more."""
    change = size if sign > 0 or size > 0.8 else -size
    position = healthy.way[:, j] + change * acts * way_and_rate(healthy, j)[0]
    return Change(j, position=position), float(np.sign(change))


@fault(LIKE)
def gain(healthy, rng, joints, least):
    """The joint moves by less or more than the others throughout."""
    j = int(rng.choice(joints))
    if (sizes := _gain_size(healthy, j, 1.0, least, within=False)) is None:
        return None
    change, sign = _with_gain(healthy, j, rng.choice([-1, 1]), sizes[0])
    return single(change, **GAIN, sizes=sizes, sign=sign)


@fault(ANY, change=True)
def gain_from(healthy, rng, joints, least):
    """The joint moves by less or more from a time on."""
    j = int(rng.choice(joints))
    since, acts = onset(healthy, rng, j)
    if (sizes := _gain_size(healthy, j, acts, least, within=True)) is None:
        return None
    change, sign = _with_gain(healthy, j, rng.choice([-1, 1]), sizes[0], acts)
    return single(change, **GAIN, sizes=sizes, sign=sign, since_s=since)


def _late(healthy, j, acts, least, *, within):
    """Return a change to a later response, and its sizes [s]; None if there is none."""
    way, rate = way_and_rate(healthy, j)
    nuisance = [way, rate] if within else [way]
    half = half_width(healthy, j, -rate * acts, within=within, nuisance=nuisance)
    angular = 2 * np.pi / healthy.motion.period_s
    if not within:
        half = float(np.hypot(half, SCATTERS * healthy.scatter[1] / angular))
    sizes = sized(half, LEAST_RAD / angular, least)
    if sizes[0] > healthy.motion.period_s / 4:
        return None
    position = np.where(acts, healthy.later(j, sizes[0]), healthy.way[:, j])
    return Change(j, position=position), sizes


@fault(LIKE)
def lag(healthy, rng, joints, least):
    """The joint is later than the others throughout."""
    j = int(rng.choice(joints))
    late = _late(healthy, j, np.True_, least, within=False)
    return None if late is None else single(late[0], **LATE, sizes=late[1])


@fault(ANY, change=True)
def lag_from(healthy, rng, joints, least):
    """The joint is later from a time on."""
    j = int(rng.choice(joints))
    since, acts = onset(healthy, rng, j)
    late = _late(healthy, j, acts, least, within=True)
    return None if late is None else single(late[0], **LATE, sizes=late[1], since_s=since)


def _offset(healthy, j, acts, least, *, within):
    way, rate = way_and_rate(healthy, j)
    half = half_width(healthy, j, 1.0 * acts, within=within, nuisance=[way, rate])
    if not within:
        half = float(np.hypot(half, SCATTERS * healthy.scatter[2]))
    return sized(half, LEAST_RAD, least) if np.isfinite(half) else None


@fault(LIKE)
def offset(healthy, rng, joints, least):
    """The joint's zero is off throughout."""
    j, sign = int(rng.choice(joints)), float(rng.choice([-1, 1]))
    acts = np.ones(healthy.t_s.size)
    if (sizes := _offset(healthy, j, acts, least, within=False)) is None:
        return None
    change = Change(j, position=healthy.way[:, j] + sign * sizes[0])
    return single(change, **ZERO, sizes=sizes, sign=sign)


@fault(ANY, change=True)
def offset_from(healthy, rng, joints, least):
    """The joint's zero moves at a time."""
    j, sign = int(rng.choice(joints)), float(rng.choice([-1, 1]))
    since, acts = onset(healthy, rng, j)
    sizes = _offset(healthy, j, acts, least, within=True)
    change = Change(j, position=healthy.way[:, j] + sign * sizes[0] * acts)
    return single(change, **ZERO, sizes=sizes, sign=sign, since_s=since)


TOOTH = (5.0, 15.0)
"""Pitch of the last wheel of hobby servos, whose 24 to 72 teeth are 5 to 15 degrees apart
[degree]."""


@fault(ANY, change=True)
def teeth(healthy, rng, joints, least):
    """At a time the gear slips by some teeth."""
    j = int(rng.choice(joints))
    since, acts = onset(healthy, rng, j)
    size, half, _ = _offset(healthy, j, acts, least, within=True)
    tooth = DEGREE * rng.uniform(*TOOTH)
    slip = float(rng.choice([-1, 1])) * tooth * max(np.ceil(size / tooth), rng.integers(1, 4))
    change = Change(j, position=healthy.way[:, j] + slip * acts)
    sizes = (abs(slip), half, False)
    return single(change, **ZERO, sizes=sizes, sign=float(np.sign(slip)), since_s=since)


@fault(ANY)
def drift(healthy, rng, joints, least):
    """The joint's zero drifts evenly."""
    j, sign = int(rng.choice(joints)), float(rng.choice([-1, 1]))
    ramp = healthy.t_s / healthy.t_s[-1]
    half = half_width(healthy, j, ramp, within=True, nuisance=list(way_and_rate(healthy, j)))
    sizes = sized(half, max(LEAST_RAD, BEYOND_REST * healthy.rest_error(j)), least)
    change = Change(j, reading=lambda read: read + sign * sizes[0] * ramp)
    allowed, quantities = {"slipped", "slipped_sensor"}, {"offset", "drift"}
    return single(change, {"drifting_sensor"}, allowed, quantities=quantities, sizes=sizes)


def _weak(healthy, places, least, **more):
    """Return joints that all have the same smaller gain, or None."""
    sizes = [_gain_size(healthy, j, 1.0, least, within=False) for j in places]
    if None in sizes:
        return None
    size, half, floor = max(sizes)
    if size > 0.8:
        return None
    changes = tuple(_with_gain(healthy, j, -1, size)[0] for j in places)
    names, quantities = frozenset(GAIN["names"]), frozenset(GAIN["quantities"])
    joints = tuple(PlantedJoint(j, names, names, quantities, -1.0) for j in places)
    return Planted(changes, joints, size, half, floor, **more)


def _mirrored(healthy, joints, first, last):
    """Return pairs of candidate joints at mirror positions, the first of each within a range."""
    chosen = set(joints)
    pairs = [(j, healthy.m - 1 - j) for j in range(first, last)]
    return [pair for pair in pairs if chosen.issuperset(pair) and pair[0] < pair[1]]


@fault(("white", "ar90", "quantised_encoder", "delayed", "many_joints"))
def mirror_inner(healthy, rng, joints, least):
    """Two weak joints at mirror positions, none of them at an end or beside it."""
    pairs = _mirrored(healthy, joints, 2, (healthy.m - 2) // 2)
    if healthy.m < 9 or not pairs:
        return None
    return _weak(healthy, pairs[rng.integers(len(pairs))], least)


@fault(("white", "ar90", "quantised_encoder", "delayed", "many_joints"))
def mirror_ends(healthy, rng, joints, least):
    """Two weak joints, the first and the last: as well the boundary's doing."""
    pairs = _mirrored(healthy, joints, 0, 1) if healthy.m >= 7 else []
    return _weak(healthy, pairs[0], least, undecidable=True) if pairs else None


@fault(("short_chain",))
def weak_inner(healthy, rng, joints, least):
    """A weak inner joint of 4 to 6."""
    inner = [j for j in joints if 0 < j < healthy.m - 1]
    return _weak(healthy, (int(rng.choice(inner)),), least) if inner else None
