"""When the control loop's ticks are: by the clock, or when the robot says so."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Protocol

from undulog.capture.common.errors import SourceError
from undulog.capture.log.messages.frames import FrameArray

from .link import Link, VirtualRobotLink

LOST_S = 5.0
"""A robot in lockstep that doesn't come to its next tick within this time is lost [s]."""


class Pace(Protocol):
    """Gives one tick after the other."""

    by_the_clock: bool
    """Whether the clock sets the pace, rather than the robot."""
    overruns: int
    """Ticks that were left out because the one before took too long."""
    late_s: float
    """How late the newest tick is, against the first one that had not been taken [s]."""

    def next(self) -> tuple[int, Sequence[FrameArray]]:
        """Wait for the next tick.

        Returns:
            Its number, from 0, and the frames that have come by it.

        Raises:
            SourceError: If the bus is lost.
        """
        ...


class WallPace:
    """Ticks of the computer's monotonic clock, anchored at the first one."""

    by_the_clock = True

    def __init__(self, link: Link, rate_hz: int) -> None:
        """The first tick is at once.

        Args:
            link: The bus.
            rate_hz: Ticks a second.
        """
        self.overruns = 0
        self.late_s = 0.0
        self._link, self._period_ns = link, 1_000_000_000 // rate_hz
        self._tick = -1
        self._start_ns = 0

    def next(self) -> tuple[int, Sequence[FrameArray]]:
        """Wait for the next tick; those that are over by then are left out.

        Returns:
            Its number, and the frames that have come by it.

        Raises:
            SourceError: If the bus is lost.
        """
        now_ns = time.monotonic_ns()
        if self._tick < 0:
            self._tick, self._start_ns = 0, now_ns
            return 0, self._link.receive()
        due_ns = self._start_ns + (self._tick + 1) * self._period_ns
        while now_ns < due_ns:
            time.sleep((due_ns - now_ns) * 1e-9)
            now_ns = time.monotonic_ns()
        # Also where the process was stopped while it slept: what is over is left out.
        left_out = (now_ns - due_ns) // self._period_ns
        self.overruns += left_out
        self._tick += 1 + left_out
        self.late_s = (now_ns - due_ns) * 1e-9
        return self._tick, self._link.receive()


class LockstepPace:
    """The ticks of a robot that waits for the commands of each."""

    by_the_clock = False

    def __init__(self, link: VirtualRobotLink) -> None:
        """The first tick that the robot tells is tick 0.

        Args:
            link: The robot's bus.
        """
        self.overruns = 0
        self.late_s = 0.0
        self._link = link
        self._first: int | None = None

    def next(self) -> tuple[int, Sequence[FrameArray]]:
        """Wait for the robot's next tick.

        Returns:
            Its number, and the frames that came by it.

        Raises:
            SourceError: If the robot is gone, or does not come to it.
        """
        found = self._link.wait_tick(LOST_S)
        if found is None:
            raise SourceError(
                self._link.place, f"the robot is lost: no control tick for {LOST_S:g} s"
            )
        tick, frames = found
        if self._first is None:
            self._first = tick
        return tick - self._first, frames
