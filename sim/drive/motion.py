"""Motions to be driven: a scenario's gait, a plan, or the commands of a session."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

from undulog.capture import Session
from undulog.capture.common.console import complain
from undulog.capture.common.errors import (
    DataError,
    JointSetError,
    PlanError,
    UsageError,
)
from undulog.capture.common.files import Shelf
from undulog.capture.robot.model import Plane, Robot

from ..gait.contract import Gait
from ..scenario.scenario import Kernels, Scenario
from ..scenario.scenario_file import load_scenario, parse_scenario, scenario_names
from ..twin.adaptive import build_gait
from .plan import PlanGait, is_plan, parse_plan
from .recorded_commands import COMMANDS, CommandReplay, RecordedCommands

# Attachments of recorded commands that say what they were made from: they go on to the run.
_EXPLAINS = ("plan.toml", "gait.toml")

_HEADING = "heading_rad"
# Keys of a plan's record: by how much the robot is turned [rad], and the number of the run.
_RUN = "run"

_Number = TypeVar("_Number", int, float)

# Metadata records of recorded commands that say what they are for: likewise.
_RECORDS = ("undulog.plan",)


@dataclass(frozen=True)
class MotionSource:
    """A motion to be driven.

    Attributes:
        kind: ``gait``, ``plan`` or ``commands``.
        robot: The robot that it was made for.
        world: Finds the scenario that it was made for, None where that isn't known.
        planes: The planes that it needs.
        make: Builds the gait, at time zero, for a robot; in a world if that is given, else in the
            one that it was made for.
        facts: What a session's metadata says of it.
        attachments: File name to TOML text that explains it.
        origin: The scenario whose gait and controller are driven, if that is what it is: a run's
            scenario then says it all.
        settle_s: The first part of it that is not fit for steady-state analysis, None where it
            does not say.
        records: Metadata records that go along, by name.
        kernels: What computed the force laws in the run that it is taken from.
        joints: The joints that recorded commands are for; None where it is no commands.
        heading_rad: By how much its plan turns the robot against the world's own heading [rad].
        run: Its number in a plan that repeats commands; every run gets noise of its own.
        as_run: Whether it is taken from a run, whose world has that heading and noise already.
    """

    kind: str
    name: str
    robot: Robot
    world: Callable[[], Scenario | None]
    duration_s: float
    planes: tuple[Plane, ...]
    make: Callable[[Robot, Scenario | None], Gait]
    facts: Mapping[str, str]
    attachments: Mapping[str, bytes]
    origin: Scenario | None = None
    settle_s: float | None = None
    records: Mapping[str, Mapping[str, str]] = field(default_factory=dict[str, Mapping[str, str]])
    kernels: Kernels = Kernels.NUMPY
    joints: tuple[str, ...] | None = None
    heading_rad: float = 0.0
    run: int = 0
    as_run: bool = False

    def check_fits(self, robot: Robot) -> None:
        """Check that a robot on a bus has the joints and the planes of the motion.

        Raises:
            JointSetError: If its commands are of another joint set.
            UsageError: If the robot lacks a plane.
        """
        if self.joints is not None and set(self.joints) != set(robot.joint_names):
            raise JointSetError(
                f"{self.name} is of another joint set than {robot.name}; nothing was sent\n"
                f"  it commands {len(self.joints)} joints: {', '.join(self.joints)}\n"
                f"  {robot.name} has {len(robot.joint_names)}: {', '.join(robot.joint_names)}"
            )
        for plane in self.planes:
            if not len(robot.joint_indices(plane)):
                raise UsageError(
                    f"{self.name} moves {plane} joints, and {robot.name} has none; nothing was sent"
                )

    def scenario(self, world: Scenario | None, duration_s: float | None) -> Scenario:
        """The scenario of a run on the twin.

        Args:
            world: Where to run it; where it was made for if None.
            duration_s: Length of the run; its own if None.

        Returns:
            The world, with the length, the settling time that it says, the robot turned as its
            plan says, the seed of the noise raised by its number in the plan, and, if it is a
            scenario's gait, that gait and controller.

        Raises:
            UsageError: If no world is known, or its robot lacks a plane.
            ScenarioError: If the world that it was made for can't be had, e.g. for its robot.
        """
        where = world or self.world()
        if where is None:
            raise UsageError(
                f"{self.name} does not name the world it ran in; name one, e.g. --on twin:flat"
            )
        for plane in self.planes:
            if not len(where.robot.joint_indices(plane)):
                raise UsageError(
                    f"{self.name} moves {plane} joints and {where.robot.name} of {where.name} has "
                    "none"
                )
        if world is not None or not self.as_run:
            turned = where.world.turned(self.heading_rad) if self.heading_rad else where.world
            where = dataclasses.replace(where, world=turned, seed=where.seed + self.run)
        if self.origin is not None:
            where = dataclasses.replace(
                where, gait=self.origin.gait, controller=self.origin.controller
            )
        if self.settle_s is not None:
            where = dataclasses.replace(where, settle_s=self.settle_s)
        return where.changed(duration_s=self.duration_s if duration_s is None else duration_s)


def find_motion(
    word: str,
    world: Scenario | None = None,
    changes: Mapping[str, Any] | None = None,
    robot: Robot | None = None,
    command_topic: str = COMMANDS,
) -> MotionSource:
    """Find a motion by name.

    Args:
        word: Name of a shipped scenario, or a file: a scenario or a plan (TOML), or a session of
            commands (MCAP).
        world: Where it will be run, if that is known: its robot takes recorded commands.
        changes: Of recorded commands: what to change of the world that they were recorded in, see
            :func:`.sim.scenario.scenario_file.parse_scenario`.
        robot: The robot for recorded commands, in place of that of the session or world.
        command_topic: Where the commands of a session are.

    Raises:
        UsageError: If there is no such thing.
        InputFileError: If there is no such file.
        FaultyFileError: If a file has faults; lists all of them.
        LogError: If a session can't be read, or has no commands.
        DataError: If a session's commands are of another robot, or of none.
    """
    path = Path(word)
    is_folder = path.is_dir() and word not in scenario_names()  # of the parts of a session
    if path.suffix == ".mcap" or is_folder:
        return _commands(path, world, changes, robot, command_topic)
    document = Shelf("gait or plan", "undulog.sim", "scenarios", PlanError).read(word)
    if is_plan(document.text):
        return _plan(document.text, document.source)
    return _gait(load_scenario(word))


def _gait(scenario: Scenario) -> MotionSource:
    def make(robot: Robot, world: Scenario | None) -> Gait:
        return build_gait(world or dataclasses.replace(scenario, robot=robot))

    return MotionSource(
        kind="gait",
        name=scenario.name,
        robot=scenario.robot,
        world=lambda: scenario,
        duration_s=scenario.duration_s,
        planes=tuple(scenario.gait.planes),
        make=make,
        facts={"driven": "gait", "driven.by": scenario.name},
        attachments={"gait.toml": scenario.toml().encode()},
        origin=scenario,
        settle_s=scenario.settle_s,
    )


def _plan(text: str, source: Path) -> MotionSource:
    plan = parse_plan(text, source)
    return MotionSource(
        kind="plan",
        name=plan.name,
        robot=plan.scenario.robot,
        world=lambda: plan.scenario,
        duration_s=plan.duration_s,
        planes=tuple(plan.start),
        make=lambda robot, _: PlanGait(plan, robot),
        facts={"driven": "plan", "driven.by": plan.name},
        attachments={"plan.toml": text.encode()},
    )


def _commands(
    path: Path,
    world: Scenario | None,
    changes: Mapping[str, Any] | None,
    robot: Robot | None,
    command_topic: str,
) -> MotionSource:
    facts = {"driven": "commands", "driven.by": path.name}
    with Session.open(path) as session:
        recorded = RecordedCommands.read(session, command_topic)
        for warning in session.warnings:  # of a damaged log commands may be missing
            complain(f"warning: {path}: {warning}")
        stored, meta = session.attachments, session.metadata
        settle_s, described = session.settle_s, session.robot
        if robot is None:
            robot = described if world is None else world.robot
        facts["driven.session_id"] = session.session_id
    if robot is None:
        raise DataError(
            f"{path}: the session has no robot; name one by its world, e.g. twin:flat, or, on a "
            "bus, by --robot"
        )
    try:
        replay = CommandReplay(recorded, robot)
    except JointSetError as error:
        raise JointSetError(f"{path}: {error}") from error
    except DataError as error:
        raise DataError(f"{path}: {error}") from error

    def recorded_world() -> Scenario | None:
        """The scenario that a session of the twin ran."""
        text = stored.get("scenario.toml")
        if text is None:
            return None
        return parse_scenario(text.decode(), f"{path}:scenario.toml", described, changes)

    return MotionSource(
        kind="commands",
        name=path.name,
        robot=robot,
        world=recorded_world,
        duration_s=replay.duration_s,
        planes=(),
        make=lambda robot, _: CommandReplay(recorded, robot),
        facts=facts,
        attachments={name: stored[name] for name in _EXPLAINS if name in stored},
        settle_s=settle_s,
        records={name: meta[name] for name in _RECORDS if name in meta},
        kernels=_kernels(meta.get("undulog", {}).get("kernels")),
        joints=recorded.commands.names,
        heading_rad=_planned(meta, _HEADING, float, path),
        # A plan that turns the robot repeats its commands; others change them from run to run.
        run=_planned(meta, _RUN, int, path) if _HEADING in meta.get("undulog.plan", {}) else 0,
        as_run="driven" in meta.get("undulog", {}),
    )


def _planned(
    meta: Mapping[str, Mapping[str, str]], key: str, kind: Callable[[str], _Number], path: Path
) -> _Number:
    """A number of the plan's record."""
    text = meta.get("undulog.plan", {}).get(key, "0")
    try:
        value = kind(text)
    except ValueError:
        value = None
    if value is None or not math.isfinite(value) or (isinstance(value, int) and value < 0):
        raise DataError(f"{path}: {key} of its plan is {text!r}; expected a number")
    return value


def _kernels(name: str | None) -> Kernels:
    """Return the kernels of a session; the default if unknown."""
    return Kernels(name) if name in set(Kernels) else Kernels.NUMPY
