"""Faults that nobody foresaw; several at once, too few joints, and none."""

import numpy as np

from .planting import FAULTS, GAIN, OFFSET, RESPONSE, fault, hold, single, spell
from .responding import clipped, weak
from .robot import Change
from .sensing import misled
from .standing import again
from .truth import PAUSED, STOPPED, Truth, either, standing


@fault("jam that comes loose again")
def _(robot, rng, j):
    """The position stands still for a third of the time, then follows again."""
    start, acts = spell(robot, j, rng, (0.2, 0.4), (0.25, 0.4))
    change = Change(j, position=hold(robot.moved(j), acts))
    kinds = again(standing(robot.channels, "pushing"))
    return single(change, {"jammed", "stalled", "intermittent"}, kinds, since_s=start)


@fault("single samples read zero")
def _(robot, rng, j):
    """Samples of the position are zero at random."""
    lost = rng.random(len(robot.t_s)) < rng.uniform(0.02, 0.1)
    change = Change(j, reading=lambda read: np.where(lost, 0.0, read))
    kinds = frozenset({"noisy_sensor", "lost_samples"})
    return single(change, kinds, kinds | {"wrapped_sensor"}, compared=False)


@fault("sensor clipped at the end of its range")
def _(robot, rng, j):
    """The position has flat tops at one end; all else goes on."""
    side, about = rng.choice([-1, 1]), robot.bias[j]
    level = rng.uniform(0.1, 0.6) * robot.swing(j)
    kinds = clipped(robot) | {"clipped_sensor"}
    kinds |= robot.channels.unless_second(*STOPPED, *PAUSED)
    change = Change(j, reading=lambda read: about + side * np.minimum(side * (read - about), level))
    return single(change, {"clipped_sensor"}, kinds, stands_out=GAIN | OFFSET, checked=False)


@fault("follows its neighbour's command")
def _(robot, rng, j):
    """The position is in step with the joint beside it."""
    other = j + 1 if j + 1 < robot.m else j - 1
    kinds = frozenset({"swapped"})
    apart = np.angle(np.exp(1j * (robot.phase[other] - robot.phase[j])))
    if abs(apart) > np.radians(120):  # as good as inverted
        kinds |= either(robot.channels, "inverted", "inverted_sensor", cause="inverted")
    return single(misled(robot, j, other), kinds, stands_out=RESPONSE | OFFSET, checked=False)


@fault("off by a whole turn from the beginning")
def _(robot, rng, j):
    """The position is off by a whole turn of the counter."""
    turn = rng.choice([-1, 1]) * 2 * np.pi
    kinds = robot.channels.unless_second("slipped") | {"wrapped_sensor"}
    change = Change(j, reading=lambda read: read + turn)
    return single(change, kinds, kinds | {"slipped_sensor"}, stands_out=OFFSET, checked=False)


def _both(first, second):
    def plant(robot, rng, j):
        other = int((j + rng.integers(1, robot.m)) % robot.m)
        planted = FAULTS[first].plant(robot, rng, j)
        two = FAULTS[second].plant(robot, rng, other)
        return planted[0] + two[0], Truth(planted[1].joints + two[1].joints)

    plant.__doc__ = "Both, at two joints."
    return plant


for _pair in (
    ("jam half-way", "lag more"),
    ("dead from the beginning", "inverted"),
    ("sensor frozen half-way", "gain less"),
    ("gain less", "lag more"),
    ("gain less", "gain less"),
    ("stale samples", "encoder slips"),
):
    fault(f"two at once: {_pair[0]}; {_pair[1]}", joints=(7, 40))(_both(*_pair))


@fault("three joints, one weak", joints=(3, 3))
def _(robot, rng, j):
    """One of three positions is smaller."""
    changes, truth = weak(robot, rng, j)
    return changes, Truth(truth.joints, undecided=True)


@fault("healthy")
def _(robot, rng, j):
    """All is as usual."""
    return (), Truth()
