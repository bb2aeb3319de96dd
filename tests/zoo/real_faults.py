"""Faults planted in recordings of real robots, where the recorded motion can show them."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from .healthy import DEGREE
from .independent_fit import LEAST_RAD, period_of
from .oracle import EXPOSED
from .planted import GAIN, LATE, LINE, REPEATS, STOPPED, ZERO, PlantedJoint

SINCE = 0.4
"""Share of the record at which changes begin."""

WEAKER, OFFSET, LATER_S, SWING, HELD_S = 0.75, 5 * DEGREE, 0.1, 3 * DEGREE, 2.0
"""Sizes of the planted faults: what users of such robots called a fault."""

MEMORY_S, LAGS = 0.5, 26
"""Memory of a response [s] and its taps, 20 ms apart: a servo of 1 Hz has settled to 4 % then."""

RIDGE = 1e-6
"""Least singular value that counts, relative: a slow command and its delayed copy are collinear."""

LINE_HZ = (3.1, 7.3)
"""Frequencies of a vibration: the first of them that has six samples a period, from above; no
multiple of what the recorded robots are commanded at."""


@dataclass(frozen=True)
class RealFault:
    """A fault in a recording.

    Attributes:
        positions: Of all joints [rad], shape (n, m).
        truth: Right statements about its joint.
    """

    positions: np.ndarray
    truth: PlantedJoint


def rest_error(signals, joint):
    """Return how far from its response a joint rests [rad], at most 3 degrees.

    The 95th percentile of what a response of any shape leaves, y(t) = sum_i h_i c(t - i D) + b by
    least squares over half a second: a servo's poles are no rest error.
    """
    t_s, command, position = columns(signals, joint)
    lags_s = np.linspace(0.0, MEMORY_S, LAGS)
    late = np.interp(t_s[:, None] - lags_s, t_s, command)
    model = np.column_stack([late, np.ones(t_s.size)])
    fit, *_ = np.linalg.lstsq(model, position, rcond=RIDGE)
    return min(float(np.percentile(np.abs(position - model @ fit), 95)), LEAST_RAD)


def columns(signals, joint):
    """Return times, command and position of a joint, shape (n,) each."""
    return signals.t_s, signals.commands[:, joint], signals.positions[:, joint]


def moves(signals, joint, acts):
    """Whether a joint is asked to move more than three rest errors in some time, and does."""
    least = EXPOSED * rest_error(signals, joint)
    reach = min(float(np.ptp(part[acts])) for part in columns(signals, joint)[1:])
    return reach > max(least, DEGREE)


def exposed_joints(signals):
    """Return joints that are asked to move, before a change and after it, indices."""
    after = _after(signals)
    every = range(len(signals.names))
    return [j for j in every if moves(signals, j, after) and moves(signals, j, ~after)]


FAULTS: dict[str, Callable[..., RealFault | None]] = {}


def _register(plant):
    FAULTS[plant.__name__.strip("_")] = plant
    return plant


def _after(signals):
    t_s = signals.t_s
    return t_s >= t_s[0] + SINCE * (t_s[-1] - t_s[0])


def _planted(signals, joint, position, names, allowed=(), **truth):
    positions = signals.positions.copy()
    positions[:, joint] = position
    names = frozenset(names)
    truth["quantities"] = frozenset(truth.get("quantities", ()))
    return RealFault(positions, PlantedJoint(joint, names, names | frozenset(allowed), **truth))


def _shown(signals, joint, position):
    """Whether a departure is larger than a degree and the rest error."""
    departure = float(np.max(np.abs(position - signals.positions[:, joint])))
    return departure > max(DEGREE, rest_error(signals, joint))


@_register
def held(signals, joint):
    """The position is held for 2 s where the joint moves most."""
    t_s, _, position = columns(signals, joint)
    count = max(int(HELD_S / float(np.median(np.diff(t_s)))), 2)
    starts = np.arange(int(0.1 * t_s.size), int(0.9 * t_s.size) - count, max(count // 10, 1))
    reach = [np.max(np.abs(position[k : k + count] - position[k])) for k in starts]
    if not reach or max(reach) <= EXPOSED * rest_error(signals, joint):
        return None
    first = int(starts[int(np.argmax(reach))])
    stays = position.copy()
    stays[first : first + count] = position[first]
    kinds = STOPPED | REPEATS | {"intermittent"}
    when = {"since_s": float(t_s[first]), "until_s": float(t_s[first + count])}
    return _planted(signals, joint, stays, kinds, **when)


@_register
def gain_from(signals, joint):
    """The joint moves by a quarter less from 40 % of the time on."""
    after, (t_s, _, position) = _after(signals), columns(signals, joint)
    middle = float(np.mean(position))
    weaker = np.where(after, middle + WEAKER * (position - middle), position)
    if not _shown(signals, joint, weaker):
        return None
    since_s = float(t_s[np.argmax(after)])
    return _planted(signals, joint, weaker, **GAIN, sign=-1.0, since_s=since_s)


@_register
def offset(signals, joint):
    """The position is 5 degrees off throughout."""
    return _planted(signals, joint, signals.positions[:, joint] + OFFSET, **ZERO, sign=1.0)


@_register
def offset_from(signals, joint):
    """The position is 5 degrees off from 40 % of the time on."""
    after, (t_s, _, position) = _after(signals), columns(signals, joint)
    since_s = float(t_s[np.argmax(after)])
    return _planted(signals, joint, position + OFFSET * after, **ZERO, sign=1.0, since_s=since_s)


def _later(signals, joint):
    t_s, _, position = columns(signals, joint)
    later = np.interp(t_s - LATER_S, t_s, position)
    return later if _shown(signals, joint, later) else None


@_register
def lag(signals, joint):
    """The position is 100 ms later throughout."""
    later = _later(signals, joint)
    return None if later is None else _planted(signals, joint, later, **LATE)


@_register
def lag_from(signals, joint):
    """The position is 100 ms later from 40 % of the time on."""
    after, later = _after(signals), _later(signals, joint)
    if later is None:
        return None
    position = np.where(after, later, signals.positions[:, joint])
    since_s = float(signals.t_s[np.argmax(after)])
    return _planted(signals, joint, position, **LATE, since_s=since_s)


@_register
def vibration(signals, joint):
    """The joint also swings by 3 degrees at a frequency of its own throughout."""
    t_s, command, position = columns(signals, joint)
    rate_hz = 1 / float(np.median(np.diff(t_s)))
    f = next((f for f in reversed(LINE_HZ) if 6 * f <= rate_hz), None)
    if f is None or f * period_of(t_s, command) < 1.5:
        return None
    return _planted(signals, joint, position + SWING * np.sin(2 * np.pi * f * t_s), **LINE)


@_register
def still(signals, joint):
    """The joint stays where it was at the start, but for the noise of its sensor."""
    position = np.full(signals.t_s.size, signals.positions[0, joint])
    if not _shown(signals, joint, position):
        return None
    names = STOPPED | {"frozen_sensor"}
    return _planted(signals, joint, position, names, REPEATS)


def faulty(signals, planted):
    """Return a recording with a planted fault; efforts are left out: they would contradict it."""
    return replace(signals, positions=planted.positions, efforts=None)
