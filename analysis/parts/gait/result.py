"""The gait of a window, its groups and its frequency."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from ...common.estimate import Estimate

if TYPE_CHECKING:
    pass


@dataclass(frozen=True)
class Window:
    """A half-open stretch of the session that was analysed.

    Attributes:
        start_s: From the session's start [s].
        stop_s: From the session's start [s].
        cycles: Gait cycles in it; 0 where there is no gait.
    """

    start_s: float
    stop_s: float
    cycles: float


@dataclass(frozen=True)
class GroupFacts:
    """Joints that share a rhythm.

    Attributes:
        joints: Names of the driven joints that have it, head to tail.
        windows: Whole cycles of it at the end of the fitted stretch.
        wave: As in :class:`GaitFacts`.
        lag_per_joint_rad: As in :class:`GaitFacts`.
        trend: How the responses change over the fitted window: ``steady``, ``drifting`` or
            ``settling``; None where it is unknown.
        time_constant_s: Of the approach to steady values, where the responses settle.
        oscillation_hz: Frequency by which a transient that rings is off the gait's; None of others.
        cycle_correlation: Of gain or lag from one cycle to the next, the larger; None where cycles
            do not vary by more than noise.
        effective_cycles: How many independent cycles would show the mean as well, where they vary;
            below 4 intervals may be too narrow.
        frequency_drift_hz_per_s: Of the commands; empty where their frequency stays.
        amplitude_drift_per_cycle: Of the commands, relative; empty where it stays.
    """

    frequency_hz: Estimate
    joints: tuple[str, ...]
    windows: tuple[Window, ...] = ()
    wave: str | None = None
    lag_per_joint_rad: dict[str, float] = field(default_factory=dict[str, float])
    trend: str | None = None
    time_constant_s: Estimate = field(default_factory=Estimate)
    oscillation_hz: float | None = None
    cycle_correlation: float | None = None
    effective_cycles: float | None = None
    frequency_drift_hz_per_s: Estimate = field(default_factory=Estimate)
    amplitude_drift_per_cycle: Estimate = field(default_factory=Estimate)


@dataclass(frozen=True)
class GaitFacts:
    """The rhythm that was found; where joints have several, that of the largest group.

    Attributes:
        frequency_hz: Gait frequency with interval; value None where there is no gait.
        windows: What was analysed: energies, coverage and body motion are taken over these whole
            cycles (0 cycles where there is no gait).
        wave: ``head-to-tail``, ``tail-to-head``, ``standing`` or None.
        lag_per_joint_rad: Commanded phase step from joint to joint, by plane.
        fitted: The stretch whose samples gain, lag and frequency are fitted to: the windows and
            the part of a cycle that is left over; None where there is no gait.
        groups: Joints by frequency, the largest group first, which the values above are of; one
            group where all driven joints share a frequency, none where there is no gait.
    """

    frequency_hz: Estimate
    windows: tuple[Window, ...] = ()
    wave: str | None = None
    lag_per_joint_rad: dict[str, float] = field(default_factory=dict[str, float])
    fitted: Window | None = None
    groups: tuple[GroupFacts, ...] = ()
