"""Commands as functions of time: gaits, chirps, multisines, steps, binary sequences, ordinary work.

A motion is evaluated at any times, so that a joint that is late by a delay gets its command at
exactly that much earlier. Before time 0 a robot stands at its first command.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

TONES = 12
"""Of a multisine: the crest factor of random phases, about 2.5, changes little with more."""

SPEED_RAD_S = 10.0
"""Fastest command: the joints' default limit in a robot description (``Joint.max_velocity``)."""

PER_PERIOD = 12
"""Samples a period at least: six times the two of the sampling theorem, so that a servo's answer
between two samples is nearly straight."""

SHORTEST_CYCLES = 8.0
"""Cycles that a drawn gait has at least: with fewer than eight blocks nothing is to be claimed from
a comparison."""


@dataclass(frozen=True)
class Motion:
    """Commands of m joints.

    Attributes:
        at: From times [s], shape (n, m) or (n, 1), to commands [rad], shape (n, m).
        middle: About which the commands move [rad], shape (m,).
        amplitude: How far from there at most [rad], shape (m,); 0: the joint isn't moved.
        period_s: Time in which it repeats, or a typical one in which it goes there and back [s].
    """

    at: Callable[[np.ndarray], np.ndarray]
    middle: np.ndarray
    amplitude: np.ndarray
    period_s: float


@dataclass(frozen=True)
class Drawn:
    """What all motions of one session have in common.

    Attributes:
        m: Joints.
        rate_hz: Samples a second.
        duration_s: Length [s].
        amplitude: Of the commands [rad], shape (m,).
        middle: [rad], shape (m,).
    """

    m: int
    rate_hz: float
    duration_s: float
    amplitude: np.ndarray
    middle: np.ndarray


def frequency(rng, drawn, slowest=SHORTEST_CYCLES):
    """Draw a frequency [Hz], logarithmically, within what rate, length and speed allow.

    Args:
        rng: Generator.
        drawn: The session.
        slowest: Periods in the session at least.
    """
    low = max(0.1, slowest / drawn.duration_s)
    swing = float(np.max(drawn.amplitude))
    high = min(3.0, drawn.rate_hz / PER_PERIOD, SPEED_RAD_S / (2 * np.pi * swing))
    return float(np.exp(rng.uniform(*np.log([low, max(high, low)]))))


def gait(rng, drawn, *, shared=False, by_plane=None):
    """Return a travelling wave.

    Args:
        rng: Generator.
        drawn: The session.
        shared: Whether all joints have the same command.
        by_plane: Plane of each joint, 0 or 1, shape (m,); the second has its own amplitude and
            phase.
    """
    f, m = frequency(rng, drawn), drawn.m
    step = rng.choice([-1, 1]) * rng.uniform(np.radians(20), np.radians(100))
    phase = rng.uniform(-np.pi, np.pi) - step * np.arange(m)
    amplitude, middle = drawn.amplitude, drawn.middle
    if by_plane is not None:
        amplitude = amplitude * np.where(by_plane, rng.uniform(0.6, 1.0), 1.0)
        phase = phase + by_plane * rng.uniform(-np.pi, np.pi)
    if shared:
        phase, middle = np.full(m, phase[0]), np.full(m, middle[0])

    def at(t):
        return middle + amplitude * np.sin(2 * np.pi * f * np.maximum(t, 0.0) + phase)

    return Motion(at, middle, amplitude, 1 / f)


def chirp(rng, drawn):
    """Return a sine whose frequency grows linearly, with a phase for each joint."""
    first = max(0.1, 3.0 / drawn.duration_s)
    last = max(frequency(rng, drawn), 2 * first)
    phase = rng.uniform(-np.pi, np.pi, drawn.m) * rng.integers(2)  # half of them: the same command

    def at(t):
        t = np.maximum(t, 0.0)
        angle = 2 * np.pi * (first * t + (last - first) * t**2 / (2 * drawn.duration_s))
        return drawn.middle + drawn.amplitude * np.sin(angle + phase)

    return Motion(at, drawn.middle, drawn.amplitude, 1 / first)


def multisine(rng, drawn):
    """Return sums of tones at multiples of one frequency, with random phases."""
    base = SHORTEST_CYCLES / drawn.duration_s
    highest = max(frequency(rng, drawn), 2 * base)
    tones = base * np.unique(np.rint(np.geomspace(1, highest / base, TONES)))
    phase = rng.uniform(-np.pi, np.pi, (tones.size, drawn.m))
    size = drawn.amplitude / np.sqrt(2 * tones.size)  # rms of half of the amplitude

    def at(t):
        t = np.maximum(t, 0.0)
        waves = sum(
            np.sin(2 * np.pi * f * t + start) for f, start in zip(tones, phase, strict=True)
        )
        return drawn.middle + size * waves

    return Motion(at, drawn.middle, drawn.amplitude, 1 / base)


