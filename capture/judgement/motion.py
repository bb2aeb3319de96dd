"""What was recorded of a joint, and its course: command and position at equal steps of time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from ..common.arrays import BoolArray, FloatArray, IntArray
from .levels import ANGLE_MARGIN_RAD, COVERAGE, FEWEST, FULL, MISSING, WHOLE
from .shifts import rank_correlation

LARGEST_COURSE = 1 << 16
"""Steps of a course at most: an hour at 18 Hz, ten samples a cycle of the fastest gaits. Memory and
time of the judgement of 25 joints stay below 0.1 GB and some seconds."""

ALIKE = 2
"""Ratio of long to short cycles (90 and 10 %) of a rhythm at most: a gait that changes its pace by
more is several gaits."""


@dataclass(frozen=True)
class Samples:
    """One quantity of one joint: finite samples at increasing times.

    Attributes:
        t_s: Times from the common origin [s], strictly increasing, shape (n,).
        values: Shape (n,).
    """

    t_s: FloatArray
    values: FloatArray

    def at(self, t_s: FloatArray) -> FloatArray:
        """Return values at other times, interpolated linearly; the ends are held."""
        if t_s is self.t_s:
            return self.values
        return np.interp(t_s, self.t_s, self.values).astype(np.float64, copy=False)

    @property
    def range(self) -> float:
        """Largest minus smallest value."""
        return float(np.ptp(self.values)) if self.values.size else 0.0

    @property
    def period_s(self) -> float:
        """Median sampling interval [s]; 0 of fewer than two samples."""
        return float(np.median(np.diff(self.t_s))) if self.t_s.size > 1 else 0.0


@dataclass(frozen=True)
class RecordedJoint:
    """What was recorded of one joint; None for a quantity that was not.

    Attributes:
        command: Commanded position [rad].
        position: Measured position [rad].
        velocity: [rad/s].
        effort: Torque [N m], or motor current [A] where no torque was recorded.
        reference: Position by a second sensor [rad].
        limits: Lower and upper limit of the joint [rad], or None.
        kind: Joints of one kind have the same servo and load; None where nothing is known.
        outside_loop: Quantities that are measured outside of the servo's own loop, of ``velocity``
            and ``effort``; a servo computes what it measures inside from its own encoder.
    """

    name: str
    command: Samples
    position: Samples
    velocity: Samples | None = None
    effort: Samples | None = None
    reference: Samples | None = None
    limits: tuple[float, float] | None = None
    kind: str | None = None
    outside_loop: frozenset[str] = field(default_factory=frozenset[str])


@dataclass(frozen=True)
class Course:
    """Commands and positions of k joints at n common, equal steps of time.

    Attributes:
        t_s: Times [s], shape (n,).
        command: Commanded positions [rad], shape (k, n).
        position: Measured positions [rad], shape (k, n).
        present: Where a joint's position was sampled, and no driver repeated what all joints had,
            shape (k, n).
        asked: Where its command is known, shape (k, n): not in gaps of its record.
        step_s: Time from one step to the next [s].
    """

    t_s: FloatArray
    command: FloatArray
    position: FloatArray
    present: BoolArray
    asked: BoolArray
    step_s: float


def course_of(motions: Sequence[RecordedJoint]) -> Course | None:
    """Bring joints to common steps: the finest median sampling interval of their positions.

    Args:
        motions: Joints with two samples or more of both command and position.

    Returns:
        Their course from the first to the last time at which any has both; None for no joints.
    """
    if not motions:
        return None
    start = min(max(m.command.t_s[0], m.position.t_s[0]) for m in motions)
    stop = max(min(m.command.t_s[-1], m.position.t_s[-1]) for m in motions)
    finest = min(m.position.period_s for m in motions)
    step = max(finest, (stop - start) / LARGEST_COURSE)
    if step <= 0 or stop - start < 2 * step:
        return None
    t_s = np.asarray(np.arange(start, stop + step / 2, step), dtype=np.float64)
    command = np.stack([m.command.at(t_s) for m in motions])
    position = np.stack([m.position.at(t_s) for m in motions])
    present = np.stack([_present(m, t_s, step) for m in motions])
    return Course(
        t_s,
        command,
        position,
        present & ~_paused(command, position),
        np.stack([_asked(m.command.t_s, t_s) for m in motions]),
        step,
    )


def _present(motion: RecordedJoint, t_s: FloatArray, step_s: float) -> BoolArray:
    """Mark the steps with a sample nearby, within the time in which the joint was commanded."""
    samples = motion.position.t_s
    following = np.searchsorted(samples, t_s).clip(1, samples.size - 1)
    near = MISSING * max(step_s, motion.position.period_s)
    before, after = np.abs(t_s - samples[following - 1]), np.abs(samples[following] - t_s)
    close = np.minimum(before, after) <= near
    commanded = (t_s >= motion.command.t_s[0]) & (t_s <= motion.command.t_s[-1] + near)
    return np.asarray(close & commanded, dtype=np.bool_)


def _paused(command: FloatArray, position: FloatArray) -> BoolArray:
    """Mark the steps in which all joints repeat their values though most commands move.

    Nothing came in over the bus meanwhile, and a driver repeated what it had; shape (n,). Joints
    that stand for a third of the record or more are not one of these.
    """
    paused = np.zeros(position.shape[1], dtype=np.bool_)
    if position.shape[0] < 2:
        return paused
    repeats = np.all(np.diff(position, prepend=np.nan) == 0, axis=0)
    for first, last in runs_of(repeats):
        asked = np.ptp(command[:, first - 1 : last], axis=1)
        if np.median(asked) > ANGLE_MARGIN_RAD / 2:
            paused[first:last] = True
    return paused if np.mean(paused) < 1 - WHOLE else np.zeros_like(paused)


def runs_of(marked: BoolArray) -> list[tuple[int, int]]:
    """Return the first index and the one after the last of each run of marks."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], marked.astype(np.int8), [0]])))
    return [(int(first), int(last)) for first, last in edges.reshape(-1, 2)]


