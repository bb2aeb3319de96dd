"""The rulers of a replay: time since the session's start, cycles of its gait, and one mean cycle.

``session_time`` counts from the first sample. ``gait_cycle`` is the gait's cumulative phase over
2 pi, so that two runs at different frequencies can be scrubbed in step; Rerun has no timeline
of real numbers, so one cycle is drawn as one second: ``+3.25s`` there reads 3.25 cycles.
``ensemble_cycle`` counts the degrees of a mean cycle (:mod:`.replay.draw.cycles.mean_cycle`), which
is computed; samples are never folded into one cycle.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import rerun as rr

from undulog.capture.common.arrays import BoolArray, FloatArray, IntArray

from .sampling import interpolate

SESSION_TIME = "session_time"
GAIT_CYCLE = "gait_cycle"
ENSEMBLE_CYCLE = "ensemble_cycle"

ROWS_PER_CHUNK = 4096
"""Rows sent at once: small enough to page through an hour, large enough to be columns."""


@dataclass(frozen=True)
class Rhythm:
    """The gait's phase as it was logged.

    Attributes:
        t_ns: Sampling times [ns], ascending, shape (n,).
        cycles: Cumulative phase over 2 pi, shape (n,).
    """

    t_ns: IntArray
    cycles: FloatArray

    @classmethod
    def from_phase(cls, t_ns: IntArray, phase_rad: FloatArray) -> Rhythm:
        """Count cycles from a phase that may be wrapped.

        Args:
            t_ns: Sampling times [ns], ascending, shape (n,).
            phase_rad: Phase [rad], wrapped to any interval of 2 pi or cumulative, shape (n,).

        Returns:
            The rhythm; samples without a phase are left out.
        """
        known = np.isfinite(phase_rad)
        return cls(t_ns[known], np.unwrap(phase_rad[known]) / (2.0 * np.pi))


@dataclass(frozen=True)
class Clock:
    """Turns sampling times into Rerun's time columns.

    Attributes:
        start_ns: Unix time of the session's first sample [ns].
        rhythm: The gait's phase, or None where the session has no gait.
    """

    start_ns: int
    rhythm: Rhythm | None = None

    def rows(self, t_ns: IntArray) -> Iterator[tuple[slice, list[rr.TimeColumn]]]:
        """Cut rows into chunks that share their timelines.

        Rows whose gait phase isn't known (before the gait starts, in a gap) have no place on
        ``gait_cycle``, and Rerun wants the same timelines in all rows of a chunk.

        Args:
            t_ns: Sampling times of the rows [ns], shape (n,).

        Yields:
            Runs of at most ``ROWS_PER_CHUNK`` rows, with their time columns.
        """
        cycles = self._cycles(t_ns)
        known = np.isfinite(cycles)
        for part in _runs(known):
            since = (t_ns[part] - self.start_ns).astype("timedelta64[ns]")
            columns = [rr.TimeColumn(SESSION_TIME, duration=since)]
            if known[part.start]:
                beat = np.round(cycles[part] * 1e9).astype("timedelta64[ns]")
                columns.append(rr.TimeColumn(GAIT_CYCLE, duration=beat))
            yield part, columns

    def _cycles(self, t_ns: IntArray) -> FloatArray:
        if self.rhythm is None:
            return np.full(t_ns.size, np.nan)
        return interpolate(self.rhythm.t_ns, self.rhythm.cycles, t_ns)


def _runs(known: BoolArray) -> Iterator[slice]:
    """Runs of equal value in ``known``, each cut into chunks."""
    edges = np.flatnonzero(np.diff(known)) + 1
    for start, stop in zip([0, *edges], [*edges, known.size], strict=True):
        for low in range(int(start), int(stop), ROWS_PER_CHUNK):
            yield slice(low, min(low + ROWS_PER_CHUNK, int(stop)))
