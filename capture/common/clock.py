"""The computer's clocks as an argument: what depends on time can be run at any time.

Logic that waits, and that judges how late it is, takes a :class:`Clock`. A test passes a clock
whose time it sets, with late ticks and pauses as inputs; everything else passes :data:`REAL`.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from select import select


def _pause(duration_s: float) -> None:
    """Wait by ``select``: ``time.sleep`` never returns under libfaketime, which sets clocks."""
    select([], [], [], duration_s)


@dataclass(frozen=True)
class Clock:
    """Readings of time, and waiting.

    Attributes:
        monotonic_ns: Time that nobody sets [ns].
        wall_ns: Unix time [ns].
        sleep: Waits for a time [s], or longer.
    """

    monotonic_ns: Callable[[], int] = time.monotonic_ns
    wall_ns: Callable[[], int] = time.time_ns
    sleep: Callable[[float], None] = _pause


REAL = Clock()
"""The clock of this computer."""
