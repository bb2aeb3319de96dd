"""What stands between a distance and a joint: low pass, latched side, memory of near readings."""

from __future__ import annotations

import math
from typing import Generic, TypeVar

import numpy as np

from undulog.capture.common.arrays import BoolArray, FloatArray

_Value = TypeVar("_Value", float, FloatArray)


class LowPass(Generic[_Value]):
    """First-order low pass, T y' = x - y, exact for inputs that are held between two steps."""

    def __init__(self, time_constant_s: float, start: _Value) -> None:
        """Start at rest.

        Args:
            time_constant_s: T [s]; 0 passes everything.
            start: y at the start.
        """
        self._time_constant_s = time_constant_s
        self._value: _Value = start

    def step(self, elapsed_s: float, wanted: _Value) -> _Value:
        """Follow an input for a while.

        Args:
            elapsed_s: For how long [s].
            wanted: x, held meanwhile.

        Returns:
            y at the end.
        """
        if self._time_constant_s > 0.0:
            left = math.exp(-elapsed_s / self._time_constant_s)
            self._value = wanted + (self._value - wanted) * left
        else:
            self._value = wanted
        return self._value


class SideLatch:
    """To which side to turn: the freer one, kept a while so that noise can't turn it to and fro."""

    def __init__(self, margin_m: float, hold_s: float) -> None:
        """Start with a turn to the right.

        Args:
            margin_m: The other side must be freer by more than this [m].
            hold_s: A side is kept at least so long [s].
        """
        self._margin_m = margin_m
        self._hold_s = hold_s
        self._side = 1.0
        self._since_s = -math.inf

    def step(self, time_s: float, left_m: float, right_m: float) -> float:
        """Choose.

        Args:
            time_s: Now [s].
            left_m: Free way to the left [m]; +inf where nothing is in range.
            right_m: Free way to the right [m].

        Returns:
            +1 to turn right, -1 to turn left; the last side on a tie, at first +1.
        """
        gap = 0.0 if left_m == right_m else right_m - left_m  # no inf - inf
        wanted = math.copysign(1.0, gap)
        if (
            abs(gap) > self._margin_m
            and wanted != self._side
            and time_s - self._since_s >= self._hold_s
        ):
            self._side, self._since_s = wanted, time_s
        return self._side


class NearMemory:
    """Distances of sensors that fold back: what comes nearer than they can tell reads as farther.

    An infrared triangulation sensor (Sharp GP2Y0A02 class) gives its highest voltage at its
    shortest range; nearer than that the voltage falls again. One reading can't tell the two
    branches apart. But an obstacle cannot come onto the near branch without passing the highest
    voltage. So once a reading is that near, nearer than any later one is believed for a while:
    the obstacle stays where it was last seen rather than jumping away.
    """

    def __init__(self, near_m: FloatArray, hold_s: float) -> None:
        """Start with nothing near.

        Args:
            near_m: Readings up to this are near the fold [m], shape (n,); 0 for a sensor that
                does not fold back.
            hold_s: How long a near reading is believed [s].
        """
        self._near_m = near_m
        self._hold_s = hold_s
        self._seen_m = np.full(len(near_m), math.inf)
        self._until_s = np.full(len(near_m), -math.inf)

    def step(self, time_s: float, read_m: FloatArray) -> FloatArray:
        """Take in a reading of each sensor.

        Args:
            time_s: Now [s].
            read_m: What the sensors read [m], +inf: nothing in range, shape (n,).

        Returns:
            What to believe [m], never more than what was read, shape (n,).
        """
        held: BoolArray = time_s < self._until_s
        near: BoolArray = read_m <= self._near_m
        believed = np.where(held, np.minimum(self._seen_m, read_m), read_m)
        self._seen_m = np.where(near, believed, np.where(held, self._seen_m, math.inf))
        self._until_s = np.where(near, time_s + self._hold_s, self._until_s)
        return believed
