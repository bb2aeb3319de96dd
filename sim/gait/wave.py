"""One plane's travelling wave: its parameters and which way it runs, and what is logged of it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Annotated, TypeAlias

import numpy as np

from undulog.capture.common.arrays import BoolArray, FloatArray, IntArray
from undulog.capture.common.config import NonNegative
from undulog.capture.common.errors import UsageError
from undulog.capture.common.strict_table import above, at_most
from undulog.capture.robot.model import Plane, Robot

from .contract import CONTROL_RATE_HZ, WALK, GaitTick, Modulation, Readings
from .rhythm import Change, Rhythm, within_limits


class Wave(StrEnum):
    """Which way the bending wave runs along the body."""

    HEAD_TO_TAIL = "head-to-tail"
    TAIL_TO_HEAD = "tail-to-head"


Frequency: TypeAlias = Annotated[float, above(0.0), at_most(CONTROL_RATE_HZ / 4)]
"""A frequency that the control rate can carry [Hz]."""


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

    amplitude: NonNegative
    frequency_hz: Frequency
    lag: NonNegative
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


@dataclass(frozen=True)
class _PlanePart:
    """One driven plane of the robot: its joints, their limits, and what sets their rhythm."""

    plane: Plane
    rhythm: Rhythm
    joints: IntArray
    names: tuple[str, ...]
    lower: FloatArray
    upper: FloatArray

    def cut(self, key: str, wanted: FloatArray, given: FloatArray) -> list[str]:
        """Names of a value that was cut: that of the plane, or those of the joints concerned."""
        differs: BoolArray = wanted != given
        if differs.all():
            return [f"{self.plane}.{key}"]
        return [f"{self.names[i]}.{key}" for i in np.flatnonzero(differs)]


class WaveGenerator:
    """A generator made of one rhythm a plane; joints of the other planes are held straight."""

    def __init__(
        self, rhythms: Mapping[Plane, Rhythm], robot: Robot, *, per_joint: bool = False
    ) -> None:
        """Put the planes together.

        Args:
            rhythms: The driven planes.
            robot: Who is to move.
            per_joint: Tell every joint's own values too: for whoever sets joints apart, by the
                rhythm itself or by :meth:`modulate`. Unlike limits within a plane set them apart
                as well.
        """
        lower, upper = robot.limits()
        self._held = np.clip(np.zeros(len(robot.joints)), lower, upper)
        self._parts: list[_PlanePart] = []
        for plane, rhythm in rhythms.items():
            joints = robot.joint_indices(plane)
            names = tuple(joint.name for joint in robot.joints if joint.plane is plane)
            part = _PlanePart(plane, rhythm, joints, names, lower[joints], upper[joints])
            self._parts.append(part)
        unlike = any(np.ptp(part.lower) + np.ptp(part.upper) > 0.0 for part in self._parts)
        self._per_joint = per_joint or unlike
        self._modulation = Modulation.none(len(robot.joints))

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the values: each driven plane's, then perhaps those of its joints."""
        names: list[str] = []
        for part in self._parts:
            names += [f"{part.plane}.{key}" for key in VALUE_NAMES]
            if self._per_joint:
                names += [f"{joint}.{key}" for key in JOINT_VALUE_NAMES for joint in part.names]
        return tuple(names)

    def modulate(self, modulation: Modulation) -> None:
        """Change the generator from the next step on.

        Args:
            modulation: What to change, until the next call.

        Raises:
            UsageError: If it is of another number of joints or has a value that is not finite.
        """
        given = modulation.amplitude_factor, modulation.offset
        if any(values.shape != self._held.shape for values in given):
            raise UsageError(
                f"a modulation of {given[0].size} factors and {given[1].size} offsets; the robot "
                f"has {self._held.size} joints"
            )
        finite = all(np.isfinite(values).all() for values in given)
        if not (finite and math.isfinite(modulation.frequency_factor)):
            raise UsageError(f"a modulation can't hold NaN or infinity: {modulation}")
        self._modulation = modulation

    def step(self, time_s: float, readings: Readings) -> GaitTick:
        """Advance to a time and say what to do from then on.

        Args:
            time_s: Time since the start [s], never less than in the call before.
            readings: What the robot has told by then.

        Returns:
            Commands and values.
        """
        modulation = self._modulation
        command = self._held.copy()
        values: list[FloatArray] = []
        clamped: list[str] = []
        for part in self._parts:
            joints = part.joints
            change = Change(
                modulation.amplitude_factor[joints],
                modulation.offset[joints],
                modulation.frequency_factor,
            )
            swing = part.rhythm.step(time_s, change, readings)
            amplitude, offset = within_limits(swing.amplitude, swing.offset, part.lower, part.upper)
            clamped += part.cut("A", swing.amplitude, amplitude)
            clamped += part.cut("offset", swing.offset, offset)
            angle = amplitude * np.sin(swing.phase) + offset
            # Rounding of offset + amplitude may pass the limit in the last digit.
            command[joints] = np.minimum(np.maximum(angle, part.lower), part.upper)
            first = amplitude[0], swing.omega, swing.lag, offset[0], swing.phase[0]
            values.append(np.array(first))
            if self._per_joint:
                values += [amplitude, offset, swing.phase]
        return GaitTick(command, np.concatenate(values), WALK, tuple(clamped))
