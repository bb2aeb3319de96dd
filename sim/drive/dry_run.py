"""Dry run of a motion in the twin of its robot, through the gate of a bus.

It is the same gate (:mod:`.gate`), state by state: it reads the pose of the twin's servos,
ramps to the first pose, clamps, watches and ends. What the twin does not have (temperatures, supply
voltages, lost replies, a late process) is not tried.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any

import numpy as np

from undulog.capture.common.arrays import FloatArray
from undulog.capture.common.console import TerminalColumn, table
from undulog.capture.common.errors import SimulationError, some_names
from undulog.capture.common.process import StopRequest
from undulog.capture.robot.model import Robot, Safety

from ..scenario.scenario import LONGEST_S, Scenario
from ..scenario.scenario_file import parse_scenario
from ..twin.recording import Driver, open_session
from ..twin.session_log import SessionLog
from ..twin.stability import warnings
from ..twin.twin import Twin
from .dry_run_gait import Demand, GatedGait, JointDemand, NotedGait
from .gate import POSE_S, Gate
from .limits import GateLimits, Ramp, gate_limits, missing_limits, safety_example
from .motion import MotionSource
from .outcome import DriveEnding, GateEvent, GateFault

_NOMINAL = """
description = "Flat ground, and servos as the description of the robot has them."
robot = "{robot}"
duration_s = 1.0
[gait.{plane}]
amplitude = 0.0
frequency_hz = 1.0
lag = 0.0
"""
_FASTEST_HZ = 16_000  # physics; an hour there takes hours
_NO_LIMIT = {"min_voltage": -math.inf}

_NOTHING = "-"
_TOO_NARROW = "; the terminal is too narrow for all of it, --json has it"

_NAMED = 3
_REMARKS = 6
_SHOWN_AS = {  # of a demand: unit and how many of it are one of SI's
    "range": ("°", math.degrees(1.0)),
    "rate": ("°/s", math.degrees(1.0)),
    "tracking error": ("°", math.degrees(1.0)),
    "current": ("A", 1.0),
    "torque": ("N m", 1.0),
}


class DryRunVerdict(StrEnum):
    """Verdict of a dry run."""

    RUNS = "would run"
    CLAMPED = "would be clamped"
    STOPS = "would stop"
    REFUSED = "would not start"
    UNFINISHED = "not known"

    @property
    def fit(self) -> bool:
        """Whether the drive would reach its end."""
        return self in (DryRunVerdict.RUNS, DryRunVerdict.CLAMPED)


@dataclass(frozen=True)
class DryRun:
    """How a dry run went.

    Attributes:
        scenario: The scenario that it was in, with its planned duration.
        duration_s: How long the gait commanded [s].
        joints: What was asked of each joint, head to tail.
        first_pose: The first commands [rad], shape (m,).
        approach_s: How long the ramp from straight joints to there takes [s]; NaN if no limit says
            how fast it may be.
        cut: What the gait itself had cut to the joint limits.
        missing: The limits that the robot lacks to be armed.
        fault: Why the gate would end it early, None if it wouldn't.
        started: Whether it came to the first pose.
        complete: Whether it reached its end.
        remarks: What the gate had to say.
        path: The session that was written, or None.
    """

    driven: MotionSource
    scenario: Scenario
    duration_s: float
    joints: tuple[JointDemand, ...]
    first_pose: FloatArray
    approach_s: float
    cut: tuple[str, ...]
    missing: tuple[str, ...]
    fault: GateFault | None
    started: bool
    complete: bool
    remarks: tuple[GateEvent, ...]
    path: Path | None = None

    @property
    def verdict(self) -> DryRunVerdict:
        """The verdict."""
        if self.missing:
            return DryRunVerdict.REFUSED
        if self.fault is not None:
            return DryRunVerdict.STOPS
        if not self.complete:
            return DryRunVerdict.UNFINISHED
        if self.cut or any(joint.clamped for joint in self.joints):
            return DryRunVerdict.CLAMPED
        return DryRunVerdict.RUNS

    @property
    def closest(self) -> tuple[str, Demand] | None:
        """The joint and the quantity that come closest to a limit, or go farthest beyond it."""
        demands = ((joint.name, demand) for joint in self.joints for demand in joint.demands)
        finite = (demand for demand in demands if math.isfinite(demand[1].share))
        return max(finite, key=lambda pair: pair[1].share, default=None)

    @property
    def energy_j(self) -> tuple[float, float, float]:
        """Of all joints: mechanical work, the same without sign, electrical work [J]."""
        return (
            math.fsum(joint.energy_net_j for joint in self.joints),
            math.fsum(joint.energy_abs_j for joint in self.joints),
            math.fsum(joint.energy_el_j for joint in self.joints),
        )


def dry_run(
    driven: MotionSource,
    *,
    robot: Robot | None = None,
    world: Scenario | None = None,
    duration_s: float | None = None,
    output: Path | None = None,
    force: bool = False,
    stop: StopRequest | None = None,
    on_time: Callable[[float], None] | None = None,
) -> DryRun:
    """Run a motion in the twin and report its demands.

    Args:
        robot: The robot; the one that the motion was made for if None.
        world: The world; by default the one that the motion was made for, or flat ground if
            unknown.
        duration_s: Duration [s]; that of the motion if None.
        output: The session of the twin to write, or None.
        stop: Ends the dry run at the next tick.
        on_time: Called with the gait's time in each tick [s].

    Raises:
        UsageError: If the world's robot lacks a plane, or the duration can't be.
        SimulationError: If the twin's state becomes impossible.
        OutputExistsError: If the session is there and ``force`` is not given.
        LogWriteError: If the session can't be written.
    """
    where = world or driven.world() or nominal_world(robot or driven.robot)
    if robot is not None:
        where = dataclasses.replace(where, robot=where.modules.fitted(robot))
    planned = driven.scenario(where, duration_s)
    robot = planned.robot
    missing = missing_limits(robot)
    limits = gate_limits(_unlimited(robot, missing))
    inner = NotedGait(driven.make(robot, planned), robot)
    gate = Gate(inner, limits, duration_s=planned.duration_s, place=f"the twin of {robot.name}")
    gait = GatedGait(inner, gate, robot, limits)
    longest_ramp_s = Ramp(limits.lower, limits.upper, limits.ramp_rate).duration_s
    longest_s = planned.duration_s + POSE_S + 2.0 * longest_ramp_s
    scenario = planned.changed(duration_s=min(longest_s, LONGEST_S))
    with ExitStack() as opened:
        twin = opened.enter_context(Twin(scenario, gait))
        gait.twin = twin
        log = None
        if output is not None:
            facts = {"planned_duration_s": repr(planned.duration_s), "dry_run": "yes"}
            explained = driven.attachments, driven.records
            driver = Driver(gait, {**driven.facts, **facts}, *explained)
            writer = opened.enter_context(open_session(scenario, output, driver, force=force))
            log = SessionLog(writer, twin)
        try:
            for sample in twin.samples():
                gait.book(sample)
                if log is not None:
                    log.write(sample)
                    for remark in gait.fresh_remarks():
                        log.log_event(*remark)
                if on_time is not None:
                    on_time(gate.run_s)
                if gate.done or (stop is not None and stop.requested):
                    break
        except SimulationError as error:
            if log is not None:
                log.end("bad", str(error))
                log.log_event("error", str(error))
            raise
        outcome, first = gate.outcome, inner.first
        complete = outcome is not None and outcome.how is DriveEnding.COMPLETE
        if log is not None:
            why = "it was stopped" if outcome is None else outcome.why
            log.end("good" if complete else "bad", why)
    return DryRun(
        driven=driven,
        scenario=planned,
        duration_s=gate.run_s,
        joints=gait.tally.joints(),
        first_pose=first,
        approach_s=math.nan if "ramp_rate" in missing else _approach_s(first, limits),
        cut=inner.cut,
        missing=missing,
        fault=None if outcome is None else outcome.fault,
        started=gate.run_from is not None,
        complete=complete,
        remarks=tuple(gait.remarks),
        path=output,
    )


def nominal_world(robot: Robot) -> Scenario:
    """Flat ground, for a robot of which no world is known.

    Returns:
        A scenario in which nothing moves by itself, at a physics rate that the robot's gears need.
    """
    text = _NOMINAL.format(robot=robot.name, plane=robot.joints[0].plane)
    world = parse_scenario(text, "nominal", robot)
    while world.physics_rate_hz < _FASTEST_HZ and warnings(world):
        world = dataclasses.replace(world, physics_rate_hz=2 * world.physics_rate_hz)
    return world


def _unlimited(robot: Robot, missing: tuple[str, ...]) -> Robot:
    """Return the robot with the missing limits set to infinity."""
    given = {name: _NO_LIMIT.get(name, math.inf) for name in missing}
    return dataclasses.replace(robot, safety=dataclasses.replace(robot.safety or Safety(), **given))


def _approach_s(first: FloatArray, limits: GateLimits) -> float:
    """How long the ramp takes from straight joints to the first pose."""
    rest = np.clip(np.zeros_like(first), limits.lower, limits.upper)
    return Ramp(rest, np.clip(first, limits.lower, limits.upper), limits.ramp_rate).duration_s


def _number(value: float, form: str) -> str:
    return _NOTHING if math.isnan(value) else format(value, f"z{form}")


def _degrees(value: float, form: str = ".1f") -> str:
    return _number(math.degrees(value), form)


def _share(name: str) -> Callable[[JointDemand], str]:
    def cell(joint: JointDemand) -> str:
        (match,) = (demand for demand in joint.demands if demand.name == name)
        return _number(100.0 * match.share, ".0f")

    return cell


_COLUMNS: tuple[tuple[TerminalColumn, Callable[[JointDemand], str]], ...] = (
    (TerminalColumn("joint", left=True), lambda joint: joint.name),
    (TerminalColumn("from °", spare=4), lambda joint: _degrees(joint.least)),
    (TerminalColumn("to °", spare=4), lambda joint: _degrees(joint.greatest)),
    (TerminalColumn("%"), _share("range")),
    (TerminalColumn("°/s", spare=5), lambda joint: _degrees(joint.rate, ".0f")),
    (TerminalColumn("%"), _share("rate")),
    (TerminalColumn("°/s²", spare=1), lambda joint: _degrees(joint.acceleration, ".0f")),
    (TerminalColumn("error °", spare=5), lambda joint: _degrees(joint.tracking_error)),
    (TerminalColumn("%"), _share("tracking error")),
    (TerminalColumn("N m", spare=5), lambda joint: _number(joint.torque_peak, ".3f")),
    (TerminalColumn("%"), _share("torque")),
    (TerminalColumn("rms", spare=2), lambda joint: _number(joint.torque_rms, ".3f")),
    (TerminalColumn("A", spare=5), lambda joint: _number(joint.current_peak, ".2f")),
    (TerminalColumn("%"), _share("current")),
    (TerminalColumn("net J", spare=3), lambda joint: _number(joint.energy_net_j, ".3f")),
    (TerminalColumn("abs J", spare=2), lambda joint: _number(joint.energy_abs_j, ".3f")),
    (TerminalColumn("el. J", spare=3), lambda joint: _number(joint.energy_el_j, ".3f")),
    (TerminalColumn("clamped", spare=3), lambda joint: _number(joint.clamped or math.nan, ".0%")),
)


def joint_table(joints: Sequence[JointDemand], width: int) -> Iterator[str]:
    """The table.

    Args:
        joints: What is asked of each.
        width: Characters in a line; columns that may go, go where they don't fit.

    Yields:
        What the percentages are of, the heads, a line for each joint.
    """
    rows = [[(cell(joint), "") for _, cell in _COLUMNS] for joint in joints]
    lines, left_out = table([column for column, _ in _COLUMNS], rows, width)
    yield (
        "% of the limit: half the range, [safety]'s rate, tracking error and current, the servo's "
        f"stall torque{_TOO_NARROW if left_out else ''}"
    )
    yield from (line.plain for line in lines)


def summary_lines(run: DryRun, width: int) -> Iterator[str]:
    """Lines for a terminal.

    Args:
        width: Characters in a line of the table.

    Yields:
        The answer, what it would take, the joints.
    """
    yield from _answer(run)
    yield from _remarks(run)
    where = f"{run.driven.kind} in the twin of {run.scenario.robot.name} in {run.scenario.name}"
    yield f"{where}, {run.duration_s:g} s; nothing was sent, and no bus opened"
    yield _approach(run)
    seconds = max(run.duration_s, 1e-9)
    net, absolute, electrical = run.energy_j
    yield (
        f"energy: mechanical {net:.3g} J net and {absolute:.3g} J absolute, electrical "
        f"{electrical:.3g} J; mean power {net / seconds:.3g} W and {electrical / seconds:.3g} W"
    )
    if run.path is not None:
        yield f"session of the twin: {run.path}"
    yield ""
    yield from joint_table(run.joints, width)


def _answer(run: DryRun) -> Iterator[str]:
    robot, near = run.scenario.robot.name, _nearest(run)
    what = f"{run.driven.name} on {robot}"
    match run.verdict:
        case DryRunVerdict.RUNS:
            yield f"{what} would run as it is; {near}"
        case DryRunVerdict.CLAMPED:
            yield f"{what} would run, clamped: {_clamps(run)}; {near}"
        case DryRunVerdict.STOPS:
            when = f"at {run.duration_s:.2f} s" if run.started else "on the way to the first pose"
            yield f"{what} would stop {when}: {run.fault.text if run.fault is not None else ''}"
        case DryRunVerdict.UNFINISHED:
            yield (
                f"{what}: not known, the dry run was stopped at {run.duration_s:g} s of "
                f"{run.scenario.duration_s:g} s; {near}"
            )
        case DryRunVerdict.REFUSED:
            lacks = f"{robot} lacks the limits {', '.join(run.missing)}"
            yield f"{what} would not start: {lacks}; {near}"
            yield "Its description needs this, with values of its own; --robot names the file:"
            yield from (f"  {line}" for line in safety_example(run.missing).splitlines())


def _nearest(run: DryRun) -> str:
    """What comes closest to its limit."""
    closest = run.closest
    if closest is None:
        return "it has no limits to come close to"
    joint, demand = closest
    unit, scale = _SHOWN_AS[demand.name]
    return (
        f"closest to a limit: {joint}, {demand.name} {scale * demand.value:.3g} of "
        f"{scale * demand.limit:.3g} {unit} ({demand.share:.0%})"
    )


def _clamps(run: DryRun) -> str:
    named = [
        f"{joint.name} {joint.clamped:.0%} of the time" for joint in run.joints if joint.clamped
    ]
    cut = f"cut to the joint limits: {', '.join(run.cut)}" if run.cut else ""
    return "; ".join(part for part in (some_names(named, _NAMED), cut) if part)


def _remarks(run: DryRun) -> Iterator[str]:
    """What the gate would change, and why."""
    texts = [remark.text for remark in run.remarks if remark.level == "warn"]
    yield from (f"  {text}" for text in texts[:_REMARKS])
    if len(texts) > _REMARKS:
        yield f"  and {len(texts) - _REMARKS} more of this kind; --json has all"


def _approach(run: DryRun) -> str:
    if np.isnan(run.first_pose).any():
        return "first pose: not known"
    farthest = max(range(len(run.joints)), key=lambda i: abs(run.first_pose[i]))
    angle = math.degrees(run.first_pose[farthest])
    if run.approach_s == 0.0:
        return "first pose: straight joints"
    how_long = f"a ramp of {run.approach_s:.2f} s from straight joints"
    if math.isnan(run.approach_s):
        how_long = "no ramp_rate gives the speed of the way there"
    return f"first pose: {run.joints[farthest].name} farthest, at {angle:.1f}°; {how_long}"


def reported(run: DryRun) -> dict[str, Any]:
    """The dry run as plain JSON values.

    Returns:
        SI units; what isn't known, or has no limit, is None.
    """
    closest = run.closest
    net, absolute, electrical = run.energy_j
    seconds = max(run.duration_s, 1e-9)
    return {
        "armed": False,
        "driven": run.driven.name,
        "kind": run.driven.kind,
        "robot": run.scenario.robot.name,
        "world": run.scenario.name,
        "verdict": str(run.verdict),
        "would_run": run.verdict.fit,
        "duration_s": run.duration_s,
        "planned_duration_s": run.scenario.duration_s,
        "stop": _stop(run),
        "missing_limits": list(run.missing),
        "closest": None if closest is None else {"joint": closest[0], **_demand(closest[1])},
        "first_pose": list(run.first_pose),
        "approach_s": _known(run.approach_s),
        "energy_net_j": net,
        "energy_abs_j": absolute,
        "energy_el_j": electrical,
        "power_net_w": net / seconds,
        "power_el_w": electrical / seconds,
        "cut": list(run.cut),
        "remarks": [{"level": remark.level, "text": remark.text} for remark in run.remarks],
        "joints": [_joint(joint) for joint in run.joints],
        "path": None if run.path is None else str(run.path),
    }


def _stop(run: DryRun) -> dict[str, Any] | None:
    fault = run.fault
    if fault is None:
        return None
    time_s = run.duration_s if run.started else None
    return {"time_s": time_s, "why": fault.text, **fault.to_dict()}


def _joint(joint: JointDemand) -> dict[str, Any]:
    values = {name: _known(value) for name, value in vars(joint).items()}
    shares = {demand.name.replace(" ", "_"): _known(demand.share) for demand in joint.demands}
    return {**values, "margin": joint.margin, "share": shares}


def _demand(demand: Demand) -> dict[str, Any]:
    return {
        "quantity": demand.name,
        "value": demand.value,
        "limit": demand.limit,
        "share": demand.share,
    }


def _known(value: Any) -> Any:
    return None if isinstance(value, float) and not math.isfinite(value) else value
