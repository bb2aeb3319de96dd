"""Less effort of a servo that draws too much: its command gives way towards where the joint is."""

from __future__ import annotations

import numpy as np

from undulog.capture.common.arrays import BoolArray, FloatArray

_LESS = 0.8
_MORE = 0.02


class Yielding:
    """Keeps currents below their limits, as far as a position servo can be kept there.

    A position servo's current follows the distance of its command from the joint's angle. While
    the current is beyond its limit that distance shrinks by a fifth in each control tick; below it
    grows back by a fiftieth.
    """

    def __init__(self, limit: FloatArray) -> None:
        """Give way nowhere.

        Args:
            limit: Greatest currents [A], NaN where there is none, shape (m,).
        """
        self._limit = limit
        self._share = np.ones(len(limit))

    @property
    def yields(self) -> BoolArray:
        """Joints that give way, shape (m,)."""
        return self._share < 1.0

    def apply(self, wanted: FloatArray, angle: FloatArray, current: FloatArray) -> FloatArray:
        """Pull commands towards the measured angles where currents ask for it.

        Args:
            wanted: Joint angles [rad], shape (m,).
            angle: Measured angles [rad], NaN where unknown, shape (m,).
            current: Measured currents [A], NaN where unknown, shape (m,).

        Returns:
            Joint angles [rad], shape (m,); untouched where nothing gives way.
        """
        beyond = np.abs(current) > self._limit  # False for NaN
        grown = np.minimum(self._share + _MORE, 1.0)
        self._share = np.where(beyond, self._share * _LESS, grown)
        pulls = self.yields & np.isfinite(angle)
        pulled = np.where(pulls, angle, 0.0)
        pulled += self._share * (wanted - pulled)
        return np.where(pulls, pulled, wanted)
