"""Command ``drive``: on the twin, or over a bus."""

from __future__ import annotations

import os
import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

from undulog.capture.commands.sessions import SessionLine, each_session, sessions_of, show
from undulog.capture.commands.topic_options import CommandTopic
from undulog.capture.common.console import (
    UNLIMITED,
    complain,
    emit,
    output_width,
    progress,
    refuse_existing,
)
from undulog.capture.common.errors import LogWriteError, UsageError
from undulog.capture.common.process import interruptible

from .run import check_session_name, speed_text, with_progress

if TYPE_CHECKING:
    from undulog.capture.robot.model import Robot

    from ..drive.loop import BusTick
    from ..drive.motion import MotionSource
    from ..drive.report import BusReport
    from ..scenario.scenario import Scenario
    from ..twin.recording import TwinRecording

_TWIN = "twin"
_CONTRACT = CommandTopic()


@dataclass(frozen=True)
class BusDrive:
    """A motion for a bus, as the command line gives it.

    Attributes:
        robot: The robot on the bus; the one that the motion was made for if None.
        duration_s: Duration [s]; that of the motion if None.
        output: The session to write; a dry run needs none.
        recorder: Control socket of a recorder; that of the only running one if None.
    """

    driven: MotionSource
    on: str
    robot: Robot | None
    duration_s: float | None
    output: Path | None
    recorder: Path | None
    force: bool

    def drive(self) -> BusReport:
        """Drive over the bus, with progress on a terminal.

        Returns:
            The report, also where it ended early.

        Raises:
            UsageError: If the arguments can't be used, e.g. the robot has no limits.
            SourceError: If the bus is silent, or the robot can't be driven from its pose.
        """
        from ..drive.loop import ConsoleWatch
        from ..drive.over_bus import bus_plan, drive_bus

        if self.output is None:
            raise UsageError(
                "an armed drive is recorded, with every action of the gate: name the session with "
                "-o, e.g. -o drive.mcap"
            )
        recorder = self.recorder or _only_recorder()
        settings = self.output, self.robot, self.duration_s
        plan = bus_plan(self.driven, self.on, *settings, recorder=recorder, force=self.force)
        console = ConsoleWatch()
        start = time.monotonic()
        with interruptible(twice=True) as stop, progress(plan.driven.name, plan.duration_s) as bar:

            def show(tick: BusTick) -> None:
                note = f"{tick.step.phase}, {speed_text(tick.time_s, start)}"
                bar.update(min(tick.time_s, plan.duration_s), note)

            report = drive_bus(plan, stop=stop, on_tick=show, console=console)
            console.gone()  # output is discarded from here on
        return report

    def dry_run(self, *, as_json: bool) -> int:
        """Run the motion in the twin, through the gate of the bus, and print the report.

        Args:
            as_json: Report as one JSON object.

        Returns:
            The exit code.

        Raises:
            UsageError: If the arguments can't be used, e.g. the robot has no bus.
        """
        from ..drive.dry_run import dry_run, reported, summary_lines
        from ..drive.over_bus import check_drivable

        if self.recorder is not None:
            raise UsageError("--recorder is for --arm: a dry run sends nothing")
        driven = self.driven
        check_drivable(driven, self.robot or driven.robot)
        start = time.monotonic()
        length_s = driven.duration_s if self.duration_s is None else self.duration_s
        with interruptible() as stop, progress(f"dry run of {driven.name}", length_s) as bar:
            dry = dry_run(
                driven,
                robot=self.robot,
                duration_s=self.duration_s,
                output=self.output,
                force=self.force,
                stop=stop,
                on_time=lambda time_s: bar.update(time_s, speed_text(time_s, start)),
            )
        hint = ["", f"To send it to {self.on}, the same with --arm and -o SESSION.mcap"]
        lines = [*summary_lines(dry, output_width()), *(hint if dry.verdict.fit else [])]
        emit({"on": self.on, **reported(dry)}, lines, as_json=as_json)
        return 0 if dry.verdict.fit else 1


def early_end(report: BusReport) -> int:
    """Print on stderr what ended a drive early; return the exit code, 0 if nothing did."""
    if report.complete:
        return 0
    complain(f"error: {report.outcome.why}; {report.outcome.ended}")
    return 1


