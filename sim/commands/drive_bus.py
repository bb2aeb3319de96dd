"""Armed driving over a bus, for the commands that offer it."""

from __future__ import annotations

import os
import shutil
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from undulog.capture.common.console import complain, echo, emit_json, progress
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
from ..scenario.scenario import Scenario

_UNLIMITED = 10_000


def run_dry(
    driven: MotionSource,
    on: str,
    *,
    robot: Robot | None = None,
    world: Scenario | None = None,
    duration_s: float | None = None,
    output: Path | None = None,
    force: bool = False,
    as_json: bool = False,
) -> int:
    """Run it in the twin, and report what it would take.

    Args:
        driven: What to drive.
        on: The bus that it would be driven on, as the command line names it.
        robot: On which robot; the one that it was made for if None.
        world: Where; by default the world that it was made for, and flat ground if that is not
            known.
        duration_s: How long [s]; its own length if None.
        output: The session of the twin to write, or None.
        force: Replace an existing session.
        as_json: Report as one JSON object.

    Returns:
        The exit code: 0 if it would run to its end, 1 if not.

    Raises:
        UsageError: If something of it can't be.
        SimulationError: If the twin's state becomes impossible.
        OutputExistsError: If the session is there and ``force`` is not given.
        LogWriteError: If the session can't be written.
    """
    start = time.monotonic()
    length_s = driven.duration_s if duration_s is None else duration_s
    with interruptible() as stop, progress(f"dry run of {driven.name}", length_s) as bar:

        def show(time_s: float) -> None:
            elapsed_s = max(time.monotonic() - start, 1e-3)
            bar.update(time_s, f"{time_s / elapsed_s:.1f} x real time")

        run = dry_run(
            driven,
            robot=robot,
            world=world,
            duration_s=duration_s,
            output=output,
            force=force,
            stop=stop,
            on_time=show,
        )
    if as_json:
        emit_json({"on": on, **reported(run)})
    else:
        width = shutil.get_terminal_size().columns if sys.stdout.isatty() else _UNLIMITED
        echo(*summary_lines(run, width))
        if run.verdict.fit:
            echo("", f"To send it to {on}, the same with --arm and -o SESSION.mcap")
    return 0 if run.verdict.fit else 1


@dataclass(frozen=True)
class ArmedRun:
    """An armed drive and how it went.

    Attributes:
        plan: What was to be done.
        report: How it went.
    """

    plan: BusPlan
    report: BusReport

    @property
    def complete(self) -> bool:
        """Whether it ran to its planned end."""
        return self.report.outcome.how is DriveEnding.COMPLETE

    def facts(self) -> dict[str, Any]:
        """For JSON."""
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
        """For people, the answer first."""
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
        """Say on stderr what ended it early.

        Returns:
            The exit code: 0 if it ran to its planned end, 1 if not.
        """
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
        driven: What to drive.
        on: The bus.
        robot: On which robot; the one that it was made for if None.
        duration_s: How long [s]; its own length if None.
        output: The session to write.
        recorder: Control socket of a recorder; the only one that runs if None.
        force: Replace an existing session.

    Returns:
        How it went, also where it ended early.

    Raises:
        UsageError: If something of it can't be.
        SourceError: If the bus is silent, or the robot is no robot to start with.
    """
    if output is None:
        raise UsageError(
            "an armed drive is recorded, with every action of the gate: name the session with -o, "
            "e.g. -o drive.mcap"
        )
    plan = bus_plan(
        driven,
        on,
        robot=robot,
        duration_s=duration_s,
        output=output,
        recorder=recorder or _only_recorder(),
        force=force,
    )
    console = ConsoleWatch()
    start = time.monotonic()
    with interruptible(twice=True) as stop, progress(driven.name, plan.duration_s) as bar:

        def show(tick: BusTick) -> None:
            elapsed_s = max(time.monotonic() - start, 1e-3)
            pace = f"{tick.time_s / elapsed_s:.1f} x real time"
            bar.update(min(tick.time_s, plan.duration_s), f"{tick.step.phase}, {pace}")

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
    """What a command does on a bus: a dry run in the twin, or armed; and report the outcome.

    Args:
        driven: What to drive.
        on: The bus.
        arm: Whether commands are sent.
        robot: On which robot; the one that it was made for if None.
        duration_s: How long [s]; its own length if None.
        output: The session to write; a dry run needs none.
        recorder: Control socket of a recorder; the only one that runs if None.
        force: Replace an existing session.
        as_json: Report as one JSON object.

    Returns:
        The exit code.

    Raises:
        UsageError: If something of it can't be.
        SourceError: If the bus is silent, or the robot is no robot to start with.
    """
    if not arm:
        if recorder is not None:
            raise UsageError("--recorder is for --arm: a dry run sends nothing")
        check_drivable(driven, robot or driven.robot)
        return run_dry(
            driven,
            on,
            robot=robot,
            duration_s=duration_s,
            output=output,
            force=force,
            as_json=as_json,
        )
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


def _only_recorder() -> Path | None:
    """The recorder that runs, None if there is none."""
    found = find_sockets(os.environ)
    if len(found) > 1:
        listed = "\n".join(f"  --recorder {path}" for path in found)
        raise UsageError(f"{len(found)} recorders run; which one is to receive the gait?\n{listed}")
    return found[0] if found else None
