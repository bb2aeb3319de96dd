"""A session's measurement, and the fields of its result: rhythm, waves and joints."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from undulog.capture import SessionView
from undulog.capture.common.arrays import NS
from undulog.capture.robot.model import Robot

from ...common.estimate import Estimate
from ...estimators.intervals import around, t_factor
from ...estimators.series import Series, coverage
from ...estimators.trends import Trend
from ...response.fitting import GaitFit
from ...response.response import gain_estimate, lag_estimate
from ...response.rhythm import phase_step, wave_name
from ...signals.columns import Columns, by_plane, planes_of
from ...signals.windows import Span, Stretch, whole_cycles
from ..dead_band.result import DeadBand
from ..energy.measure import GAP_SHARE, TERMS, Energies
from ..gait.result import GaitFacts, GroupFacts, Window
from ..tracking.gait import GaitOffset
from .result import JointResult


def gait_facts(
    session: SessionView, gait: GaitFit | None, span: Span, stretch: Stretch
) -> GaitFacts:
    """Return frequency, windows and wave of the gait, and of each group of joints."""
    shift_s = (span.origin_ns - session.start_ns) / NS
    window = Window(span.start_s + shift_s, span.stop_s + shift_s, float(span.cycles))
    if gait is None:
        return GaitFacts(Estimate(), (window,))
    groups = _group_facts(session.robot, gait, window, stretch, session.start_ns)
    return GaitFacts(
        frequency_hz=groups[0].frequency_hz,
        windows=(window,),
        wave=groups[0].wave,
        lag_per_joint_rad=groups[0].lag_per_joint_rad,
        fitted=Window(*stretch.since(session.start_ns), stretch.duration_s * gait.fit.frequency_hz),
        groups=groups,
    )


def _group_facts(
    robot: Robot | None, gait: GaitFit, window: Window, stretch: Stretch, start_ns: int
) -> tuple[GroupFacts, ...]:
    """Return frequency, whole cycles and wave of each group, the largest first.

    Args:
        window: The largest group's whole cycles.
        start_ns: Unix time of the session's start [ns].
    """
    result: list[GroupFacts] = []
    for index, group in enumerate(gait.groups):
        frequency = group.fit.frequency_hz
        half = t_factor(group.omega_dof) * group.omega_error / (2 * np.pi)
        if index > 0:
            first_s, last_s, cycles = whole_cycles(*stretch.since(start_ns), frequency)
            window = Window(first_s, last_s, float(cycles))
        wave, steps = main_wave(robot, group)
        estimate = Estimate(frequency, around(frequency, half))
        facts = GroupFacts(estimate, group.driven, (window,), wave, steps)
        result.append(_with_changes(facts, group))
    return tuple(result)


def _with_changes(facts: GroupFacts, gait: GaitFit) -> GroupFacts:
    """Add how the gait of a group and its responses change."""
    if gait.pace is not None:
        facts = dataclasses.replace(facts, frequency_drift_hz_per_s=gait.pace.hz_per_s)
    changes = gait.changes
    if changes is None:
        return facts
    turn = changes.slow.turn if changes.trend is Trend.SETTLING else 0.0
    return dataclasses.replace(
        facts,
        trend=str(changes.trend),
        time_constant_s=changes.time_constant_s,
        oscillation_hz=turn / (2 * np.pi * changes.period_s) or None,
        cycle_correlation=max(changes.slow.correlation) if changes.varies else None,
        effective_cycles=changes.slow.effective if changes.varies else None,
        amplitude_drift_per_cycle=changes.amplitude_drift or Estimate(),
    )


def main_wave(robot: Robot | None, gait: GaitFit) -> tuple[str | None, dict[str, float]]:
    """Direction of the wave of the plane with the largest command, and each plane's phase step."""
    steps: dict[str, float] = {}
    main, largest = None, 0.0
    for plane, names in by_plane(robot, gait.driven).items():
        if len(names) > 1:
            waves = gait.fit.fundamental[[gait.driven.index(name) for name in names]]
            steps[plane] = phase_step(waves)
            if np.abs(waves).max() > largest:
                main, largest = plane, float(np.abs(waves).max())
    return None if main is None else wave_name(steps[main]), steps


