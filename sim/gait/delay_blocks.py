"""The delay-block generator: one master sine, passed from joint to joint through delays.

The other way in which Meister, Stepanenko & Kernbach 2011 make the phase shift (their Simulink
model): joint i of the plane gives out what the master was (i - 1) tau ago,

    A(t') sin(Phi(t')) + Y(t'),  t' = t - (i - 1) tau,

with A and Y as the start's ramp makes them. While omega is constant this is Eq. 2 with the lag
phi = omega tau, on every joint once its delay is over. A change of omega reaches joint i only
(i - 1) tau later, where Eq. 2 changes all joints at once, and leaves another lag behind it.

The master stood still before the start, so a joint rests until its delay is over. A controller's
amplitude factors and offsets act at the joint, behind its delay; the frequency factor acts on the
master.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Annotated

import numpy as np

from undulog.capture.common.arrays import FloatArray
from undulog.capture.common.config import NonNegative
from undulog.capture.common.strict_table import at_least, at_most
from undulog.capture.robot.model import Plane, Robot

from .contract import Modulation, Readings
from .wave import Frequency, IntegratedPhase, Wave, WaveGenerator, WaveState, started


@dataclass(frozen=True)
class DelayLine:
    """The master of one plane, and the delays behind it.

    Attributes:
        amplitude: A [rad].
        frequency_hz: omega / 2 pi.
        delay_s: tau, from one joint of the plane to the next, not negative [s].
        wave: Which way the wave runs: from the head, the first joint is the master; from the tail,
            the last.
        offset: Y, bends the whole body [rad].
        phase: Phase of the master at the start [rad].
    """

    amplitude: NonNegative
    frequency_hz: Frequency
    delay_s: Annotated[float, at_least(0.0), at_most(10.0)]
    wave: Wave = Wave.HEAD_TO_TAIL
    offset: float = 0.0
    phase: float = 0.0

    def delays(self, joint_count: int) -> FloatArray:
        """How long each joint is behind the master.

        Args:
            joint_count: n.

        Returns:
            Delays, head to tail [s], shape (n,).
        """
        behind = self.delay_s * np.arange(joint_count, dtype=np.float64)
        return behind if self.wave is Wave.HEAD_TO_TAIL else behind[::-1]


@dataclass(frozen=True)
class DelayBlocks:
    """Parameters of the delay-block gait.

    Attributes:
        planes: The planes that are driven; the joints of the others are held straight.
        ramp_s: The master's amplitude and offset grow from nothing over this time, smoothly.
    """

    planes: dict[Plane, DelayLine] = field(default_factory=dict[Plane, DelayLine])
    ramp_s: NonNegative = 2.0


class DelayBlockGait(WaveGenerator):
    """The delay-block generator; it always logs the values of every joint."""

    def __init__(self, parameters: DelayBlocks, robot: Robot) -> None:
        """Start at time zero with straight joints.

        Args:
            robot: Who is to do it.
        """
        rhythms = {
            plane: _DelayRhythm(line, parameters.ramp_s, len(robot.joint_indices(plane)))
            for plane, line in parameters.planes.items()
        }
        super().__init__(rhythms, robot, per_joint=True)


class DelayedPhase:
    """The integrated phase of the recent past.

    omega is constant between ticks, so Phi is linear there: joining the ticks by straight lines
    gives Phi(t - tau) exactly, at any delay.
    """

    def __init__(self, phase: float, omega: float, span_s: float) -> None:
        """Start at time zero; before it, the phase stood still.

        Args:
            phase: Phi at the start [rad].
            omega: Rate until the first tick says otherwise [rad/s].
            span_s: How far back it must reach [s].
        """
        self._now = IntegratedPhase(phase, omega)
        self._span_s = span_s
        self._knots = np.zeros((2, 256))  # times, phases
        self._knots[1, 0] = phase
        self._count = 1

    def advance(self, time_s: float, omega: float) -> None:
        """Go on to a time, and run at another rate from then on.

        Args:
            time_s: Time since the start [s], never less than in the call before.
            omega: Rate from this time on [rad/s].
        """
        if self._count == self._knots.shape[1]:
            self._make_room(time_s - self._span_s)
        self._knots[:, self._count] = time_s, self._now.advance(time_s, omega)
        self._count += 1

    def at(self, time_s: FloatArray) -> FloatArray:
        """The phase at past times.

        Args:
            time_s: Times, no more than the span back from the last tick [s], any shape.

        Returns:
            Phi [rad], of the same shape.
        """
        times: FloatArray = self._knots[0, : self._count]
        phases: FloatArray = self._knots[1, : self._count]
        return np.interp(time_s, times, phases)

    def _make_room(self, earliest_s: float) -> None:
        """Forget what lies before a time, but for the knot that starts the line over it."""
        times = self._knots[0, : self._count]
        first = max(int(np.searchsorted(times, earliest_s, side="right")) - 1, 0)
        kept = self._knots[:, first : self._count]
        self._count = kept.shape[1]
        room = self._knots if 2 * self._count <= times.size else np.zeros((2, 2 * times.size))
        room[:, : self._count] = kept.copy()
        self._knots = room


class _DelayRhythm:
    """One plane's master and its delays."""

    def __init__(self, line: DelayLine, ramp_s: float, joint_count: int) -> None:
        self._line, self._ramp_s = line, ramp_s
        self._delays = line.delays(joint_count)
        self._omega = 2.0 * math.pi * line.frequency_hz
        self._history = DelayedPhase(line.phase, self._omega, float(self._delays.max()))
        self._sign = -1.0 if line.wave is Wave.HEAD_TO_TAIL else 1.0

    def step(self, time_s: float, change: Modulation, readings: Readings) -> WaveState:  # noqa: ARG002
        line = self._line
        omega = self._omega * change.frequency_factor
        self._history.advance(time_s, omega)
        then = time_s - self._delays
        ramp = np.array([started(instant, self._ramp_s) for instant in then.tolist()])
        return WaveState(
            amplitude=ramp * line.amplitude * change.amplitude_factor,
            offset=ramp * line.offset + change.offset,
            phase=self._history.at(then),
            omega=omega,
            lag=self._sign * omega * line.delay_s,
        )
