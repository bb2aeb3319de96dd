"""From the runs of a sweep to the coupling of the chain: orchestration of :mod:`.chain`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from undulog.capture.common.arrays import ComplexArray
from undulog.capture.common.console import Warn
from undulog.capture.common.errors import DataError
from undulog.capture.robot.model import Servo

from ...results.coupling import (
    ComplexMatrix,
    Coupling,
    LinearCoupling,
    Route,
    ToneCoupling,
    rows_of,
)
from ...results.estimate import Estimate
from ...signals.stretch import Options
from ..kicks.local import SINGULAR, reciprocity
from .chain import MeasuredMatrix, impedance, impedance_behind_servos, inverse, servo_side, transfer
from .runs import CommandTones, Sweep, SweepData, sweep_data
from .tones import distortion, sideband_energy

NONLINEAR = 0.01
"""Distortion of a tone above which a chain isn't called linear."""

_VALIDITY = {
    False: "without contact: the linear chain, at these frequencies, at any small amplitude",
    None: "only if the robot touched nothing, which its sessions don't record",
    True: "in contact: what a linear chain explains best of these very motions, no more",
}


def sweep_coupling(
    sweep: Sweep,
    commanded: Sequence[CommandTones | None],
    paths: Sequence[Path],
    options: Options,
    warn: Warn,
) -> Coupling:
    """Estimate H and Z, and say by which route and how far they hold.

    Args:
        sweep: Which of the sessions are its runs.
        commanded: What each session commands.
        paths: The files of all sessions.
        warn: Takes one sentence for each thing that is missing or doubtful.

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
    beside = Estimate()
    if data.beside is not None:
        beside = sideband_energy(data.response, data.beside)
    _warn(data, beside, tones, warn)
    first = np.array(tones[0].H.real) + 1j * np.array(tones[0].H.imag)
    return LinearCoupling(
        identifiable=True,
        why=f"{len(sweep.index)} runs of a {plan}: H = Y C^-1",
        matrix=rows_of(np.abs(first)),
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
    command: ComplexArray = data.command[k] * np.exp(-1j * omega * hold_s)
    H = transfer(command, data.response[k])
    condition = float(np.linalg.cond(H.value))
    regular = condition < SINGULAR
    side = None if servos is None else servo_side(servos, omega)
    by_servo = impedance_behind_servos(H, side) if regular and side is not None else None
    by_torque = None if data.torque is None else impedance(data.response[k], data.torque[k])
    Z = by_torque or by_servo
    nothing = Estimate(), (Estimate(), Estimate(), Estimate())
    if Z is not None:
        asymmetry, bands = reciprocity(Z.value, Z.draws)
    else:
        X = np.linalg.inv(H.value).astype(np.complex128) if regular else None
        asymmetry, bands = nothing if X is None else reciprocity(X, inverse(H))
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
        asymmetry=asymmetry,
        within_1=bands[0],
        within_2=bands[1],
        within_3=bands[2],
    )


def _distortion(data: SweepData, k: int) -> float | None:
    """Of the torques where they are recorded: Z shows it more than H does."""
    omega = float(data.omega[k])
    if data.torque is not None and data.torque_beside is not None:
        return distortion(omega, data.torque[k], data.torque_beside)
    return None if data.beside is None else distortion(omega, data.response[k], data.beside)


def _servos(data: SweepData, names: Sequence[str]) -> tuple[list[Servo] | None, str]:
    """The driven joints' servos, if they are known and linear; and why not."""
    if data.robot is None:
        return None, "the sessions carry no robot description"
    robot = data.robot
    joints = {joint.name: joint.servo for joint in robot.joints}
    if data.run is None and "servo" in robot.assumed:
        return None, f"the servo of {robot.name} is assumed, not known"
    if any(name not in joints for name in names):
        return None, f"{robot.name} has other joints"
    servos = [joints[name] for name in names]
    if any(max(one.coulomb_friction, one.static_friction, one.backlash) > 0 for one in servos):
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
    bent = [one for one in tones if (one.distortion or 0.0) > NONLINEAR]
    if bent:
        at = ", ".join(
            f"{one.frequency_hz:.4g} Hz ({100 * (one.distortion or 0):.2g} %)" for one in bent
        )
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
    return ComplexMatrix(
        rows_of(matrix.value.real),
        rows_of(matrix.value.imag),
        rows_of(matrix.error),
        rows_of(matrix.half),
    )
