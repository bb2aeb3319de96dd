"""What one plane's wave does from tick to tick, before it is kept within the joints' limits."""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np

from undulog.capture.common.arrays import FloatArray

from .contract import Readings


def smoothstep(x: float) -> float:
    """Rise from 0 to 1 with no slope at either end, 3 x^2 - 2 x^3.

    Args:
        x: Where; clipped to 0 to 1.

    Returns:
        The value.
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


class Change(NamedTuple):
    """The part of a :class:`~.sim.gait.contract.Modulation` that concerns one plane.

    Attributes:
        amplitude_factor: Multiplies each joint's amplitude, shape (n,).
        offset: Added to each joint's offset [rad], shape (n,).
        frequency_factor: Multiplies omega.
    """

    amplitude_factor: FloatArray
    offset: FloatArray
    frequency_factor: float


class Swing(NamedTuple):
    """What the n joints of a plane are to do from one tick on: A sin(phase) + Y.

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


class Rhythm(Protocol):
    """One plane's generator of phases, amplitudes and offsets."""

    def step(self, time_s: float, change: Change, readings: Readings) -> Swing:
        """Advance to a time and say what to do from then on.

        Args:
            time_s: Time since the start [s], never less than in the call before.
            change: In force from this time on.
            readings: What the robot has told by then.

        Returns:
            What the joints are to do.
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
