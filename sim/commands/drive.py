"""Command ``drive``."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

from undulog.capture.common.console import echo, emit_json, refuse_existing
from undulog.capture.common.errors import UsageError

from .run import check_session_name, with_progress

if TYPE_CHECKING:
    from ..drive.motion import MotionSource
    from ..scenario.scenario import Scenario
    from ..twin.recording import Recording


_TWIN = "twin"


def drive(
    what: str,
    /,
    *,
    on: str,
    output: Annotated[Path | None, Parameter(name=["--output", "-o"])] = None,
    duration: float | None = None,
    arm: bool = False,
    robot: str | None = None,
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
        on: `twin` (the world that it was made for), `twin:SCENARIO`, or a bus,
            `can:INTERFACE:CHANNEL[?KEY=VALUE&...]`.
        output: The session file to write, `.mcap`; a dry run needs none.
        duration: How long to drive in seconds, instead of the gait's or plan's duration.
        arm: Send the commands.
        robot: The robot on the bus, a name or a TOML file; by default the one that it was made for.
        recorder: Control socket of the recorder that receives the gait; by default the only one
            that runs.
        force: Replace the output if it is there.
        json: Print one JSON object instead of text.
    """
    from ..drive.in_process import drive_twin
    from ..drive.motion import find_motion
    from ..scenario.scenario_file import load_scenario

    if output is not None:
        check_session_name(output)
        refuse_existing(output, force=force)
    scheme, colon, rest = on.partition(":")
    if scheme == _TWIN and colon and not rest:
        raise UsageError("--on twin: names no scenario; expected twin or twin:SCENARIO")
    if scheme != _TWIN:
        from undulog.capture import load_robot

        from ..drive.over_bus import bus_address
        from .drive_bus import drive_on_bus

        bus_address(on)
        described = load_robot(robot) if robot is not None else None
        return drive_on_bus(
            find_motion(what, robot=described),
            on,
            arm=arm,
            robot=described,
            duration_s=duration,
            output=output,
            recorder=recorder,
            force=force,
            as_json=json,
        )
    if arm or recorder is not None or robot is not None:
        raise UsageError(
            "--arm, --recorder and --robot are for a bus; a run of the twin records itself"
        )
    world = load_scenario(rest) if rest else None
    driven = find_motion(what, world)
    scenario = driven.scenario(world, duration)
    if output is None:
        raise UsageError(
            "a run of the twin is recorded: name the session with -o, e.g. -o run.mcap"
        )
    recording, factor = with_progress(
        driven.name, scenario, partial(drive_twin, driven, scenario, output, force=force)
    )
    if json:
        emit_json(_reported(driven, scenario, recording, factor))
    else:
        echo(*_summary(driven, scenario, recording, factor))
    return 0


def _reported(
    driven: MotionSource, scenario: Scenario, recording: Recording, factor: float
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
    driven: MotionSource, scenario: Scenario, recording: Recording, factor: float
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
