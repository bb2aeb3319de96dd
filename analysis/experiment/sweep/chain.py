"""The linear coupling of a chain: H from commands and responses, Z from responses and torques.

Over r runs at one frequency, with complex amplitudes as columns, commands C, responses Y and joint
torques T, all of shape (m, r)::

    Y = H C        H = Y C^+
    T = Z Y        Z = T Y^+

Z is the body's impedance as its joints see it, torque on the joint per angle: of a free chain
-w^2 (M_qq - M_qb M_bb^-1 M_bq). It needs no model of the servo, which may even be nonlinear. A
servo that is linear, T = D_r C - D_q Y, closes the loop to H = (Z + D_q)^-1 D_r, so where its
parameters are known

    Z = D_r H^-1 - D_q

For a DC servo with a series-elastic gear, without Coulomb friction and play (kappa = Kt V Kp / R),
from its equations of motion::

    M = -w^2 Jm + j w (b + Kt^2 / R)     G = k_g + j w c_g
    D_r = G kappa / (M + G)              D_q = G (kappa + M) / (M + G)

Errors are propagated to first order from the noise of each run's amplitudes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import stdtrit

from undulog.capture.common.arrays import ComplexArray, FloatArray
from undulog.capture.robot.model import Servo

from ...estimators.intervals import CONFIDENCE, DRAWS, welch_satterthwaite


@dataclass(frozen=True)
class Phasors:
    """Complex amplitudes of m joints in r runs.

    Attributes:
        value: Shape (m, r).
        variance: Of their real and of their imaginary parts, shape (m, r).
        dof: Degrees of freedom of the variances, shape (m, r).
    """

    value: ComplexArray
    variance: FloatArray
    dof: FloatArray

    def draws(self, seed: int) -> ComplexArray:
        """Errors that they may have.

        Returns:
            Student draws, shape (DRAWS, m, r).
        """
        random = np.random.default_rng(seed)
        dof = np.broadcast_to(self.dof, (DRAWS, *self.dof.shape))
        real, imag = random.standard_t(dof), random.standard_t(dof)
        return (np.sqrt(self.variance) * (real + 1j * imag)).astype(np.complex128)


@dataclass(frozen=True)
class MeasuredMatrix:
    """A complex matrix with standard errors.

    Attributes:
        value: Shape (m, m), row = answering joint.
        error: Of the real and of the imaginary part of each element, shape (m, m).
        dof: Degrees of freedom of the errors, shape (m, m).
        condition_number: Of the matrix that was inverted for it: what its inversion may multiply
            relative errors by.
        draws: Errors that the whole matrix may have, shape (DRAWS, m, m).
    """

    value: ComplexArray
    error: FloatArray
    dof: FloatArray
    condition_number: float
    draws: ComplexArray

    @property
    def half(self) -> FloatArray:
        """Half widths of the 95 % intervals of real and imaginary parts, shape (m, m)."""
        return self.error * stdtrit(self.dof, 0.5 + CONFIDENCE / 2)


@dataclass(frozen=True)
class ServoSide:
    """What m linear servos do: T = D_r C - D_q Y.

    Attributes:
        D_r: Torque per command [N m/rad], shape (m,).
        D_q: Torque against the joint's angle [N m/rad], shape (m,).
    """

    D_r: ComplexArray
    D_q: ComplexArray


def transfer(command: ComplexArray, response: Phasors, seed: int = 21) -> MeasuredMatrix:
    """H = Y C^+, the commands taken as exact.

    Args:
        command: C, of full rank, shape (m, r), r >= m.
        response: Y.

    Returns:
        H [rad/rad]. With C a DFT matrix of amplitude A and white noise sigma in N samples a run,
        abs(error of an element) has the standard deviation 2 sigma / (A sqrt(N m)).
    """
    weights: ComplexArray = np.linalg.pinv(command).astype(np.complex128)
    power = np.abs(weights) ** 2
    return MeasuredMatrix(
        (response.value @ weights).astype(np.complex128),
        np.sqrt(response.variance @ power),
        _dof(response.variance, response.dof, power),
        float(np.linalg.cond(command)),
        response.draws(seed) @ weights,
    )


def impedance(response: Phasors, torque: Phasors, seed: int = 22) -> MeasuredMatrix:
    """Z = T Y^+.

    Args:
        response: Y, of full rank.
        torque: T on the joints, positive in the direction of positive angles [N m].

    Returns:
        Z [N m/rad].
    """
    weights: ComplexArray = np.linalg.pinv(response.value).astype(np.complex128)
    power = np.abs(weights) ** 2
    Z: ComplexArray = (torque.value @ weights).astype(np.complex128)
    through = np.abs(Z) ** 2 @ response.variance  # of the responses' noise, seen as torque
    variance = torque.variance + through
    parts = np.stack([torque.variance, through])
    # A joint's torque with its own few bins, the responses together with no fewer than the least.
    least = np.broadcast_to(response.dof.min(axis=0), torque.dof.shape)
    dof = welch_satterthwaite(parts, np.stack([torque.dof, least]))
    return MeasuredMatrix(
        Z,
        np.sqrt(variance @ power),
        _dof(variance, dof, power),
        float(np.linalg.cond(response.value)),
        (torque.draws(seed) - Z @ response.draws(seed + 1)) @ weights,
    )


def inverse(H: MeasuredMatrix) -> ComplexArray:
    """Errors that H^-1 may have.

    Returns:
        Shape (DRAWS, m, m).
    """
    X = np.linalg.inv(H.value)
    return (np.linalg.inv(H.value + H.draws) - X).astype(np.complex128)


def impedance_behind_servos(H: MeasuredMatrix, servos: ServoSide) -> MeasuredMatrix:
    """Z = D_r H^-1 - D_q.

    Args:
        H: Of the commands as the servos hold them; regular.

    Returns:
        Z [N m/rad]; to first order var X_ij = sum_kl abs(X_ik)^2 var H_kl abs(X_lj)^2, columns of H
        taken as independent.
    """
    X: ComplexArray = np.linalg.inv(H.value).astype(np.complex128)
    size = np.abs(X) ** 2
    scale = np.abs(servos.D_r)[:, None]
    error = scale * np.sqrt(size @ H.error**2 @ size)
    return MeasuredMatrix(
        (servos.D_r[:, None] * X - np.diag(servos.D_q)).astype(np.complex128),
        error,
        np.full_like(error, float(H.dof.min())),
        float(np.linalg.cond(H.value)),
        servos.D_r[:, None] * inverse(H),
    )


def servo_side(servos: Sequence[Servo], omega: float) -> ServoSide:
    """What linear servos do at one frequency.

    Args:
        servos: Of m joints; their Coulomb friction and play are not in it.
        omega: Angular frequency [rad/s].
    """
    sides: list[tuple[complex, complex]] = []
    for one in servos:
        winding = one.torque_constant / one.resistance_ohm
        kappa = winding * one.supply_v * one.proportional_gain
        damping = one.viscous_friction + winding * one.torque_constant
        M = -(omega**2) * one.rotor_inertia + 1j * omega * damping
        G = one.gear_stiffness + 1j * omega * one.gear_damping
        sides.append((G * kappa / (M + G), G * (kappa + M) / (M + G)))
    table = np.array(sides, dtype=np.complex128).reshape(-1, 2)
    return ServoSide(table[:, 0], table[:, 1])


def _dof(variance: FloatArray, dof: FloatArray, power: FloatArray) -> FloatArray:
    """Degrees of freedom of sum_k variance_ik power_kj, shape (m, m)."""
    parts = variance.T[:, :, None] * power[:, None, :]
    return welch_satterthwaite(parts, np.broadcast_to(dof.T[:, :, None], parts.shape))
