"""Whether a bus is silent, measured against the interval at which its joints report.

Before arming, the interval is measured as the largest gap but one between control ticks in which
the angle of any joint was received: a single pause does not count, a router that delivers in bursts
does. From then on the bus is silent when no joint was received for the larger of 3 ticks and 3
intervals.

At least 3 ticks have to take place without a joint. A process that was stopped itself sends nothing
meanwhile and finds what came as it goes on: its own pause is no silence of the bus.
"""

from __future__ import annotations

_INTERVALS = 3
_LEAST_TICKS = 3
_LEAST_GAPS = 4


class Silence:
    """Counts control ticks in which no joint of a bus was received.

    Attributes:
        interval: Reply interval [control ticks]; None before it is measured.
        ticks: Control ticks since a joint was received.
    """

    def __init__(self) -> None:
        """Nothing was received yet."""
        self.interval: int | None = None
        self.ticks = 0
        self._tick = -1
        self._looked = 0  # ticks of these that took place
        self._gaps: list[int] | None = None  # None before the first reception

    @property
    def limit(self) -> int:
        """After so many ticks without a joint the bus is silent."""
        return max(_LEAST_TICKS, _INTERVALS * (self.interval or 1))

    @property
    def silent(self) -> bool:
        """Whether it is; never before the interval is measured."""
        long = self.ticks >= self.limit and self._looked >= _LEAST_TICKS
        return self.interval is not None and long

    def tick(self, tick: int, *, received: bool, expected: bool = True) -> None:
        """Count a control tick.

        Args:
            tick: Its number; some may have been left out before it.
            received: Whether the angle of a joint was received since the tick before.
            expected: Whether one should have been; else a tick without one is not counted.
        """
        before, self._tick = self._tick, tick
        if received or expected:
            self.ticks += tick - before
            self._looked += 1
        if not received:
            return
        if self._gaps is None:
            self._gaps = []
        elif self.interval is None:
            self._gaps.append(self.ticks)
        self.ticks = self._looked = 0

    def measure(self) -> bool:
        """Take the interval from what was received so far.

        Returns:
            Whether it was enough: five ticks in which a joint was received.
        """
        if self._gaps is None or len(self._gaps) < _LEAST_GAPS:
            return False
        self.interval = sorted(self._gaps)[-2]
        return True