def joint_results(
    robot: Robot | None,
    columns: Columns,
    *,
    responses: Mapping[str, Series],
    gait: GaitFit | None,
    energies: Mapping[str, Energies],
    flags: Mapping[str, Sequence[str]],
    dead: Mapping[str, DeadBand],
    offsets: Mapping[str, GaitOffset],
    span: Span,
) -> tuple[JointResult, ...]:
    """Return the results of all joints, head to tail.

    Args:
        flags: Artefacts of each joint in the analysed window, by name.
        dead: Dead bands, by name.
        offsets: Of the gait's joints, by name.
        span: The window of energies and coverage.
    """
    planes = planes_of(robot)
    results: list[JointResult] = []
    for name in columns.names:
        response = responses.get(name)
        part = None if response is None else response.between(span.start_s, span.stop_s)
        fraction = 0.0 if part is None else coverage(part.t_s, span.start_s, span.stop_s)
        joint_flags = [flag for flag in flags.get(name, ()) if flag != "gaps"]
        if fraction < 1 - GAP_SHARE and "not_recorded" not in joint_flags:
            joint_flags.append("gaps")
        index = None if gait is None else gait.group_of(name)
        group = None if gait is None or index is None else gait.groups[index]
        gain, lag = response_estimates(group, name)
        per_cycle = {term: energies[name].per_cycle(term) for term in TERMS}
        results.append(
            JointResult(
                name=name,
                plane=planes.get(name),
                command_amplitude_rad=None if gait is None else gait.command_amplitudes.get(name),
                gain=gain,
                lag_rad=lag,
                **{
                    f"energy_{term}_j": None if energy is None else float(np.sum(energy))
                    for term, energy in per_cycle.items()
                },
                coverage=fraction,
                samples=0 if part is None else part.count,
                flags=tuple(joint_flags),
                group=index,
                frequency_hz=None if group is None else group.fit.frequency_hz,
                dead_band=dead.get(name),
                **_offset(offsets.get(name)),
                **_changes(group, name),
            )
        )
    return tuple(results)


def _offset(offset: GaitOffset | None) -> dict[str, Any]:
    if offset is None:
        return {}
    return {"offset_rad": offset.offset_rad.estimate, "command_mean_rad": offset.command_rad}


def response_estimates(gait: GaitFit | None, name: str) -> tuple[Estimate, Estimate]:
    """Return a joint's gain and lag [rad]; without values where they aren't known."""
    if gait is None or gait.response is None or name not in gait.answered:
        return Estimate(), Estimate()
    place = gait.answered.index(name)
    lag = lag_estimate(gait.response, place)
    # A phase that noise leaves open means an amplitude that isn't there.
    return (gain_estimate(gait.response, place) if lag.value is not None else Estimate()), lag


def _changes(gait: GaitFit | None, name: str) -> dict[str, Any]:
    """Return the fields of a joint's changes from cycle to cycle."""
    if gait is None or gait.changes is None or name not in gait.answered:
        return {}
    changes, place = gait.changes, gait.answered.index(name)
    fields: dict[str, Any] = {}
    if changes.trend is not Trend.STEADY:
        drifts = changes.trend is Trend.DRIFTING
        keys = (
            ("gain_drift_per_cycle", "lag_drift_rad_per_cycle")
            if drifts
            else ("gain_transient", "lag_transient_rad")
        )
        fields |= zip(keys, changes.of_joint(place), strict=True)
    if changes.varies:
        fields["gain_cycle_sd"], fields["lag_cycle_sd_rad"] = changes.scatter[:, place].tolist()
    return fields
