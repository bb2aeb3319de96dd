"""One plane's travelling wave: its parameters and which way it runs, and what is logged of it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Annotated, NamedTuple, Protocol, TypeAlias

import numpy as np

from undulog.capture.common.arrays import BoolArray, FloatArray, IntArray
from undulog.capture.common.config import NonNegative
from undulog.capture.common.errors import UsageError
from undulog.capture.common.strict_table import above, at_most
from undulog.capture.robot.model import Plane, Robot

from .contract import CONTROL_RATE_HZ, WALK, GaitTick, Modulation, Readings

VALUE_NAMES = ("A", "omega", "lag", "offset", "phase")
"""What is logged of a plane: amplitude [rad], omega [rad/s], signed lag [rad], offset [rad] and
phase [rad], the last two and the amplitude those of the plane's first joint. Where all joints of
the plane are alike, the command of its joint i (from 1) is A sin(phase + (i - 1) lag) + offset."""

JOINT_VALUE_NAMES = ("A", "offset", "phase")
"""What is logged of every driven joint, as ``joint03.A``, where a gait may set joints apart: the
joint's command is A sin(phase) + offset."""


Frequency: TypeAlias = Annotated[float, above(0.0), at_most(CONTROL_RATE_HZ / 4)]
"""A frequency that the control rate can carry [Hz]."""


def smoothstep(x: float) -> float:
    """Rise from 0 to 1 with no slope at either end, 3 x^2 - 2 x^3.

    Args:
        x: Where; clipped to 0 to 1.
    """
    x = min(max(x, 0.0), 1.0)
    return x * x * (3.0 - 2.0 * x)


def started(time_s: float, ramp_s: float) -> float:
    """Share of amplitude and offset that has come by a time: nothing before the start, then all.

    Args:
        time_s: Time since the start [s]; negative before it.
        ramp_s: How long the rise takes [s]; 0: no time at all.

    Returns:
        0 to 1, smooth where ``ramp_s`` is positive.
    """
    if ramp_s > 0.0:
        return smoothstep(time_s / ramp_s)
    return 1.0 if time_s >= 0.0 else 0.0


