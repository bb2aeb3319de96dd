"""Joints that stand still: jammed, stalled, dead, frozen, for good or at times."""

import numpy as np

from .planting import WITH_EFFORT, bouts, fault, hold, onset, single
from .robot import Change, Channels
from .truth import LOADED, PAUSED, STOPPED, Truth, standing


def _jam(robot, rng, j, acts, since, *, exact=None):
    still = rng.random() < 0.5 if exact is None else exact
    change = Change(j, position=hold(robot.moved(j), acts), exact=acts & still)
    return single(change, {"jammed", "stalled"}, standing(robot.channels, "pushing"), since_s=since)


def _plant_jam(robot, rng, j):
    """The position stands still while the command moves; an effort pushes."""
    since, acts = onset(robot, j, rng)
    return _jam(robot, rng, j, acts, since)


for _place in ("head", "middle", "tail", None):
    fault(f"jam half-way{f', {_place}' if _place else ''}", place=_place)(_plant_jam)


@fault(
    "jam half-way, position constant to the bit, velocity logged",
    channels=(Channels(velocity="true"), Channels(velocity="derived")),
)
def _(robot, rng, j):
    """As above; no noise any more, and the velocity is zero."""
    since, acts = onset(robot, j, rng)
    return _jam(robot, rng, j, acts, since, exact=True)


@fault("jam late")
def _(robot, rng, j):
    """As above, but only in the last fifth or so."""
    left = max(2.6 * 2 * np.pi / robot.omega / robot.duration_s, 0.15)
    since, acts = onset(robot, j, rng, 1 - left - 0.02, 1 - left)
    return _jam(robot, rng, j, acts, since)


@fault("jam from the beginning")
def _(robot, rng, j):
    """The position never moves."""
    return _jam(robot, rng, j, np.ones(len(robot.t_s), dtype=bool), None)


@fault("stall at constant effort", channels=WITH_EFFORT)
def _(robot, rng, j):
    """The position stands still, the effort stays at one value while the command travels."""
    since, acts = onset(robot, j, rng)
    position = hold(robot.moved(j), acts)
    # The integral part of the loop has run to its limit: constant, whatever the command does.
    pull = rng.choice([-1, 1]) * robot.amplitude[j] * rng.uniform(2.0, 6.0)
    asked = np.where(acts, position + pull, robot.asked(j))
    change = Change(j, position=position, asked=asked, exact=acts & (rng.random() < 0.5))
    return single(change, {"stalled"}, LOADED, since_s=since)


def _dead(robot, j, acts, since, position):
    change = Change(j, position=position, power=np.where(acts, 0.0, 1.0))
    return single(change, {"dead"}, standing(robot.channels, "dead"), since_s=since)


@fault("dead from the beginning")
def _(robot, rng, j):
    """The position stays at a rest angle; an effort is zero."""
    rest = np.full(len(robot.t_s), robot.bias[j] + rng.choice([0.0, 1.0]) * rng.uniform(-0.2, 0.2))
    return _dead(robot, j, np.ones(len(robot.t_s), dtype=bool), None, rest)


@fault("dead half-way, holds its place")
def _(robot, rng, j):
    """The gearbox holds the angle that it has; an effort is zero from then on."""
    since, acts = onset(robot, j, rng)
    return _dead(robot, j, acts, since, hold(robot.moved(j), acts))


@fault("dead half-way, sags to rest")
def _(robot, rng, j):
    """The position falls to a rest angle within a second and stays; an effort is zero."""
    since, acts = onset(robot, j, rng)
    moved, t = robot.moved(j), robot.t_s[:, j]
    rest = rng.uniform(-0.3, 0.3)
    sag = rest + (hold(moved, acts) - rest) * np.exp(-(t - since).clip(0) / 0.3)
    return _dead(robot, j, acts, since, np.where(acts, sag, moved))