def _asked(command_s: FloatArray, t_s: FloatArray) -> BoolArray:
    """Mark the steps that are in no gap between two commands."""
    intervals = np.diff(command_s)
    gaps = np.flatnonzero(intervals > 2 * MISSING * float(np.quantile(intervals, COVERAGE)))
    covered = np.ones(t_s.size, dtype=np.bool_)
    for gap in gaps.tolist():
        covered &= (t_s <= command_s[gap]) | (t_s >= command_s[gap + 1])
    return covered


def rises_of(command: FloatArray) -> IntArray:
    """Return the steps at which a command of shape (n,) rises through its middle."""
    low, high = float(command.min()), float(command.max())
    away = np.abs(command - (low + high) / 2) > (1 - FULL) * (high - low)
    above = command[away] > (low + high) / 2
    return np.flatnonzero(away).astype(np.int64)[1:][above[1:] & ~above[:-1]]


def cycle_s(command: FloatArray, step_s: float) -> float:
    """Return the median time from one rise of a command through its middle to the next.

    Args:
        command: Shape (n,).

    Returns:
        With a hysteresis of a tenth of the range [s]; infinite for fewer than three rises, and
        where the cycles are not alike, as in a chirp.
    """
    rises = rises_of(command)
    if rises.size <= 2:
        return float("inf")
    lengths = np.diff(rises)
    short, long = np.quantile(lengths, (1 - FULL, FULL))
    return float(np.median(lengths)) * step_s if long <= ALIKE * short else float("inf")


def is_sweep(command: FloatArray) -> bool:
    """Return whether the cycles of a command of shape (n,) get shorter, or longer, all along.

    Fewer than :data:`FEWEST` do so by chance.
    """
    lengths = np.diff(rises_of(command))
    if lengths.size < FEWEST or lengths.min() == lengths.max():
        return False
    return abs(rank_correlation(lengths)) > FULL