def _levels(edges_s, levels):
    """Return commands that stay at one level from edge to edge; (k,) edges, (k + 1, m) levels."""

    def at(t):
        index = np.searchsorted(edges_s, np.maximum(t, 0.0), side="right")
        return levels[index, np.arange(levels.shape[1])]

    return at


def steps(rng, drawn):
    """Return steps to random levels, of all joints at the same time."""
    period_s = max(rng.uniform(1.0, 4.0), 20 / drawn.rate_hz)
    edges_s = np.arange(period_s, drawn.duration_s, period_s)
    levels = drawn.middle + drawn.amplitude * rng.uniform(-1, 1, (edges_s.size + 1, drawn.m))
    return Motion(_levels(edges_s, levels), drawn.middle, drawn.amplitude, 2 * period_s)


def binary(rng, drawn):
    """Return a random binary sequence for each joint."""
    period_s = max(rng.uniform(0.4, 1.5), 10 / drawn.rate_hz)
    edges_s = np.arange(period_s, drawn.duration_s, period_s)
    signs = rng.choice([-1.0, 1.0], (edges_s.size + 1, drawn.m))
    levels = drawn.middle + drawn.amplitude * signs
    return Motion(_levels(edges_s, levels), drawn.middle, drawn.amplitude, 2 * period_s)


def work(rng, drawn):
    """Return ordinary work: from pose to pose by the smoothest jerk, with rests between them.

    The way u(10 u^2 - 15 u^3 + 6 u^4) is that of Flash and Hogan (J. Neurosci. 5, 1985).
    """
    fastest = 1.875 * 2 * float(np.max(drawn.amplitude)) / SPEED_RAD_S  # greatest slope: 15 / 8
    go_s = max(rng.uniform(0.6, 2.5), fastest, 10 / drawn.rate_hz)
    rest_s = rng.uniform(0.2, 1.5)
    starts_s = np.arange(rest_s, drawn.duration_s, go_s + rest_s)
    poses = rng.uniform(-1, 1, (starts_s.size + 1, drawn.m))
    # Not every joint takes part in every move.
    stays = rng.random(poses.shape) < 0.25
    for k in range(1, len(poses)):
        poses[k] = np.where(stays[k], poses[k - 1], poses[k])
    poses = drawn.middle + drawn.amplitude * poses
    joints = np.arange(drawn.m)

    def at(t):
        t = np.maximum(t, 0.0)
        index = np.searchsorted(starts_s, t, side="right")
        began = np.concatenate([[0.0], starts_s])[index]
        u = np.clip((t - began) / go_s, 0.0, 1.0)
        share = u**3 * (10 - 15 * u + 6 * u**2)
        before = poses[np.maximum(index - 1, 0), joints]
        return before + np.where(index > 0, share, 0.0) * (poses[index, joints] - before)

    return Motion(at, drawn.middle, drawn.amplitude, 2 * (go_s + rest_s))


def ending(motion, end_s):
    """Return a motion that holds its last command from a time on."""
    return replace(motion, at=lambda t: motion.at(np.minimum(t, end_s)))


def holding(motion, holds_s):
    """Return a motion that holds its command for a while, some times, and goes on from there.

    Args:
        motion: The motion.
        holds_s: Start and length of each hold [s], in order, shape (k, 2).
    """
    starts_s, lengths_s = np.asarray(holds_s).T
    knots = np.stack([starts_s, starts_s + lengths_s], axis=1).ravel()
    # Time of the motion at the start of each hold, and the same at its end.
    clock = np.repeat(starts_s - np.cumsum(lengths_s) + lengths_s, 2)

    def progress(t):
        inside = np.interp(t, knots, clock)
        after = clock[-1] + t - knots[-1]
        return np.where(t < knots[0], t, np.where(t > knots[-1], after, inside))

    return replace(motion, at=lambda t: motion.at(progress(t)))


def partly(motion, moves):
    """Return a motion of some joints; the others stay in the middle.

    Args:
        motion: The motion.
        moves: Which joints move, shape (m,).
    """

    def at(t):
        return np.where(moves, motion.at(t), motion.middle)

    return replace(motion, at=at, amplitude=np.where(moves, motion.amplitude, 0.0))
