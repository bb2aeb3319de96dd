"""Wrong sign, scale or place, and sensors that show something else than the joint."""

import numpy as np

from .planting import GAIN, LAG, OFFSET, RESPONSE, fault, offset, onset, relative, single, spell
from .robot import Change
from .truth import PAUSED, Truth, either


@fault("inverted")
def _(robot, rng, j):
    """The position is the mirror image of what it should be."""
    position = 2 * robot.bias[j] - robot.moved(j)
    # Turned as a whole: its servo sees what it always saw, and so does its effort.
    asked = robot.asked(j) - robot.moved(j) + position
    kinds = either(robot.channels, "inverted", "inverted_sensor", cause="inverted")
    return single(Change(j, position=position, asked=asked), {"inverted"}, kinds)


@fault("sensor inverted")
def _(robot, rng, j):
    """The same; a velocity of its own has the other sign."""
    kinds = either(robot.channels, "inverted", "inverted_sensor", cause="inverted_sensor")
    return single(Change(j, reading=np.negative), {"inverted_sensor"}, kinds)


def _scaled(j, reading):
    change = Change(j, reading=reading)
    return single(change, {"scaled_sensor"}, stands_out=GAIN | OFFSET, checked=False)


@fault("sensor of wrong scale")
def _(robot, rng, j):
    """The position has a gain of its own, in its constant part too."""
    size = relative(robot, j, rng, 0.5)
    scale = 1 - min(size, 0.6) if rng.random() < 0.5 else 1 + size
    return _scaled(j, lambda read: scale * read)


@fault("sensor in degrees")
def _(robot, rng, j):
    """The position is 180/pi times as large."""
    return _scaled(j, np.degrees)


@fault("swapped cables")
def _(robot, rng, j):
    """Two joints carry out each other's command."""
    other = j + 1 if j + 1 < robot.m else j - 1
    first, second = (
        single(misled(robot, a, b), {"swapped"}, stands_out=RESPONSE | OFFSET, checked=False)
        for a, b in ((j, other), (other, j))
    )
    return first[0] + second[0], Truth(first[1].joints + second[1].joints)


def misled(robot, j, other):
    """Return a joint that carries out the command of another one."""
    return Change(j, position=robot.moved(j, of=other), asked=robot.asked(other, at=j))


@fault("stale samples")
def _(robot, rng, j):
    """Every value is repeated some times."""
    every = int(np.ceil(rng.uniform(4, 8)))
    old = np.arange(len(robot.t_s)) // every * every
    kinds = frozenset({"stale_sensor", "frozen_sensor", "lost_samples"})
    if not (robot.channels.effort or robot.channels.second):
        kinds |= PAUSED
    change = Change(j, telemetry=lambda values: values[old])
    return single(change, {"stale_sensor"}, kinds, stands_out=LAG, checked=False)


@fault("wrapped counter")
def _(robot, rng, j):
    """The position jumps by a whole turn in a part of each cycle."""
    # The counter wraps at half the amplitude, on one side of the middle.
    at = robot.bias[j] + rng.choice([-1, 1]) * rng.uniform(0.1, 0.6) * robot.swing(j)
    side = np.sign(at - robot.bias[j])

    def wrapped(read):
        return np.where(side * (read - at) > 0, read - side * 2 * np.pi, read)

    return single(Change(j, reading=wrapped), {"wrapped_sensor"})


def _slip(robot, rng, j):
    since, acts = onset(robot, j, rng)
    side, least = np.sign(rng.uniform(-1, 1)), 0.35 * robot.amplitude[j]
    return since, np.where(acts, side * max(abs(offset(robot, j, rng, 0.5, 0.3)), least), 0.0)


def _slipped(change, name, kinds, since):
    return single(change, {name}, kinds, stands_out=OFFSET, since_s=since, checked=False)


@fault("encoder slips")
def _(robot, rng, j):
    """The position makes a step and goes on from there."""
    since, step = _slip(robot, rng, j)
    kinds = either(robot.channels, "slipped", "slipped_sensor", cause="slipped_sensor", fast=True)
    return _slipped(Change(j, reading=lambda read: read + step), "slipped_sensor", kinds, since)


@fault("horn slips")
def _(robot, rng, j):
    """The same; a second sensor shows it too."""
    since, step = _slip(robot, rng, j)
    kinds = either(robot.channels, "slipped", "slipped_sensor", cause="slipped")
    change = Change(j, position=robot.moved(j) + step, asked=robot.asked(j) + step)
    return _slipped(change, "slipped", kinds, since)


@fault("sensor drifts")
def _(robot, rng, j):
    """The mean of the position wanders."""
    drift = (2 * offset(robot, j, rng, 0.4)) * robot.t_s[:, j] / robot.duration_s
    kinds = robot.channels.unless_second("slipped", "slipped_sensor") | {"drifting_sensor"}
    change = Change(j, reading=lambda read: read + drift)
    return single(change, {"drifting_sensor"}, kinds, stands_out=OFFSET, checked=False)


@fault("noise bursts")
def _(robot, rng, j):
    """The position is noisy for half a second, some times."""
    t = robot.t_s[:, j]
    starts = rng.uniform(0.05, 0.9, 4) * robot.duration_s
    acts = ((t[:, None] >= starts) & (t[:, None] < starts + 0.5)).any(axis=1)
    noise = max(20 * robot.sigma, 0.1) * rng.uniform(1, 3) * rng.normal(size=t.size) * acts
    kinds = robot.channels.unless_second(*PAUSED) | {"noisy_sensor"}
    return single(Change(j, reading=lambda read: read + noise), {"noisy_sensor"}, kinds)


@fault("packets of one servo lost")
def _(robot, rng, j):
    """Samples of one joint are missing at random."""
    lost = rng.random(len(robot.t_s)) < rng.uniform(0.1, 0.5)
    return single(Change(j, lost=lost), {"lost_samples"}, compared=False)


@fault("one servo silent for a while")
def _(robot, rng, j):
    """Samples of one joint are missing for seconds."""
    start, lost = spell(robot, j, rng, (0.25, 0.5), (0.15, 0.3))
    return single(Change(j, lost=lost), {"lost_samples"}, since_s=start, compared=False)
