"""The gait of each window in which it is constant."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from ...common.estimate import Estimate

if TYPE_CHECKING:
    pass


@dataclass(frozen=True)
class JointInWindow:
    """One joint's response in one window of a constant gait.

    Attributes:
        joint: Name.
        command_amplitude_rad: Amplitude of the command.
        gain: Amplitude of the response over that of the command.
        lag_rad: Lag of the response behind the command, in (-pi, pi]; positive = late.
    """

    joint: str
    command_amplitude_rad: float | None
    gain: Estimate
    lag_rad: Estimate


@dataclass(frozen=True)
class GaitWindow:
    """One gait of a session whose gait changes.

    Attributes:
        start_s: Start of its window, from the session's start [s].
        stop_s: End [s].
        cycles: Periods in it.
        frequency_hz: Frequency of its largest group of joints.
        wave: ``head-to-tail``, ``tail-to-head``, ``standing`` or None.
        joints: In chain order.
    """

    start_s: float
    stop_s: float
    cycles: float
    frequency_hz: Estimate
    wave: str | None
    joints: tuple[JointInWindow, ...]
