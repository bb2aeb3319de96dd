"""One line of the result for each joint: response, four energies, coverage, flags."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from capture.arrays import FloatArray
from capture.robot import Robot

from .energy import Energy, integrate, power_of
from .fitting import GaitFit
from .flags import joint_flags
from .reading import Columns, Warn, planes_of
from .response import gain_estimate, lag_estimate
from .result import Estimate, JointResult
from .series import Series, coverage

_THIN = 0.99
"""Power covered less than this part of the window is worth a warning."""


@dataclass(frozen=True)
class Span:
    """The window over which energies are taken, in s from the common origin.

    Attributes:
        origin_ns: Unix time of the origin [ns].
        start_s: Start [s].
        stop_s: End, not included [s].
        cycles: Whole cycles in it; 0 where there is no gait.
    """

    origin_ns: int
    start_s: float
    stop_s: float
    cycles: int


@dataclass(frozen=True)
class Energies:
    """Mechanical and electrical energy of one joint; None where it was not recorded."""

    mechanical: Energy | None
    electrical: Energy | None


def joint_energies(columns: Columns, span: Span, warn: Warn) -> dict[str, Energies]:
    """Energies of all joints.

    Args:
        columns: The session's columns.
        span: The window.
        warn: Told of joints whose power has gaps.

    Returns:
        By joint name.
    """
    result: dict[str, Energies] = {}
    thin: list[str] = []
    for name in columns.names:
        mechanical = electrical = None
        if name in columns.effort and name in columns.velocity:
            power = power_of(columns.effort[name], columns.velocity[name], span.origin_ns)
            mechanical = integrate(power, span.start_s, span.stop_s, max(span.cycles, 1))
        if name in columns.current and name in columns.voltage:
            power = power_of(columns.current[name], columns.voltage[name], span.origin_ns)
            electrical = integrate(power, span.start_s, span.stop_s, max(span.cycles, 1))
        result[name] = Energies(mechanical, electrical)
        if any(one is not None and one.coverage < _THIN for one in (mechanical, electrical)):
            thin.append(name)
    if thin:
        warn(
            f"the power of {', '.join(thin)} has gaps, which are not bridged: energies count only "
            "the time that has samples"
        )
    return result


def joint_results(
    robot: Robot | None,
    columns: Columns,
    *,
    commands: Mapping[str, Series],
    responses: Mapping[str, Series],
    gait: GaitFit | None,
    energies: Mapping[str, Energies],
    span: Span,
) -> tuple[JointResult, ...]:
    """The joints' lines, head to tail.

    Args:
        robot: The robot, or None.
        columns: The session's columns.
        commands: By joint name, on the analysed stretch.
        responses: By joint name, on the analysed stretch.
        gait: The fitted gait, or None.
        energies: By joint name.
        span: The window of energies and coverage.

    Returns:
        One result a joint.
    """
    planes = planes_of(robot)
    limits = {} if robot is None else {j.name: (j.lower, j.upper) for j in robot.joints}
    results: list[JointResult] = []
    for name in columns.names:
        response = responses.get(name)
        part = None if response is None else response.between(span.start_s, span.stop_s)
        fraction = 0.0 if part is None else coverage(part.t_s, span.start_s, span.stop_s)
        driven = gait is not None and name in gait.driven
        flags: tuple[str, ...] = ("not_recorded",)
        if response is not None and response.count:
            flags = joint_flags(
                response,
                commands.get(name),
                limits.get(name),
                driven_hz=gait.fit.frequency_hz if gait is not None and driven else None,
                fraction_covered=fraction,
            )
        # A frozen encoder says nothing about its joint.
        gain, lag = _estimates(None if "frozen" in flags else gait, name)
        power = energies[name]
        mechanical, electrical = power.mechanical, power.electrical
        results.append(
            JointResult(
                name=name,
                plane=planes.get(name),
                command_amplitude_rad=None if gait is None else gait.command_amplitudes.get(name),
                gain=gain,
                lag_rad=lag,
                energy_net_j=_total(None if mechanical is None else mechanical.net_j),
                energy_plus_j=_total(None if mechanical is None else mechanical.plus_j),
                energy_abs_j=_total(None if mechanical is None else mechanical.abs_j),
                energy_el_j=_total(None if electrical is None else electrical.net_j),
                energy_el_clipped_j=_total(None if electrical is None else electrical.plus_j),
                coverage=fraction,
                samples=0 if part is None else part.count,
                flags=flags,
            )
        )
    return tuple(results)


def _estimates(gait: GaitFit | None, name: str) -> tuple[Estimate, Estimate]:
    if gait is None or gait.response is None or name not in gait.answered:
        return Estimate(), Estimate()
    place = gait.answered.index(name)
    lag = lag_estimate(gait.response, place)
    # A phase that noise leaves open means an amplitude that isn't there.
    return (gain_estimate(gait.response, place) if lag.value is not None else Estimate()), lag


def _total(per_cycle: FloatArray | None) -> float | None:
    return None if per_cycle is None else float(np.sum(per_cycle))
