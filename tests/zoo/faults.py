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
from .truth import LOADED, PAUSED, STOPPED, JointTruth, Truth, either, standing

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


# -- sizes and times ---------------------------------------------------------------------------


def _relative(robot: Robot, j: int, rng: Generator, most: float, share: float = 1.0) -> float:
    """A relative size of gain, or of lag in rad, of three half intervals or more."""
    half = robot.half(j, len(robot.t_s) * share)[0]
    least = max(3 * half, MARGIN_GAIN + 2 * half) / share
    return float(np.exp(rng.uniform(np.log(least), np.log(max(most, 2 * least)))))


def _offset(robot: Robot, j: int, rng: Generator, most: float, share: float = 1.0) -> float:
    half = robot.half(j, len(robot.t_s) * share)[1]
    least = max(3 * half, MARGIN_RAD + 2 * half) / share
    size = float(np.exp(rng.uniform(np.log(least), np.log(max(most, 2 * least)))))
    return float(rng.choice([-1.0, 1.0])) * size


def _onset(robot: Robot, j: int, rng: Generator, low: float = 0.25, high: float = 0.7):
    """Time of an onset [s], and where it acts, shape (n,)."""
    start = float(rng.uniform(low, high)) * robot.duration_s
    return start, robot.t_s[:, j] >= start


def _hold(values: np.ndarray, acts: np.ndarray) -> np.ndarray:
    """Values that stay, while something acts, what they were when it began."""
    index = np.arange(len(values))
    begins = acts & ~np.concatenate(([False], acts[:-1]))
    last = np.maximum.accumulate(np.where(begins | ~acts, index, 0))
    return values[np.where(acts, last, index)]


def _bouts(robot: Robot, j: int, rng: Generator, share: float) -> np.ndarray:
    """Where something acts for a share of the time, in bouts of a cycle or so, shape (n,)."""
    period = 2 * np.pi / robot.omega
    count = max(2, round(share * robot.duration_s / period))
    long = share * robot.duration_s / count
    slots = robot.duration_s / count
    starts = np.arange(count) * slots + rng.uniform(0.1, 0.9 - share, count) * slots
    t = robot.t_s[:, j, None]
    return ((t >= starts) & (t < starts + long)).any(axis=1)


# -- joints that stand still -------------------------------------------------------------------


def _jam(robot, rng, j, acts, since, *, exact=None):
    still = rng.random() < 0.5 if exact is None else exact
    change = Change(
        j,
        position=_hold(robot.moved(j), acts),
        exact=acts if still else None,
    )
    kinds = standing(robot.channels, "pushing")
    return (change,), Truth(
        (JointTruth(j, frozenset({"jammed", "stalled"}), kinds, since_s=since),)
    )


def _plant_jam(robot, rng, j):
    """The position stands still while the command moves; an effort pushes."""
    since, acts = _onset(robot, j, rng)
    return _jam(robot, rng, j, acts, since)


for _place in ("head", "middle", "tail", None):
    fault(f"jam half-way{f', {_place}' if _place else ''}", place=_place)(_plant_jam)


@fault(
    "jam half-way, position constant to the bit, velocity logged",
    channels=(Channels(velocity="true"), Channels(velocity="derived")),
)
def _(robot, rng, j):
    """As above; no noise any more, and the velocity is zero."""
    since, acts = _onset(robot, j, rng)
    return _jam(robot, rng, j, acts, since, exact=True)


@fault("jam late")
def _(robot, rng, j):
    """As above, but only in the last fifth or so."""
    left = max(2.6 * 2 * np.pi / robot.omega / robot.duration_s, 0.15)
    since, acts = _onset(robot, j, rng, 1 - left - 0.02, 1 - left)
    return _jam(robot, rng, j, acts, since)


@fault("jam from the beginning")
def _(robot, rng, j):
    """The position never moves."""
    acts = np.ones(len(robot.t_s), dtype=bool)
    return _jam(robot, rng, j, acts, None)


@fault("stall at constant effort", channels=WITH_EFFORT)
def _(robot, rng, j):
    """The position stands still, the effort stays at one value while the command travels."""
    since, acts = _onset(robot, j, rng)
    position = _hold(robot.moved(j), acts)
    # The integral part of the loop has run to its limit: constant, whatever the command does.
    pull = rng.choice([-1, 1]) * robot.amplitude[j] * rng.uniform(2.0, 6.0)
    wanted = np.where(acts, position + pull, robot.wanted(j))
    change = Change(j, position=position, wanted=wanted, exact=acts if rng.random() < 0.5 else None)
    return (change,), Truth((JointTruth(j, frozenset({"stalled"}), LOADED, since_s=since),))


