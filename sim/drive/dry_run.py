"""Dry run of a motion in the twin of its robot, through the gate of a bus.

It is the same gate (:mod:`.sim.gate.gate`), state by state: it reads the pose of the twin's servos,
ramps to the first pose, clamps, watches and ends. What the twin does not have (temperatures, supply
voltages, lost replies, a late process) is not tried.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

import numpy as np

from undulog.capture.common.arrays import FloatArray
from undulog.capture.common.errors import SimulationError
from undulog.capture.common.process import StopRequest
from undulog.capture.robot.model import Robot, Safety

from ..gate.gate import POSE_S, Gate
from ..gate.limits import GateLimits, Ramp, gate_limits, missing_limits
from ..gate.outcome import DriveEnding, GateEvent, GateFault
from ..scenario.scenario import LONGEST_S, Scenario
from ..scenario.scenario_file import parse_scenario
from ..twin.recording import Driver, open_session
from ..twin.session_log import SessionLog
from ..twin.stability import warnings
from ..twin.twin import Twin
from .dry_run_gait import Demand, GatedGait, JointDemand, NotedGait
from .motion import MotionSource

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


class Verdict(StrEnum):
    """Verdict of a dry run."""

    RUNS = "would run"
    CLAMPED = "would be clamped"
    STOPS = "would stop"
    REFUSED = "would not start"
    UNFINISHED = "not known"

    @property
    def fit(self) -> bool:
        """Whether the drive would reach its end."""
        return self in (Verdict.RUNS, Verdict.CLAMPED)


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
    def verdict(self) -> Verdict:
        """The verdict."""
        if self.missing:
            return Verdict.REFUSED
        if self.fault is not None:
            return Verdict.STOPS
        if not self.complete:
            return Verdict.UNFINISHED
        if self.cut or any(joint.clamped for joint in self.joints):
            return Verdict.CLAMPED
        return Verdict.RUNS

    @property
    def closest(self) -> tuple[str, Demand] | None:
        """The joint and the quantity that come closest to a limit, or go farthest beyond it."""
        demands = ((joint.name, demand) for joint in self.joints for demand in joint.demands)
        finite = (one for one in demands if math.isfinite(one[1].share))
        return max(finite, key=lambda one: one[1].share, default=None)

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
    place = f"the twin of {robot.name}"
    gate = Gate(inner, limits, duration_s=planned.duration_s, place=place)
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
    target = np.clip(first, limits.lower, limits.upper)
    return Ramp(rest, target, limits.ramp_rate).duration_s