def within_limits(
    amplitude: FloatArray, offset: FloatArray, lower: FloatArray, upper: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Cut offset, then amplitude, so that offset +- amplitude stays within the limits.

    Each joint is cut by its own limits. The wave keeps its shape: a cut sine would have flat tops,
    and harmonics that no one commanded.

    Args:
        amplitude: Wanted; a negative one is half a turn of phase [rad], shape (n,).
        offset: Wanted [rad], shape (n,).
        lower: Lower limits [rad], shape (n,).
        upper: Upper limits [rad], shape (n,).

    Returns:
        Amplitude and offset [rad], each of shape (n,).
    """
    offset = np.minimum(np.maximum(offset, lower), upper)
    room = np.minimum(upper - offset, offset - lower)
    return np.minimum(np.maximum(amplitude, -room), room), offset


class WaveState(NamedTuple):
    """Wave of the n joints of a plane from one tick on: A sin(phase) + Y.

    Attributes:
        amplitude: A, as wanted: not yet cut to the limits [rad], shape (n,).
        offset: Y, likewise [rad], shape (n,).
        phase: [rad], shape (n,).
        omega: Rate of the plane's phase [rad/s].
        lag: Signed phase from one joint to the next that the gait asks for [rad].
    """

    amplitude: FloatArray
    offset: FloatArray
    phase: FloatArray
    omega: float
    lag: float


class PhaseGenerator(Protocol):
    """One plane's generator of phases, amplitudes and offsets."""

    def step(self, time_s: float, change: Modulation, readings: Readings) -> WaveState:
        """Return the wave from a time on.

        Args:
            time_s: Time since the start [s], never less than in the call before.
            change: In force from this time on.
            readings: Newest readings.

        Returns:
            Wave of the joints.
        """
        ...


class IntegratedPhase:
    """Phi' = omega, with an omega that changes only at ticks: the integral is exact.

    Attributes:
        value: Phi at the time that was advanced to last [rad].
    """

    def __init__(self, phase: float, omega: float) -> None:
        """Start at time zero.

        Args:
            phase: Phi at the start [rad].
            omega: Rate until the first tick says otherwise [rad/s].
        """
        self.value, self._omega, self._time_s = phase, omega, 0.0

    def advance(self, time_s: float, omega: float) -> float:
        """Go on to a time at the rate in force, and take another one from then on.

        Args:
            time_s: Time since the start [s], never less than in the call before.
            omega: Rate from this time on [rad/s].

        Returns:
            Phi at this time [rad].
        """
        self.value += self._omega * (time_s - self._time_s)
        self._omega, self._time_s = omega, time_s
        return self.value


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


@dataclass(frozen=True)
class _PlanePart:
    """One driven plane of the robot: its joints, their limits, and what sets their rhythm."""

    plane: Plane
    rhythm: PhaseGenerator
    joints: IntArray
    names: tuple[str, ...]
    lower: FloatArray
    upper: FloatArray

    def angles(self, swing: WaveState) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Commands, and the amplitudes and offsets that are within the limits."""
        amplitude, offset = within_limits(swing.amplitude, swing.offset, self.lower, self.upper)
        angle = amplitude * np.sin(swing.phase) + offset
        # Rounding of offset + amplitude may pass the limit in the last digit.
        return np.minimum(np.maximum(angle, self.lower), self.upper), amplitude, offset

    def cut(self, key: str, requested: FloatArray, given: FloatArray) -> list[str]:
        """Names of a value that was cut: that of the plane, or those of the joints concerned."""
        differs: BoolArray = requested != given
        if differs.all():
            return [f"{self.plane}.{key}"]
        return [f"{self.names[i]}.{key}" for i in np.flatnonzero(differs)]


class WaveGenerator:
    """A generator made of one rhythm a plane; joints of the other planes are held straight.

    Attributes:
        names: Names of the values: each driven plane's, then perhaps those of its joints.
    """

    def __init__(
        self, rhythms: Mapping[Plane, PhaseGenerator], robot: Robot, *, per_joint: bool = False
    ) -> None:
        """Put the planes together.

        Args:
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
        values: list[str] = []
        for part in self._parts:
            values += [f"{part.plane}.{key}" for key in VALUE_NAMES]
            if self._per_joint:
                values += [f"{joint}.{key}" for key in JOINT_VALUE_NAMES for joint in part.names]
        self.names = tuple(values)
        self._modulation = Modulation.none(len(robot.joints))

    def modulate(self, modulation: Modulation) -> None:
        """Change the generator from the next step on."""
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
        """Return the commands from a time on."""
        modulation = self._modulation
        command = self._held.copy()
        values: list[FloatArray] = []
        clamped: list[str] = []
        for part in self._parts:
            joints = part.joints
            change = Modulation(
                modulation.amplitude_factor[joints],
                modulation.offset[joints],
                modulation.frequency_factor,
            )
            swing = part.rhythm.step(time_s, change, readings)
            command[joints], amplitude, offset = part.angles(swing)
            clamped += part.cut("A", swing.amplitude, amplitude)
            clamped += part.cut("offset", swing.offset, offset)
            first = amplitude[0], swing.omega, swing.lag, offset[0], swing.phase[0]
            values.append(np.array(first))
            if self._per_joint:
                values += [amplitude, offset, swing.phase]
        return GaitTick(command, np.concatenate(values), WALK, tuple(clamped))


@dataclass(frozen=True)
class Serpentine:
    """Parameters of the serpentine gait.

    Attributes:
        planes: The planes that are driven; the joints of the others are held straight.
        ramp_s: Amplitude and offset grow from nothing over this time, smoothly.
    """

    planes: dict[Plane, PlaneGait] = field(default_factory=dict[Plane, PlaneGait])
    ramp_s: NonNegative = 2.0


class SerpentineGait(WaveGenerator):
    """The serpentine generator: every joint computes its own sine."""

    def __init__(self, parameters: Serpentine, robot: Robot, *, per_joint: bool = False) -> None:
        """Start at time zero with straight joints.

        Args:
            robot: Who is to do it.
            per_joint: Tell every joint's own values too, for a controller that sets them apart.
        """
        rhythms = {
            plane: _SerpentineRhythm(wave, parameters.ramp_s, len(robot.joint_indices(plane)))
            for plane, wave in parameters.planes.items()
        }
        super().__init__(rhythms, robot, per_joint=per_joint)
        self._rhythms = rhythms

    def commands(self, times_s: FloatArray) -> FloatArray:
        """Return the commands of many ticks at once, unmodulated; the generator stays as it is.

        Args:
            times_s: Times since the start, from 0 on, ascending [s], shape (k,).

        Returns:
            As :meth:`step` gives them one after the other [rad], shape (k, m).
        """
        command = np.tile(self._held, (len(times_s), 1))
        for part in self._parts:
            command[:, part.joints] = part.angles(self._rhythms[part.plane].waves(times_s))[0]
        return command


class _SerpentineRhythm:
    """Eq. 2, or Eq. 6: A sin(Phi(t) + (i - 1) phi) + Y, Phi(0) = phi_0."""

    def __init__(self, wave: PlaneGait, ramp_s: float, joint_count: int) -> None:
        self._wave, self._ramp_s = wave, ramp_s
        self._omega = 2.0 * math.pi * wave.frequency_hz
        self._phase = IntegratedPhase(wave.phase, self._omega)
        self._lags = np.arange(joint_count, dtype=np.float64) * wave.signed_lag

    def step(self, time_s: float, change: Modulation, readings: Readings) -> WaveState:  # noqa: ARG002
        wave, ramp = self._wave, started(time_s, self._ramp_s)
        omega = self._omega * change.frequency_factor
        return WaveState(
            amplitude=ramp * wave.amplitude * change.amplitude_factor,
            offset=ramp * wave.offset + change.offset,
            phase=self._phase.advance(time_s, omega) + self._lags,
            omega=omega,
            lag=wave.signed_lag,
        )

    def waves(self, times_s: FloatArray) -> WaveState:
        """Return the unmodulated waves of ticks, a leading axis of time."""
        wave = self._wave
        ramp = np.array([[started(time_s, self._ramp_s)] for time_s in times_s.tolist()])
        passed = self._omega * np.diff(times_s, prepend=0.0)
        phase = np.cumsum(np.concatenate([[wave.phase], passed]))[1:]  # added up as in step
        return WaveState(
            amplitude=ramp * wave.amplitude * np.ones_like(self._lags),
            offset=ramp * wave.offset * np.ones_like(self._lags),
            phase=phase[:, np.newaxis] + self._lags,
            omega=self._omega,
            lag=wave.signed_lag,
        )
