"""Chains of coupled oscillators, Eq. 1 of Meister, Stepanenko & Kernbach 2011, integrated.

x_i' = f(x_i, a) + phi(x_{i-1}, x_{i+1}, b) with open ends: the first and the last have one
neighbour. Ijspeert, Neural Networks 21, 642 (2008), reviews both kinds of oscillator.

All states are in a frame that turns with the common phase Phi' = omega, which coupling does not
see: only what sets an oscillator apart from Phi is integrated numerically.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol, TypeVar

import numpy as np

from undulog.capture.common.arrays import ComplexArray, FloatArray

_State = TypeVar("_State", FloatArray, ComplexArray)

Extra = Callable[[float, FloatArray], FloatArray]
"""Further rates of the phases [rad/s], given the time since the start of the advance [s] and the
phases in the turning frame [rad]."""

STEP_OF_FASTEST = 0.2
"""Longest step, as a share of the shortest time constant that the rates' bound allows: a step of
the classical Runge-Kutta method then errs by (0.2)^5/120 = 3e-6 of a deviation at most."""


@dataclass(frozen=True)
class Coupling:
    """What neighbours do to each other.

    Attributes:
        forward: b_f: of oscillator i on i + 1, so towards the tail [1/s], shape (n - 1,).
        backward: b_b: of oscillator i + 1 on i, towards the head [1/s], shape (n - 1,).
        lag: psi, the difference phi_{i+1} - phi_i that every pair is drawn to [rad].
    """

    forward: FloatArray
    backward: FloatArray
    lag: float

    @property
    def fastest(self) -> float:
        """Bound of the rates that it causes [1/s]: twice the greatest sum on one oscillator."""
        pull = np.zeros(len(self.forward) + 1)
        pull[1:] += np.abs(self.forward)
        pull[:-1] += np.abs(self.backward)
        return 2.0 * float(pull.max())


def phase_rates(theta: FloatArray, coupling: Coupling) -> FloatArray:
    """phi_i' = sum_j K_ij sin(phi_j - phi_i - psi_ij), psi_ij = (j - i) psi, |j - i| = 1.

    Args:
        theta: Phases [rad], shape (n,).
        coupling: K.

    Returns:
        Their rates [rad/s], shape (n,).
    """
    pull = np.sin(theta[1:] - theta[:-1] - coupling.lag)
    rate = np.empty_like(theta)
    rate[-1] = 0.0
    np.multiply(coupling.backward, pull, out=rate[:-1])
    rate[1:] -= coupling.forward * pull
    return rate


def hopf_rates(z: ComplexArray, coupling: Coupling, attraction: float) -> ComplexArray:
    """z_i' = alpha (mu - |z_i|^2) z_i + sum_j K_ij (z_j exp(-i psi_ij) - z_i), mu = 1.

    With z = x + i y and i omega z, which the turning frame leaves out, the first part is the Hopf
    oscillator x' = alpha (mu - r^2) x - omega y, y' = alpha (mu - r^2) y + omega x of Righetti &
    Ijspeert (ICRA 2008). The coupling turns the neighbour by the wanted lag and vanishes in the
    wanted pattern, so the limit cycle keeps its radius sqrt(mu) there.

    Args:
        z: States, in units of the limit cycle's radius, shape (n,).
        coupling: K.
        attraction: alpha [1/s]; deviations of the radius decay at 2 alpha.

    Returns:
        Their rates [1/s], shape (n,).
    """
    turn = complex(math.cos(coupling.lag), math.sin(coupling.lag))
    rate = attraction * (1.0 - np.abs(z) ** 2) * z
    rate[:-1] += coupling.backward * (z[1:] * turn.conjugate() - z[:-1])
    rate[1:] += coupling.forward * (z[:-1] * turn - z[1:])
    return rate


def integrate(
    rate: Callable[[float, _State], _State], state: _State, span_s: float, fastest: float
) -> _State:
    """Advance a state by the classical Runge-Kutta method of fourth order, in equal steps.

    Args:
        rate: Of the time since the start [s] and the state.
        state: At the start.
        span_s: How far [s].
        fastest: Bound of the rates of change [1/s]; sets the number of steps.

    Returns:
        The state at the end.
    """
    count = max(math.ceil(span_s * fastest / STEP_OF_FASTEST), 1)
    h = span_s / count
    x: Any = state  # an array, real or complex
    for k in range(count):
        t = k * h
        k1 = rate(t, x)
        k2 = rate(t + h / 2, x + h / 2 * k1)
        k3 = rate(t + h / 2, x + h / 2 * k2)
        k4 = rate(t + h, x + h * k3)
        x = x + h / 6 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
    return x


class Oscillators(Protocol):
    """A chain's state: phases, and radii in units of the limit cycle's."""

    @property
    def theta(self) -> FloatArray:
        """Phases in the turning frame, without jumps [rad], shape (n,)."""
        ...

    @property
    def radius(self) -> FloatArray:
        """Radii, 1 on the limit cycle, shape (n,)."""
        ...

    def advance(self, span_s: float, extra: Extra, fastest: float) -> None:
        """Go on for a time.

        Args:
            span_s: How long [s].
            extra: Further rates of the phases.
            fastest: Bound of the rates that these cause [1/s].
        """
        ...

    def kick(self, turn: FloatArray) -> None:
        """Turn each oscillator at once; radii stay.

        Args:
            turn: Added to the phases [rad], shape (n,).
        """
        ...


class PhaseOscillators:
    """phi_i' = omega + extra_i + sum_j K_ij sin(phi_j - phi_i - psi_ij)."""

    def __init__(self, theta: FloatArray, coupling: Coupling) -> None:
        """Start at given phases.

        Args:
            theta: [rad], shape (n,).
            coupling: What neighbours do.
        """
        self.theta, self._coupling = theta, coupling
        self.radius = np.ones_like(theta)

    def advance(self, span_s: float, extra: Extra, fastest: float) -> None:
        """Go on for a time, see :class:`Oscillators`."""
        coupling = self._coupling

        def rate(time_s: float, theta: FloatArray) -> FloatArray:
            return extra(time_s, theta) + phase_rates(theta, coupling)

        self.theta = integrate(rate, self.theta, span_s, fastest + coupling.fastest)

    def kick(self, turn: FloatArray) -> None:
        """Turn each at once, see :class:`Oscillators`."""
        self.theta = self.theta + turn


