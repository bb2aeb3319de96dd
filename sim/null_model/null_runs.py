"""The runs of the twin that a null model is made of: what is changed, and what it answers."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from undulog.capture.common.arrays import ComplexArray, FloatArray
from undulog.capture.common.errors import UsageError

from ..gait.serpentine import Serpentine
from ..scenario.engines import Kernels
from ..scenario.modules import MASS_FACTOR, Modules
from ..scenario.scenario import Scenario
from ..scenario.sensors import Noise, SensorModels
from ..twin.twin import Twin

HARMONICS = 3
MIN_CYCLES = 3.0

SERVO = {
    "stall_torque": "N m",
    "proportional_gain": "1/rad",
    "coulomb_friction": "N m",
}
"""Shared servo parameters and their units: V/R by way of the stall torque Kt V/R, Kp, t_c."""

GROUND = {"mu_tangential": "1", "mu_normal": "1"}


class Variant(NamedTuple):
    """One run of the twin.

    Attributes:
        shared: Factor on each shared parameter, by name.
        module: Kind, driven joint and factor of the one module that differs; None for none.
    """

    shared: Mapping[str, float]
    module: tuple[str, str, float] | None = None


def steady_frequency(scenario: Scenario) -> float:
    """Frequency of a steady gait of identical modules.

    Args:
        scenario: The scenario.

    Returns:
        [Hz].

    Raises:
        UsageError: If the gait isn't steady, or the modules aren't identical.
    """
    gait = scenario.gait
    if not isinstance(gait, Serpentine) or scenario.controller is not None:
        raise UsageError(
            f"{scenario.name}: a null model is of a steady gait: kind serpentine, no controller"
        )
    servos = {joint.servo for joint in scenario.robot.joints}
    if len(servos) > 1 or scenario.modules.link_of:
        raise UsageError(
            f"{scenario.name}: a null model is of identical modules; leave out servo_of and link_of"
        )
    frequencies = {wave.frequency_hz for wave in gait.planes.values()}
    if len(frequencies) != 1:
        raise UsageError(f"{scenario.name}: a null model needs one frequency for all planes")
    (frequency_hz,) = frequencies
    if scenario.settle_s < gait.ramp_s:
        raise UsageError(f"{scenario.name}: its settle_s is shorter than its gait's ramp_s")
    left_s = scenario.duration_s - scenario.settle_s
    if left_s * frequency_hz < MIN_CYCLES:
        raise UsageError(
            f"{scenario.name}: {left_s:g} s after settling are fewer than {MIN_CYCLES:g} cycles; "
            "give it a longer duration_s"
        )
    return frequency_hz


def driven_joints(scenario: Scenario) -> list[int]:
    """The driven joints.

    Args:
        scenario: The scenario.

    Returns:
        Their indices, head to tail.
    """
    planes = scenario.gait.planes
    return [j for j, joint in enumerate(scenario.robot.joints) if joint.plane in planes]


def shared_values(scenario: Scenario) -> dict[str, float]:
    """theta_0.

    Args:
        scenario: Of identical modules.

    Returns:
        The shared parameters that its robot and its ground have, by name; those that are 0 stay 0.
    """
    servo, ground = scenario.robot.joints[0].servo, scenario.world.ground
    values = {name: float(getattr(servo, name)) for name in SERVO}
    if ground is not None:
        values |= {name: float(getattr(ground, name)) for name in GROUND}
    return {name: value for name, value in values.items() if value > 0}


def varied(scenario: Scenario, values: Mapping[str, float], variant: Variant) -> Scenario:
    """A scenario with identical modules, its parameters changed, and without noise.

    Args:
        scenario: Of identical modules.
        values: theta_0.
        variant: What to change.

    Returns:
        The scenario to run.
    """
    theta = {name: value * variant.shared.get(name, 1.0) for name, value in values.items()}
    servo = {**scenario.modules.servo, **{name: theta[name] for name in SERVO if name in theta}}
    servo_of: dict[str, dict[str, float]] = {}
    link_of: dict[str, dict[str, float]] = {}
    if variant.module is not None:
        kind, joint, factor = variant.module
        if kind == "mass":  # a module is a joint and the link behind it
            link = scenario.robot.links[scenario.robot.joint_names.index(joint) + 1]
            link_of = {link.name: {MASS_FACTOR: factor}}
        else:
            servo_of = {joint: {kind: theta[kind] * factor}}
    modules = Modules(servo, servo_of, link_of)
    ground = scenario.world.ground
    if ground is not None:
        own = {name: theta[name] for name in GROUND if name in theta}
        ground = dataclasses.replace(ground, **own)
    return dataclasses.replace(
        scenario,
        modules=modules,
        robot=modules.fitted(scenario.robot),
        world=dataclasses.replace(scenario.world, ground=ground),
        noise=Noise(),
        sensing=SensorModels(),
    )


def response(
    scenario: Scenario, frequency_hz: float, kernels: Kernels
) -> tuple[ComplexArray, ComplexArray]:
    """Run the twin: complex amplitudes of the driven joints' commands, and y.

    Args:
        scenario: What to run.
        frequency_hz: Of its gait.
        kernels: What computes the force laws.

    Returns:
        Both of shape (m,); least squares of the gait's frequency and its harmonics over the settled
        part.
    """
    times: list[float] = []
    commands: list[FloatArray] = []
    angles: list[FloatArray] = []
    driven = driven_joints(scenario)
    with Twin(scenario, kernels=kernels) as twin:
        for sample in twin.samples():
            if sample.time_s >= scenario.settle_s:
                times.append(sample.time_s)
                commands.append(sample.gait.command[driven])
                angles.append(sample.step.body.angle[driven])
    turn = 2 * np.pi * frequency_hz * np.array(times)
    columns = [np.ones_like(turn)]
    for h in range(1, HARMONICS + 1):
        columns += [np.cos(h * turn), -np.sin(h * turn)]
    both = np.concatenate([np.array(commands), np.array(angles)], axis=1)
    fitted = np.linalg.lstsq(np.stack(columns, axis=1), both)[0]
    amplitudes = np.asarray(fitted[1] + 1j * fitted[2], dtype=np.complex128)
    command, answer = amplitudes[: len(driven)], amplitudes[len(driven) :]
    return command, np.log(answer / command)
