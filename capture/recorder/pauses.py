"""Pauses of the recorder: times in which its process did not run.

A process is stopped by a signal (Ctrl-Z, SIGSTOP), a debugger, a frozen container or a suspended
computer. Meanwhile the kernel's buffers fill; what they hold is received afterwards, with the
kernel's times where it has them. A pause is an event of the session, with the frames that were lost
in it, as far as the sources count them.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from ..common.arrays import NS

_SHORTEST_NS = 5_000_000
"""A shorter delay after SIGCONT was none: the usual lateness of a tick on a busy computer."""

_UNEXPLAINED_NS = 500_000_000
"""A delay without a signal that is reported: half of what makes the loop leave out ticks."""

_SUSPENDED_NS = 100_000_000
"""A difference of the clocks with and without suspension that is reported: their readings lie
microseconds apart."""

_SETTLED_NS = 500_000_000
"""After a pause the sources have counted what was lost in it: a poll follows each 20 ms."""


@dataclass(frozen=True)
class Pause:
    """A time in which the process did not run.

    Attributes:
        began_ns: Last time at which it ran [ns, monotonic].
        ended_ns: First time at which it ran again [ns, monotonic].
        suspended_ns: Time in which the computer was suspended, and the session's clock stood [ns].
        by_signal: Whether the process was stopped, and continued by SIGCONT.
    """

    began_ns: int
    ended_ns: int
    suspended_ns: int
    by_signal: bool

    def __str__(self) -> str:
        """Return what happened, and for how long."""
        duration_s = (self.ended_ns - self.began_ns) / NS
        if self.suspended_ns:
            return (
                f"the computer was suspended for {self.suspended_ns / NS:.2f} s; the session's "
                "clock stood meanwhile"
            )
        if self.by_signal:
            return f"the recorder was stopped by a signal for {duration_s:.2f} s"
        return (
            f"the recorder did not run for {duration_s:.2f} s: a debugger, a frozen container, or "
            "other programs held the processors"
        )


def suspended_ns() -> int:
    """Return the time for which the computer has been suspended since it started [ns]."""
    return time.clock_gettime_ns(time.CLOCK_BOOTTIME) - time.monotonic_ns()


class PauseWatch:
    """Finds pauses from the times at which the recorder's loop runs, and reports their losses."""

    def __init__(
        self,
        now_ns: int,
        continued: Callable[[], int],
        suspended: Callable[[], int] = suspended_ns,
    ) -> None:
        """Start.

        Args:
            now_ns: Time [ns, monotonic].
            continued: Returns how often the process was continued by SIGCONT.
            suspended: Returns for how long the computer has been suspended [ns].
        """
        self.pauses: list[Pause] = []
        """All so far."""
        self._continued, self._suspended = continued, suspended
        self._count, self._before_ns = continued(), suspended()
        self._last_ns, self._early = now_ns, 0
        self._delays: list[tuple[int, int, int]] = []
        """Since the last report: how long, from, to [ns]."""
        self._reported = 0
        self._dropped: dict[str, int | None] = {}

    def look(self, now_ns: int, planned_ns: int = 0) -> None:
        """Note that the loop runs.

        Args:
            now_ns: Time [ns, monotonic].
            planned_ns: Part of the time since the last call that the loop meant to wait [ns].
        """
        delay_ns = now_ns - self._last_ns - planned_ns
        if delay_ns >= _SHORTEST_NS:
            self._delays.append((delay_ns, self._last_ns, now_ns))
        self._last_ns = now_ns

    def report(self, dropped: Mapping[str, int | None], *, ends: bool = False) -> tuple[str, ...]:
        """Return the texts of the pauses that are due: once what was lost in them is counted.

        Args:
            dropped: Frames lost so far, by name of the source; None where they aren't counted.
            ends: Whether this is the last call.
        """
        self._find()
        open_pauses = self.pauses[self._reported :]
        if not open_pauses:
            self._dropped = dict(dropped)
            return ()
        settled = self._last_ns - open_pauses[-1].ended_ns >= _SETTLED_NS
        if not settled and not ends:
            return ()
        self._reported = len(self.pauses)
        losses = _losses(self._dropped, dropped)
        self._dropped = dict(dropped)
        return tuple(f"{pause}; {losses}" for pause in open_pauses)

    def _find(self) -> None:
        """Add the pauses since the last call.

        Which delay a signal ended isn't known: the longest ones, as many as there were signals. A
        stop after the last call of :meth:`look` has its signal counted before its delay.
        """
        delays, self._delays = sorted(self._delays, reverse=True), []
        count, total_ns = self._continued(), self._suspended()
        new, slept_ns = count - self._count, total_ns - self._before_ns
        signals, self._early = new + self._early, 0
        self._count, self._before_ns = count, total_ns
        if slept_ns >= _SUSPENDED_NS:
            _, began_ns, ended_ns = delays[0] if delays else (0, self._last_ns, self._last_ns)
            self.pauses.append(Pause(began_ns, ended_ns, slept_ns, by_signal=signals > 0))
            return
        stops = [Pause(began, ended, 0, by_signal=True) for _, began, ended in delays[:signals]]
        self._early = min(new, signals - len(stops))
        if not signals and delays and delays[0][0] >= _UNEXPLAINED_NS:
            stops = [Pause(*delays[0][1:], 0, by_signal=False)]
        self.pauses += sorted(stops, key=lambda pause: pause.began_ns)


def _losses(before: Mapping[str, int | None], after: Mapping[str, int | None]) -> str:
    """Return what the sources have counted as lost."""
    lost = {name: (count or 0) - (before.get(name) or 0) for name, count in after.items()}
    parts = [f"{name} {count}" for name, count in lost.items() if count > 0]
    text = f"frames lost meanwhile: {', '.join(parts)}" if parts else "no frame is counted as lost"
    uncounted = [name for name, count in after.items() if count is None]
    return f"{text} ({', '.join(uncounted)} counts none)" if uncounted else text
