"""The verb ``drive`` over a bus."""

from __future__ import annotations

import os
import sys
import time
from dataclasses import asdict
from pathlib import Path
from typing import Any

from capture.console import emit_json, progress
from capture.daemon.control_socket import find_sockets
from capture.errors import UsageError
from capture.interruption import interruptible

from .driven import Driven
from .loop import BusTick
from .over_bus import BusPlan, BusReport, bus_plan, drive_bus

_SHOWN = 3


def on_bus(
    driven: Driven,
    on: str,
    *,
    duration_s: float | None,
    armed: bool,
    output: Path | None,
    recorder: Path | None,
    force: bool,
    as_json: bool,
) -> int:
    """Drive over a bus, and say how it went.

    Args:
        driven: What to drive.
        on: The bus.
        duration_s: How long [s]; its own length if None.
        armed: Whether commands are sent.
        output: The session to write, or None.
        recorder: Control socket of a recorder; the only one that runs if None.
        force: Replace an existing session.
        as_json: Report as one JSON object.

    Returns:
        The exit code.

    Raises:
        UsageError: If something of it can't be.
        SourceError: If nobody is there, or the robot is lost.
    """
    if armed and recorder is None:
        recorder = _only_recorder()
    plan = bus_plan(
        driven,
        on,
        duration_s=duration_s,
        armed=armed,
        output=output,
        recorder=recorder if armed else None,
        force=force,
    )
    if armed and recorder is None and output is None:
        sys.stderr.write("note: no recorder runs and there is no -o: /gait is not recorded\n")
    start = time.monotonic()
    with interruptible() as stop, progress(driven.name, plan.duration_s) as bar:

        def show(tick: BusTick) -> None:
            elapsed_s = max(time.monotonic() - start, 1e-3)
            bar.update(tick.time_s, f"{tick.time_s / elapsed_s:.1f} x real time")

        report = drive_bus(plan, stop=stop, on_tick=show)
    if as_json:
        emit_json(_reported(plan, report))
    else:
        print("\n".join(_told(plan, report)))
    return 0


def _only_recorder() -> Path | None:
    """The recorder that runs, None if there is none."""
    found = find_sockets(os.environ)
    if len(found) > 1:
        listed = "\n".join(f"  --recorder {path}" for path in found)
        raise UsageError(f"{len(found)} recorders run; which one is told the gait?\n{listed}")
    return found[0] if found else None


def _reported(plan: BusPlan, report: BusReport) -> dict[str, Any]:
    return {
        "driven": plan.driven.name,
        "kind": plan.driven.kind,
        "on": plan.address.text,
        "robot": plan.driven.robot.name,
        "armed": plan.armed,
        "pace": "lockstep" if report.lockstep else "real time",
        "path": str(plan.output) if plan.output is not None else None,
        "planned_duration_s": plan.duration_s,
        **asdict(report.tally),
        "real_time_factor": report.tally.duration_s / max(report.wall_s, 1e-3),
        "first_frames": report.first_frames,
        "recorder": str(plan.recorder) if plan.recorder is not None else None,
        "gait_told": report.told,
        "gait_not_told": report.not_told,
    }


def _told(plan: BusPlan, report: BusReport) -> list[str]:
    tally, driven = report.tally, plan.driven
    how = "drove" if plan.armed else "dry run of"
    if tally.complete:
        lines = [f"{plan.address.text}: {how} {driven.name} for {tally.duration_s:g} s"]
    else:
        planned = f"{plan.duration_s:g} s"
        lines = [f"stopped at rest at {tally.duration_s:g} s of {planned}: {plan.address.text}"]
    pace = "in lockstep with the robot" if report.lockstep else "in real time"
    lines.append(
        f"{driven.kind} for {driven.robot.name}, {tally.ticks} ticks {pace}, "
        f"{tally.overruns} left out as the one before took too long"
    )
    heard = f"{tally.received} received, {tally.decoded} of them with readings"
    lines.append(f"{tally.sent} frames sent, {heard}")
    if not plan.armed and report.first_frames:
        shown = " ".join(report.first_frames[:_SHOWN])
        lines.append(f"nothing was sent; the first tick would have been {shown} ...")
    if plan.output is not None:
        lines.append(f"session: {plan.output}")
    if plan.recorder is not None:
        lines.append(f"the recorder at {plan.recorder} was told {report.told} samples of the gait")
    if report.not_told is not None:
        lines.append(f"warning: it was not told all: {report.not_told}")
    return lines
