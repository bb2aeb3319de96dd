"""Plan files: TOML, read strictly, every fault reported at once.

A plan::

    description = "Faster, then the other way."
    scenario = "flat"               # robot and world; a name, or a TOML file beside the plan

    [gait]                          # what the plan starts from, as in a scenario; may be left out:
    ramp_s = 2.0                    # the scenario's own gait then

    [gait.horizontal]
    amplitude = 0.4
    frequency_hz = 0.5
    lag = 1.0471975511965976

    [[segments]]
    duration_s = 6.0                # the gait as it is

    [[segments]]
    duration_s = 10.0
    transition_s = 2.0              # how long the change takes, smoothly; 1 by default
    mode = "fast"                   # goes to /gait/mode; "walk" by default
    horizontal = { frequency_hz = 0.8, amplitude = 0.3 }

    [[segments]]
    duration_s = 10.0
    horizontal = { wave = "tail-to-head", offset = 0.1 }

A segment names what changes (amplitude, frequency_hz, lag, wave, offset); the rest stays as it was.
A plane that is to come in later is driven from the start, with an amplitude of zero.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from undulog.capture.common.errors import Fault, PlanError
from undulog.capture.common.input_file import is_file
from undulog.capture.common.strict_table import NAME_PATTERN, Faults, Table, listed, read_toml
from undulog.capture.robot.model import Plane

from ..gait.contract import WALK
from ..gait.serpentine import Serpentine
from ..gait.wave import PlaneGait, Wave
from ..scenario.gaits_toml import read_gait
from ..scenario.scenario import CONTROL_RATE_HZ, LONGEST_S, Scenario
from ..scenario.scenario_file import load_scenario, scenario_names
from .plan import Plan, Segment

_HIGHEST_HZ = CONTROL_RATE_HZ / 4


def is_plan(text: str) -> bool:
    """Whether TOML text is a plan rather than a scenario.

    Args:
        text: The text. What is no TOML is no plan: a scenario's reader tells what is wrong with it.

    Returns:
        Whether it has segments.
    """
    try:
        return "segments" in read_toml(text)
    except ValueError:
        return False


def parse_plan(text: str, source: Path) -> Plan:
    """Read a plan.

    Args:
        text: The TOML text.
        source: Where it comes from: for messages, for its name, and to find a scenario beside it.

    Returns:
        The plan.

    Raises:
        PlanError: If it has faults; lists all of them.
        ScenarioError: If the file of its scenario has faults.
    """
    try:
        values = read_toml(text)
    except ValueError as error:
        raise PlanError(source, [Fault("syntax", str(error), "TOML 1.0")]) from error
    faults = Faults()
    top = Table(values, "", faults)
    stem = source.stem if NAME_PATTERN.fullmatch(source.stem) else "plan"
    name = top.name("name") if "name" in top else stem
    description = top.text("description")
    scenario = _scenario(top, source.parent)
    start, ramp_s = _start(top, scenario)
    segments = _segments(top, start)
    top.close()
    if (found := faults.all()) or scenario is None:
        raise PlanError(source, found)
    return Plan(name, description, scenario, start, ramp_s, segments)


def _scenario(top: Table, folder: Path) -> Scenario | None:
    """The plan's scenario; None after a fault."""
    name = top.text("scenario")
    if name in scenario_names():
        return load_scenario(name)
    if name and is_file(folder / name):
        return load_scenario(folder / name)
    if name:  # a missing name is a fault already
        near = listed(scenario_names(), name)
        top.fault("scenario", f"a TOML file beside the plan, or one of {near}")
    return None


def _start(top: Table, scenario: Scenario | None) -> tuple[dict[Plane, PlaneGait], float]:
    """What each plane does at time zero, and the ramp [s]."""
    robot = scenario.robot if scenario is not None else None
    given = "gait" in top
    if given:
        gait = read_gait(top.table("gait"), robot, max_frequency_hz=_HIGHEST_HZ)
    elif scenario is not None:
        gait = scenario.gait
    else:
        return {}, 0.0
    if not isinstance(gait, Serpentine):
        top.fault("gait", "a serpentine gait, of the plan's own or of its scenario")
        return {}, 0.0
    return dict(gait.planes), gait.ramp_s


def _segments(top: Table, start: Mapping[Plane, PlaneGait]) -> tuple[Segment, ...]:
    segments: list[Segment] = []
    for values, where in top.tables("segments"):
        planes = segments[-1].planes if segments else start
        table = Table(values, where, top.faults)
        segments.append(_segment(table, planes))
        table.close()
    if not segments:
        top.fault("segments", "at least one table [[segments]]")
    if sum(segment.duration_s for segment in segments) > LONGEST_S:
        top.fault("segments", f"at most {LONGEST_S:g} s together", "more")
    return tuple(segments)


def _segment(table: Table, before: Mapping[Plane, PlaneGait]) -> Segment:
    duration_s = table.number("duration_s", at_least=1 / CONTROL_RATE_HZ, at_most=LONGEST_S)
    shorter = min(Segment.transition_s, duration_s)
    transition_s = table.number("transition_s", default=shorter, at_least=0.0)
    if transition_s > duration_s:
        table.fault("transition_s", f"at most the segment's duration_s = {duration_s:g}")
    planes = dict(before)
    for plane in Plane:
        if plane not in table:
            continue
        if plane not in before:
            driven = ", ".join(before) or "none"
            table.fault(plane, f"a plane that is driven from the start ({driven}); see [gait]")
            continue
        part = table.table(plane)
        planes[plane] = _changed(part, before[plane])
        part.close()
    mode = table.text("mode", WALK)
    if not mode.strip():
        table.fault("mode", "a word, e.g. walk")
    return Segment(duration_s, planes, transition_s, mode)


def _changed(part: Table, before: PlaneGait) -> PlaneGait:
    """A plane's values after a change."""
    values: dict[str, Any] = {
        "amplitude": part.number("amplitude", default=before.amplitude, at_least=0.0),
        "frequency_hz": part.number(
            "frequency_hz", default=before.frequency_hz, above=0.0, at_most=_HIGHEST_HZ
        ),
        "lag": part.number("lag", default=before.lag, at_least=0.0),
        "offset": part.number("offset", default=before.offset),
    }
    if "wave" in part:
        values["wave"] = part.choice("wave", Wave) or before.wave
    return dataclasses.replace(before, **values)
