"""Trends from cycle to cycle: columns of a linear model.

What isn't linear in them, a time constant and a rotation, lies on a grid.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from undulog.capture.common.arrays import BoolArray, FloatArray

MIN_CYCLES = 5
"""Fewer cycles show no trend beside their scatter."""

_SHORTEST = 0.4  # time constant in cycles
_LONGEST = 0.5  # share of the window


class Trend(StrEnum):
    """How the responses change over the window."""

    STEADY = "steady"
    DRIFTING = "drifting"
    SETTLING = "settling"


@dataclass(frozen=True)
class Shapes:
    """Trends of one kind.

    Attributes:
        kind: ``steady``, ``drifting``, ``settling`` or ``ringing``.
        designs: Columns of each, the first is 1, shape (s, c, p).
        tau: Time constants [cycles], NaN where there is none, shape (s,).
        turn: Rotations per cycle [rad], shape (s,).
        free: Parameters that are not linear.
    """

    kind: str
    designs: FloatArray
    tau: FloatArray
    turn: FloatArray
    free: int

    @property
    def longest(self) -> float:
        """Longest time constant on the grid [cycles]."""
        return float(self.tau.max())


def steady(cycles: int) -> Shapes:
    """Return no trend."""
    return Shapes("steady", np.ones((1, cycles, 1)), np.full(1, np.nan), np.zeros(1), 0)


def families(place: FloatArray) -> Iterator[Shapes]:
    """Yield the trends by kind.

    Args:
        place: Number of each cycle from 0 on, at least ``MIN_CYCLES`` of them, shape (c,).
    """
    columns: list[FloatArray] = [np.ones(place.size)]
    for degree in (1, 2):
        power = place**degree
        basis = np.linalg.qr(np.stack(columns, axis=1))[0]
        columns.append(np.asarray(power - basis @ (basis.T @ power), dtype=np.float64))
        if place.size - degree >= MIN_CYCLES - 1:
            design = np.stack(columns, axis=1)[None]
            yield Shapes("drifting", design, np.full(1, np.nan), np.zeros(1), 0)
    longest = _LONGEST * float(place[-1] + 1)
    yield transients(place, log_spaced(_SHORTEST, longest, 24), np.zeros(1))
    if place.size > MIN_CYCLES:
        turn = np.pi * np.arange(1, 16) / 16
        yield transients(place, log_spaced(2 * _SHORTEST, longest, 12), turn)


def log_spaced(low: float, high: float, count: int) -> FloatArray:
    """Return numbers of one ratio."""
    return low * (high / low) ** (np.arange(float(count)) / (count - 1))


def finer(
    values: FloatArray, kept: BoolArray, count: int, lowest: float, highest: float
) -> FloatArray:
    """Return a grid that reaches one step beyond the values that are kept."""
    below, above = values[values < values[kept].min()], values[values > values[kept].max()]
    low, high = float(np.max(below, initial=lowest)), float(np.min(above, initial=highest))
    return log_spaced(low, high, count)


def transients(place: FloatArray, tau: FloatArray, turn: FloatArray) -> Shapes:
    """Return every time constant with every rotation; without rotation where that is 0."""
    taus: FloatArray = np.repeat(tau, turn.size)
    turns: FloatArray = np.tile(turn, tau.size)
    decay = np.exp(-place / taus[:, None])
    angle = turns[:, None] * place
    parts = [np.ones(decay.shape), decay * np.cos(angle), decay * np.sin(angle)]
    if not turn.any():
        return Shapes("settling", np.stack(parts[:2], axis=2), taus, turns, 1)
    return Shapes("ringing", np.stack(parts, axis=2), taus, turns, 2)
