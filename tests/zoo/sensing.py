"""Wrong sign, scale or place, and sensors that show something else than the joint."""

import numpy as np

from .planting import GAIN, LAG, OFFSET, RESPONSE, fault, offset, onset, relative
from .robot import Change
from .truth import PAUSED, JointTruth, Truth, either


@fault("inverted")
def _(robot, rng, j):
    """The position is the mirror image of what it should be."""
    about = robot.bias[j]
    position = 2 * about - robot.moved(j)
    # Turned as a whole: its servo sees what it always saw, and so does its effort.
    wanted = robot.wanted(j) - robot.moved(j) + position
    kinds = either(robot.channels, "inverted", "inverted_sensor", cause="inverted")
    return (Change(j, position=position, wanted=wanted),), Truth(
        (JointTruth(j, frozenset({"inverted"}), kinds),)
    )


@fault("sensor inverted")
def _(robot, rng, j):
    """The same; a velocity of its own has the other sign."""
    kinds = either(robot.channels, "inverted", "inverted_sensor", cause="inverted_sensor")
    return (Change(j, reading=lambda read: -read),), Truth(
        (JointTruth(j, frozenset({"inverted_sensor"}), kinds),)
    )


def _scaled(j):
    kinds = frozenset({"scaled_sensor"})
    return Truth((JointTruth(j, kinds, kinds, GAIN | OFFSET, checked=False),))


@fault("sensor of wrong scale")
def _(robot, rng, j):
    """The position has a gain of its own, in its constant part too."""
    size = relative(robot, j, rng, 0.5)
    scale = 1 - min(size, 0.6) if rng.random() < 0.5 else 1 + size
    return (Change(j, reading=lambda read: scale * read),), _scaled(j)


@fault("sensor in degrees")
def _(robot, rng, j):
    """The position is 180/pi times as large."""
    return (Change(j, reading=np.degrees),), _scaled(j)


@fault("swapped cables")
def _(robot, rng, j):
    """Two joints carry out each other's command."""
    other = j + 1 if j + 1 < robot.m else j - 1
    changes = tuple(
        Change(a, position=robot.moved(a, of=b), wanted=robot.wanted(b, at=a))
        for a, b in ((j, other), (other, j))
    )
    kinds = frozenset({"swapped"})
    return changes, Truth(
        tuple(JointTruth(k, kinds, kinds, RESPONSE | OFFSET, checked=False) for k in (j, other))
    )


@fault("stale samples")
def _(robot, rng, j):
    """Every value is repeated some times."""
    every = int(np.ceil(rng.uniform(4, 8)))
    old = np.arange(len(robot.t_s)) // every * every
    kinds = frozenset({"stale_sensor", "frozen_sensor", "lost_samples"})
    if not (robot.channels.effort or robot.channels.second):
        kinds |= PAUSED
    return (Change(j, telemetry=lambda one: one[old]),), Truth(
        (JointTruth(j, frozenset({"stale_sensor"}), kinds, LAG, checked=False),)
    )


@fault("wrapped counter")
def _(robot, rng, j):
    """The position jumps by a whole turn in a part of each cycle."""
    # The counter wraps at half the amplitude, on one side of the middle.
    at = robot.bias[j] + rng.choice([-1, 1]) * rng.uniform(0.1, 0.6) * robot.swing(j)
    side = np.sign(at - robot.bias[j])

    def wrapped(read):
        return np.where(side * (read - at) > 0, read - side * 2 * np.pi, read)

    kinds = frozenset({"wrapped_sensor"})
    return (Change(j, reading=wrapped),), Truth((JointTruth(j, kinds, kinds),))


def _slip(robot, rng, j):
    since, acts = onset(robot, j, rng)
    size = np.sign(rng.uniform(-1, 1)) * max(
        abs(offset(robot, j, rng, 0.5, 0.3)), 0.35 * robot.amplitude[j]
    )
    return since, np.where(acts, size, 0.0)


@fault("encoder slips")
def _(robot, rng, j):
    """The position makes a step and goes on from there."""
    since, step = _slip(robot, rng, j)
    kinds = either(robot.channels, "slipped", "slipped_sensor", cause="slipped_sensor", fast=True)
    return (Change(j, reading=lambda read: read + step),), Truth(
        (JointTruth(j, frozenset({"slipped_sensor"}), kinds, OFFSET, since_s=since, checked=False),)
    )


@fault("horn slips")
def _(robot, rng, j):
    """The same; a second sensor shows it too."""
    since, step = _slip(robot, rng, j)
    kinds = either(robot.channels, "slipped", "slipped_sensor", cause="slipped")
    change = Change(j, position=robot.moved(j) + step, wanted=robot.wanted(j) + step)
    return (change,), Truth(
        (JointTruth(j, frozenset({"slipped"}), kinds, OFFSET, since_s=since, checked=False),)
    )


@fault("sensor drifts")
def _(robot, rng, j):
    """The mean of the position wanders."""
    size = 2 * offset(robot, j, rng, 0.4)
    drift = size * robot.t_s[:, j] / robot.duration_s
    kinds = frozenset({"drifting_sensor"})
    if not robot.channels.second:
        kinds |= {"slipped", "slipped_sensor"}
    return (Change(j, reading=lambda read: read + drift),), Truth(
        (JointTruth(j, frozenset({"drifting_sensor"}), kinds, OFFSET, checked=False),)
    )


@fault("noise bursts")
def _(robot, rng, j):
    """The position is noisy for half a second, some times."""
    t = robot.t_s[:, j]
    starts = rng.uniform(0.05, 0.9, 4) * robot.duration_s
    acts = ((t[:, None] >= starts) & (t[:, None] < starts + 0.5)).any(axis=1)
    noise = max(20 * robot.sigma, 0.1) * rng.uniform(1, 3) * rng.normal(size=t.size) * acts
    kinds = frozenset({"noisy_sensor"})
    if not robot.channels.second:
        kinds |= PAUSED
    return (Change(j, reading=lambda read: read + noise),), Truth(
        (JointTruth(j, frozenset({"noisy_sensor"}), kinds),)
    )


@fault("packets of one servo lost")
def _(robot, rng, j):
    """Samples of one joint are missing at random."""
    lost = rng.random(len(robot.t_s)) < rng.uniform(0.1, 0.5)
    kinds = frozenset({"lost_samples"})
    return (Change(j, lost=lost),), Truth((JointTruth(j, kinds, kinds, compared=False),))


@fault("one servo silent for a while")
def _(robot, rng, j):
    """Samples of one joint are missing for seconds."""
    start = float(rng.uniform(0.25, 0.5)) * robot.duration_s
    t = robot.t_s[:, j]
    lost = (t >= start) & (t < start + rng.uniform(0.15, 0.3) * robot.duration_s)
    kinds = frozenset({"lost_samples"})
    return (Change(j, lost=lost),), Truth(
        (JointTruth(j, kinds, kinds, since_s=start, compared=False),)
    )
