"""The faults: each a pure function from a healthy robot to what changes, with its truth.

Where mechanics and a sensor can look alike, both are planted. Sizes are drawn from three times the
half width of the simultaneous interval upwards (and clear of the margins): below it, silence is
right.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from .robot import MARGIN_GAIN, MARGIN_RAD, Change, Channels, Robot
from .truth import Truth

Generator = np.random.Generator
Planted = tuple[tuple[Change, ...], Truth]


@dataclass(frozen=True)
class Fault:
    """One kind of planted fault.

    Attributes:
        name: Its name.
        plant: From robot, generator and joint to the changes and the truth.
        place: ``head``, ``middle``, ``tail`` or None: anywhere.
        channels: Those it needs; None: any.
        joints: Least and most joints, or None.
        cycles: Least cycles that the session must have.
    """

    name: str
    plant: Callable[[Robot, Generator, int], Planted]
    place: str | None = None
    channels: tuple[Channels, ...] | None = None
    joints: tuple[int, int] | None = None


FAULTS: dict[str, Fault] = {}

WITH_EFFORT = (
    Channels(effort=True),
    Channels(velocity="derived", effort=True),
    Channels(velocity="true", effort=True),
)
GAIN, LAG, OFFSET = (frozenset({word}) for word in ("gain", "lag", "offset"))
RESPONSE = GAIN | LAG


def fault(name, **more):
    """Register a fault."""

    def register(plant):
        FAULTS[name] = Fault(name, plant, **more)
        return plant

    return register


def where(fault: Fault, robot: Robot, rng: Generator) -> int:
    """The joint at which a fault is planted."""
    anywhere = int(rng.integers(robot.m))
    places = {"head": 0, "middle": robot.m // 2, "tail": robot.m - 1}
    return anywhere if fault.place is None else places[fault.place]


def plant(fault: Fault, robot: Robot, seed: int) -> Planted:
    """Plant a fault.

    Args:
        fault: The fault.
        robot: The healthy robot.
        seed: Of place, size and time.

    Returns:
        The changes and the truth.
    """
    rng = np.random.default_rng([seed, 3])
    return fault.plant(robot, rng, where(fault, robot, rng))


def relative(robot: Robot, j: int, rng: Generator, most: float, share: float = 1.0) -> float:
    """A relative size of gain, or of lag in rad, of three half intervals or more."""
    half = robot.half(j, len(robot.t_s) * share)[0]
    least = max(3 * half, MARGIN_GAIN + 2 * half) / share
    return float(np.exp(rng.uniform(np.log(least), np.log(max(most, 2 * least)))))


def offset(robot: Robot, j: int, rng: Generator, most: float, share: float = 1.0) -> float:
    half = robot.half(j, len(robot.t_s) * share)[1]
    least = max(3 * half, MARGIN_RAD + 2 * half) / share
    size = float(np.exp(rng.uniform(np.log(least), np.log(max(most, 2 * least)))))
    return float(rng.choice([-1.0, 1.0])) * size


def onset(robot: Robot, j: int, rng: Generator, low: float = 0.25, high: float = 0.7):
    """Time of an onset [s], and where it acts, shape (n,)."""
    start = float(rng.uniform(low, high)) * robot.duration_s
    return start, robot.t_s[:, j] >= start


def hold(values: np.ndarray, acts: np.ndarray) -> np.ndarray:
    """Values that stay, while something acts, what they were when it began."""
    index = np.arange(len(values))
    begins = acts & ~np.concatenate(([False], acts[:-1]))
    last = np.maximum.accumulate(np.where(begins | ~acts, index, 0))
    return values[np.where(acts, last, index)]


def bouts(robot: Robot, j: int, rng: Generator, share: float) -> np.ndarray:
    """Where something acts for a share of the time, in bouts of a cycle or so, shape (n,)."""
    period = 2 * np.pi / robot.omega
    count = max(2, round(share * robot.duration_s / period))
    long = share * robot.duration_s / count
    slots = robot.duration_s / count
    starts = np.arange(count) * slots + rng.uniform(0.1, 0.9 - share, count) * slots
    t = robot.t_s[:, j, None]
    return ((t >= starts) & (t < starts + long)).any(axis=1)
