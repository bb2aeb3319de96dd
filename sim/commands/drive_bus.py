"""Armed driving over a bus, for the commands that offer it."""

from __future__ import annotations

import os
import shutil
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from undulog.capture.common.console import UNLIMITED, complain, echo, emit_json, progress
from undulog.capture.common.errors import UsageError
from undulog.capture.common.process import interruptible
from undulog.capture.recorder.control_client import find_sockets
from undulog.capture.robot.model import Robot

from ..drive.dry_run import dry_run
from ..drive.dry_run_text import reported, summary_lines
from ..drive.loop import BusTick, ConsoleWatch
from ..drive.motion import MotionSource
from ..drive.over_bus import BusPlan, bus_plan, check_drivable, drive_bus
from ..drive.report import BusReport, report_facts, report_lines
from ..gate.outcome import DriveEnding
from .run import speed_text


@dataclass(frozen=True)
class ArmedRun:
    """An armed drive and its report."""

    plan: BusPlan
    report: BusReport

    @property
    def complete(self) -> bool:
        """Whether it ran to its planned end."""
        return self.report.outcome.how is DriveEnding.COMPLETE

    def facts(self) -> dict[str, Any]:
        """Return the report as plain JSON values."""
        plan = self.plan
        return {
            "driven": plan.driven.name,
            "kind": plan.driven.kind,
            "on": plan.address.text,
            "robot": plan.robot.name,
            "path": str(plan.output),
            "planned_duration_s": plan.duration_s,
            "recorder": str(plan.recorder) if plan.recorder is not None else None,
            **report_facts(self.report),
        }

    def lines(self) -> list[str]:
        """Return the report as lines of text, the outcome first."""
        plan, report = self.plan, self.report
        driven, why = plan.driven, report.outcome.why
        if self.complete:
            lines = [f"{plan.address.text}: drove {driven.name} for {report.gait_s:g} s"]
        else:
            at = f"at {report.gait_s:g} s of {plan.duration_s:g} s"
            lines = [f"{plan.address.text}: stopped {at}: {why}"]
        first, *more = report_lines(report)
        lines += [f"{driven.kind} for {plan.robot.name}, {first}", *more]
        lines.append(f"session: {plan.output}")
        if plan.recorder is not None:
            received = f"received {report.told} samples of the gait"
            lines.append(f"the recorder at {plan.recorder} {received}")
        if report.not_told is not None:
            lines.append(f"warning: it did not receive all: {report.not_told}")
        return lines

    def complain(self) -> int:
        """Print on stderr what ended it early; returns the exit code, 0 if nothing did."""
        if self.complete:
            return 0
        outcome = self.report.outcome
        complain(f"error: {outcome.why}; {outcome.ended}")
        return 1


def drive_armed(
    driven: MotionSource,
    on: str,
    *,
    robot: Robot | None,
    duration_s: float | None,
    output: Path | None,
    recorder: Path | None,
    force: bool,
) -> ArmedRun:
    """Drive over a bus, with progress on a terminal.

    Args:
        robot: The robot on the bus; the one that the motion was made for if None.
        duration_s: Duration [s]; that of the motion if None.
        recorder: Control socket of a recorder; that of the only running one if None.

    Returns:
        The run, also where it ended early.

    Raises:
        UsageError: If the arguments can't be used, e.g. the robot has no limits.
        SourceError: If the bus is silent, or the robot can't be driven from its pose.
    """
    if output is None:
        raise UsageError(
            "an armed drive is recorded, with every action of the gate: name the session with -o, "
            "e.g. -o drive.mcap"
        )
    recorder = recorder or _only_recorder()
    plan = bus_plan(driven, on, output, robot, duration_s, recorder=recorder, force=force)
    console = ConsoleWatch()
    start = time.monotonic()
    with interruptible(twice=True) as stop, progress(driven.name, plan.duration_s) as bar:

        def show(tick: BusTick) -> None:
            note = f"{tick.step.phase}, {speed_text(tick.time_s, start)}"
            bar.update(min(tick.time_s, plan.duration_s), note)

        report = drive_bus(plan, stop=stop, on_tick=show, console=console)
        console.gone()  # output is discarded from here on
    return ArmedRun(plan, report)


def drive_on_bus(
    driven: MotionSource,
    on: str,
    *,
    arm: bool,
    robot: Robot | None = None,
    duration_s: float | None = None,
    output: Path | None = None,
    recorder: Path | None = None,
    force: bool = False,
    as_json: bool = False,
) -> int:
    """Drive over a bus, or in a dry run in the twin, and print a report.

    Args:
        arm: Whether commands are sent.
        robot: The robot on the bus; the one that the motion was made for if None.
        duration_s: Duration [s]; that of the motion if None.
        output: The session to write; a dry run needs none.
        recorder: Control socket of a recorder; that of the only running one if None.
        as_json: Report as one JSON object.

    Returns:
        The exit code.

    Raises:
        UsageError: If the arguments can't be used, e.g. the robot has no limits.
        SourceError: If the bus is silent, or the robot can't be driven from its pose.
    """
    if arm:
        run = drive_armed(
            driven,
            on,
            robot=robot,
            duration_s=duration_s,
            output=output,
            recorder=recorder,
            force=force,
        )
        if as_json:
            emit_json(run.facts())
        else:
            echo(*run.lines())
        return run.complain()
    if recorder is not None:
        raise UsageError("--recorder is for --arm: a dry run sends nothing")
    check_drivable(driven, robot or driven.robot)
    start = time.monotonic()
    length_s = driven.duration_s if duration_s is None else duration_s
    with interruptible() as stop, progress(f"dry run of {driven.name}", length_s) as bar:
        dry = dry_run(
            driven,
            robot=robot,
            duration_s=duration_s,
            output=output,
            force=force,
            stop=stop,
            on_time=lambda time_s: bar.update(time_s, speed_text(time_s, start)),
        )
    if as_json:
        emit_json({"on": on, **reported(dry)})
    else:
        width = shutil.get_terminal_size().columns if sys.stdout.isatty() else UNLIMITED
        echo(*summary_lines(dry, width))
        if dry.verdict.fit:
            echo("", f"To send it to {on}, the same with --arm and -o SESSION.mcap")
    return 0 if dry.verdict.fit else 1


def _only_recorder() -> Path | None:
    """Return the control socket of the running recorder, None if there is none."""
    sockets = find_sockets(os.environ)
    if len(sockets) > 1:
        listed = "\n".join(f"  --recorder {path}" for path in sockets)
        raise UsageError(
            f"{len(sockets)} recorders run; which one is to receive the gait?\n{listed}"
        )
    return sockets[0] if sockets else None