def _only_recorder() -> Path | None:
    """Return the control socket of the running recorder, None if there is none."""
    from undulog.capture.recorder.control_client import find_sockets

    sockets = find_sockets(os.environ)
    if len(sockets) > 1:
        listed = "\n".join(f"  --recorder {path}" for path in sockets)
        raise UsageError(
            f"{len(sockets)} recorders run; which one is to receive the gait?\n{listed}"
        )
    return sockets[0] if sockets else None


def _dry_runs(
    whats: Sequence[str], on: str, robot: Robot | None, duration_s: float | None, topic: str
) -> dict[str, SessionLine]:
    """Run motions in the twin, through the gate of a bus, one after the other."""
    from ..drive.dry_run import dry_run, reported, summary_lines
    from ..drive.motion import find_motion
    from ..drive.over_bus import check_drivable

    def line(what: str) -> SessionLine:
        driven = find_motion(what, robot=robot, command_topic=topic)
        check_drivable(driven, robot or driven.robot)
        with interruptible() as stop:
            dry = dry_run(driven, robot=robot, duration_s=duration_s, stop=stop)
        if stop.requested:
            raise KeyboardInterrupt
        first, verdict = next(iter(summary_lines(dry, UNLIMITED))), dry.verdict
        facts = {"on": on, **reported(dry)}
        return SessionLine(dry.scenario.robot.name, driven.name, verdict, first, facts, verdict.fit)

    return each_session(whats, "dry run", line)


def _twin_runs(
    whats: Sequence[str],
    world: Scenario | None,
    folder: Path,
    duration_s: float | None,
    topic: str,
    *,
    force: bool,
) -> dict[str, SessionLine]:
    """Drive motions on the twin, one after the other, each into a session of its name."""
    from ..drive.in_process import drive_twin
    from ..drive.motion import find_motion

    outputs = {what: folder / f"{Path(what).stem}.mcap" for what in whats}
    for what, output in outputs.items():
        if list(outputs.values()).count(output) > 1 or output.resolve() == Path(what).resolve():
            raise UsageError(f"{what}: {output} would replace another session; name another folder")
        if folder.is_dir():
            refuse_existing(output, force=force)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise LogWriteError(folder, f"no folder can be made: {error.strerror or error}") from error

    def line(what: str) -> SessionLine:
        driven = find_motion(what, world, command_topic=topic)
        scenario = driven.scenario(world, duration_s)
        start = time.monotonic()
        with interruptible() as stop:
            recording = drive_twin(driven, scenario, outputs[what], force=force, stop=stop)
        if stop.requested:
            raise KeyboardInterrupt
        factor = recording.duration_s / (time.monotonic() - start)
        facts = _reported(driven, scenario, recording, factor)
        first = _summary(driven, scenario, recording, factor)[0]
        return SessionLine(scenario.robot.name, driven.name, "good", first, facts)

    return each_session(whats, "drive", line)


def _motions(given: Sequence[str]) -> list[str]:
    """Return what is named: of a folder its TOML files and sessions, of a pattern what fits it."""
    from ..scenario.scenario_file import scenario_names

    motions: list[str] = []
    for what in given:
        plans = sorted(Path(what).glob("*.toml")) if what not in scenario_names() else []
        sessions = [
            session for session in sessions_of([Path(what)]) if str(session) != str(Path(what))
        ]
        motions += map(str, [*plans, *sessions]) if plans or sessions else [what]
    return motions


