"""Gaits: what the joints are commanded to do.

Every gait, this one and any with feedback, keeps one contract, :class:`Gait`: it is asked once a
control tick, in order of time, and answers with the joint commands and with what it meant by
them. Each plane's phase is *integrated*, Phi' = omega, and never computed as omega t: the two
differ as soon as omega changes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from enum import StrEnum
from typing import NamedTuple, Protocol

import numpy as np

from capture.arrays import FloatArray
from capture.robot import Plane, Robot

WALK = "walk"
"""The mode of a gait that only goes on."""


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


@dataclass(frozen=True)
class Serpentine:
    """Parameters of the open-loop serpentine gait.

    Attributes:
        planes: The planes that are driven; the joints of the others are held straight.
        ramp_s: Amplitude and offset grow from nothing over this time, smoothly.
    """

    planes: dict[Plane, PlaneGait] = field(default_factory=dict[Plane, PlaneGait])
    ramp_s: float = 2.0


class GaitTick(NamedTuple):
    """What a gait says at one control tick.

    Attributes:
        command: Joint angles to be reached [rad], shape (m,).
        values: What the gait meant, in the order of :attr:`Gait.names`, shape (k,).
        mode: One word for what the gait is about.
        clamped: Names of values that were cut to the joint limits.
    """

    command: FloatArray
    values: FloatArray
    mode: str
    clamped: tuple[str, ...]


class Gait(Protocol):
    """What every gait generator offers."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the values, e.g. ``horizontal.A``."""
        ...

    def step(self, time_s: float) -> GaitTick:
        """Advance to a time and say what to do from then on.

        Args:
            time_s: Time since the start [s], never less than in the call before.

        Returns:
            Commands and values.
        """
        ...


VALUE_NAMES = ("A", "omega", "lag", "offset", "phase")
"""What is logged of a plane: amplitude [rad], omega [rad/s], signed lag [rad], offset [rad], and
the phase of the plane's first joint [rad]: the command of its joint i (from 1) is
A sin(phase + (i - 1) lag) + offset."""


def smoothstep(x: float) -> float:
    """Rise from 0 to 1 with no slope at either end, 3 x^2 - 2 x^3.

    Args:
        x: Where; clipped to 0 to 1.

    Returns:
        The value.
    """
    x = min(max(x, 0.0), 1.0)
    return x * x * (3.0 - 2.0 * x)


def within_limits(
    amplitude: float, offset: float, lower: float, upper: float
) -> tuple[float, float]:
    """Cut offset, then amplitude, so that offset +- amplitude stays within the limits.

    The wave keeps its shape: a cut sine would have flat tops, and harmonics that no one commanded.

    Args:
        amplitude: Wanted, not negative [rad].
        offset: Wanted [rad].
        lower: Lower limit [rad].
        upper: Upper limit [rad].

    Returns:
        Amplitude and offset [rad].
    """
    offset = min(max(offset, lower), upper)
    return min(amplitude, upper - offset, offset - lower), offset


class SerpentineGait:
    """The serpentine generator, Eqs. 2 and 6 of Meister, Stepanenko & Kernbach 2011."""

    def __init__(self, parameters: Serpentine, robot: Robot) -> None:
        """Start at time zero with straight joints.

        Args:
            parameters: What to do.
            robot: Who is to do it.
        """
        lower, upper = robot.limits()
        self._parameters = parameters
        self._command = np.clip(np.zeros(len(robot.joints)), lower, upper)
        self._time_s = 0.0
        self._joints = {plane: robot.joint_indices(plane) for plane in parameters.planes}
        self._limits = {
            plane: (float(lower[chosen].max()), float(upper[chosen].min()))
            for plane, chosen in self._joints.items()
        }
        self._phase = {plane: gait.phase for plane, gait in parameters.planes.items()}

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the values: five for each driven plane."""
        return tuple(f"{plane}.{name}" for plane in self._joints for name in VALUE_NAMES)

    def step(self, time_s: float) -> GaitTick:
        """Advance to a time and say what to do from then on.

        Args:
            time_s: Time since the start [s], never less than in the call before.

        Returns:
            Commands and values.
        """
        elapsed, self._time_s = time_s - self._time_s, time_s
        ramp_s = self._parameters.ramp_s
        ramp = smoothstep(time_s / ramp_s) if ramp_s > 0.0 else 1.0
        command = self._command.copy()
        values: list[float] = []
        clamped: list[str] = []
        for plane, gait in self._parameters.planes.items():
            omega = 2.0 * math.pi * gait.frequency_hz
            self._phase[plane] += omega * elapsed
            phase, lag, joints = self._phase[plane], gait.signed_lag, self._joints[plane]
            wanted = ramp * gait.amplitude, ramp * gait.offset
            amplitude, offset = within_limits(*wanted, *self._limits[plane])
            if amplitude != wanted[0]:
                clamped.append(f"{plane}.A")
            if offset != wanted[1]:
                clamped.append(f"{plane}.offset")
            # Eq. 2: A sin(omega t + (i - 1) phi) + Y
            command[joints] = amplitude * np.sin(phase + np.arange(len(joints)) * lag) + offset
            values += [amplitude, omega, lag, offset, phase]
        return GaitTick(command, np.array(values), WALK, tuple(clamped))
