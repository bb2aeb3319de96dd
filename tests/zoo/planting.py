"""The faults: each a pure function from a healthy robot to what changes, with its truth.

Where mechanics and a sensor can look alike, both are planted. Sizes are drawn from three times the
half width of the simultaneous interval upwards (and clear of the margins): below it, silence is
right.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from .robot import MARGIN_GAIN, MARGIN_RAD, Change, Channels, Robot
from .truth import JointTruth, Truth

Generator = np.random.Generator
Kinds = frozenset[str]
Planted = tuple[tuple[Change, ...], Truth]


@dataclass(frozen=True)
class Fault:
    """One kind of planted fault.

    Attributes:
        plant: Returns the changes and the truth for a robot, a generator and a joint.
        place: ``head``, ``middle``, ``tail`` or None: anywhere.
        channels: Required channels; None: any.
        joints: Least and most joints, or None.
    """

    name: str
    plant: Callable[[Robot, Generator, int], Planted]
    place: str | None = None
    channels: tuple[Channels, ...] | None = None
    joints: tuple[int, int] | None = None


FAULTS = {}

WITH_EFFORT = tuple(Channels(velocity, effort=True) for velocity in (None, "derived", "true"))
GAIN, LAG, OFFSET = (frozenset({word}) for word in ("gain", "lag", "offset"))
RESPONSE = GAIN | LAG


def fault(name, **more):
    """Register a fault."""

    def register(plant):
        FAULTS[name] = Fault(name, plant, **more)
        return plant

    return register


def single(change, names=frozenset(), allowed=None, **truth):
    """Return the change of one joint with its truth; ``allowed`` is ``names`` by default."""
    names = frozenset(names)
    of_joint = JointTruth(change.joint, names, names if allowed is None else allowed, **truth)
    return (change,), Truth((of_joint,))


def plant(fault, robot, seed):
    """Plant a fault in a healthy robot; the seed determines place, size and time."""
    rng = np.random.default_rng([seed, 3])
    anywhere = int(rng.integers(robot.m))
    places = {"head": 0, "middle": robot.m // 2, "tail": robot.m - 1}
    return fault.plant(robot, rng, places.get(fault.place, anywhere))


def relative(robot, j, rng, most):
    """Draw a relative size of gain, or of lag in rad, of three half intervals or more."""
    return _size(robot.half(j)[0], MARGIN_GAIN, rng, most)


def offset(robot, j, rng, most, share=1.0):
    """Draw an offset [rad] of three half intervals or more; it acts for a share of the time."""
    size = _size(robot.half(j, len(robot.t_s) * share)[1], MARGIN_RAD, rng, most, share)
    return float(rng.choice([-1.0, 1.0])) * size


def _size(half, margin, rng, most, share=1.0):
    least = max(3 * half, margin + 2 * half) / share
    return float(np.exp(rng.uniform(np.log(least), np.log(max(most, 2 * least)))))


def onset(robot, j, rng, low=0.25, high=0.7):
    """Draw the time of an onset [s]; return it and when the fault acts, shape (n,)."""
    start = float(rng.uniform(low, high)) * robot.duration_s
    return start, robot.t_s[:, j] >= start


def spell(robot, j, rng, begin, long):
    """Draw an interval; return its start [s] and when a fault acts in it, shape (n,).

    Args:
        robot: The robot.
        j: The joint.
        rng: Generator.
        begin: Least and largest start, in shares of the session.
        long: Least and largest length, likewise.
    """
    start = float(rng.uniform(*begin)) * robot.duration_s
    t = robot.t_s[:, j]
    return start, (t >= start) & (t < start + rng.uniform(*long) * robot.duration_s)


def hold(values, acts):
    """Return values that stay constant while a fault acts, as they were when it began."""
    index = np.arange(len(values))
    begins = acts & ~np.concatenate(([False], acts[:-1]))
    return values[np.where(acts, np.maximum.accumulate(np.where(begins | ~acts, index, 0)), index)]


def bouts(robot, j, rng, share):
    """Return when a fault acts for a share of the time, in bouts of about a cycle, shape (n,)."""
    count = max(2, round(share * robot.duration_s / (2 * np.pi / robot.omega)))
    long = share * robot.duration_s / count
    slots = robot.duration_s / count
    starts = np.arange(count) * slots + rng.uniform(0.1, 0.9 - share, count) * slots
    t = robot.t_s[:, j, None]
    return ((t >= starts) & (t < starts + long)).any(axis=1)
