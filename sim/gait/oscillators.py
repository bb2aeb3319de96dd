"""The oscillator generator: each plane a chain of coupled oscillators, perhaps felt back.

Eq. 1 of Meister, Stepanenko & Kernbach 2011 for the joints of each plane. Joint i is commanded
A_i r_i sin(phi_i) + Y_i; A and Y follow what is asked for by :class:`Approach`, so that nothing
jumps, and begin at zero.

With feedback each oscillator turns by what its own servo reports,

    phi_i' = omega_i + eps (2 ((q_i - Y_i) / A) cos phi_i - b_i) + coupling,

A the plane's own amplitude: of a response q_i - Y_i = g_i A sin(phi_i + delta_i) a cycle leaves
eps (g_i sin(delta_i) - b_i), and a steady b_i = g_i sin(delta_i) removes what is constant of it.
The angles are those last reported, so delta_i holds their age too; a joint that has reported
nothing yet is not fed back.

Locked phases contain no information on their coupling. Kicks reveal it: at intervals each phase
jumps by a random amount, and the way back shows the coupling.

Chains of coupled oscillators, Eq. 1 of Meister, Stepanenko & Kernbach 2011, integrated.

x_i' = f(x_i, a) + phi(x_{i-1}, x_{i+1}, b) with open ends: the first and the last have one
neighbour. Ijspeert, Neural Networks 21, 642 (2008), reviews both kinds of oscillator.

All states are in a frame that turns with the common phase Phi' = omega, which coupling does not
see: only what sets an oscillator apart from Phi is integrated numerically.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Annotated, Any, TypeAlias, TypeVar

import numpy as np

from undulog.capture.common.arrays import ComplexArray, FloatArray, IntArray
from undulog.capture.common.config import NonNegative
from undulog.capture.common.strict_table import above, at_least, at_most
from undulog.capture.robot.model import Plane, Robot

from .contract import CONTROL_RATE_HZ, Modulation, Readings
from .wave import IntegratedPhase, PlaneGait, WaveGenerator, WaveState

_State = TypeVar("_State", FloatArray, ComplexArray)

Extra = Callable[[float, FloatArray], FloatArray]
"""Further rates of the phases [rad/s], given the time since the start of the advance [s] and the
phases in the turning frame [rad]."""

STEP_OF_FASTEST = 0.2
"""Longest step, as a share of the shortest time constant that the rates' bound allows: a step of
the classical Runge-Kutta method then errs by (0.2)^5/120 = 3e-6 of a deviation at most."""

_STRONGEST = float(CONTROL_RATE_HZ)  # greatest coupling, feedback and rate of an oscillator [1/s]

_SAME_TIME_S = 1e-9  # rounding of times: a kick comes no tick late for it


Numbers: TypeAlias = float | tuple[float, ...]
"""One number for all, or one for each."""

Rates: TypeAlias = Annotated[Numbers, at_least(-_STRONGEST), at_most(_STRONGEST)]

PositiveRate: TypeAlias = Annotated[float, above(0.0), at_most(_STRONGEST)]


@dataclass(frozen=True)
class NeighbourCoupling:
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


def phase_rates(theta: FloatArray, coupling: NeighbourCoupling) -> FloatArray:
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


def hopf_rates(z: ComplexArray, coupling: NeighbourCoupling, attraction: float) -> ComplexArray:
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
        x = x + h / 6 * (k1 + 2.0 * k2 + 2.0 * k3 + rate(t + h, x + h * k3))
    return x


class PhaseOscillators:
    """phi_i' = omega + extra_i + sum_j K_ij sin(phi_j - phi_i - psi_ij).

    Attributes:
        theta: Phases in the turning frame, without jumps [rad], shape (n,).
        radius: Radii in units of the limit cycle's, shape (n,).
    """

    def __init__(self, theta: FloatArray, coupling: NeighbourCoupling) -> None:
        """Start at given phases.

        Args:
            theta: [rad], shape (n,).
        """
        self.theta, self._coupling = theta, coupling
        self.radius = np.ones_like(theta)

    def advance(self, span_s: float, extra: Extra, fastest: float) -> None:
        """Advance the state.

        Args:
            span_s: For how long [s].
            extra: Further rates of the phases.
            fastest: Bound of the rates that these cause [1/s].
        """
        coupling = self._coupling

        def rate(time_s: float, theta: FloatArray) -> FloatArray:
            return extra(time_s, theta) + phase_rates(theta, coupling)

        self.theta = integrate(rate, self.theta, span_s, fastest + coupling.fastest)

    def kick(self, turn: FloatArray) -> None:
        """Turn each oscillator at once, by angles [rad], shape (n,); radii stay."""
        self.theta = self.theta + turn


class HopfOscillators:
    """Hopf oscillators, :func:`hopf_rates`, with the extra rates turning each one's phase."""

    def __init__(self, theta: FloatArray, coupling: NeighbourCoupling, attraction: float) -> None:
        """Start on the limit cycle at given phases.

        Args:
            theta: [rad], shape (n,).
            attraction: alpha [1/s].
        """
        self.theta, self._coupling, self._attraction = theta, coupling, attraction
        self._z: ComplexArray = np.exp(1j * theta)

    @property
    def radius(self) -> FloatArray:
        """Radii, 1 on the limit cycle, shape (n,)."""
        return np.abs(self._z)

    def advance(self, span_s: float, extra: Extra, fastest: float) -> None:
        """Advance the state, as :meth:`PhaseOscillators.advance`."""
        coupling, attraction = self._coupling, self._attraction

        def rate(time_s: float, z: ComplexArray) -> ComplexArray:
            return (1j * extra(time_s, np.angle(z)) * z) + hopf_rates(z, coupling, attraction)

        before = self._z
        self._z = integrate(rate, before, span_s, fastest + coupling.fastest + 2.0 * attraction)
        self.theta = self.theta + np.angle(self._z * np.conj(before))

    def kick(self, turn: FloatArray) -> None:
        """Turn each oscillator at once, by angles [rad], shape (n,); radii stay."""
        self._z = self._z * np.exp(1j * turn)
        self.theta = self.theta + turn