def _dead(robot, j, acts, since, position):
    power = np.where(acts, 0.0, 1.0)
    kinds = standing(robot.channels, "dead")
    return (Change(j, position=position, power=power),), Truth(
        (JointTruth(j, frozenset({"dead"}), kinds, since_s=since),)
    )


@fault("dead from the beginning")
def _(robot, rng, j):
    """The position stays at a rest angle; an effort is zero."""
    rest = np.full(len(robot.t_s), robot.bias[j] + rng.choice([0.0, 1.0]) * rng.uniform(-0.2, 0.2))
    return _dead(robot, j, np.ones(len(robot.t_s), dtype=bool), None, rest)


@fault("dead half-way, holds its place")
def _(robot, rng, j):
    """The gearbox holds the angle that it has; an effort is zero from then on."""
    since, acts = _onset(robot, j, rng)
    return _dead(robot, j, acts, since, _hold(robot.moved(j), acts))


@fault("dead half-way, sags to rest")
def _(robot, rng, j):
    """The position falls to a rest angle within a second and stays; an effort is zero."""
    since, acts = _onset(robot, j, rng)
    moved, t = robot.moved(j), robot.t_s[:, j]
    rest = rng.uniform(-0.3, 0.3)
    sag = rest + (_hold(moved, acts) - rest) * np.exp(-(t - since).clip(0) / 0.3)
    return _dead(robot, j, acts, since, np.where(acts, sag, moved))


@fault("sensor frozen half-way")
def _(robot, rng, j):
    """The position repeats one value to the bit; all else goes on."""
    since, acts = _onset(robot, j, rng)
    kinds = standing(robot.channels, "sensor")
    return (Change(j, reading=lambda read: _hold(read, acts)),), Truth(
        (JointTruth(j, frozenset({"frozen_sensor"}), kinds, since_s=since),)
    )


@fault("sensor frozen from the beginning")
def _(robot, rng, j):
    """The position is one value; all else is as usual."""
    kinds = standing(robot.channels, "sensor")
    return (Change(j, reading=lambda read: np.full_like(read, read[0])),), Truth(
        (JointTruth(j, frozenset({"frozen_sensor"}), kinds),)
    )


@fault("whole telemetry of a servo frozen half-way")
def _(robot, rng, j):
    """Position, velocity and effort of one servo each repeat one value."""
    since, acts = _onset(robot, j, rng)
    # A constant effort is what a stall shows; a second sensor, of another make, goes on.
    kinds = frozenset({"frozen_sensor", "stale_sensor", "lost_samples"})
    kinds |= frozenset() if robot.channels.second else STOPPED
    return (Change(j, telemetry=lambda one: _hold(one, acts)),), Truth(
        (JointTruth(j, frozenset({"frozen_sensor", "stale_sensor"}), kinds, since_s=since),)
    )


def _again(kinds):
    """Kinds of a joint that stands and follows again; a sensor that does so repeats old values."""
    return kinds | PAUSED | ({"stale_sensor"} if "frozen_sensor" in kinds else frozenset())


@fault("intermittent, a fifth of the time")
def _(robot, rng, j):
    """The position stands still for a part of a cycle, again and again; the effort is zero then."""
    acts = _bouts(robot, j, rng, 0.2)
    change = Change(j, position=_hold(robot.moved(j), acts), power=np.where(acts, 0.0, 1.0))
    kinds = _again(standing(robot.channels, "dead"))
    return (change,), Truth((JointTruth(j, frozenset({"intermittent", "dead"}), kinds),))


@fault("sensor frozen at times, a fifth of the time")
def _(robot, rng, j):
    """The position repeats one value for a part of a cycle, again and again; all else goes on."""
    acts = _bouts(robot, j, rng, 0.2)
    kinds = standing(robot.channels, "sensor") | {"stale_sensor"}
    if not (robot.channels.effort or robot.channels.second or robot.channels.velocity == "true"):
        kinds |= PAUSED
    return (Change(j, reading=lambda read: _hold(read, acts)),), Truth(
        (JointTruth(j, frozenset({"frozen_sensor", "stale_sensor"}), kinds),)
    )


