"""Faults planted in healthy robots, sized by the oracle, with the statements that are right.

What the data can't separate is stated whole: a servo computes its effort from its own encoder, so
that an encoder that freezes and a joint that jams look alike in it; a motor without power gives no
effort.
"""

import zlib
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from .healthy import DEGREE, Change, Healthy, draw
from .oracle import change_times, half_width, judged_joints

STOPPED = frozenset({"jammed", "stalled", "dead", "at_limit"})
"""Mechanical reasons for a joint that stands still."""

LOADED = frozenset({"jammed", "stalled", "at_limit"})
"""It stands still, and its motor pushes."""

REPEATS = frozenset({"frozen_sensor", "stale_sensor", "lost_samples"})
"""Reasons of a sensor or of the record for a position that stays at one value."""

LEAST_GAIN = 0.02
LEAST_RAD = DEGREE
"""Least sizes of a planted fault: the margins below which nothing is stated."""

BEYOND_REST = 4.0
"""Rest errors by which a planted line or limit changes the position at least: a third more than the
three below which a judge is to be silent."""

TRIES = 40
"""Robots that are drawn from one seed until a joint of one of them is asked to move enough."""

MOST = 3.0
"""Largest planted change of a gain: a larger one is another fault (a wrong unit)."""

SCATTERS = 3.5
"""Standard deviations from joint to joint that count as half an interval, since a joint is compared
with how sound ones scatter, too: one of 60 normal values is beyond in 3 % of the chains."""

PERIODIC = ("white", "ar90", "ar98", "student", "multiplicative", "shared", "quantised_encoder")
PERIODIC += (
    "stick",
    "backlash",
    "delayed",
    "wander",
    "planes",
    "described_planes",
    "efforts",
    "one_command",
)
"""Kinds whose joints are alike and repeat one motion."""

LIKE = (*PERIODIC, "many_joints", "short_chain", "chirp", "multisine", "some_move")
"""Kinds whose joints are alike: what one of them does throughout can be told from the others."""

ANY = (*LIKE, "few_joints", "two_servos", "soft", "one_free_end", "two_free_ends", "bus_pauses")
ANY += ("command_ends", "command_holds", "steps", "binary", "arm", "twin")
"""Kinds in which a change at a time can be told from the same joint at other times."""


GAIN = {"names": {"weak", "scaled_sensor"}, "quantities": {"gain"}}
"""A gain is the joint's or its sensor's scale; either is stated."""

LATE = {"names": {"late"}, "allowed": {"stale_sensor"}, "quantities": {"lag"}, "sign": 1.0}
"""A lag is stated as such; an old value is later, too."""

ZERO = {"names": {"slipped", "slipped_sensor"}, "quantities": {"offset", "rest"}}
"""A zero that moved is the joint's or its sensor's, or the joint rests off its command."""

LINE = {"names": {"vibrating"}, "allowed": {"noisy_sensor"}, "quantities": {"motion"}}
"""Motion at another frequency than the command's."""

LIMIT = {"names": {"at_limit", "clipped_sensor"}, "quantities": {"gain", "offset", "lag"}}
"""A joint that doesn't reach the ends of its motion, or a sensor that doesn't show them."""


@dataclass(frozen=True)
class Least:
    """Least size of a planted fault.

    Attributes:
        halves: In half-widths of the oracle's interval.
        margins: In margins; at one a true change is as large as what may be called alike.
    """

    halves: float = 3.0
    margins: float = 1.0


USUAL = Least()
"""The size that has a bar."""


@dataclass(frozen=True)
class PlantedJoint:
    """Right statements about one joint.

    Attributes:
        joint: Its index.
        names: Kinds that name the fault; an accusation states one of them.
        allowed: Kinds that the data can't separate; it states none but these.
        quantities: Quantities by which it may be stated to differ instead.
        sign: Of that difference; 0: either.
        since_s: Onset [s]; None: from the beginning.
        until_s: End [s]; None: to the end.
    """

    joint: int
    names: frozenset[str]
    allowed: frozenset[str]
    quantities: frozenset[str] = frozenset()
    sign: float = 0.0
    since_s: float | None = None
    until_s: float | None = None