class Approach:
    """r'' = g (g (R - r) - 2 r'): critically damped, for each of n values.

    The amplitude law of Ijspeert, Crespi, Ryczko & Cabelguen, Science 315, 1416 (2007), with
    a = 2 g. R changes only at ticks, so the closed form is exact.
    """

    def __init__(self, start: FloatArray, rate: float) -> None:
        """Rest at a value.

        Args:
            start: The values, shape (n,).
            rate: g [1/s].
        """
        self.value = start
        self._target = start
        self._velocity = np.zeros_like(start)
        self._rate = rate

    def advance(self, elapsed_s: float) -> FloatArray:
        """Go on towards the target in force.

        Args:
            elapsed_s: For how long [s].

        Returns:
            The values reached, shape (n,).
        """
        g, error = self._rate, self.value - self._target
        slope = self._velocity + g * error
        decay = np.exp(-g * elapsed_s)
        self.value = self._target + (error + slope * elapsed_s) * decay
        self._velocity = (self._velocity - g * slope * elapsed_s) * decay
        return self.value

    def aim(self, target: FloatArray) -> None:
        """Take another target from now on.

        Args:
            target: R, shape (n,).
        """
        self._target = target


class OscillatorKind(StrEnum):
    """What each oscillator is."""

    PHASE = "phase"
    HOPF = "hopf"


@dataclass(frozen=True)
class OscillatorChain(PlaneGait):
    """One plane's chain of n oscillators; ``lag`` and ``phase`` are the pattern it starts in.

    Attributes:
        oscillator: Phase or Hopf oscillators.
        forward: b_f, of joint i on joint i + 1 [1/s], one number or n - 1.
        backward: b_b, of joint i + 1 on joint i [1/s], one number or n - 1.
        detuning: omega_i - omega [rad/s], one number or n.
        start_phase: Deviation from the pattern at the start [rad], one number or n.
        approach_rate: Of amplitude and offset towards what is asked for [1/s].
        attraction: alpha of Hopf oscillators [1/s].
        feedback: eps [1/s].
        feedback_bias: b, one number or n.
        kick_every_s: Time from the start to the first kick and from one to the next, of which
            at most one comes in a control period; 0: no kicks.
        kick_size: Largest jump of a phase; each is drawn evenly up to it [rad].
        kick_seed: Of these jumps; one seed gives the same in every run.
    """

    oscillator: OscillatorKind = OscillatorKind.PHASE
    forward: Rates = 5.0
    backward: Rates = 5.0
    detuning: Rates = 0.0
    start_phase: Numbers = 0.0
    approach_rate: PositiveRate = 4.0
    attraction: PositiveRate = 5.0
    feedback: Annotated[float, at_least(0.0), at_most(_STRONGEST)] = 0.0
    feedback_bias: Numbers = 0.0
    kick_every_s: NonNegative = 0.0
    kick_size: NonNegative = 0.0
    kick_seed: Annotated[int, at_least(0)] = 1

    def contradictions(self) -> Iterator[tuple[str, str]]:
        """Feedback is measured against an amplitude."""
        if self.feedback > 0.0 and self.amplitude == 0.0:
            yield "amplitude", "> 0 with feedback, which is measured against it"


