"""One plane's travelling wave: its parameters and which way it runs, and what is logged of it."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum


class Wave(StrEnum):
    """Which way the bending wave runs along the body."""

    HEAD_TO_TAIL = "head-to-tail"
    TAIL_TO_HEAD = "tail-to-head"


@dataclass(frozen=True)
class PlaneGait:
    """The serpentine wave of one plane, Eq. 2 (horizontal) or Eq. 6 (vertical).

    Attributes:
        amplitude: A [rad].
        frequency_hz: omega / 2 pi.
        lag: Phase from one joint of the plane to the next, not negative [rad].
        wave: Which way the wave runs; the sign of the lag follows from it.
        offset: Y, bends the whole body [rad].
        phase: phi_0, the phase of the plane's first joint at the start [rad].
    """

    amplitude: float
    frequency_hz: float
    lag: float
    wave: Wave = Wave.HEAD_TO_TAIL
    offset: float = 0.0
    phase: float = 0.0

    @property
    def signed_lag(self) -> float:
        """Coefficient of (i - 1), i counted from the head: negative when the wave runs tailwards.

        With +(i-1) phi the crest moves towards the low indices, so towards the head.
        """
        return -self.lag if self.wave is Wave.HEAD_TO_TAIL else self.lag


VALUE_NAMES = ("A", "omega", "lag", "offset", "phase")
"""What is logged of a plane: amplitude [rad], omega [rad/s], signed lag [rad], offset [rad] and
phase [rad], the last two and the amplitude those of the plane's first joint. Where all joints of
the plane are alike, the command of its joint i (from 1) is A sin(phase + (i - 1) lag) + offset."""

JOINT_VALUE_NAMES = ("A", "offset", "phase")
"""What is logged of every driven joint, as ``joint03.A``, where a gait may set joints apart: the
joint's command is A sin(phase) + offset."""
