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
from pathlib import Path

import numpy as np
from scipy.special import stdtrit

from undulog.capture.common.arrays import ComplexArray, FloatArray
from undulog.capture.common.console import Warn
from undulog.capture.common.errors import DataError
from undulog.capture.robot.model import Servo

from ..common.estimate import Estimate
from ..estimators.intervals import CONFIDENCE, welch_satterthwaite
from ..results.coupling import ComplexMatrix, Coupling, LinearCoupling, Route, ToneCoupling, rows_of
from ..signals.stretch import Options
from .local_coupling import SINGULAR, UNKNOWN_SHAPE, reciprocity
from .sweep_runs import CommandTones, Sweep, SweepData, sweep_data
from .tones import Phasors, distortion, sideband_energy

NONLINEAR = 0.01
"""Distortion of a tone above which a chain isn't called linear."""

_VALIDITY = {
    False: "without contact: the linear chain, at these frequencies, at any small amplitude",
    None: "only if the robot touched nothing, which its sessions don't record",
    True: "in contact: what a linear chain explains best of these very motions, no more",
}


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


def transfer(command: ComplexArray, response: Phasors) -> MeasuredMatrix:
    """Estimate H = Y C^+, the commands taken as exact.

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
        response.draws(21) @ weights,
    )


def impedance(response: Phasors, torque: Phasors) -> MeasuredMatrix:
    """Estimate Z = T Y^+.

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
    return MeasuredMatrix(
        Z,
        np.sqrt(variance @ power),
        _dof(variance, welch_satterthwaite(parts, np.stack([torque.dof, least])), power),
        float(np.linalg.cond(response.value)),
        (torque.draws(22) - Z @ response.draws(23)) @ weights,
    )


def inverse(H: MeasuredMatrix) -> ComplexArray:
    """Draw errors of H^-1.

    Returns:
        Shape (DRAWS, m, m).
    """
    return (np.linalg.inv(H.value + H.draws) - np.linalg.inv(H.value)).astype(np.complex128)


def impedance_behind_servos(
    H: MeasuredMatrix, D_r: ComplexArray, D_q: ComplexArray
) -> MeasuredMatrix:
    """Estimate Z = D_r H^-1 - D_q.

    Args:
        H: Of the commands as the servos hold them; regular.
        D_r: Torque of the servos per command [N m/rad], shape (m,).
        D_q: Torque against the joint's angle [N m/rad], shape (m,).

    Returns:
        Z [N m/rad]; to first order var X_ij = sum_kl abs(X_ik)^2 var H_kl abs(X_lj)^2, columns of H
        taken as independent.
    """
    X: ComplexArray = np.linalg.inv(H.value).astype(np.complex128)
    size = np.abs(X) ** 2
    error = np.abs(D_r)[:, None] * np.sqrt(size @ H.error**2 @ size)
    return MeasuredMatrix(
        (D_r[:, None] * X - np.diag(D_q)).astype(np.complex128),
        error,
        np.full_like(error, float(H.dof.min())),
        float(np.linalg.cond(H.value)),
        D_r[:, None] * inverse(H),
    )


def servo_side(servos: Sequence[Servo], omega: float) -> tuple[ComplexArray, ComplexArray]:
    """Return D_r and D_q of linear servos at one frequency.

    Args:
        servos: Of m joints; their Coulomb friction and play are not in it.
        omega: Angular frequency [rad/s].
    """
    sides: list[tuple[complex, complex]] = []
    for servo in servos:
        winding = servo.torque_constant / servo.resistance_ohm
        kappa = winding * servo.supply_v * servo.proportional_gain
        damping = servo.viscous_friction + winding * servo.torque_constant
        M = -(omega**2) * servo.rotor_inertia + 1j * omega * damping
        G = servo.gear_stiffness + 1j * omega * servo.gear_damping
        sides.append((G * kappa / (M + G), G * (kappa + M) / (M + G)))
    table = np.array(sides, dtype=np.complex128).reshape(-1, 2)
    return table[:, 0], table[:, 1]


def _dof(variance: FloatArray, dof: FloatArray, power: FloatArray) -> FloatArray:
    """Return the degrees of freedom of sum_k variance_ik power_kj, shape (m, m)."""
    parts = variance.T[:, :, None] * power[:, None, :]
    return welch_satterthwaite(parts, np.broadcast_to(dof.T[:, :, None], parts.shape))


def sweep_coupling(
    sweep: Sweep,
    commanded: Sequence[CommandTones | None],
    paths: Sequence[Path],
    options: Options,
    warn: Warn,
) -> Coupling:
    """Estimate H and Z, with the route of Z and their validity.

    Args:
        commanded: Tones of each session.
        paths: The files of all sessions.
        warn: Receives a sentence for each missing or doubtful value.

    Returns:
        A :class:`LinearCoupling`; or not identifiable, with the reason and what to record.
    """
    m = len(sweep.names)
    plan = "lag-sweep" if sweep.lines == 1 else "multisine"
    if sweep.lacking:
        return Coupling(
            identifiable=False,
            why=f"{len(sweep.index)} of {m} runs of a {plan}: H = Y C^-1 needs C of full rank",
            record=f"the {sweep.lacking} runs that are missing",
        )
    try:
        data = sweep_data(sweep, commanded, paths, options)
    except DataError as error:
        return Coupling(
            identifiable=False, why=str(error), record=f"all {m} runs of the {plan}, each whole"
        )
    if plan == "lag-sweep" and data.contact:
        return Coupling(
            identifiable=False,
            why="in contact every gait is its own operating point, so the gaits of a lag sweep "
            "are no runs of one linear chain",
            record=f"phase-kicks around one gait ({4 * m} runs and one without a kick), or the "
            "lag sweep without contact",
        )
    step_s = 0.0 if data.run is None else 1.0 / data.run.physics_rate_hz
    hold_s = (data.period_s - step_s) / 2
    servos, servo_why = _servos(data, sweep.names)
    tones = tuple(_tone(data, k, hold_s, servos) for k in range(len(sweep.tones)))
    beside = Estimate() if data.beside is None else sideband_energy(data.response, data.beside)
    _warn(data, beside, tones, warn)
    return LinearCoupling(
        identifiable=True,
        why=f"{len(sweep.index)} runs of a {plan}: H = Y C^-1",
        matrix=rows_of(np.abs(np.array(tones[0].H.real) + 1j * np.array(tones[0].H.imag))),
        condition_number=tones[0].condition_number,
        plan=plan,
        joints=sweep.names,
        runs=len(sweep.index),
        contact=data.contact,
        validity=_VALIDITY[data.contact],
        hold_s=hold_s,
        route_why=_route_why(tones[0].route, servo_why),
        tones=tones,
        sideband_energy=beside,
        drift_per_cycle=data.drift,
    )


