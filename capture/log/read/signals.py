"""Joint signals: one series per joint, each with its own sampling times."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from ...common.arrays import FloatArray, IntArray
from ...common.errors import DataError

if TYPE_CHECKING:
    import pandas as pd

LARGEST = 1e100
"""A larger value counts as missing: no sensor sends it, and its powers are not finite."""


@dataclass(frozen=True)
class Signal:
    """Samples of one quantity of one joint.

    Attributes:
        t_ns: Sampling times [Unix ns], not decreasing, shape (n,).
        values: Shape (n,).
    """

    name: str
    unit: str
    t_ns: IntArray
    values: FloatArray


@dataclass(frozen=True)
class JointSignals:
    """One quantity of several joints, head to tail; each joint has its own sampling times.

    Attributes:
        topic: Where it was read from.
        field: ``position``, ``velocity`` or ``effort`` of the JointState.
        t_ns: Sampling times [Unix ns], one array of shape (n_j,) per joint. Joints sampled
            together share one array.
        values: One array of shape (n_j,) per joint; NaN samples are kept.
    """

    topic: str
    field: str
    unit: str
    names: tuple[str, ...]
    t_ns: tuple[IntArray, ...]
    values: tuple[FloatArray, ...]

    @cached_property
    def _place(self) -> dict[str, int]:
        """Name to its first place."""
        return {name: j for j, name in reversed([*enumerate(self.names)])}

    def signal(self, name: str) -> Signal:
        """Return the samples of one joint.

        Raises:
            DataError: If there is no such joint.
        """
        j = self._place.get(name)
        if j is None:
            raise DataError(f"{self.topic} has no joint {name!r}; it has {', '.join(self.names)}")
        return Signal(name, self.unit, self.t_ns[j], self.values[j])

    def select(self, names: Iterable[str]) -> JointSignals:
        """Return the same quantity of some joints, in the order of ``names``.

        Raises:
            DataError: If there is no such joint.
        """
        chosen = [self.signal(name) for name in names]
        return JointSignals(
            self.topic,
            self.field,
            self.unit,
            tuple(signal.name for signal in chosen),
            tuple(signal.t_ns for signal in chosen),
            tuple(signal.values for signal in chosen),
        )

    def frame(self) -> pd.DataFrame:
        """Return all samples in long form.

        Returns:
            Columns ``joint`` (categorical, in chain order), ``t_ns`` and the field's name with its
            unit, e.g. ``position [rad]``; one row per sample.
        """
        import pandas as pd

        counts = [len(t) for t in self.t_ns]
        joint = np.repeat(np.array(self.names, dtype=object), counts)
        order = pd.CategoricalDtype(categories=list(self.names), ordered=True)
        frame = pd.DataFrame(index=pd.RangeIndex(len(joint)))
        frame["joint"] = pd.Series(joint, dtype=order)
        frame["t_ns"] = np.concatenate([*self.t_ns, np.empty(0, dtype=np.int64)])
        frame[f"{self.field} [{self.unit}]"] = np.concatenate([*self.values, np.empty(0)])
        return frame
