"""What one plane's wave does from tick to tick, before it is kept within the joints' limits."""

from __future__ import annotations

from typing import NamedTuple, Protocol

from undulog.capture.common.arrays import FloatArray

from .readings import Readings


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