def _tone(data: SweepData, k: int, hold_s: float, servos: Sequence[Servo] | None) -> ToneCoupling:
    omega = float(data.omega[k])
    # A command held over its period acts half of it late; the twin's steps look ahead by half one.
    H = transfer(data.command[k] * np.exp(-1j * omega * hold_s), data.response[k])
    condition = float(np.linalg.cond(H.value))
    regular = condition < SINGULAR
    side = None if servos is None else servo_side(servos, omega)
    by_servo = impedance_behind_servos(H, *side) if regular and side is not None else None
    by_torque = None if data.torque is None else impedance(data.response[k], data.torque[k])
    Z = by_torque or by_servo
    shape = UNKNOWN_SHAPE
    if Z is not None:
        shape = reciprocity(Z.value, Z.draws)
    elif regular:
        shape = reciprocity(np.linalg.inv(H.value).astype(np.complex128), inverse(H))
    difference = None
    if by_torque is not None and by_servo is not None:
        apart = float(np.linalg.norm(by_servo.value - by_torque.value))
        difference = apart / float(np.linalg.norm(by_torque.value))
    return ToneCoupling(
        frequency_hz=omega / (2 * np.pi),
        command_condition=H.condition_number,
        H=_matrix(H),
        condition_number=condition if regular else None,
        route=Route.TORQUE if by_torque else Route.SERVO if by_servo else Route.ROW_SCALED,
        Z=None if Z is None else _matrix(Z),
        inverted_condition=None if Z is None else Z.condition_number,
        servo_difference=difference,
        distortion=_distortion(data, k),
        asymmetry=shape[0],
        within_1=shape[1],
        within_2=shape[2],
        within_3=shape[3],
    )


def _distortion(data: SweepData, k: int) -> float | None:
    """Return the distortion, of torques where they are recorded: Z shows it more than H."""
    omega = float(data.omega[k])
    if data.torque is not None and data.torque_beside is not None:
        return distortion(omega, data.torque[k], data.torque_beside)
    return None if data.beside is None else distortion(omega, data.response[k], data.beside)


def _servos(data: SweepData, names: Sequence[str]) -> tuple[list[Servo] | None, str]:
    """Return the driven joints' servos if they are known and linear, or why not."""
    if data.robot is None:
        return None, "the sessions carry no robot description"
    robot = data.robot
    joints = {joint.name: joint.servo for joint in robot.joints}
    if data.run is None and "servo" in robot.assumed:
        return None, f"the servo of {robot.name} is assumed, not known"
    if any(name not in joints for name in names):
        return None, f"{robot.name} has other joints"
    servos = [joints[name] for name in names]
    if any(
        max(servo.coulomb_friction, servo.static_friction, servo.backlash) > 0 for servo in servos
    ):
        return None, "the servos have Coulomb friction or play, and are not linear"
    return servos, ""


def _route_why(route: Route, servo_why: str) -> str:
    if route is Route.TORQUE:
        return "torques are recorded, and Z = T Y^-1 needs no model of the servo"
    if route is Route.SERVO:
        return "no torques of all driven joints; the servo's parameters are known"
    return f"no torques of all driven joints, and {servo_why or 'H is singular'}"


def _warn(data: SweepData, beside: Estimate, tones: Sequence[ToneCoupling], warn: Warn) -> None:
    if data.contact is None:
        warn(
            "whether the robot touched anything isn't known: in contact every gait is its own "
            "operating point, and these matrices mean little"
        )
    if data.drift > 0:
        warn(
            f"not settled: responses drift by up to {100 * data.drift:.2g} % per cycle; let each "
            "run settle longer (--start, or plan with a longer --settle)"
        )
    if beside.value is None:
        warn("too short to measure energy beside the tones; record two periods of the multisine")
    bent = [(tone.frequency_hz, tone.distortion or 0.0) for tone in tones]
    if at := ", ".join(f"{hz:.4g} Hz ({100 * by:.2g} %)" for hz, by in bent if by > NONLINEAR):
        warn(
            "not linear: where nothing is commanded, lines reach more than 1 % of the tone beside "
            f"them, at {at}; H and Z hold for these motions only, take a smaller amplitude"
        )
    if tones[0].servo_difference is not None and tones[0].servo_difference > 1.5:
        warn(
            "Z by torques and Z behind the described servos have nothing in common: look at the "
            "sign of the efforts (positive = turns the joint towards positive angles)"
        )


def _matrix(matrix: MeasuredMatrix) -> ComplexMatrix:
    value = matrix.value
    return ComplexMatrix(*map(rows_of, (value.real, value.imag, matrix.error, matrix.half)))