@dataclass(frozen=True)
class Planted:
    """A planted fault.

    Attributes:
        changes: What it changes.
        joints: Right statements about its joints.
        size: Relative for a gain, s for a delay, else rad.
        half: Half of the oracle's interval of it, in the same unit.
        floor: Whether its size is that of the margins.
        undecidable: Whether it is as right to state both joints as the boundary's doing.
    """

    changes: tuple[Change, ...]
    joints: tuple[PlantedJoint, ...]
    size: float = 0.0
    half: float = 0.0
    floor: bool = False
    undecidable: bool = False


@dataclass(frozen=True)
class Fault:
    """A kind of fault.

    Attributes:
        name: Its name.
        plant: From a robot, a generator, candidate joints and the least size to what is planted;
            None if nothing of that size can be.
        kinds: Healthy kinds in which it is planted.
        change: Whether it begins within the record.
    """

    name: str
    plant: Callable[[Healthy, np.random.Generator, list[int], Least], Planted | None]
    kinds: tuple[str, ...]
    change: bool


FAULTS: dict[str, Fault] = {}


def fault(kinds, *, change=False):
    """Register a fault under its function's name."""

    def register(plant):
        name = plant.__name__.strip("_")
        FAULTS[name] = Fault(name, plant, kinds, change)
        return plant

    return register


def plant(name, seed, *, kinds=(), least=USUAL):
    """Draw a healthy robot and plant a fault in it; the seed determines both.

    Args:
        name: Of the fault.
        seed: Seed.
        kinds: Healthy kinds from which is chosen; all that suit the fault if empty.
        least: Least size.

    Returns:
        The robot and what is planted; None twice if none of the robots drawn is asked to move
        enough or none of its motions can show a fault of that size.
    """
    spec = FAULTS[name]
    rng = np.random.default_rng([seed, zlib.crc32(name.encode()), 5])
    chosen = [k for k in spec.kinds if not kinds or k in kinds]
    if not chosen:
        return None, None
    base = chosen[rng.integers(len(chosen))]
    for attempt in range(TRIES):
        healthy = draw(base, seed * TRIES + attempt)
        joints = judged_joints(healthy, change=spec.change)
        planted = spec.plant(healthy, rng, joints, least) if joints else None
        if planted is not None:
            return healthy, planted
    return None, None


def onset(healthy, rng, joint):
    """Draw the time of a change [s]; return it and when it acts, shape (n,)."""
    first = int(rng.choice(np.flatnonzero(change_times(healthy, joint))))
    return float(healthy.t_s[first]), np.arange(healthy.t_s.size) >= first


def way_and_rate(healthy, joint):
    """Return the motion of a joint about its middle and its rate, shape (n,) each."""
    way = healthy.way[:, joint] - healthy.middle[joint]
    return way, np.gradient(way, healthy.t_s)


def hold(values, acts):
    """Return values that stay as they were when a change began, in its one interval."""
    first = int(np.argmax(acts))
    return np.where(acts, values[max(first - 1, 0)], values)


def single(change, names, allowed=(), *, quantities=(), sizes=(0.0, 0.0, False), **more):
    size, half, floor = sizes
    names = frozenset(names)
    truth = PlantedJoint(
        change.joint, names, names | frozenset(allowed), frozenset(quantities), **more
    )
    return Planted((change,), (truth,), size, half, floor)


def sized(half, margin, least):
    """Return the size, half the interval, and whether the size is that of the margin."""
    sizes = least.margins * margin, least.halves * half
    return max(sizes), half, sizes[0] > sizes[1]


def stays(healthy, kinds, effort):
    """Kinds of a joint that stands still: with efforts those that explain them, too."""
    return effort if healthy.efforts else kinds


def resolved(healthy, joint, departure, least, *, within):
    """Whether the oracle sees a departure of size 1, and it is beyond the rest error."""
    margin = max(least.margins * LEAST_RAD, BEYOND_REST * healthy.rest_error(joint))
    is_large = bool(np.max(np.abs(departure)) >= margin)
    return is_large and least.halves * half_width(healthy, joint, departure, within=within) <= 1
