"""A null model from the twin: how identical modules answer a scenario's gait, and its derivatives.

The twin runs the scenario with its modules identical and without noise, and again with each shared
parameter changed by a factor exp(+-h), by pairs of them, and with each module changed by itself.
With y = ln(response / command) of the driven joints and x = ln(theta / theta_0), central
differences give::

    slope_k = (y(+h) - y(-h)) / 2 h          curvature_kk = (y(+h) - 2 y(0) + y(-h)) / h^2
    curvature_kl = (y(+h, +h) + y(-h, -h) - y(+h, -h) - y(-h, +h)) / 4 h^2

Runs at other parameters, drawn within the reach, say how far model and twin are apart.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import combinations
from typing import NamedTuple

import numpy as np

from undulog.capture.common.arrays import ComplexArray, FloatArray, frozen
from undulog.capture.common.errors import UsageError
from undulog.capture.robot.null_model import NullModel, SharedParameter

from ..gait.wave import Serpentine
from ..scenario.scenario import MASS_FACTOR, Kernels, Modules, Scenario
from ..scenario.sensors import Noise, SensorModels
from .twin import Twin

HARMONICS = 3
MIN_CYCLES = 3.0

SERVO = {
    "stall_torque": "N m",
    "proportional_gain": "1/rad",
    "coulomb_friction": "N m",
}
"""Shared servo parameters and their units: V/R by way of the stall torque Kt V/R, Kp, t_c."""

GROUND = {"mu_tangential": "1", "mu_normal": "1"}

STEP = 0.1
"""h: every parameter is changed by a factor exp(+-0.1)."""

REACH = 0.2
"""Range of validity of the model: factors exp(+-0.2)."""

HELD_OUT = 4


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
    if len({joint.servo for joint in scenario.robot.joints}) > 1 or scenario.modules.link_of:
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

    Returns:
        Their indices, head to tail.
    """
    planes = scenario.gait.planes
    return [j for j, joint in enumerate(scenario.robot.joints) if joint.plane in planes]


def shared_values(scenario: Scenario) -> dict[str, float]:
    """theta_0.

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
        values: theta_0.
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
        changed = {name: theta[name] for name in GROUND if name in theta}
        ground = dataclasses.replace(ground, **changed)
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


def null_model(
    scenario: Scenario,
    *,
    made_by: str,
    spread: float = 0.2,
    kernels: Kernels = Kernels.NUMPY,
    on_run: Callable[[int, int], None] | None = None,
) -> NullModel:
    """Make a null model of a scenario.

    Args:
        scenario: A serpentine gait without a controller, settled for at least three cycles.
        made_by: A sentence on its origin.
        spread: Standard deviation of each ln theta, as known beforehand.
        kernels: What computes the force laws.
        on_run: Called with the number of finished runs and of all runs.

    Raises:
        UsageError: If the scenario's gait has no steady rhythm, or its modules differ.
        SimulationError: If the twin fails.
    """
    frequency_hz = steady_frequency(scenario)
    values = shared_values(scenario)
    names = list(values)
    driven = driven_joints(scenario)
    variants = list(_variants(names, [scenario.robot.joint_names[j] for j in driven]))
    responses: list[ComplexArray] = []
    command = np.zeros(len(driven), dtype=np.complex128)
    for k, variant in enumerate(variants):
        command, y = response(varied(scenario, values, variant), frequency_hz, kernels)
        responses.append(y)
        if on_run is not None:
            on_run(k + 1, len(variants))
    runs = iter(responses)
    base = next(runs)
    slope, curvature = _derivatives(base, runs, len(names))
    modules = {
        kind: frozen(np.array([(next(runs) - next(runs)) / (2 * STEP) for _ in driven]))
        for kind in ("stall_torque", "mass")
    }
    model = NullModel(
        robot=scenario.robot.name,
        frequency_hz=frequency_hz,
        joints=tuple(scenario.robot.joint_names[j] for j in driven),
        command=frozen(command),
        parameters=tuple(
            SharedParameter(name, {**SERVO, **GROUND}[name], values[name], REACH) for name in names
        ),
        covariance=frozen(spread**2 * np.eye(len(names))),
        response=frozen(base),
        slope=frozen(slope),
        curvature=frozen(curvature),
        modules=modules,
        error=0.0,
        made_by=made_by,
    )
    rests: list[float] = []
    for variant, y in zip(variants[-HELD_OUT:], runs, strict=True):
        x = np.log([variant.shared[name] for name in names])
        rests.append(float(np.abs(y - model.at(x)[0]).max()))
    return dataclasses.replace(model, error=max(rests))


def _variants(names: Sequence[str], joints: Sequence[str]) -> Iterator[Variant]:
    """All runs in the order in which they are used."""
    up, down = float(np.exp(STEP)), float(np.exp(-STEP))
    yield Variant({})
    for name in names:
        yield Variant({name: up})
        yield Variant({name: down})
    for first, other in combinations(names, 2):
        for a, b in ((up, up), (down, down), (up, down), (down, up)):
            yield Variant({first: a, other: b})
    for kind in ("stall_torque", "mass"):
        for joint in joints:
            yield Variant({}, (kind, joint, up))
            yield Variant({}, (kind, joint, down))
    random = np.random.default_rng(1)
    for _ in range(HELD_OUT):
        factors = np.exp(random.uniform(-REACH, REACH, len(names)))
        yield Variant(dict(zip(names, factors.tolist(), strict=True)))


def _derivatives(
    base: ComplexArray, runs: Iterator[ComplexArray], count: int
) -> tuple[ComplexArray, ComplexArray]:
    """Slope (K, m) and curvature (K, K, m), by central differences."""
    slope = np.zeros((count, base.size), dtype=np.complex128)
    curvature = np.zeros((count, count, base.size), dtype=np.complex128)
    for k in range(count):
        up, down = next(runs), next(runs)
        slope[k] = (up - down) / (2 * STEP)
        curvature[k, k] = (up - 2 * base + down) / STEP**2
    for k, n in combinations(range(count), 2):
        both, neither, first, other = (next(runs) for _ in range(4))
        curvature[k, n] = curvature[n, k] = (both + neither - first - other) / (4 * STEP**2)
    return slope, curvature