@dataclass(frozen=True)
class OscillatorChains:
    """Parameters of the oscillator gait.

    Attributes:
        planes: The planes that are driven; the joints of the others are held straight.
    """

    planes: dict[Plane, OscillatorChain] = field(default_factory=dict[Plane, OscillatorChain])


class OscillatorGait(WaveGenerator):
    """The oscillator generator; it always logs the values of every joint."""

    def __init__(self, parameters: OscillatorChains, robot: Robot) -> None:
        """Start at time zero with straight joints.

        Args:
            robot: Who is to do it.
        """
        rhythms = {
            plane: _OscillatorRhythm(chain, robot.joint_indices(plane))
            for plane, chain in parameters.planes.items()
        }
        super().__init__(rhythms, robot, per_joint=True)


class _OscillatorRhythm:
    """One plane's chain."""

    def __init__(self, chain: OscillatorChain, joints: IntArray) -> None:
        n = len(joints)
        self._chain, self._joints = chain, joints
        self._omega = 2.0 * math.pi * chain.frequency_hz
        self._phase = IntegratedPhase(chain.phase, self._omega)
        self._bias = np.broadcast_to(chain.feedback_bias, n)
        self._detuning = np.broadcast_to(chain.detuning, n)
        coupling = NeighbourCoupling(
            np.broadcast_to(chain.forward, n - 1),
            np.broadcast_to(chain.backward, n - 1),
            chain.signed_lag,
        )
        start = np.arange(n, dtype=np.float64) * chain.signed_lag + np.broadcast_to(
            chain.start_phase, n
        )
        self._oscillators = (
            HopfOscillators(start, coupling, chain.attraction)
            if chain.oscillator is OscillatorKind.HOPF
            else PhaseOscillators(start, coupling)
        )
        self._amplitude = Approach(np.zeros(n), chain.approach_rate)
        self._offset = Approach(np.zeros(n), chain.approach_rate)
        self._random, self._kicks = np.random.default_rng(chain.kick_seed), 0
        # What is in force until the next tick.
        self._time_s, self._factor = 0.0, 1.0
        self._felt, self._steady = np.zeros(n), np.zeros(n)

    def step(self, time_s: float, change: Modulation, readings: Readings) -> WaveState:
        chain, elapsed = self._chain, time_s - self._time_s
        self._turn(elapsed)
        self._kick(time_s)
        amplitude, offset = self._amplitude.advance(elapsed), self._offset.advance(elapsed)
        self._amplitude.aim(chain.amplitude * change.amplitude_factor)
        self._offset.aim(chain.offset + change.offset)
        self._time_s, self._factor = time_s, change.frequency_factor
        omega = self._omega * self._factor
        common = self._phase.advance(time_s, omega)
        if chain.feedback > 0.0:
            self._feel(readings.angle[self._joints], offset)
        return WaveState(
            amplitude=amplitude * self._oscillators.radius,
            offset=offset,
            phase=common + self._oscillators.theta,
            omega=omega,
            lag=chain.signed_lag,
        )

    def _feel(self, angle: FloatArray, offset: FloatArray) -> None:
        """Take the servos' reports; joints without one are left out."""
        finite = np.isfinite(angle)
        eps = self._chain.feedback
        self._felt = eps * 2.0 * np.where(finite, angle - offset, 0.0) / self._chain.amplitude
        self._steady = np.where(finite, eps * self._bias, 0.0)

    def _kick(self, time_s: float) -> None:
        """Make the kick whose time has come; at most one a control period."""
        every, size = self._chain.kick_every_s, self._chain.kick_size
        if every > 0.0:
            due = (time_s + _SAME_TIME_S) / every  # times to kick so far
            if due >= self._kicks + 1:
                self._kicks = np.floor(due)
                self._oscillators.kick(self._random.uniform(-size, size, len(self._joints)))

    def _turn(self, elapsed_s: float) -> None:
        """Advance the oscillators by what has been in force since the last tick."""
        omega, phase = self._omega * self._factor, self._phase.value
        detuning, felt, steady = self._factor * self._detuning, self._felt, self._steady

        def constant(_time_s: float, _theta: FloatArray) -> FloatArray:
            return detuning

        def sensed(time_s: float, theta: FloatArray) -> FloatArray:
            return detuning + felt * np.cos(phase + omega * time_s + theta) - steady

        if self._chain.feedback > 0.0:
            self._oscillators.advance(elapsed_s, sensed, abs(omega) + float(np.abs(felt).max()))
        else:
            self._oscillators.advance(elapsed_s, constant, 0.0)
