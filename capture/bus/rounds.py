"""Rounds of samples: joints that are sampled in turn, gathered until each had its turn."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..common.arrays import FloatArray, IntArray

LONGEST_ROUND_NS = 100_000_000
"""No round spans more than this [ns]: later samples belong to the next one."""


@dataclass(frozen=True)
class Rounds:
    """Complete rounds of samples.

    Attributes:
        stamp_ns: Time of the first sample of each round [Unix ns], shape (g,).
        last_ns: Latest sample time of each round [Unix ns], shape (g,).
        offset_s: Sample time minus stamp [s], NaN where missing, shape (g, m).
        values: NaN where missing, shape (g, m, q).
    """

    stamp_ns: IntArray
    last_ns: IntArray
    offset_s: FloatArray
    values: FloatArray


class RoundGatherer:
    """Gathers samples into rounds, over any number of calls."""

    def __init__(self, joints: int, quantities: int) -> None:
        """Start with no samples.

        Args:
            joints: Number of joints m.
            quantities: Number of values q a sample.
        """
        self._joints, self._quantities = joints, quantities
        self.forget()

    def forget(self) -> None:
        """Drop the samples kept back."""
        self._t_ns: IntArray = np.empty(0, dtype=np.int64)
        self._joint: IntArray = np.empty(0, dtype=np.int64)
        self._values: FloatArray = np.empty((0, self._quantities), dtype=np.float64)

    def add(self, t_ns: IntArray, joint: IntArray, values: FloatArray) -> Rounds:
        """Add samples in the order in which they were recorded.

        Args:
            t_ns: Sample times [Unix ns], shape (k,).
            joint: Joint indices, shape (k,).
            values: Shape (k, q).

        Returns:
            The rounds that are complete now; the last one may still grow and is kept back.
        """
        self._t_ns = np.concatenate([self._t_ns, t_ns])
        self._joint = np.concatenate([self._joint, joint])
        self._values = np.concatenate([self._values, values])
        starts = _round_starts(self._t_ns, self._joint, self._joints)
        return self._take(starts[:-1], starts[-1] if starts else 0)

    def finish(self) -> Rounds:
        """Return the last round, complete or not."""
        return self._take(_round_starts(self._t_ns, self._joint, self._joints), len(self._t_ns))

    def _take(self, starts: list[int], stop: int) -> Rounds:
        """Turn the samples before ``stop`` into rounds and keep the rest."""
        t_ns, joint, values = self._t_ns[:stop], self._joint[:stop], self._values[:stop]
        self._t_ns, self._joint = self._t_ns[stop:], self._joint[stop:]
        self._values = self._values[stop:]
        lengths = np.diff([*starts, stop])
        which = np.repeat(np.arange(len(starts)), lengths)
        stamp_ns = t_ns[starts]
        shape = (len(starts), self._joints)
        offset_s = np.full(shape, np.nan)
        offset_s[which, joint] = (t_ns - stamp_ns[which]) * 1e-9
        gathered = np.full((*shape, values.shape[1]), np.nan)
        gathered[which, joint] = values
        last_ns = np.maximum.reduceat(t_ns, starts) if starts else stamp_ns
        return Rounds(stamp_ns, last_ns, offset_s, gathered)


def _round_starts(t_ns: IntArray, joint: IntArray, joints: int) -> list[int]:
    """Return index of the first sample of each round.

    A round that starts at s ends at the first sample i whose joint was last seen at s or later, or
    that is too far from s in time. Of more samples than there are joints one must be such a one,
    so each look is short.
    """
    if not len(joint):
        return []
    order = np.argsort(joint, kind="stable")
    earlier = np.full(len(joint), -1)
    repeats = np.diff(joint[order], prepend=-1) == 0
    earlier[order[1:]] = np.where(repeats[1:], order[:-1], -1)
    starts = [0]
    while True:
        start = starts[-1]
        look = slice(start + 1, start + 2 + joints)
        ends = earlier[look] >= start
        ends |= np.abs(t_ns[look] - t_ns[start]) > LONGEST_ROUND_NS
        step = int(ends.argmax()) if len(ends) else 0
        if not len(ends) or not ends[step]:
            return starts
        starts.append(start + 1 + step)
