"""Faults of joints that stand still, for good or for a while, and of encoders that repeat."""

import numpy as np

from .healthy import Change
from .oracle import change_times
from .planted import (
    ANY,
    LOADED,
    REPEATS,
    STOPPED,
    TRIES,
    fault,
    hold,
    onset,
    resolved,
    single,
    stays,
)


def _standing(healthy, joint, position, acts, least, **truth):
    departure = position - healthy.way[:, joint]
    if not resolved(healthy, joint, departure, least, within=True):
        return None
    power = np.where(acts, 0.0, 1.0) if truth.pop("powerless", False) else 1.0
    return single(Change(joint, position=position, power=power), **truth)


@fault(ANY)
def dead(healthy, rng, joints, least):
    """The joint lies at a rest angle throughout; its motor gives no effort."""
    j = int(rng.choice(joints))
    rest = healthy.middle[j] + rng.choice([0.0, 1.0]) * rng.uniform(-0.2, 0.2)
    position, acts = np.full(healthy.t_s.size, rest), np.ones(healthy.t_s.size, dtype=bool)
    allowed = stays(healthy, STOPPED | {"frozen_sensor"}, {"dead"})
    kinds = {"names": {"dead"}, "allowed": allowed}
    return _standing(healthy, j, position, acts, least, powerless=True, **kinds)


@fault(ANY, change=True)
def dead_from(healthy, rng, joints, least):
    """From a time on the joint falls to a rest angle and lies there; no effort."""
    j = int(rng.choice(joints))
    since, acts = onset(healthy, rng, j)
    way = healthy.way[:, j]
    rest = healthy.middle[j] + rng.uniform(-0.3, 0.3)
    falls = rest + (hold(way, acts) - rest) * np.exp(-(healthy.t_s - since).clip(0) / 0.3)
    allowed = stays(healthy, STOPPED | {"frozen_sensor"}, {"dead"})
    truth = {"names": {"dead"}, "allowed": allowed, "since_s": since, "powerless": True}
    return _standing(healthy, j, np.where(acts, falls, way), acts, least, **truth)


@fault(ANY)
def still(healthy, rng, joints, least):
    """Commands are sent, and the joint stays where it was at the start."""
    j = int(rng.choice(joints))
    position = np.full(healthy.t_s.size, healthy.way[0, j])
    allowed = stays(healthy, STOPPED | {"frozen_sensor"}, LOADED | {"frozen_sensor"})
    kinds = {"names": {"jammed", "stalled"}, "allowed": allowed}
    return _standing(healthy, j, position, np.ones(position.size, dtype=bool), least, **kinds)


@fault(ANY, change=True)
def jammed(healthy, rng, joints, least):
    """From a time on the joint stays where it is; its motor pushes."""
    j = int(rng.choice(joints))
    since, acts = onset(healthy, rng, j)
    allowed = stays(healthy, STOPPED | {"frozen_sensor"}, LOADED | {"frozen_sensor"})
    truth = {"names": {"jammed", "stalled"}, "allowed": allowed, "since_s": since}
    return _standing(healthy, j, hold(healthy.way[:, j], acts), acts, least, **truth)


@fault(ANY, change=True)
def frozen(healthy, rng, joints, least):
    """From a time on the encoder repeats one value; the joint moves on."""
    j = int(rng.choice(joints))
    since, acts = onset(healthy, rng, j)
    departure = hold(healthy.way[:, j], acts) - healthy.way[:, j]
    if not resolved(healthy, j, departure, least, within=True):
        return None
    change = Change(j, reading=lambda read: hold(read, acts))
    allowed = stays(healthy, STOPPED | REPEATS, LOADED | REPEATS)
    return single(change, {"frozen_sensor"}, allowed, since_s=since)


HELD_S = 2.0
"""How long a position is held."""


@fault(ANY, change=True)
def held(healthy, rng, joints, least):
    """For 2 s the joint stays where it is."""
    j = int(rng.choice(joints))
    way, t_s = healthy.way[:, j], healthy.t_s
    for first in rng.permutation(np.flatnonzero(change_times(healthy, j)))[:TRIES].tolist():
        acts = (t_s >= t_s[first]) & (t_s < t_s[first] + HELD_S)
        position = hold(way, acts)
        kinds = STOPPED | REPEATS | {"intermittent"}
        names = {"jammed", "stalled", "dead", "intermittent"}
        truth = {"since_s": float(t_s[first]), "until_s": float(t_s[first]) + HELD_S}
        planted = _standing(healthy, j, position, acts, least, names=names, allowed=kinds, **truth)
        if planted is not None:
            return planted
    return None


@fault(ANY)
def inverted(healthy, rng, joints, least):
    """The joint moves against its command."""
    j = int(rng.choice(joints))
    position = 2 * healthy.middle[j] - healthy.way[:, j]
    if not resolved(healthy, j, position - healthy.way[:, j], least, within=True):
        return None
    return single(Change(j, position=position), {"inverted", "inverted_sensor"})