@fault("commands don't reach a servo for a while")
def _(robot, rng, j):
    """For two cycles the position stands still, with the small effort of a held command."""
    start = float(rng.uniform(0.25, 0.5)) * robot.duration_s
    long = rng.uniform(1.5, 2.5) * 2 * np.pi / robot.omega
    t = robot.t_s[:, j]
    acts = (t >= start) & (t < start + long)
    held = _hold(robot.wanted(j), acts)
    # It goes to where it was last sent and stays, with the small effort that this takes.
    rest = robot.wanted(j)[acts][0] * (1.0 if not acts.any() else robot.gain[j])
    moved = robot.moved(j)
    settles = rest + (_hold(moved, acts) - rest) * np.exp(-(t - start).clip(0) / 0.1)
    change = Change(j, position=np.where(acts, settles, moved), wanted=held)
    kinds = PAUSED | STOPPED
    if not (robot.channels.effort or robot.channels.second):
        kinds |= {"frozen_sensor", "stale_sensor"}
    names = frozenset({"intermittent", "dead", "jammed", "stalled"})
    return (change,), Truth((JointTruth(j, names, kinds, since_s=start),))


@fault("a third of the joints dead", joints=(6, 40))
def _(robot, rng, j):
    """Several positions stay at rest angles."""
    count = min(robot.m // 3, robot.m - 4)
    joints = sorted(rng.permutation(robot.m)[:count].tolist())
    changes, truths = [], []
    acts = np.ones(len(robot.t_s), dtype=bool)
    for one in joints:
        made, truth = _dead(robot, one, acts, None, np.full(len(acts), robot.bias[one]))
        changes += made
        truths += truth.joints
    return tuple(changes), Truth(tuple(truths))


# -- wrong sign, scale, place ------------------------------------------------------------------


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


@fault("sensor of wrong scale")
def _(robot, rng, j):
    """The position has a gain of its own, in its constant part too."""
    size = _relative(robot, j, rng, 0.5)
    scale = 1 - min(size, 0.6) if rng.random() < 0.5 else 1 + size
    return (Change(j, reading=lambda read: scale * read),), Truth(
        (
            JointTruth(
                j,
                frozenset({"scaled_sensor"}),
                frozenset({"scaled_sensor"}),
                GAIN | OFFSET,
                checked=False,
            ),
        )
    )


@fault("sensor in degrees")
def _(robot, rng, j):
    """The position is 180/pi times as large."""
    return (Change(j, reading=np.degrees),), Truth(
        (
            JointTruth(
                j,
                frozenset({"scaled_sensor"}),
                frozenset({"scaled_sensor"}),
                GAIN | OFFSET,
                checked=False,
            ),
        )
    )


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


# -- sensors that tell something else -----------------------------------------------------------


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
    since, acts = _onset(robot, j, rng)
    size = np.sign(rng.uniform(-1, 1)) * max(
        abs(_offset(robot, j, rng, 0.5, 0.3)), 0.35 * robot.amplitude[j]
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
    size = 2 * _offset(robot, j, rng, 0.4)
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


# -- joints that respond differently -------------------------------------------------------------


def _responds(j, quantities, **more):
    more = {"checked": False} | more
    return Truth((JointTruth(j, stands_out=quantities, **more),))


def _weak(robot, rng, j):
    """The position is smaller."""
    size = min(_relative(robot, j, rng, 0.5), 0.6)
    return (Change(j, position=robot.moved(j, gain=1 - size)),), _responds(j, GAIN)


for _place in ("head", "middle", "tail", None):
    fault(f"gain less{f', {_place}' if _place else ''}", place=_place)(_weak)
fault("gain less, of six", joints=(6, 6))(_weak)
fault("gain less, of forty", joints=(40, 40))(_weak)


@fault("gain more")
def _(robot, rng, j):
    """The position is larger."""
    size = _relative(robot, j, rng, 0.4)
    return (Change(j, position=robot.moved(j, gain=1 + size)),), _responds(j, GAIN)


@fault("lag more")
def _(robot, rng, j):
    """The position is later."""
    size = _relative(robot, j, rng, 0.5)
    return (Change(j, position=robot.moved(j, more_lag=size)),), _responds(j, LAG)


@fault("offset only")
def _(robot, rng, j):
    """The position is off by a constant."""
    size = _offset(robot, j, rng, 0.3)
    return (Change(j, position=robot.moved(j) + size),), _responds(j, OFFSET)


@fault("gain fades")
def _(robot, rng, j):
    """The position becomes smaller from cycle to cycle."""
    size = min(2 * _relative(robot, j, rng, 0.25), 0.9)
    gain = 1 - size * robot.t_s[:, j] / robot.duration_s
    return (Change(j, position=robot.moved(j, gain=gain)),), _responds(j, GAIN)


@fault("gain less from half-way on")
def _(robot, rng, j):
    """The position becomes smaller at once."""
    _, acts = _onset(robot, j, rng, 0.4, 0.6)
    size = min(2.5 * _relative(robot, j, rng, 0.2), 0.5)
    change = Change(j, position=robot.moved(j, gain=np.where(acts, 1 - size, 1.0)))
    return (change,), _responds(j, GAIN)


def _clipped(robot):
    """A flat top is the sensor's as well, unless another sensor shows it too."""
    proved = robot.channels.second
    return frozenset() if proved else frozenset({"clipped_sensor", "frozen_sensor"})


@fault("saturates at both ends")
def _(robot, rng, j):
    """Flat tops at both ends of the motion."""
    level = rng.uniform(0.5, 0.75) * robot.swing(j)
    about = robot.bias[j]
    position = about + np.clip(robot.moved(j) - about, -level, level)
    kinds = LOADED | _clipped(robot)
    truth = JointTruth(j, frozenset({"at_limit"}), kinds | STOPPED, GAIN, checked=False)
    return (Change(j, position=position),), Truth((truth,))


@fault("at its limit on one side")
def _(robot, rng, j):
    """Flat tops at one end of the motion."""
    level = rng.uniform(-0.2, 0.4) * robot.swing(j)
    side, about = rng.choice([-1, 1]), robot.bias[j]
    position = about + side * np.minimum(side * (robot.moved(j) - about), level)
    kinds = LOADED | _clipped(robot)
    truth = JointTruth(
        j, frozenset({"at_limit"}), kinds | STOPPED | PAUSED, GAIN | OFFSET, checked=False
    )
    return (Change(j, position=position),), Truth((truth,))


@fault("speed limited")
def _(robot, rng, j):
    """A triangle instead of a sine."""
    moved, t = robot.moved(j), robot.t_s[:, j]
    most = rng.uniform(0.3, 0.55) * robot.swing(j) * robot.omega
    position = moved.copy()
    for k in range(1, len(t)):
        step = most * (t[k] - t[k - 1])
        position[k] = position[k - 1] + np.clip(moved[k] - position[k - 1], -step, step)
    return (Change(j, position=position),), _responds(j, RESPONSE)


def _grown(robot, j, rng, make):
    """The position that an operator makes, its size grown until the response shows it.

    Flat tops at the reversals change the fundamental by little: a size that is large as a share
    of the motion may leave gain and lag within the margins.
    """
    half = robot.half(j)[0]
    size = rng.uniform(0.08, 0.3)
    while size < 1.0:
        position = make(size * robot.swing(j))
        ratio = _fundamental(robot, j, position) / _fundamental(robot, j, robot.moved(j))
        if (
            abs(abs(ratio) - 1) > max(3 * half, MARGIN_GAIN + 2 * half)
            or abs(np.angle(ratio)) > max(3 * half, MARGIN_RAD + 2 * half)
        ):  # fmt: skip
            break
        size *= 1.2
    return position


def _fundamental(robot, j, values):
    """Complex amplitude at the gait frequency, by least squares."""
    angle = robot.omega * robot.t_s[:, j]
    model = np.stack([np.cos(angle), np.sin(angle), np.ones(angle.size)], axis=1)
    (cosine, sine, _), *_ = np.linalg.lstsq(model, values)
    return complex(cosine, -sine)


@fault("backlash")
def _(robot, rng, j):
    """Flat for a moment at both reversals, then in step again."""
    moved = robot.moved(j)

    def play(half):
        position = moved.copy()
        for k in range(1, len(moved)):
            position[k] = np.clip(position[k - 1], moved[k] - half, moved[k] + half)
        return position

    return (Change(j, position=_grown(robot, j, rng, play)),), _responds(j, RESPONSE)


@fault("sticks at both reversals")
def _(robot, rng, j):
    """Flat for a moment at both reversals, then a jump."""
    moved = robot.moved(j)

    def stuck(band):
        position, moves = moved.copy(), True
        for k in range(2, len(moved)):
            if moves and (moved[k] - moved[k - 1]) * (moved[k - 1] - moved[k - 2]) < 0:
                moves = False
            moves = moves or abs(moved[k] - position[k - 1]) > band
            position[k] = moved[k] if moves else position[k - 1]
        return position

    return (Change(j, position=_grown(robot, j, rng, stuck)),), _responds(j, RESPONSE)


@fault("lag grows")
def _(robot, rng, j):
    """The position becomes later from cycle to cycle."""
    size = 2 * _relative(robot, j, rng, 0.3)
    position = robot.moved(j, more_lag=size * robot.t_s[:, j] / robot.duration_s)
    return (Change(j, position=position),), _responds(j, LAG)


@fault("weak to one side")
def _(robot, rng, j):
    """The position is smaller on one side of its middle."""
    size = min(2 * _relative(robot, j, rng, 0.25), 0.7)
    moved, about = robot.moved(j), robot.bias[j] + robot.zero[j]
    side = rng.choice([-1, 1]) * (moved - about) > 0
    position = np.where(side, about + (1 - size) * (moved - about), moved)
    return (Change(j, position=position),), _responds(j, GAIN | OFFSET)


# -- faults that nobody foresaw ------------------------------------------------------------------


@fault("jam that comes loose again")
def _(robot, rng, j):
    """The position stands still for a third of the time, then follows again."""
    start = float(rng.uniform(0.2, 0.4)) * robot.duration_s
    t = robot.t_s[:, j]
    acts = (t >= start) & (t < start + rng.uniform(0.25, 0.4) * robot.duration_s)
    change = Change(j, position=_hold(robot.moved(j), acts))
    kinds = _again(standing(robot.channels, "pushing"))
    names = frozenset({"jammed", "stalled", "intermittent"})
    return (change,), Truth((JointTruth(j, names, kinds, since_s=start),))


@fault("single samples read zero")
def _(robot, rng, j):
    """Samples of the position are zero at random."""
    lost = rng.random(len(robot.t_s)) < rng.uniform(0.02, 0.1)
    kinds = frozenset({"noisy_sensor", "lost_samples"})
    return (Change(j, reading=lambda read: np.where(lost, 0.0, read)),), Truth(
        (JointTruth(j, kinds, kinds | {"wrapped_sensor"}, compared=False),)
    )


@fault("sensor clipped at the end of its range")
def _(robot, rng, j):
    """The position has flat tops at one end; all else goes on."""
    side, about = rng.choice([-1, 1]), robot.bias[j]
    level = rng.uniform(0.1, 0.6) * robot.swing(j)
    kinds = _clipped(robot) | {"clipped_sensor"}
    if not robot.channels.second:
        kinds |= STOPPED | PAUSED
    return (
        Change(j, reading=lambda read: about + side * np.minimum(side * (read - about), level)),
    ), Truth((JointTruth(j, frozenset({"clipped_sensor"}), kinds, GAIN | OFFSET, checked=False),))


@fault("follows its neighbour's command")
def _(robot, rng, j):
    """The position is in step with the joint beside it."""
    other = j + 1 if j + 1 < robot.m else j - 1
    change = Change(j, position=robot.moved(j, of=other), wanted=robot.wanted(other, at=j))
    kinds = frozenset({"swapped"})
    apart = np.angle(np.exp(1j * (robot.phase[other] - robot.phase[j])))
    if abs(apart) > np.radians(120):  # as good as inverted
        kinds |= either(robot.channels, "inverted", "inverted_sensor", cause="inverted")
    return (change,), Truth((JointTruth(j, kinds, kinds, RESPONSE | OFFSET, checked=False),))


@fault("off by a whole turn from the beginning")
def _(robot, rng, j):
    """The position is off by a whole turn of the counter."""
    turn = rng.choice([-1, 1]) * 2 * np.pi
    kinds = frozenset({"wrapped_sensor"})
    if not robot.channels.second:
        kinds |= {"slipped"}
    return (Change(j, reading=lambda read: read + turn),), Truth(
        (JointTruth(j, kinds, kinds | {"slipped_sensor"}, OFFSET, checked=False),)
    )


# -- several, few, none --------------------------------------------------------------------------


def _both(first: str, second: str):
    def plant(robot, rng, j):
        other = int((j + rng.integers(1, robot.m)) % robot.m)
        one = FAULTS[first].plant(robot, rng, j)
        two = FAULTS[second].plant(robot, rng, other)
        return one[0] + two[0], Truth(one[1].joints + two[1].joints)

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
    changes, truth = _weak(robot, rng, j)
    return changes, Truth(truth.joints, undecided=True)


@fault("healthy")
def _(robot, rng, j):
    """All is as usual."""
    return (), Truth()
