"""Command ``replay``."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

from undulog.capture.commands.topic_options import CONTRACT, JointTopicOptions
from undulog.capture.common.console import echo, emit_json, progress, refuse_existing
from undulog.capture.common.errors import UsageError
from undulog.capture.common.process import interruptible

if TYPE_CHECKING:
    from undulog.analysis.results.comparison import Comparison

    from ..reproduce import LogDifference, ReproducedRun


_TWIN = "twin"
_SHOWN = 6


def replay(
    file: Path,
    /,
    *,
    on: str,
    output: Annotated[Path | None, Parameter(name=["--output", "-o"])] = None,
    change: Annotated[list[str] | None, Parameter(name="--set")] = None,
    duration: float | None = None,
    arm: bool = False,
    robot: str | None = None,
    topics: JointTopicOptions = CONTRACT,
    recorder: Path | None = None,
    force: bool = False,
    json: bool = False,
) -> int:
    """Run a recorded experiment again, in the twin or on the robot, and report what differs.

    The session's commands are given to the twin of its robot at their own times, and the run is
    recorded. In the world that a twin's session ran in, it is the same to the last bit. With
    `--set` one value of that world is another; then it reports from when on that mattered, and what
    differs as `undulog compare` has it.

    On a bus it is a dry run in the twin, which reports what it would take. With `--arm` the
    commands are sent, behind the same safety gate as those of `undulog drive`.

    Example: `undulog replay run.mcap --on twin --set servo.stall_torque=0.2 -o weak.mcap`

    Args:
        file: The session, `.mcap`; of the twin, of a robot, or one of commands.
        on: `twin` (the world that it was recorded in), `twin:SCENARIO`, which the session of a
            real robot needs, or a bus, `can:INTERFACE:CHANNEL[?KEY=VALUE&...]`.
        output: The session to write, `.mcap`; a dry run needs none.
        change: `KEY=VALUE`, a key of the scenario file with dots and its value, e.g.
            `world.ground.mu_normal=0.4`; may be given several times.
        duration: How long in seconds, instead of as long as there are commands.
        arm: Send the commands.
        robot: The robot on the bus, a name or a TOML file; by default the session's own.
        topics: Where commands and responses of the session are; commands are never found by type.
        recorder: Control socket of the recorder that receives the gait; by default the only one
            that runs.
        force: Replace the output if it is there.
        json: Print one JSON object instead of text.
    """
    from undulog.sim.commands.run import check_session_name, speed_text

    if output is not None:
        check_session_name(output)
        refuse_existing(output, force=force)
    scheme, colon, world = on.partition(":")
    if scheme != _TWIN:
        if change:
            raise UsageError("--set changes the twin's world: on a bus the world is as it is")
        given = {"duration_s": duration, "output": output, "recorder": recorder, "force": force}
        return _on_bus(file, on, robot, topics.names, arm=arm, as_json=json, **given)
    if colon and not world:
        raise UsageError("--on twin: names no scenario; expected twin or twin:SCENARIO")
    if arm or robot is not None or recorder is not None:
        raise UsageError("--arm, --robot and --recorder are for a bus")
    if output is None:
        raise UsageError("a run of the twin is recorded: name the session with -o, e.g. -o b.mcap")
    from undulog.sim.scenario.scenario_file import read_changes

    from ..reproduce import find_repetition, replay_in_twin, what_next

    changes = read_changes(change or [])
    repetition = find_repetition(file, world or None, changes, duration, topics.names)
    start = time.monotonic()
    with interruptible() as stop, progress(file.name, repetition.scenario.duration_s) as bar:
        again = replay_in_twin(
            repetition,
            output,
            force=force,
            stop=stop,
            on_sample=lambda sample: bar.update(sample.time_s, speed_text(sample.time_s, start)),
        )
    if json:
        emit_json(_reported(again, changes))
    else:
        echo(*_summary(again))
        if again.comparison is not None and not again.exact:
            _show(again.comparison)
        echo(*what_next(file, again.recording.path, comparable=again.comparison is not None))
    return 0


def _on_bus(
    file: Path,
    on: str,
    robot: str | None,
    topics: tuple[str, str],
    *,
    arm: bool,
    as_json: bool,
    **given: Any,
) -> int:
    """Send a session's commands on a bus, and report the outcome and the differences.

    Args:
        topics: Of commands and responses of the session.
        given: The rest of a :class:`~undulog.sim.commands.drive.BusDrive`.

    Returns:
        The exit code: 0 if it ran to its end, 1 if not.
    """
    from undulog.capture import Session, load_robot
    from undulog.sim.commands.drive import BusDrive, early_end
    from undulog.sim.drive.motion import find_motion
    from undulog.sim.drive.over_bus import bus_address

    from ..reproduce import compared, what_next

    bus_address(on)
    described = load_robot(robot) if robot is not None else None
    driven = find_motion(str(file), robot=described, command_topic=topics[0])
    if driven.kind != "commands":
        raise UsageError(f"{file} is no session; 'undulog drive {file} --on {on}' drives a gait")
    bus = BusDrive(driven, on, described, **given)
    if not arm:
        return bus.dry_run(as_json=as_json)
    report = bus.drive()
    comparison, why = None, "it did not run to its end"
    if report.complete:
        with Session.open(file) as first, Session.open(report.plan.output) as second:
            comparison, why = compared(first.with_joints(*topics), second)
    if as_json:
        facts = None if comparison is None else comparison.to_dict()
        emit_json(
            {"original": str(file), **report.facts(), "comparison": facts, "not_compared": why}
        )
    else:
        echo(*report.lines())
        if comparison is not None:
            _show(comparison)
        elif report.complete:
            echo(f"Not compared: {why}")
        echo(*what_next(file, report.plan.output, comparable=comparison is not None))
    return early_end(report)


def _show(comparison: Comparison) -> None:
    """Print a comparison below the output before it."""
    from undulog.analysis.commands.analyse import show
    from undulog.analysis.present.text_experiment import render_comparison

    echo("")
    show(lambda width, color: render_comparison(comparison, width=width, color=color), None)


def _summary(again: ReproducedRun) -> Iterator[str]:
    recording, scenario = again.recording, again.scenario
    yield (
        f"{recording.path}: {again.original.name} again on the twin of {scenario.robot.name} in "
        f"{scenario.name}, {recording.duration_s:g} s, session {recording.session_id}"
    )
    if not recording.complete:
        yield f"stopped at rest at {recording.duration_s:g} s of {scenario.duration_s:g} s"
    if again.same is not None:
        yield from _same(again.same)
    if again.not_compared is not None and not again.exact:
        yield f"Not compared: {again.not_compared}"


def _same(same: LogDifference) -> Iterator[str]:
    if same.exact:
        yield f"The same to the last bit: all {same.messages} messages on {len(same.same)} topics."
        return
    if same.differs_s:
        first = sorted(same.differs_s.items(), key=lambda item: item[1])
        named = ", ".join(f"{topic} from {at_s:.3f} s on" for topic, at_s in first[:_SHOWN])
        more = f" and {len(first) - _SHOWN} more" if len(first) > _SHOWN else ""
        yield f"Differs: {named}{more}; {len(same.same)} topics are the same to the last bit."
    if same.one_sided:
        yield f"Only one of the two has {', '.join(same.one_sided)}."


def _reported(again: ReproducedRun, changes: dict[str, Any]) -> dict[str, Any]:
    recording, same = again.recording, again.same
    return {
        "original": str(again.original),
        "path": str(recording.path),
        "session_id": recording.session_id,
        "on": f"{_TWIN}:{again.scenario.name}",
        "changes": changes,
        "duration_s": recording.duration_s,
        "planned_duration_s": again.scenario.duration_s,
        "complete": recording.complete,
        "exact": None if same is None else same.exact,
        "differs_s": None if same is None else same.differs_s,
        "one_sided": None if same is None else list(same.one_sided),
        "comparison": None if again.comparison is None else again.comparison.to_dict(),
        "not_compared": again.not_compared,
    }
