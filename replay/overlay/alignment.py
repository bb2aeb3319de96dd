"""Where each session lies on the timelines that all of them share.

``session_time`` counts from each session's own zero: its first sample, or the start of its gait.
``gait_cycle`` is moved by whole cycles only, so that equal places are equal phases; every session
is in its first cycle between 0 and 1 there. The other way round, a sample of one session finds its
counterpart in another one at the same time, or at the same phase.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from undulog.capture.common.arrays import BoolArray, FloatArray, IntArray
from undulog.capture.common.errors import UsageError

from ..samples.sampling import gaps, interpolate
from ..samples.timeline import GAIT_CYCLE, SESSION_TIME, Clock, Rhythm
from .side import Side


class Align(StrEnum):
    """What happens at once."""

    TIME = "time"
    """The same time since each session's first sample."""

    GAIT = "gait"
    """The same time since the start of each session's gait."""

    PHASE = "phase"
    """The same phase of the gait."""

    @property
    def timeline(self) -> str:
        """The timeline on which aligned samples lie at one place."""
        return GAIT_CYCLE if self is Align.PHASE else SESSION_TIME


@dataclass(frozen=True)
class Ruler:
    """A session's place on the common timelines.

    Attributes:
        zero_ns: Its time at 0 of ``session_time`` [Unix ns].
        cycles: Whole cycles that are added to its gait's phase.
    """

    zero_ns: int
    cycles: int


@dataclass(frozen=True)
class Aligned:
    """A session with its place on the common timelines.

    Attributes:
        side: The session.
        ruler: Its place.
    """

    side: Side
    ruler: Ruler

    @property
    def clock(self) -> Clock:
        """Turns the session's sampling times into places on the common timelines."""
        rhythm = self.side.rhythm
        if rhythm is not None:
            rhythm = Rhythm(rhythm.t_ns, rhythm.cycles + self.ruler.cycles)
        return Clock(self.ruler.zero_ns, rhythm)


def align(sides: Sequence[Side], how: Align) -> tuple[Aligned, ...]:
    """Put sessions on common timelines.

    Args:
        sides: The sessions.
        how: What happens at once.

    Returns:
        Each with its place.

    Raises:
        UsageError: If a session has no gait to be aligned by.
    """
    if how is not Align.TIME:
        without = [side.name for side in sides if side.rhythm is None]
        if without:
            raise UsageError(
                f"--align {how}: no phase of a gait was logged (/gait) in {', '.join(without)}; "
                "align by --align time"
            )
    if how is Align.PHASE:
        back = [side.name for side in sides if side.rhythm is not None and _runs_back(side.rhythm)]
        if back:
            raise UsageError(
                f"--align phase: the gait's phase runs backwards in {', '.join(back)}, so its "
                "cycles can't be counted; align by --align time"
            )
    return tuple(Aligned(side, _ruler(side, how)) for side in sides)


def counterparts(a: Aligned, b: Aligned, how: Align, t_ns: IntArray) -> tuple[IntArray, BoolArray]:
    """When in one session happens what happens in another one at given times.

    Args:
        a: The session that the times are of.
        b: The other one.
        how: What happens at once.
        t_ns: Times in ``a`` [Unix ns], shape (n,).

    Returns:
        Times in ``b`` [Unix ns], shape (n,), and whether each is known: in a gap of a gait's
        phase, and outside of it, it isn't.
    """
    if how is not Align.PHASE:
        return t_ns - a.ruler.zero_ns + b.ruler.zero_ns, np.ones(t_ns.shape, dtype=np.bool_)
    one, other = a.clock.rhythm, b.clock.rhythm
    assert one is not None  # noqa: S101 - align() saw to it
    assert other is not None  # noqa: S101
    return times_of(other, interpolate(one.t_ns, one.cycles, t_ns))


def times_of(rhythm: Rhythm, cycles: FloatArray) -> tuple[IntArray, BoolArray]:
    """When a gait first reached given phases.

    Args:
        rhythm: The gait's phase.
        cycles: Wanted phases in cycles, cumulative, shape (n,); may be NaN.

    Returns:
        Times [Unix ns], shape (n,), and whether each is known; 0 where it isn't.
    """
    reached = np.maximum.accumulate(rhythm.cycles)
    forward = np.flatnonzero(np.diff(reached, prepend=-np.inf) > 0)
    t_ns, at = rhythm.t_ns[forward], rhythm.cycles[forward]
    left = np.searchsorted(at, cycles, side="right") - 1
    last = at.size - 1
    within = (left >= 0) & ((left < last) | (cycles == at[-1]))
    left = np.clip(left, 0, max(last - 1, 0))
    if last < 1:
        return np.where(within, t_ns[0], 0), within
    with np.errstate(invalid="ignore"):
        share = np.where(within, (cycles - at[left]) / (at[left + 1] - at[left]), 0.0)
    step = np.round(share * (t_ns[left + 1] - t_ns[left])).astype(np.int64)
    known = within & (~gaps(t_ns)[left] | (share == 0.0))
    return np.where(known, t_ns[left] + step, 0), known


def _ruler(side: Side, how: Align) -> Ruler:
    rhythm = side.rhythm
    if rhythm is None:
        return Ruler(side.start_ns, 0)
    zero_ns = int(rhythm.t_ns[0]) if how is Align.GAIT else side.start_ns
    cycles = -int(np.floor(rhythm.cycles[0]))
    return Ruler(zero_ns, cycles)


def _runs_back(rhythm: Rhythm) -> bool:
    return bool(rhythm.cycles[-1] < rhythm.cycles[0])
