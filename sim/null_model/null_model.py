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
from collections.abc import Callable, Iterator, Sequence
from itertools import combinations

import numpy as np

from undulog.capture.common.arrays import ComplexArray, frozen
from undulog.capture.robot.null_model import NullModel, SharedParameter

from ..scenario.engines import Kernels
from ..scenario.scenario import Scenario
from .null_runs import (
    GROUND,
    SERVO,
    Variant,
    driven_joints,
    response,
    shared_values,
    steady_frequency,
    varied,
)

STEP = 0.1
"""h: every parameter is changed by a factor exp(+-0.1)."""

REACH = 0.2
"""The model is said to hold for factors exp(+-0.2)."""

HELD_OUT = 4


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
        made_by: A sentence that says what it is made from.
        spread: Standard deviation of each ln theta, as known beforehand.
        kernels: What computes the force laws.
        on_run: Told the runs done and how many there will be.

    Returns:
        The model.

    Raises:
        UsageError: If the scenario's gait has no steady rhythm, or its modules differ.
        SimulationError: If the twin fails.
    """
    frequency_hz = steady_frequency(scenario)
    values = shared_values(scenario)
    names = list(values)
    driven = driven_joints(scenario)
    variants = list(_variants(names, [scenario.robot.joint_names[j] for j in driven]))
    found: list[ComplexArray] = []
    command = np.zeros(len(driven), dtype=np.complex128)
    for k, variant in enumerate(variants):
        command, y = response(varied(scenario, values, variant), frequency_hz, kernels)
        found.append(y)
        if on_run is not None:
            on_run(k + 1, len(variants))
    runs = iter(found)
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
    for one, other in combinations(names, 2):
        for a, b in ((up, up), (down, down), (up, down), (down, up)):
            yield Variant({one: a, other: b})
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
        both, neither, one, other = (next(runs) for _ in range(4))
        curvature[k, n] = curvature[n, k] = (both + neither - one - other) / (4 * STEP**2)
    return slope, curvature