@fault("sensor frozen half-way")
def _(robot, rng, j):
    """The position repeats one value to the bit; all else goes on."""
    since, acts = onset(robot, j, rng)
    change = Change(j, reading=lambda read: hold(read, acts))
    return single(change, {"frozen_sensor"}, standing(robot.channels, "sensor"), since_s=since)


@fault("sensor frozen from the beginning")
def _(robot, rng, j):
    """The position is one value; all else is as usual."""
    change = Change(j, reading=lambda read: np.full_like(read, read[0]))
    return single(change, {"frozen_sensor"}, standing(robot.channels, "sensor"))


@fault("whole telemetry of a servo frozen half-way")
def _(robot, rng, j):
    """Position, velocity and effort of one servo each repeat one value."""
    since, acts = onset(robot, j, rng)
    # A constant effort is what a stall shows; a second sensor, of another make, goes on.
    kinds = robot.channels.unless_second(*STOPPED)
    kinds |= {"frozen_sensor", "stale_sensor", "lost_samples"}
    change = Change(j, telemetry=lambda values: hold(values, acts))
    return single(change, {"frozen_sensor", "stale_sensor"}, kinds, since_s=since)


def again(kinds):
    """Return kinds of a joint that stands and follows again; a sensor repeats old values then."""
    return kinds | PAUSED | ({"stale_sensor"} if "frozen_sensor" in kinds else frozenset())


@fault("intermittent, a fifth of the time")
def _(robot, rng, j):
    """The position stands still for a part of a cycle, again and again; the effort is zero then."""
    acts = bouts(robot, j, rng, 0.2)
    change = Change(j, position=hold(robot.moved(j), acts), power=np.where(acts, 0.0, 1.0))
    return single(change, {"intermittent", "dead"}, again(standing(robot.channels, "dead")))


@fault("sensor frozen at times, a fifth of the time")
def _(robot, rng, j):
    """The position repeats one value for a part of a cycle, again and again; all else goes on."""
    acts = bouts(robot, j, rng, 0.2)
    kinds = standing(robot.channels, "sensor") | {"stale_sensor"}
    if not (robot.channels.effort or robot.channels.second or robot.channels.velocity == "true"):
        kinds |= PAUSED
    change = Change(j, reading=lambda read: hold(read, acts))
    return single(change, {"frozen_sensor", "stale_sensor"}, kinds)


@fault("commands don't reach a servo for a while")
def _(robot, rng, j):
    """For two cycles the position stands still, with the small effort of a held command."""
    start = float(rng.uniform(0.25, 0.5)) * robot.duration_s
    long = rng.uniform(1.5, 2.5) * 2 * np.pi / robot.omega
    t = robot.t_s[:, j]
    acts = (t >= start) & (t < start + long)
    held = hold(robot.asked(j), acts)
    # It goes to where it was last sent and stays, with the small effort that this takes.
    rest = robot.asked(j)[acts][0] * robot.gain[j]
    moved = robot.moved(j)
    settles = rest + (hold(moved, acts) - rest) * np.exp(-(t - start).clip(0) / 0.1)
    change = Change(j, position=np.where(acts, settles, moved), asked=held)
    kinds = PAUSED | STOPPED
    if not (robot.channels.effort or robot.channels.second):
        kinds |= {"frozen_sensor", "stale_sensor"}
    return single(change, {"intermittent", "dead", "jammed", "stalled"}, kinds, since_s=start)


@fault("a third of the joints dead", joints=(6, 40))
def _(robot, rng, j):
    """Several positions stay at rest angles."""
    count = min(robot.m // 3, robot.m - 4)
    joints = sorted(rng.permutation(robot.m)[:count].tolist())
    acts = np.ones(len(robot.t_s), dtype=bool)
    rest = (np.full(len(acts), robot.bias[joint]) for joint in joints)
    made = [_dead(robot, joint, acts, None, at) for joint, at in zip(joints, rest, strict=True)]
    changes = tuple(change for (change,), _ in made)
    return changes, Truth(tuple(joint for _, truth in made for joint in truth.joints))
