"""Armed driving over a bus, for the verbs that offer it."""

from __future__ import annotations

import os
import sys
import time
from pathlib import Path

from capture.console import emit_json, progress
from capture.daemon.control_socket import find_sockets
from capture.errors import UsageError
from capture.interruption import interruptible
from capture.robot import Robot

from ..gate.outcome import How
from .bus_report import BusReport, report_facts, report_lines
from .console_watch import ConsoleWatch
from .driven import Driven
from .loop import BusTick
from .over_bus import BusPlan, bus_plan, drive_bus


def drive_armed(
    driven: Driven,
    on: str,
    *,
    robot: Robot | None,
    duration_s: float | None,
    output: Path | None,
    recorder: Path | None,
    force: bool,
    as_json: bool,
) -> int:
    """Drive over a bus, and say how it went.

    Args:
        driven: What to drive.
        on: The bus.
        robot: On which robot; the one that it was made for if None.
        duration_s: How long [s]; its own length if None.
        output: The session to write.
        recorder: Control socket of a recorder; the only one that runs if None.
        force: Replace an existing session.
        as_json: Report as one JSON object.

    Returns:
        The exit code: 0 if it ran to its planned end, 1 if not.

    Raises:
        UsageError: If something of it can't be.
        SourceError: If nobody is there, or the robot is no robot to start with.
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
        console.gone()  # what is said from here on goes nowhere then
    return _tell(plan, report, as_json=as_json)


def _only_recorder() -> Path | None:
    """The recorder that runs, None if there is none."""
    found = find_sockets(os.environ)
    if len(found) > 1:
        listed = "\n".join(f"  --recorder {path}" for path in found)
        raise UsageError(f"{len(found)} recorders run; which one is told the gait?\n{listed}")
    return found[0] if found else None


def _tell(plan: BusPlan, report: BusReport, *, as_json: bool) -> int:
    outcome = report.outcome
    if as_json:
        facts = {
            "driven": plan.driven.name,
            "kind": plan.driven.kind,
            "on": plan.address.text,
            "robot": plan.robot.name,
            "path": str(plan.output),
            "planned_duration_s": plan.duration_s,
            "recorder": str(plan.recorder) if plan.recorder is not None else None,
        }
        emit_json({**facts, **report_facts(report)})
    else:
        print("\n".join(_told(plan, report)))
    if outcome.how is How.COMPLETE:
        return 0
    sys.stderr.write(f"error: {outcome.why}; {outcome.ended}\n")
    return 1


def _told(plan: BusPlan, report: BusReport) -> list[str]:
    driven, outcome = plan.driven, report.outcome
    if outcome.how is How.COMPLETE:
        lines = [f"{plan.address.text}: drove {driven.name} for {report.gait_s:g} s"]
    else:
        at = f"at {report.gait_s:g} s of {plan.duration_s:g} s"
        lines = [f"{plan.address.text}: stopped {at}: {outcome.why}"]
    lines.append(f"{driven.kind} for {plan.robot.name}, {report_lines(report)[0]}")
    lines += report_lines(report)[1:]
    lines.append(f"session: {plan.output}")
    if plan.recorder is not None:
        lines.append(f"the recorder at {plan.recorder} was told {report.told} samples of the gait")
    if report.not_told is not None:
        lines.append(f"warning: it was not told all: {report.not_told}")
    return lines
