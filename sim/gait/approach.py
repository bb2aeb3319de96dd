"""Values that follow their targets without a jump."""

from __future__ import annotations

import numpy as np

from undulog.capture.common.arrays import FloatArray


class Approach:
    """r'' = g (g (R - r) - 2 r'): critically damped, for each of n values.

    The amplitude law of Ijspeert, Crespi, Ryczko & Cabelguen, Science 315, 1416 (2007), with
    a = 2 g. R changes only at ticks, so the closed form is exact.
    """

    def __init__(self, start: FloatArray, rate: float) -> None:
        """Rest at a value.

        Args:
            start: The values, shape (n,).
            rate: g [1/s].
        """
        self.value = start
        self._target = start
        self._velocity = np.zeros_like(start)
        self._rate = rate

    def advance(self, elapsed_s: float) -> FloatArray:
        """Go on towards the target in force.

        Args:
            elapsed_s: For how long [s].

        Returns:
            The values reached, shape (n,).
        """
        g, error = self._rate, self.value - self._target
        slope = self._velocity + g * error
        decay = np.exp(-g * elapsed_s)
        self.value = self._target + (error + slope * elapsed_s) * decay
        self._velocity = (self._velocity - g * slope * elapsed_s) * decay
        return self.value

    def aim(self, target: FloatArray) -> None:
        """Take another target from now on.

        Args:
            target: R, shape (n,).
        """
        self._target = target
