"""Plans: a serpentine gait whose values change from segment to segment, and never jump in phase.

Within a segment each value goes from what it was to what it is to be,

    v(t) = v_0 + (v_1 - v_0) S((t - t_0) / T),   S(x) = 3 x^2 - 2 x^3,

over the segment's transition T, and stays there. The phase is integrated, Phi' = omega, with the
omega in force from each tick on, so it is continuous whatever the plan does. A lag may pass through
zero: that is how a wave turns round.

Plan files: TOML, read strictly, every fault reported at once.

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
import math
from bisect import bisect_right
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import accumulate
from pathlib import Path

import numpy as np

from undulog.capture.common.config import Name, NonNegative, read_field
from undulog.capture.common.errors import DescriptionFault, PlanError
from undulog.capture.common.files import is_file
from undulog.capture.common.strict_table import NAME_PATTERN, Faults, StrictTable, listed
from undulog.capture.common.untrusted_text import read_toml
from undulog.capture.robot.model import Plane, Robot

from ..gait.contract import WALK, GaitTick, Modulation, Readings
from ..gait.wave import IntegratedPhase, PlaneGait, Serpentine, WaveGenerator, WaveState, started
from ..scenario.motion import read_gait
from ..scenario.scenario import LONGEST_S, Length, Scenario
from ..scenario.scenario_file import load_scenario, scenario_names


@dataclass(frozen=True)
class PlanSegment:
    """One part of a plan.

    Attributes:
        planes: What each driven plane does once the transition is over.
        transition_s: How long the way there takes, from the segment's start; 0: a jump.
        mode: One word for what it is about.
    """

    duration_s: Length
    planes: Mapping[Plane, PlaneGait]
    transition_s: NonNegative = 1.0
    mode: str = WALK


@dataclass(frozen=True)
class Plan:
    """A sequence of segments.

    Attributes:
        scenario: Robot and world that it was written for.
        start: What each driven plane does at time zero; its ``phase`` is the phase there.
        ramp_s: Amplitude and offset grow from nothing over this time, smoothly.
        segments: At least one; all have the planes of ``start``.
    """

    name: Name
    description: str
    scenario: Scenario
    start: Mapping[Plane, PlaneGait]
    ramp_s: float
    segments: tuple[PlanSegment, ...]

    @property
    def duration_s(self) -> float:
        """How long it lasts."""
        return math.fsum(segment.duration_s for segment in self.segments)


class PlanGait(WaveGenerator):
    """The generator of a plan; after the last segment its values stay."""

    def __init__(self, plan: Plan, robot: Robot, *, per_joint: bool = False) -> None:
        """Start at time zero with straight joints.

        Args:
            robot: Who is to do it.
            per_joint: Tell every joint's own values too, for a controller that sets them apart.
        """
        self._starts = _starts(plan)
        self._modes = [segment.mode for segment in plan.segments]
        rhythms = {
            plane: _PlannedRhythm(plan, plane, len(robot.joint_indices(plane)))
            for plane in plan.start
        }
        super().__init__(rhythms, robot, per_joint=per_joint)

    def step(self, time_s: float, readings: Readings) -> GaitTick:
        """Return the commands at a time."""
        segment = bisect_right(self._starts, time_s) - 1
        return super().step(time_s, readings)._replace(mode=self._modes[segment])


class _PlannedRhythm:
    """Eq. 2, or Eq. 6, with values that change by plan."""

    def __init__(self, plan: Plan, plane: Plane, joint_count: int) -> None:
        gaits = [plan.start[plane], *(segment.planes[plane] for segment in plan.segments)]
        self._values = np.array(
            [[g.amplitude, g.offset, g.signed_lag, math.tau * g.frequency_hz] for g in gaits]
        )
        self._starts = _starts(plan)
        self._transitions = [segment.transition_s for segment in plan.segments]
        self._ramp_s = plan.ramp_s
        self._places = np.arange(joint_count)
        self._phase = IntegratedPhase(gaits[0].phase, float(self._values[0, 3]))

    def step(self, time_s: float, change: Modulation, readings: Readings) -> WaveState:  # noqa: ARG002
        segment = bisect_right(self._starts, time_s) - 1
        share = started(time_s - self._starts[segment], self._transitions[segment])
        before, after = self._values[segment], self._values[segment + 1]
        amplitude, offset, lag, omega = (before + (after - before) * share).tolist()
        ramp = started(time_s, self._ramp_s)
        omega *= change.frequency_factor
        return WaveState(
            amplitude=ramp * amplitude * change.amplitude_factor,
            offset=ramp * offset + change.offset,
            phase=self._phase.advance(time_s, omega) + self._places * lag,
            omega=omega,
            lag=lag,
        )


def _starts(plan: Plan) -> list[float]:
    """When each segment begins [s]."""
    return [0.0, *accumulate(segment.duration_s for segment in plan.segments[:-1])]


def is_plan(text: str) -> bool:
    """Whether TOML text is a plan rather than a scenario.

    Args:
        text: The text. What is no TOML is no plan: a scenario's reader tells what is wrong with it.
    """
    try:
        return "segments" in read_toml(text)
    except ValueError:
        return False


def parse_plan(text: str, source: Path) -> Plan:
    """Read a plan.

    Args:
        source: Where it comes from: for messages, for its name, and to find a scenario beside it.

    Raises:
        PlanError: If it has faults; lists all of them.
        ScenarioError: If the file of its scenario has faults.
    """
    try:
        values = read_toml(text)
    except ValueError as error:
        raise PlanError(source, [DescriptionFault("syntax", str(error), "TOML 1.0")]) from error
    faults = Faults()
    top = StrictTable(values, "", faults)
    stem = source.stem if NAME_PATTERN.fullmatch(source.stem) else "plan"
    name: str = read_field(top, Plan, "name", stem)
    description: str = read_field(top, Plan, "description")
    scenario = _scenario(top, source.parent)
    start, ramp_s = _start(top, scenario)
    segments = _segments(top, start)
    top.close()
    if (problems := faults.all()) or scenario is None:
        raise PlanError(source, problems)
    return Plan(name, description, scenario, start, ramp_s, segments)


def _scenario(top: StrictTable, folder: Path) -> Scenario | None:
    """The plan's scenario; None after a fault."""
    name = top.text("scenario")
    if name in scenario_names():
        return load_scenario(name)
    if name and is_file(folder / name):
        return load_scenario(folder / name)
    if name or top.look("scenario")[1] == "":  # what is missing or no text is a fault already
        near = listed(scenario_names(), name)
        top.fault("scenario", f"a TOML file beside the plan, or one of {near}")
    return None


