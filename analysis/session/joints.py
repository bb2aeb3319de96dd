"""One line of the result for each joint: response, four energies, coverage, flags."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from undulog.capture import SessionView
from undulog.capture.common.console import Warn
from undulog.capture.common.process import in_threads
from undulog.capture.log.messages.definitions import PowerTopic
from undulog.capture.robot.model import Robot

from ..energy import TERMS, Energies, Energy, add_up, integrate, power_of
from ..estimators.intervals import around, t_factor
from ..estimators.series import Series, clean, coverage
from ..response.fitting import GaitFit
from ..response.response import gain_estimate, lag_estimate
from ..response.rhythm import phase_step, wave_name
from ..results.analysis import GroupFacts, JointResult, Window
from ..results.artefact import Artefact, DeadBand
from ..results.estimate import Estimate
from ..signals.columns import Columns, by_plane, planes_of
from ..signals.windows import Span, Stretch, whole_cycles

_NS = 1e9


def group_facts(
    robot: Robot | None, gait: GaitFit, span: Span, stretch: Stretch, start_ns: int
) -> tuple[GroupFacts, ...]:
    """Return frequency, whole cycles and wave of each group, the largest first.

    Args:
        span: The largest group's whole cycles.
        start_ns: Unix time of the session's start [ns].
    """
    ends = [(t - start_ns) / _NS for t in (stretch.start_ns, stretch.stop_ns)]
    shift_s = (span.origin_ns - start_ns) / _NS
    result: list[GroupFacts] = []
    for index, group in enumerate(gait.groups):
        frequency = group.fit.frequency_hz
        half = t_factor(group.omega_dof) * group.omega_error / (2 * np.pi)
        if index == 0:
            window = Window(span.start_s + shift_s, span.stop_s + shift_s, float(span.cycles))
        else:
            first_s, last_s, cycles = whole_cycles(ends[0], ends[1], frequency)
            window = Window(first_s, last_s, float(cycles))
        wave, steps = _wave(robot, group)
        estimate = Estimate(frequency, around(frequency, half))
        result.append(GroupFacts(estimate, group.driven, (window,), wave, steps))
    return tuple(result)


def _wave(robot: Robot | None, gait: GaitFit) -> tuple[str | None, dict[str, float]]:
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


GAP_SHARE = 0.01
"""More of the window without samples is worth a flag, or of power a warning."""


def joint_energies(
    session: SessionView, columns: Columns, artefacts: Iterable[Artefact], span: Span, warn: Warn
) -> dict[str, Energies]:
    """Return the energies of all joints; warn of powers with gaps or falsified by a sensor."""
    wrong = list(artefacts)
    false = {one.joint for one in wrong if one.falsifies("velocity", "effort")}
    false_el = {one.joint for one in wrong if one.falsifies("current", "voltage")}
    for joints, kind in ((false, "mechanical"), (false_el, "electrical")):
        if joints:
            named = ", ".join(name for name in columns.names if name in joints)
            warn(f"{named}: {kind} energies are null, since a sensor falsifies them")

    def of_joint(name: str) -> Energies:
        powers: dict[str, Series] = {}
        found: dict[str, Energy | None] = {}
        window = span.start_s, span.stop_s, max(span.cycles, 1)
        for kind, (first, second), wrong in (
            ("mechanical", (columns.effort, columns.velocity), false),
            ("electrical", (columns.current, columns.voltage), false_el),
        ):
            if name in wrong:  # what accumulates powers goes by the same sensors
                continue
            found[kind] = _accumulated(columns, kind, name, span.origin_ns, window)
            if found[kind] is None and name in first and name in second:
                powers[kind] = power_of(first[name], second[name], span.origin_ns)
        found |= zip(powers, integrate([*powers.values()], *window), strict=True)
        return Energies(found.get("mechanical"), found.get("electrical"), frozenset(powers))

    samples = sum(one.t_ns.size for one in (*columns.effort.values(), *columns.current.values()))
    found = in_threads(of_joint, columns.names, samples, session.forget)
    result = dict(zip(columns.names, found, strict=True))
    thin = [
        name
        for name, one in result.items()
        if any(
            e is not None and e.coverage < 1 - GAP_SHARE for e in (one.mechanical, one.electrical)
        )
    ]
    if thin:
        warn(
            f"the power of {', '.join(thin)} has gaps, which are not bridged: energies count only "
            "the time that has samples"
        )
    return result


def _accumulated(
    columns: Columns, kind: str, name: str, origin_ns: int, window: tuple[float, float, int]
) -> Energy | None:
    """Return the energy by the powers that the log has themselves, or None."""
    net, plus = (
        columns.powers[topic].get(name)
        for topic in (
            (PowerTopic.MECHANICAL, PowerTopic.MECHANICAL_PLUS)
            if kind == "mechanical"
            else (PowerTopic.ELECTRICAL, PowerTopic.ELECTRICAL_PLUS)
        )
    )
    if net is None or plus is None:
        return None
    mean, positive = (clean(name, one.t_ns, one.values, origin_ns) for one in (net, plus))
    return add_up(mean, positive, *window)


def joint_results(
    robot: Robot | None,
    columns: Columns,
    *,
    responses: Mapping[str, Series],
    gait: GaitFit | None,
    energies: Mapping[str, Energies],
    flags: Mapping[str, Sequence[str]],
    dead: Mapping[str, DeadBand],
    span: Span,
) -> tuple[JointResult, ...]:
    """Return the results of all joints, head to tail.

    Args:
        flags: Artefacts of each joint in the analysed window, by name.
        dead: Dead bands, by name.
        span: The window of energies and coverage.
    """
    planes = planes_of(robot)
    results: list[JointResult] = []
    for name in columns.names:
        response = responses.get(name)
        part = None if response is None else response.between(span.start_s, span.stop_s)
        fraction = 0.0 if part is None else coverage(part.t_s, span.start_s, span.stop_s)
        own = [flag for flag in flags.get(name, ()) if flag != "gaps"]
        if fraction < 1 - GAP_SHARE and "not_recorded" not in own:
            own.append("gaps")
        index = None if gait is None else gait.group_of(name)
        group = None if gait is None or index is None else gait.groups[index]
        gain, lag = _estimates(group, name)
        per_cycle = {term: energies[name].per_cycle(term) for term in TERMS}
        results.append(
            JointResult(
                name=name,
                plane=planes.get(name),
                command_amplitude_rad=None if gait is None else gait.command_amplitudes.get(name),
                gain=gain,
                lag_rad=lag,
                **{
                    f"energy_{term}_j": None if found is None else float(np.sum(found))
                    for term, found in per_cycle.items()
                },
                coverage=fraction,
                samples=0 if part is None else part.count,
                flags=tuple(own),
                group=index,
                frequency_hz=None if group is None else group.fit.frequency_hz,
                dead_band=dead.get(name),
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
