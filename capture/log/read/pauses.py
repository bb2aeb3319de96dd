"""Pauses of a whole bus whose driver repeats the last values meanwhile.

A driver that publishes at a steady rate goes on when its bus is silent, with the values that it
has. All joints then stand exactly still at once, and once the bus is back they are somewhere else
from one sample to the next. Commands that moved all the while tell it from steps and holds; joints
that really stood, after an emergency stop, start from where they are; and one joint that fails does
so alone.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from ...common.arrays import NS, BoolArray, FloatArray, IntArray
from .sample_times import Signal

LEAST_S = 0.1
"""Shortest pause that is looked for: as long as a gap that makes a session degraded
(``LONG_GAP_S`` of the health rules)."""

LEAST_REPEATS = 3
"""Samples that repeat, at least: two may be those of a sensor that is read more slowly."""

JUMP = 3.0
"""Steps beyond the usual ones by which the joints are elsewhere at the end: with a usual step of
the 95th percentile, a sine makes none of 1.1."""

USUAL_PERCENTILE = 95.0
"""Of the steps of a joint: beyond it are those of pauses and of damage."""

COMMAND_RAD = 0.05
"""Least motion of a command in each half of a pause: as for a frozen joint
(``FROZEN_COMMAND_RAD`` of the health check)."""

_NONE = np.zeros((0, 2), np.int64)


def paused(t_ns: IntArray, positions: FloatArray) -> IntArray:
    """Find the stretches in which all joints repeat their values.

    Args:
        t_ns: Times [Unix ns], in order, shape (n,).
        positions: Of m joints [rad], shape (m, n).

    Returns:
        First sample that repeats and one past the last one, for each pause, shape (p, 2). None
        where fewer than two joints move.
    """
    step = np.abs(np.diff(positions, axis=1))
    moving = step.any(axis=1)
    if np.count_nonzero(moving) < 2:
        return _NONE
    step = step[moving]
    repeats = (step == 0).all(axis=0)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], repeats, [False]])))
    runs: IntArray = edges.reshape(-1, 2).astype(np.int64) + 1
    runs = runs[runs[:, 1] < t_ns.size]  # what ends with the record may be a robot that is off
    long = runs[:, 1] - runs[:, 0] >= LEAST_REPEATS
    long &= t_ns[runs[:, 1] - 1] - t_ns[runs[:, 0] - 1] >= LEAST_S * NS
    runs = runs[long]
    if not runs.size:
        return _NONE
    usual = np.array([np.percentile(size[size > 0], USUAL_PERCENTILE) for size in step])
    jumps = np.median(step[:, runs[:, 1] - 1] / usual[:, None], axis=0)
    return runs[jumps > JUMP]


def without_pauses(
    commands: Mapping[str, Signal],
    positions: Mapping[str, Signal],
    *others: Mapping[str, Signal],
) -> tuple[IntArray, list[dict[str, Signal]]]:
    """Leave out what is repeated in pauses of the bus.

    Args:
        commands: By joint; without them no pause is found.
        positions: By joint; they have pauses only if all have the same times.
        others: Further quantities, of which those with these times lose the same samples.

    Returns:
        First and last time of each pause [Unix ns], shape (p, 2), and the signals, positions first.
    """
    every = [dict(positions), *map(dict, others)]
    signals = list(positions.values())
    if len(signals) < 2 or any(signal.t_ns is not signals[0].t_ns for signal in signals):
        return _NONE, every
    t_ns = signals[0].t_ns
    runs = paused(t_ns, np.stack([signal.values for signal in signals]))
    asked = [commands[name] for name in positions if name in commands]
    spans = zip(t_ns[runs[:, 0] - 1].tolist(), t_ns[runs[:, 1] - 1].tolist(), strict=True)
    runs = runs[np.array([_moved(asked, *span) for span in spans], dtype=np.bool_)]
    if not runs.size:
        return _NONE, every
    kept: BoolArray = np.ones(t_ns.size, dtype=np.bool_)
    for first, stop in runs.tolist():
        kept[first:stop] = False
    left_ns = t_ns[kept]
    thinned = [
        {
            name: Signal(signal.name, signal.unit, left_ns, signal.values[kept])
            if signal.t_ns is t_ns
            else signal
            for name, signal in by_joint.items()
        }
        for by_joint in every
    ]
    return np.stack([t_ns[runs[:, 0] - 1], t_ns[runs[:, 1]]], axis=1), thinned


def _moved(commands: Sequence[Signal], start_ns: int, stop_ns: int) -> bool:
    """Whether half of the commands move in the first half of a stretch, and in the second."""
    middle_ns = (start_ns + stop_ns) // 2
    for limits in (start_ns, middle_ns), (middle_ns, stop_ns):
        moved = 0
        for signal in commands:
            first, last = np.searchsorted(signal.t_ns, limits).tolist()
            part = signal.values[max(first - 1, 0) : last + 1]
            moved += part.size > 0 and float(np.ptp(part)) > COMMAND_RAD
        if not commands or 2 * moved < len(commands):
            return False
    return True
