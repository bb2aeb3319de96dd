"""Which stretch of a session is analysed.

In this order: what the user named; the longest stretch over which the logged gait parameters stay
as they are; after the settling time that the session states; without standing still at the ends.
Within the stretch, energies are taken over whole cycles at its end, where it is best settled.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from undulog.capture.common.arrays import BoolArray, FloatArray, IntArray

from ..estimators.series import Series
from ..response.gait import MIN_CYCLES


@dataclass(frozen=True)
class Span:
    """The window over which energies are taken, in s from the common origin.

    Attributes:
        origin_ns: Unix time of the origin [ns].
        start_s: Start [s].
        stop_s: End, not included [s].
        cycles: Whole cycles in it; 0 where there is no gait.
    """

    origin_ns: int
    start_s: float
    stop_s: float
    cycles: int


_NS = 1e9
_STEADY = ("A", "omega", "lag", "offset")
"""Logged gait values that must stay; the phase runs on."""

_SAME = 1e-6
"""Relative change of a gait value that counts as none."""

_CYCLE_SLACK = 0.01
"""A stretch this much of a cycle short of a whole number still counts as whole."""


@dataclass(frozen=True)
class Stretch:
    """A half-open stretch of the session.

    Attributes:
        start_ns: Unix time [ns].
        stop_ns: Unix time, not included [ns].
    """

    start_ns: int
    stop_ns: int

    @property
    def duration_s(self) -> float:
        """Length [s]."""
        return (self.stop_ns - self.start_ns) / _NS

    def intersect(self, start_ns: int | None, stop_ns: int | None) -> Stretch:
        """The part of it within limits.

        Args:
            start_ns: Lower limit [Unix ns], or None.
            stop_ns: Upper limit [Unix ns], or None.

        Returns:
            The part; of no length where there is none.
        """
        start = self.start_ns if start_ns is None else max(self.start_ns, start_ns)
        stop = self.stop_ns if stop_ns is None else min(self.stop_ns, stop_ns)
        return Stretch(start, max(start, stop))


def covered(times_ns: Sequence[IntArray]) -> Stretch | None:
    """From the first to just after the last sample of any channel.

    Args:
        times_ns: Sampling times of the channels [Unix ns], in order.

    Returns:
        The stretch, the last sample's own interval included; None without samples.
    """
    filled = [t for t in times_ns if t.size]
    if not filled:
        return None
    last = max(filled, key=lambda t: int(t[-1]))
    interval = int(np.median(np.diff(last))) if last.size > 1 else 1
    return Stretch(min(int(t[0]) for t in filled), int(last[-1]) + max(interval, 1))


def steady_runs(
    t_ns: IntArray,
    names: Sequence[str],
    values: FloatArray,
    ignore: Sequence[str] = (),
    *,
    least_s: float = 0.0,
) -> list[Stretch]:
    """Stretches over which the logged gait parameters stay as they are.

    Args:
        t_ns: Times of the gait samples [Unix ns], shape (n,).
        names: Names such as ``horizontal.A``, shape (k,).
        values: Shape (n, k).
        ignore: Values that may change, e.g. ``offset``.
        least_s: Shorter runs are left out [s]; an adaptive gait has one for each sample.

    Returns:
        Runs in order of time; each ends with the first sample that differs, the last one an
        interval after the last sample.
    """
    if t_ns.size == 0:
        return []
    kept = [k for k, name in enumerate(names) if name.rpartition(".")[2] in _STEADY]
    kept = [k for k in kept if names[k].rpartition(".")[2] not in ignore]
    changed: BoolArray = np.zeros(t_ns.size - 1, dtype=np.bool_)
    for steady in values.T[kept]:
        step = np.abs(np.diff(steady))
        if np.any(step):
            size = np.abs(steady)
            changed |= step > _SAME * np.maximum(size[1:], size[:-1]) + 1e-12
    edges = np.concatenate([[0], np.flatnonzero(changed) + 1, [t_ns.size]])
    interval = int(np.median(np.diff(t_ns))) if t_ns.size > 1 else 1
    starts, stops = t_ns[edges[:-1]], np.append(t_ns, t_ns[-1] + interval)[edges[1:]]
    kept_runs = stops - starts >= least_s * _NS
    pairs = zip(starts[kept_runs].tolist(), stops[kept_runs].tolist(), strict=True)
    return [Stretch(start, stop) for start, stop in pairs]


def settled(run: Stretch, session_start_ns: int, settle_s: float) -> Stretch:
    """A run without its settling time.

    The settling time counts from the session's start, so that a ramp at the start is part of it;
    for a run that begins later it counts from the run's own start.

    Args:
        run: The run.
        session_start_ns: Unix time [ns].
        settle_s: Settling time [s].

    Returns:
        What is left of it.
    """
    settle_ns = round(settle_s * _NS)
    first = session_start_ns + settle_ns
    start = max(run.start_ns, first) if run.start_ns < first else run.start_ns + settle_ns
    return run.intersect(start, None)


def moving(commands: Sequence[Series]) -> tuple[float, float] | None:
    """From the first to the last sample at which any command moves.

    Args:
        commands: Commands.

    Returns:
        Times [s], or None where no command ever moves.
    """
    starts: list[float] = []
    stops: list[float] = []
    for one in commands:
        moves = np.flatnonzero(np.diff(one.values) != 0)
        if moves.size:
            starts.append(float(one.t_s[moves[0]]))
            stops.append(float(one.t_s[moves[-1] + 1]))
    return (min(starts), max(stops)) if starts else None


def whole_cycles(start_s: float, stop_s: float, frequency_hz: float) -> tuple[float, float, int]:
    """The whole cycles at the end of a stretch.

    Args:
        start_s: Start of the stretch [s].
        stop_s: Its end [s].
        frequency_hz: Gait frequency [Hz].

    Returns:
        Start and end [s], and the number of cycles; none of them where it is shorter than one.
    """
    cycles = math.floor((stop_s - start_s) * frequency_hz + _CYCLE_SLACK)
    span_s = cycles / frequency_hz
    if (stop_s - start_s - span_s) * frequency_hz <= _CYCLE_SLACK:  # the stretch is whole cycles
        return start_s, min(start_s + span_s, stop_s), cycles
    return stop_s - span_s, stop_s, cycles


def long_enough(duration_s: float, frequency_hz: float) -> bool:
    """Whether a stretch holds enough cycles for an analysis.

    Args:
        duration_s: Its length [s].
        frequency_hz: Gait frequency [Hz].

    Returns:
        True for ``MIN_CYCLES`` or more.
    """
    return duration_s * frequency_hz >= MIN_CYCLES - _CYCLE_SLACK
