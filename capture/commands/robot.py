"""Commands ``robot list``, ``show``, ``check`` and ``new``: robot descriptions."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

from ..common.console import UNLIMITED, Column, echo, emit, emit_json, table
from ..common.errors import RobotFileError
from ..common.files import check_output, write_text
from .topic_options import CONTRACT, JointTopicOptions

if TYPE_CHECKING:
    from ..robot.model import Robot


_JOINTS = (
    Column("joint", left=True),
    Column("plane", left=True),
    Column("lower/rad"),
    Column("upper/rad"),
    Column("rate/(rad/s)"),
    Column("stall/(N m)"),
)


def robot_list(*, json: bool = False) -> None:
    """List the shipped robots: name, joints, and what each is.

    Example: `undulog robot list`

    Args:
        json: Print one JSON array.
    """
    from ..robot.description import load_robot, robot_names

    robots = [load_robot(name) for name in robot_names()]
    width = max(len(robot.name) for robot in robots)
    lines = [
        f"{robot.name:<{width}}  {_joints(len(robot.joints)):>9}  {robot.description}"
        for robot in robots
    ]
    facts = [
        {"name": robot.name, "joints": len(robot.joints), "description": robot.description}
        for robot in robots
    ]
    emit(facts, lines, as_json=json)


def robot_show(robot: str, /, *, json: bool = False) -> None:
    """Show a robot: its chain with limits, its links, sensors, bus map and limits of driving.

    Example: `undulog robot show snake25`

    Args:
        robot: Name of a shipped robot (see `undulog robot list`), or a TOML file.
        json: Print one JSON object with every value, in SI units.
    """
    from ..robot.description import load_robot

    found = load_robot(robot)
    emit(_facts(found), _lines(found), as_json=json)


def robot_check(file: Path, /, *, json: bool = False) -> int:
    """Check a robot description, with the DBC files and meshes beside it; list all faults.

    Exit code 1 if there are any.

    Example: `undulog robot check my-robot.toml`

    Args:
        file: The TOML file.
        json: Print one JSON object, with the faults.
    """
    from ..robot.description import load_robot

    try:
        robot = load_robot(file)
    except RobotFileError as error:
        if not json:
            raise
        faults = [asdict(fault) for fault in error.faults]
        emit_json({"path": str(file), "faults": faults})
        return 1
    facts = {"path": str(file), "name": robot.name, "joints": list(robot.joint_names)}
    lines = [f"{file}: no fault", _head(robot)]
    emit(facts | {"faults": []}, lines, as_json=json)
    return 0


def robot_new(
    *,
    output: Annotated[Path, Parameter(name=["--output", "-o"])],
    log: Annotated[Path | None, Parameter(name="--from")] = None,
    name: str | None = None,
    topics: JointTopicOptions = CONTRACT,
    force: bool = False,
    json: bool = False,
) -> None:
    """Write a robot description to start from, with a comment on every line to fill in.

    With `--from` it has the joints of a log, in its order, and their limits are the angles and
    rates that the log shows, marked as such: put the robot's own there.

    Example: `undulog robot new -o my-robot.toml --from run.mcap`

    Args:
        output: The description, a name that ends in .toml.
        log: A log of the robot.
        name: The robot's name; that of the file if not given.
        topics: Where commands, which count as angles too, and measured angles are.
        force: Replace the file if it exists.
        json: Print one JSON object: the file and its joints.
    """
    from ..exchange.robot_draft import draft, seen_joints
    from ..log.read.session import Session

    check_output(output, (".toml",), "a description is TOML; end its name in .toml", force=force)
    joints = None
    if log is not None:
        with Session.open(log) as session:
            joints = seen_joints(topics.view(session))
    robot = draft(name or output.stem, joints, "" if log is None else log.name)
    write_text(output, robot.toml)
    if json:
        emit_json({"path": str(output), "name": robot.name, "joints": list(robot.joint_names)})
        return
    echo(f"{output}: {robot.name}, {_joints(len(robot.joints))}; its comments say what to fill in")


def _joints(count: int) -> str:
    return f"{count} joint{'s' if count != 1 else ''}"


def _facts(robot: Robot) -> dict[str, Any]:
    left_out = ("toml", "databases", "meshes")
    return {key: value for key, value in asdict(robot).items() if key not in left_out}


def _head(robot: Robot) -> str:
    planes = Counter(joint.plane.value for joint in robot.joints)
    kinds = ", ".join(f"{count} {plane}" for plane, count in planes.items())
    length = sum(link.length for link in robot.links)
    return (
        f"{robot.name}: {_joints(len(robot.joints))} ({kinds}), {length:.3g} m, "
        f"{robot.total_mass:.3g} kg, stamps by the {robot.clock} clock"
    )


def _lines(robot: Robot) -> Iterator[str]:
    yield _head(robot)
    yield from filter(None, [robot.description])
    if robot.assumed:
        yield f"assumed rather than known: {', '.join(robot.assumed)}"
    rows = [
        [
            (text, "")
            for text in (
                joint.name,
                str(joint.plane),
                *(f"{one:.4g}" for one in (joint.lower, joint.upper, joint.max_velocity)),
                f"{joint.servo.stall_torque:.4g}",
            )
        ]
        for joint in robot.joints
    ]
    texts, _ = table(_JOINTS, rows, UNLIMITED)
    yield ""
    yield from (text.plain.rstrip() for text in texts)
    yield ""
    shapes = Counter((link.length, link.radius, link.mass) for link in robot.links)
    for (length, radius, mass), count in shapes.items():
        yield f"{count} links: {length:g} m long, {radius:g} m radius, {mass:g} kg"
    for sensor in robot.sensors:
        yield f"{sensor.name}: {sensor.kind} at {sensor.link}, {sensor.topic}"
    yield from _bus(robot)
    if robot.safety is not None:
        given = {key: one for key, one in asdict(robot.safety).items() if one not in (None, ())}
        yield f"driving: {', '.join(f'{key} {value}' for key, value in given.items())}"


def _bus(robot: Robot) -> Iterator[str]:
    if robot.bus is None:
        yield "no bus map"
        return
    kinds = Counter(str(signal.quantity) for signal in robot.bus.signals)
    yield (
        f"bus: {robot.bus.bitrate} bit/s, {', '.join(robot.bus.databases) or 'no database'}; "
        f"{', '.join(f'{count} {kind}' for kind, count in kinds.items())}"
    )
