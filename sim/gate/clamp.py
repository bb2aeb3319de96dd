"""The last stage before the encoder: no command passes it that is beyond position or rate.

How closely two commands may follow each other: rates hold in true time, not from tick to tick.

The clamp bounds a step by what the greatest rate allows in one control period. Deadlines are
anchored at the first tick, so behind a tick that came late the next one is due in less than a
period: the servos would be told to go the same way in less time. The later command waits then until
the rate allows its step. No step takes more than a period, so that no wait is longer.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from undulog.capture.common.arrays import BoolArray, FloatArray, IntArray

from .limits import GateLimits

_NS = 1e9


class Spacing:
    """When the frames of a command may be sent.

    It knows when each frame of the command before was handed to the bus: a burst that was held up
    half way, e.g. as the process was stopped, holds up what follows by as much as it needs.

    Attributes:
        waits: Commands that have to wait, so far.
        longest_s: The longest of these waits [s].
    """

    def __init__(self, rate: FloatArray, now_ns: Callable[[], int]) -> None:
        """Nothing was sent yet.

        Args:
            rate: Greatest rates [rad/s], shape (m,).
            now_ns: The clock [ns].
        """
        self.waits, self.longest_s = 0, 0.0
        self._rate, self._now_ns = rate, now_ns
        self._last: FloatArray | None = None
        self._sent_ns: IntArray = np.empty(0, dtype=np.int64)

    def earliest_ns(self, command: FloatArray, count: int) -> IntArray:
        """The earliest times at which a command's frames may be sent.

        Args:
            command: Joint angles [rad], shape (m,).
            count: How many frames carry it; always in the same order.

        Returns:
            Each frame's, on the clock [ns], shape (count,); 0 where nothing was sent before.
        """
        if self._last is None:
            return np.zeros(count, dtype=np.int64)
        need_s = float(np.max(np.abs(command - self._last) / self._rate, initial=0.0))
        before = self._sent_ns
        if len(before) != count:  # not the same frames: none of them earlier than all of those
            before = np.full(count, before.max(initial=0))
        earliest = before + math.ceil(need_s * _NS)
        wait_s = (int(earliest.max()) - self._now_ns()) / _NS
        if wait_s > 0.0:
            self.waits += 1
            self.longest_s = max(self.longest_s, wait_s)
        return earliest

    def sent(self, command: FloatArray, sent_ns: IntArray) -> None:
        """A command was sent.

        Args:
            command: Joint angles [rad], shape (m,).
            sent_ns: When the bus had each of its frames, on the clock [ns], shape (n,).
        """
        self._last, self._sent_ns = command, sent_ns


_ROUNDING = 1e-12  # rad; a command that is off a limit in its last bits was not cut


class Clamped(NamedTuple):
    """A command that may be sent.

    Attributes:
        command: Joint angles [rad], shape (m,); finite, whatever was wanted.
        by_position: Joints that were cut to their position limits, shape (m,).
        by_rate: Joints that were held back to their greatest rate, shape (m,).
        unconfirmed: Joints that were held back as the bus had not confirmed the commands before,
            shape (m,).
        not_finite: Joints for which something was wanted that is no angle, shape (m,).
    """

    command: FloatArray
    by_position: BoolArray
    by_rate: BoolArray
    unconfirmed: BoolArray
    not_finite: BoolArray


class Clamp:
    """Cuts commands to position limits, and their steps to the greatest rate.

    It knows the command before, which the servos hold: a step is measured from there, and is at
    most what the greatest rate allows in one control period, also where ticks were left out. What
    was late is caught up step by step and never by a jump; that the steps are a period apart in
    true time, too, is for :mod:`.sim.gate.clamp`.
    """

    def __init__(self, limits: GateLimits, pose: FloatArray, period_s: float) -> None:
        """Start from a pose.

        Args:
            limits: Position and rate limits.
            pose: The angles that the joints have [rad], shape (m,); finite.
            period_s: Control period [s].

        Raises:
            ValueError: If the pose isn't known.
        """
        if not np.isfinite(pose).all():
            raise ValueError("the pose to start from has angles that are not known")
        self._limits, self._reach = limits, limits.rate * period_s
        self.last: FloatArray = np.clip(pose, limits.lower, limits.upper)
        """What was commanded last, at first the pose [rad], shape (m,)."""
        self.cuts: dict[str, int] = dict.fromkeys(Clamped._fields[1:], 0)
        """Commands of single joints that were changed, by why."""

    def apply(
        self, wanted: FloatArray, bounds: tuple[FloatArray, FloatArray] | None = None
    ) -> Clamped:
        """Make a command fit to be sent; it counts as sent.

        Args:
            wanted: Joint angles [rad], shape (m,); anything.
            bounds: Least and greatest angles that the commands on their way leave [rad], shapes
                (m,), the last command among them; None: all.

        Returns:
            The command, and what was changed.
        """
        limits = self._limits
        finite = np.isfinite(wanted)
        within = np.clip(np.where(finite, wanted, self.last), limits.lower, limits.upper)
        stepped = np.clip(within, self.last - self._reach, self.last + self._reach)
        command = stepped
        if bounds is not None:  # the last command is within, but for rounding
            least, greatest = np.minimum(bounds[0], self.last), np.maximum(bounds[1], self.last)
            command = np.clip(stepped, least, greatest)
        by_position = finite & (np.abs(within - wanted) > _ROUNDING)
        by_rate = np.abs(stepped - within) > _ROUNDING
        unconfirmed = np.abs(command - stepped) > _ROUNDING
        self.last = command
        found = Clamped(command.copy(), by_position, by_rate, unconfirmed, ~finite)
        for why, joints in zip(self.cuts, found[1:], strict=True):
            self.cuts[why] += int(joints.sum())
        return found