def drive(
    what: str,
    /,
    *more: str,
    on: str,
    output: Annotated[Path | None, Parameter(name=["--output", "-o"])] = None,
    duration: float | None = None,
    arm: bool = False,
    robot: str | None = None,
    commands: CommandTopic = _CONTRACT,
    recorder: Path | None = None,
    force: bool = False,
    json: bool = False,
) -> int:
    """Drive a gait, a plan or recorded commands on the twin or over a bus.

    On the twin it runs faster than real time and is recorded like `undulog sim run`. Over a bus it
    is a dry run: it runs in the twin and reports what it would take. With `--arm` commands are
    sent, 100 times a second, behind a safety gate: it reads the pose, ramps to the first one,
    keeps to the limits of the robot's file, and ends as defined there on a fault, on Ctrl-C (twice:
    at once) and when the console goes.

    Example: `undulog drive flat --on 'can:socketcand:can0?port=29536' --arm -o driven.mcap`

    Args:
        what: Name of a shipped scenario, or a scenario's TOML file: its gait is driven. Or a plan,
            a TOML file of segments. Or a session, `.mcap`: its commands are given again.
        more: More of them, folders or patterns, on the twin or for dry runs over a bus: a table, a
            line each.
        on: `twin` (the world that it was made for), `twin:SCENARIO`, or a bus,
            `can:INTERFACE:CHANNEL[?KEY=VALUE&...]`.
        output: The session file to write, `.mcap`, or the folder for the sessions of several
            motions, each with the motion's name; a dry run needs none.
        duration: How long to drive in seconds, instead of the gait's or plan's duration.
        arm: Send the commands.
        robot: The robot on the bus, a name or a TOML file; by default the one that it was made for.
        commands: Where the commands of a session are; they are never found by type.
        recorder: Control socket of the recorder that receives the gait; by default the only one
            that runs.
        force: Replace the output if it is there.
        json: Print one JSON object instead of text.
    """
    from ..drive.in_process import drive_twin
    from ..drive.motion import find_motion
    from ..scenario.scenario_file import load_scenario

    topic = commands.command_topic
    whats = _motions([what, *more])
    scheme, colon, rest = on.partition(":")
    several = len(whats) > 1
    if several and (arm or (output is not None and scheme != _TWIN)):
        raise UsageError(
            f"{what}: {len(whats)} motions; several are for the twin, or for dry runs over a bus, "
            "without --arm and -o; name one"
        )
    asked, what = what, whats[0]
    if output is not None and not several:
        check_session_name(output)
        refuse_existing(output, force=force)
    if scheme == _TWIN and colon and not rest:
        raise UsageError("--on twin: names no scenario; expected twin or twin:SCENARIO")
    if scheme != _TWIN:
        from undulog.capture import load_robot

        from ..drive.over_bus import bus_address

        bus_address(on)
        described = load_robot(robot) if robot is not None else None
        if several:
            return show(_dry_runs(whats, on, described, duration, topic), as_json=json)
        driven = find_motion(what, robot=described, command_topic=topic)
        given = BusDrive(driven, on, described, duration, output, recorder, force)
        if not arm:
            return given.dry_run(as_json=json)
        report = given.drive()
        emit(report.facts(), report.lines(), as_json=json)
        return early_end(report)
    if arm or recorder is not None or robot is not None:
        raise UsageError(
            "--arm, --recorder and --robot are for a bus; a run of the twin records itself"
        )
    world = load_scenario(rest) if rest else None
    if several:
        if output is None or output.suffix == ".mcap":
            raise UsageError(
                f"{asked}: {len(whats)} runs of the twin are recorded: name a folder for them, "
                "e.g. -o driven"
            )
        lines = _twin_runs(whats, world, output, duration, topic, force=force)
        return show(lines, as_json=json)
    driven = find_motion(what, world, command_topic=topic)
    scenario = driven.scenario(world, duration)
    if output is None:
        raise UsageError(
            "a run of the twin is recorded: name the session with -o, e.g. -o run.mcap"
        )
    recording, factor = with_progress(
        driven.name, scenario, partial(drive_twin, driven, scenario, output, force=force)
    )
    facts = _reported(driven, scenario, recording, factor)
    emit(facts, _summary(driven, scenario, recording, factor), as_json=json)
    return 0


def _reported(
    driven: MotionSource, scenario: Scenario, recording: TwinRecording, factor: float
) -> dict[str, Any]:
    return {
        "driven": driven.name,
        "kind": driven.kind,
        "on": f"{_TWIN}:{scenario.name}",
        "robot": scenario.robot.name,
        "path": str(recording.path),
        "session_id": recording.session_id,
        "duration_s": recording.duration_s,
        "planned_duration_s": scenario.duration_s,
        "complete": recording.complete,
        "ticks": recording.sample_count,
        "real_time_factor": factor,
    }


def _summary(
    driven: MotionSource, scenario: Scenario, recording: TwinRecording, factor: float
) -> list[str]:
    if recording.complete:
        first = f"{recording.path}: drove {driven.name} for {recording.duration_s:g} s"
    else:
        first = (
            f"stopped at rest at {recording.duration_s:g} s of {scenario.duration_s:g} s; "
            f"{recording.path} is complete up to there"
        )
    who = f"{driven.kind} on the twin of {scenario.robot.name} in {scenario.name}, "
    who += f"{recording.sample_count} ticks, session {recording.session_id}"
    return [first, who, f"simulated at {factor:.1f} x real time"]