def _start(top: StrictTable, scenario: Scenario | None) -> tuple[dict[Plane, PlaneGait], float]:
    """Return the gait of each plane at time zero, and the ramp [s]."""
    robot = scenario.robot if scenario is not None else None
    given = "gait" in top
    if given:
        gait = read_gait(top.table("gait"), robot)
    elif scenario is not None:
        gait = scenario.gait
    else:
        return {}, 0.0
    if not isinstance(gait, Serpentine):
        top.fault("gait", "a serpentine gait, of the plan's own or of its scenario")
        return {}, 0.0
    return dict(gait.planes), gait.ramp_s


def _segments(top: StrictTable, start: Mapping[Plane, PlaneGait]) -> tuple[PlanSegment, ...]:
    segments: list[PlanSegment] = []
    for table in top.tables("segments"):
        segments.append(_segment(table, segments[-1].planes if segments else start))
        table.close()
    if not segments:
        top.fault("segments", "at least one table [[segments]]")
    if sum(segment.duration_s for segment in segments) > LONGEST_S:
        top.fault("segments", f"at most {LONGEST_S:g} s together", "more")
    return tuple(segments)


def _segment(table: StrictTable, before: Mapping[Plane, PlaneGait]) -> PlanSegment:
    duration_s: float = read_field(table, PlanSegment, "duration_s")
    shorter = min(PlanSegment.transition_s, duration_s)
    transition_s: float = read_field(table, PlanSegment, "transition_s", shorter)
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
    mode: str = read_field(table, PlanSegment, "mode")
    if not mode.strip():
        table.fault("mode", "a word, e.g. walk")
    return PlanSegment(duration_s, planes, transition_s, mode)


def _changed(part: StrictTable, before: PlaneGait) -> PlaneGait:
    """A plane's values after a change."""
    names = ("amplitude", "frequency_hz", "lag", "offset", "wave")
    after = {name: read_field(part, PlaneGait, name, getattr(before, name)) for name in names}
    return dataclasses.replace(before, **after)