class HopfOscillators:
    """Hopf oscillators, :func:`hopf_rates`, with the extra rates turning each one's phase."""

    def __init__(self, theta: FloatArray, coupling: Coupling, attraction: float) -> None:
        """Start on the limit cycle at given phases.

        Args:
            theta: [rad], shape (n,).
            coupling: What neighbours do.
            attraction: alpha [1/s].
        """
        self.theta, self._coupling, self._attraction = theta, coupling, attraction
        self._z: ComplexArray = np.exp(1j * theta)

    @property
    def radius(self) -> FloatArray:
        """Radii, 1 on the limit cycle, shape (n,)."""
        return np.abs(self._z)

    def advance(self, span_s: float, extra: Extra, fastest: float) -> None:
        """Go on for a time, see :class:`Oscillators`."""
        coupling, attraction = self._coupling, self._attraction

        def rate(time_s: float, z: ComplexArray) -> ComplexArray:
            turning = 1j * extra(time_s, np.angle(z)) * z
            return turning + hopf_rates(z, coupling, attraction)

        before = self._z
        bound = fastest + coupling.fastest + 2.0 * attraction
        self._z = integrate(rate, before, span_s, bound)
        self.theta = self.theta + np.angle(self._z * np.conj(before))

    def kick(self, turn: FloatArray) -> None:
        """Turn each at once, see :class:`Oscillators`."""
        self._z = self._z * np.exp(1j * turn)
        self.theta = self.theta + turn
