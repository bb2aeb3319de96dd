"""What the range sensors are believed to say."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping

import numpy as np

from .filters import NearMemory


class Distances:
    """The range sensors with a memory of what came too near for them."""

    FOLD_MARGIN = 1.1
    """A reading within this factor of the fold is near it: noise, and the speed of approach."""

    def __init__(self, fold_m: Mapping[str, float], hold_s: float) -> None:
        """Start with nothing in range.

        Args:
            fold_m: Name of each sensor to the distance below which it folds back [m], 0 if it
                does not.
            hold_s: How long a near reading is believed [s].
        """
        self._names = tuple(fold_m)
        self._memory = NearMemory(self.FOLD_MARGIN * np.array(list(fold_m.values())), hold_s)
        self._believed: dict[str, float] = {}

    def step(self, time_s: float, ranges: Mapping[str, float]) -> None:
        """Take in the newest readings.

        Args:
            time_s: Now [s].
            ranges: Name to distance [m]; a sensor that has not told anything yet may be missing
                or NaN, and is taken to see nothing; -inf is too near to tell (REP 117).
        """
        read = np.array([ranges.get(name, math.inf) for name in self._names])
        read = np.maximum(np.where(np.isnan(read), math.inf, read), 0.0)
        believed = self._memory.step(time_s, read)
        self._believed = dict(zip(self._names, believed.tolist(), strict=True))

    def nearest(self, names: Iterable[str]) -> float:
        """The nearest obstacle of some sensors.

        Args:
            names: The sensors.

        Returns:
            Distance [m]; +inf where none of them sees anything.
        """
        return min((self._believed[name] for name in names), default=math.inf)
