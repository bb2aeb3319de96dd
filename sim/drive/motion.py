"""Motions to be driven: a scenario's gait, a plan, or the commands of a session.

Recorded commands, given again at their own times: each joint's by zero-order hold.

The time of the first command is time zero. A joint holds its newest command; before its first one
(a bus gives the joints their commands in turn) it holds that first one, for a jump from straight
joints would be nobody's command. Of a session of the twin every tick finds exactly the command that
was given then, bit by bit.
"""

from __future__ import annotations

import dataclasses
import math
from bisect import bisect_right
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Self, TypeVar

import numpy as np

from undulog.capture import Session
from undulog.capture.common.arrays import NS, FloatArray, IntArray
from undulog.capture.common.console import complain
from undulog.capture.common.errors import (
    DataError,
    JointSetError,
    MissingChannelError,
    PlanError,
    UsageError,
)
from undulog.capture.common.files import Shelf
from undulog.capture.log.read.sample_times import JointSignals
from undulog.capture.robot.model import Plane, Robot

from ..gait.contract import CONTROL_RATE_HZ, Gait, GaitTick, Readings
from ..scenario.scenario import Kernels, Scenario
from ..scenario.scenario_file import load_scenario, parse_scenario, scenario_names
from ..twin.adaptive import build_gait
from .plan import PlanGait, is_plan, parse_plan

COMMANDS = "/joint_commands"
REPLAY = "replay"
"""The mode of commands whose session names none."""


class _Held:
    """Values of several names, each by zero-order hold; NaN is a value unless ``known`` only."""

    def __init__(self, signals: JointSignals, *, known: bool = False) -> None:
        self.names = signals.names
        self._series: list[tuple[IntArray, FloatArray]] = []
        for t_ns, values in zip(signals.t_ns, signals.values, strict=True):
            kept = ~np.isnan(values) if known else slice(None)
            self._series.append((t_ns[kept], values[kept]))

    @property
    def given(self) -> bool:
        """Whether there is any value."""
        return any(len(t_ns) for t_ns, _ in self._series)

    def span(self) -> tuple[int, int]:
        """Time of the first and of the last value [Unix ns]."""
        times = [t_ns for t_ns, _ in self._series if len(t_ns)]
        return int(min(t[0] for t in times)), int(max(t[-1] for t in times))

    def at(self, t_ns: int) -> FloatArray:
        """The values in force at a time; NaN of what has none."""
        found = np.full(len(self._series), np.nan)
        for i, (times, values) in enumerate(self._series):
            if len(times):
                k = int(np.searchsorted(times, t_ns, side="right")) - 1
                found[i] = values[max(k, 0)]
        return found


@dataclass(frozen=True)
class RecordedCommands:
    """The commands of a session.

    Attributes:
        commands: Joint angles [rad], of some or all of a robot's joints.
        gait: The values of the gait, None where they were not recorded.
        modes: Its modes, with the times from which they were in force [Unix ns], in order.
    """

    commands: JointSignals
    gait: JointSignals | None = None
    modes: tuple[tuple[int, str], ...] = ()

    @classmethod
    def read(cls, session: Session, command_topic: str = COMMANDS) -> Self:
        """Read a session.

        Args:
            session: Open; it is not needed afterwards.
            command_topic: Its commands. They may move a robot, so that they are never guessed.

        Raises:
            MissingChannelError: If it has none.
        """
        if command_topic == COMMANDS not in session.channels:
            listed = sorted(session.channels)
            raise MissingChannelError(session.path, COMMANDS, listed, "choose with --command-topic")
        commands = session.joints(session.joint_topics(command_topic).command)
        gait = session.joints("/gait") if "/gait" in session.channels else None
        modes = session.messages("/gait/mode") if "/gait/mode" in session.channels else ()
        return cls(commands, gait, tuple((t_ns, str(message.data)) for t_ns, message in modes))


class CommandReplay:
    """The commands of a session as a gait; it does not look at the readings."""

    def __init__(self, recorded: RecordedCommands, robot: Robot) -> None:
        """Wrap recorded commands.

        Args:
            recorded: The commands; joints without one are held straight.
            robot: The robot that executes them.

        Raises:
            JointSetError: If the robot lacks one of the joints.
            DataError: If there is no command.
        """
        held = _Held(recorded.commands, known=True)
        strange = [name for name in held.names if name not in robot.joint_names]
        if strange:
            raise JointSetError(
                f"{COMMANDS} has joints that {robot.name} lacks: {', '.join(strange)}; it commands "
                f"{', '.join(held.names)}; {robot.name} has {', '.join(robot.joint_names)}"
            )
        if not held.given:
            raise DataError(f"{COMMANDS} holds no command")
        self._commands = held
        self._joints = [robot.joint_names.index(name) for name in held.names]
        self._joint_names = robot.joint_names
        self._lower, self._upper = robot.limits()
        self._rest = np.clip(np.zeros(len(robot.joints)), self._lower, self._upper)
        self._gait = _Held(recorded.gait) if recorded.gait is not None else None
        self.names: tuple[str, ...] = self._gait.names if self._gait is not None else ()
        self._since_ns = [t_ns for t_ns, _ in recorded.modes]
        self._modes = [REPLAY, *(mode for _, mode in recorded.modes)]
        self._start_ns, self._end_ns = held.span()

    @property
    def duration_s(self) -> float:
        """From the first command to the last, up to a whole control period [s]."""
        periods = (self._end_ns - self._start_ns) * CONTROL_RATE_HZ / NS
        return max(math.ceil(periods - 1e-6), 1) / CONTROL_RATE_HZ

    def step(self, time_s: float, readings: Readings) -> GaitTick:  # noqa: ARG002 - recorded
        """Return the commands in force at a time."""
        t_ns = self._start_ns + round(time_s * NS)
        wanted = self._rest.copy()
        given = self._commands.at(t_ns)
        wanted[self._joints] = np.where(np.isnan(given), self._rest[self._joints], given)
        command = np.clip(wanted, self._lower, self._upper)
        cut = np.flatnonzero(command != wanted)
        clamped = tuple(self._joint_names[i] for i in cut)
        values = self._gait.at(t_ns) if self._gait is not None else np.empty(0)
        return GaitTick(command, values, self._modes[bisect_right(self._since_ns, t_ns)], clamped)


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
        own: The scenario whose gait and controller are driven, if that is what it is: a run's
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
    own: Scenario | None = None
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
        if self.own is not None:
            where = dataclasses.replace(where, gait=self.own.gait, controller=self.own.controller)
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
    found = Shelf("gait or plan", "undulog.sim", "scenarios", PlanError).read(word)
    if is_plan(found.text):
        return _plan(found.text, found.source)
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
        own=scenario,
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
