"""Responses cycle by cycle."""

from __future__ import annotations

from dataclasses import dataclass

from ...common.cycles import check_cycles
from ..artefacts.result import Span

Maybe = tuple[float | None, ...]
"""One value a cycle, None where the cycle has none."""


Intervals = tuple[tuple[float, float] | None, ...]
"""Interval of each value, or None."""


@dataclass(frozen=True)
class JointOverTime:
    """One joint's response to its command, cycle by cycle; arrays of one entry a cycle.

    Attributes:
        start_s: Start of the cycle, from the session's start [s].
        stop_s: Its end [s].
        run: Which of :attr:`ResponseOverTime.runs_s` it belongs to.
        frequency_hz: Of the phase in that cycle.
        gain: Amplitude of the response over that of the command; None where the cycle has
            none.
        gain_ci95: Interval of each, or None.
        lag_rad: Lag of the response in (-pi, pi], positive = late [rad], or None.
        lag_ci95: Interval of each, or None.
    """

    name: str
    start_s: tuple[float, ...]
    stop_s: tuple[float, ...]
    run: tuple[int, ...]
    frequency_hz: tuple[float, ...]
    gain: Maybe
    gain_ci95: Intervals
    lag_rad: Maybe
    lag_ci95: Intervals

    def __post_init__(self) -> None:
        """Raise ValueError where values and cycles differ in number."""
        check_cycles(self.name, self, len(self.start_s))


@dataclass(frozen=True)
class ResponseOverTime:
    """Response of all driven joints over the whole session, by the logged phase.

    Attributes:
        runs_s: Stretches between sudden changes of the logged gait, from the session's start [s].
        joints: Driven joints with a phase, head to tail.
    """

    runs_s: tuple[Span, ...]
    joints: tuple[JointOverTime, ...]
