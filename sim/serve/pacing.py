"""The robot's clock, and control ticks that keep to it.

The robot's clock starts with its process and runs with the computer's monotonic clock. Tick k is
due at start + k periods; deadlines are anchored at the start, so no pause accumulates. A twin that
needs longer than a period for a period is behind, and catches up where it can. Where it can't,
simulated time stands still and the ticks that follow are due later: samples then have a gap on the
robot's clock, which a recording shows and its health check tells. Samples that are on their way by
then come after the gap, so that no time on the bus ever goes back.

A robot is no program that waits for a processor: while it keeps to the clock it may have a raised
priority, as the recorder and an armed drive have.
"""

from __future__ import annotations

import ipaddress
import socket
from bisect import bisect_left, bisect_right
from contextlib import ExitStack
from dataclasses import dataclass

from undulog.capture.common.arrays import NS
from undulog.capture.common.clock import REAL, Clock
from undulog.capture.common.errors import UsageError
from undulog.capture.common.process import raised_priority

PATIENCE_NS = 50_000_000
"""So far behind the twin may be [ns] and still try to catch up. Its samples are two control periods
old when they come; together that stays below the 0.1 s by which a recorder tells times that are
late from a clock that was set back."""

_ON_THEIR_WAY = 5  # ticks: no sample arrives later than that
_TOO_SLOW_S = 1.0  # a twin that stood still for so long would take a core from everything else


def listen_on_loopback(host: str, port: int) -> socket.socket:
    """Listen on loopback.

    Args:
        host: A name or address of the loopback interface.
        port: TCP port; 0 for any that is free.

    Raises:
        UsageError: If the host is not loopback, or nobody can listen there.
    """
    try:
        addresses = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)
    except (OSError, OverflowError) as error:
        raise UsageError(f"{host}:{port} is no address to serve at: {error}") from error
    family, _, _, _, address = addresses[0]
    if not ipaddress.ip_address(address[0]).is_loopback:
        raise UsageError(
            f"{host} is not this computer's loopback; a virtual robot is served there only, e.g. "
            f"at 127.0.0.1:{port}"
        )
    listener = socket.socket(family, socket.SOCK_STREAM)
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind(address)
        listener.listen()
        listener.setblocking(False)
    except OSError as error:
        listener.close()
        raise UsageError(f"can't serve at {host}:{port}: {error.strerror}") from error
    return listener


@dataclass
class PaceTally:
    """How well the twin kept up.

    Attributes:
        overruns: Ticks begun a period or more after they were due.
        worst_s: The greatest delay of a tick [s].
        stood_still_s: How long simulated time stood still in all [s].
    """

    ticks: int = 0
    overruns: int = 0
    worst_s: float = 0.0
    stood_still_s: float = 0.0


class Pacer:
    """When each control tick is due on the robot's clock.

    Attributes:
        period_ns: Control period [ns].
        tally: How well the ticks kept to it.
        epoch_ns: The robot's clock at zero [Unix ns].
    """

    def __init__(self, period_ns: int, *, fast: bool = False, clock: Clock = REAL) -> None:
        """Start the robot's clock at zero.

        Args:
            period_ns: Control period [ns].
            fast: Don't keep to the wall clock: each tick is due at once, and the robot's clock
                shows simulated time.
            clock: The computer's clocks.
        """
        self.period_ns = period_ns
        self.tally = PaceTally()
        self._fast = fast
        self._clock = clock
        self._zero_ns, self.epoch_ns = clock.monotonic_ns(), clock.wall_ns()
        self._present_ns = 0
        self._from_tick = [0]  # where simulated time stood still, and tick 0 as seen from there on
        self._start_ns = [0]
        self._priority = ExitStack()

    @property
    def start_ns(self) -> int:
        """When tick 0 was due, on the robot's clock [ns]."""
        return self._start_ns[0]

    def now_ns(self) -> int:
        """The robot's clock [ns]."""
        return self._present_ns if self._fast else self._clock.monotonic_ns() - self._zero_ns

    def start(self, start_ns: int) -> None:
        """Say when tick 0 is due.

        Args:
            start_ns: On the robot's clock [ns]; it is rounded up to whole microseconds, since
                socketcand has no finer times.
        """
        self._start_ns[0] = self._present_ns if self._fast else _whole_us(start_ns)

    def raise_priority(self) -> str:
        """Raise the priority of this process's threads, so that a busy computer stops no tick.

        Until :meth:`lower_priority`, or until the twin turns out to be slower than real time.

        Returns:
            The priority, or that it was refused.
        """
        return self._priority.enter_context(raised_priority()).text

    def lower_priority(self) -> None:
        """Lower it again; safe to call twice."""
        self._priority.close()

    def clock_ns(self, elapsed_ns: int) -> int:
        """The robot's clock at a moment of simulated time [ns].

        Args:
            elapsed_ns: Simulated time since tick 0 [ns].
        """
        place = bisect_right(self._from_tick, elapsed_ns // self.period_ns) - 1
        return self._start_ns[max(place, 0)] + elapsed_ns

    def wait_s(self, tick: int) -> float:
        """How long to wait for a tick [s]; 0 when it is due."""
        if self._fast:
            self._present_ns = self.clock_ns(tick * self.period_ns)
            return 0.0
        return max(0, self.clock_ns(tick * self.period_ns) - self.now_ns()) / NS

    def begin(self, tick: int) -> float:
        """Note that a tick begins.

        Returns:
            For how long simulated time stood still before it [s]; 0 nearly always.
        """
        late_ns = 0 if self._fast else self.now_ns() - self.clock_ns(tick * self.period_ns)
        tally = self.tally
        tally.ticks += 1
        tally.overruns += late_ns >= self.period_ns
        tally.worst_s = max(tally.worst_s, late_ns / NS)
        if late_ns < PATIENCE_NS:
            return 0.0
        start_ns = _whole_us(self._start_ns[-1] + late_ns)
        first = max(tick - _ON_THEIR_WAY, 0)
        place = bisect_left(self._from_tick, first)
        self._from_tick[place:], self._start_ns[place:] = [first], [start_ns]
        tally.stood_still_s += late_ns / NS
        if tally.stood_still_s > _TOO_SLOW_S:
            self.lower_priority()
        return late_ns / NS


def _whole_us(t_ns: int) -> int:
    return -(-t_ns // 1000) * 1000
