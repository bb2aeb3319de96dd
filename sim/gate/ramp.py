"""From one pose to another, all joints arriving together, none faster than it may."""

from __future__ import annotations

import numpy as np

from undulog.capture.common.arrays import FloatArray

from ..gait.limits import smoothstep

_PEAK = 1.5  # greatest slope of 3 x^2 - 2 x^3


class Ramp:
    """A straight way between two poses, with no rate at either end."""

    def __init__(self, start: FloatArray, target: FloatArray, rate: FloatArray) -> None:
        """Plan it.

        Args:
            start: Angles [rad], shape (m,).
            target: Angles [rad], shape (m,).
            rate: Greatest rates [rad/s], shape (m,).
        """
        self._start, self._way = start.copy(), target - start
        self.duration_s = _PEAK * float(np.max(np.abs(self._way) / rate, initial=0.0))
        """How long it takes [s]."""

    def at(self, time_s: float) -> FloatArray:
        """The pose at a time.

        Args:
            time_s: Since its start [s].

        Returns:
            Angles [rad], shape (m,); the target from its end on.
        """
        if time_s >= self.duration_s:
            return self._start + self._way
        return self._start + smoothstep(time_s / self.duration_s) * self._way
