"""A recorded experiment once more on a robot's bus: dry, or armed behind the safety gate."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from undulog.analysis.results.comparison import Comparison
from undulog.capture import Session, load_robot
from undulog.capture.common.console import emit_json, say
from undulog.capture.common.errors import UsageError
from undulog.sim.commands.drive_bus import drive_armed, drive_on_bus
from undulog.sim.drive.driven import find_driven
from undulog.sim.drive.over_bus import bus_address

from .run import compared, what_next


def replay_on_bus(
    file: Path,
    on: str,
    show: Callable[[Comparison], None],
    *,
    arm: bool = False,
    robot: str | None = None,
    duration_s: float | None = None,
    output: Path | None = None,
    recorder: Path | None = None,
    force: bool = False,
    as_json: bool = False,
) -> int:
    """Give a session's commands again on a bus, and say how it went and what differs.

    Args:
        file: The session.
        on: The bus.
        show: Prints a comparison.
        arm: Whether commands are sent; a dry run in the twin if not.
        robot: The robot on the bus, a name or a file; the session's own if None.
        duration_s: How long [s]; as long as there are commands if None.
        output: The session to write; a dry run needs none.
        recorder: Control socket of a recorder that is told the gait; the only one that runs if
            None.
        force: Replace an existing session.
        as_json: Report as one JSON object.

    Returns:
        The exit code: 0 if it ran to its end, 1 if not.

    Raises:
        UsageError: If something of it can't be, e.g. the session is of another joint set.
        SourceError: If nobody is there, or the robot is no robot to start with.
        LogError: If the session can't be read, or has no commands.
    """
    bus_address(on)
    described = load_robot(robot) if robot is not None else None
    driven = find_driven(str(file), robot=described)
    if driven.kind != "commands":
        raise UsageError(f"{file} is no session; 'undulog drive {file} --on {on}' drives a gait")
    if not arm:
        return drive_on_bus(
            driven,
            on,
            arm=False,
            robot=described,
            duration_s=duration_s,
            output=output,
            recorder=recorder,
            force=force,
            as_json=as_json,
        )
    run = drive_armed(
        driven,
        on,
        robot=described,
        duration_s=duration_s,
        output=output,
        recorder=recorder,
        force=force,
    )
    comparison, why = None, "it did not run to its end"
    if run.complete:
        with Session.open(file) as first, Session.open(run.plan.output) as second:
            comparison, why = compared(first, second)
    if as_json:
        told = None if comparison is None else comparison.to_dict()
        emit_json({"original": str(file), **run.facts(), "comparison": told, "not_compared": why})
    else:
        say(*run.lines())
        if comparison is not None:
            show(comparison)
        elif run.complete:
            say(f"Not compared: {why}")
        say(*what_next(file, run.plan.output, comparable=comparison is not None))
    return run.complain()
