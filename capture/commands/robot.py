"""Commands ``robot list``, ``show``, ``check`` and ``new``: robot descriptions."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from json import dumps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

from ..common.console import UNLIMITED, TerminalColumn, echo, emit, emit_json, plain, table
from ..common.errors import DataError, MissingChannelError, RobotFileError
from ..common.files import check_output, write_text
from ..log.messages import COMMAND_TOPIC, RESPONSE_TOPIC
from .topic_options import CONTRACT, JointTopicOptions

if TYPE_CHECKING:
    from ..common.arrays import FloatArray, IntArray
    from ..log.read.sample_times import JointSignals
    from ..log.read.session_view import SessionView
    from ..robot.model import Robot


_SCALES = {"rad": 1.0, "deg": math.radians(1.0)}

_MARGIN = 0.05
"""Part of a seen range that the limits lie beyond it, at each end."""

_JOINTS = (
    TerminalColumn("joint", left=True),
    TerminalColumn("plane", left=True),
    TerminalColumn("lower/rad"),
    TerminalColumn("upper/rad"),
    TerminalColumn("rate/(rad/s)"),
    TerminalColumn("stall/(N m)"),
)

_TEMPLATE = """\
# The description of a robot, to start from. All values in SI: m, kg, s, rad, N m, A, V.
# `undulog robot check` holds it to the rules, the page "Robot descriptions" of the manual has them.

name = {name}
description = ""            # one sentence
clock = "host"              # whose clock stamps the samples: host, device or simulated
assumed = ["links", "joints", "servo"]   # take out of this list what you have filled in

{origin}
# plane: horizontal (turns about z, yaw) or vertical (about y, pitch).
joints = [
{joints}
]

[defaults.link]             # of every link, one more than joints; an entry of `links` may differ
length = 0.06               # assumed: joint to joint
radius = 0.025              # assumed
mass = 0.1                  # assumed
inertia = [4e-5, 5e-5, 5e-5]  # assumed: about the centre, along x (forward), y, z
# mesh = "shell.stl"        # for the picture, a file beside this one
# mesh_scale = 0.001        # metres in one unit of it

[defaults.servo]            # of every joint, for the twin; assumed
supply_v = 6.0
stall_torque = 1.5          # at full voltage and standstill
torque_constant = 1.0       # N m/A, at the joint
proportional_gain = 8.0     # duty per rad of error
viscous_friction = 0.005    # N m s/rad
coulomb_friction = 0.03
# Stiffer gears or lighter links need shorter steps than 1 ms: `physics_rate_hz` of a scenario.
gear_stiffness = 20.0       # N m/rad
gear_damping = 0.01         # N m s/rad

# [safety]                  # limits of driving it over a bus; without them it is never driven
# max_rate = 4.0            # rad/s, of commands
# ramp_rate = 0.5           # rad/s, to the first pose and down again
# max_tracking_error = 0.35 # between command and measured angle
# max_current = 1.4
# max_temperature = 70.0    # degC
# reply_timeout_s = 0.25    # a joint that reports nothing for so long is lost
# max_late_s = 0.2          # a control tick that is later stops the drive

# [bus]                     # where each quantity is found on its CAN bus
# databases = ["robot.dbc"] # beside this file
# bitrate = 1_000_000
# signals = [
#   {{ message = "Command", signal = "Angle", direction = "tx",
#      target = "{first}", quantity = "command", unit = "deg" }},
#   {{ message = "State", signal = "Angle", direction = "rx",
#      target = "{first}", quantity = "position", unit = "deg" }},
# ]
"""

_NEW = "# From the head to the tail; these two are examples."
_SEEN = """\
# From {log}, in its order: put them in that of the chain, the head first. The limits are what the
# log shows with a margin of 5 %, not those of the robot."""


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

    description = load_robot(robot)
    emit(_facts(description), _lines(description), as_json=json)


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
                *(f"{limit:.4g}" for limit in (joint.lower, joint.upper, joint.max_velocity)),
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
        given = {
            key: value for key, value in asdict(robot.safety).items() if value not in (None, ())
        }
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


@dataclass(frozen=True)
class SeenJoint:
    """What a log shows of a joint.

    Attributes:
        lower: Least angle [rad].
        upper: Greatest angle [rad].
        rate: Greatest rate [rad/s].
    """

    name: str
    lower: float
    upper: float
    rate: float


def seen_joints(session: SessionView) -> list[SeenJoint]:
    """Return the joints of a log with the ranges of their angles and their greatest rates.

    Commands count too, if the log has some.

    Returns:
        In the order of the log. The rate is that of the measured velocities, or else between two
        samples of an angle, which noise makes larger.

    Raises:
        MissingChannelError: If the log has no such responses.
        DataError: If their angles are neither in rad nor in deg.
    """
    import numpy as np

    measured = session.joints(RESPONSE_TOPIC)
    scale = _scale(session, measured)
    try:
        rates = session.joints(RESPONSE_TOPIC, "velocity")
    except MissingChannelError:
        rates = None
    commands: JointSignals | None = None
    if COMMAND_TOPIC in session.channels:
        commands = session.joints(COMMAND_TOPIC)
    joints: list[SeenJoint] = []
    for name in measured.names:
        angle = measured.signal(name)
        values = [angle.values * scale]
        if commands is not None and name in commands.names:
            values.append(commands.signal(name).values * _scale(session, commands))
        if rates is not None and name in rates.names:
            rate = np.abs(rates.signal(name).values)
        else:
            rate = _rates(angle.t_ns, values[0])
        angles = np.concatenate(values)
        angles, rate = angles[np.isfinite(angles)], rate[np.isfinite(rate)]
        if len(angles):
            fastest = float(rate.max(initial=0.0))
            joints.append(SeenJoint(name, float(angles.min()), float(angles.max()), fastest))
    if not joints:
        raise DataError(f"{session.path}: {measured.topic} has no angle of any joint")
    return joints


def _scale(session: SessionView, signals: JointSignals) -> float:
    if signals.unit not in _SCALES:
        raise DataError(
            f"{session.path}: the angles of {signals.topic} are in {signals.unit!r}; a description "
            "has rad"
        )
    return _SCALES[signals.unit]


def _rates(t_ns: IntArray, values: FloatArray) -> FloatArray:
    import numpy as np

    from ..common.arrays import NS

    steps = np.diff(t_ns) / NS
    return np.abs(np.diff(values))[steps > 0] / steps[steps > 0]


def draft(name: str, joints: Sequence[SeenJoint] | None = None, log: str = "") -> Robot:
    """Return a description to start from, with its text.

    Args:
        joints: Those of a log; two examples if None.
        log: Name of that log.

    Raises:
        RobotFileError: If a name can't be one in a description; lists all of them.
    """
    from ..robot.description import numbered, parse_robot

    if joints is None:
        names = numbered("joint", 2)
        lines = [_line(name, -0.52, 0.52, 10.0, "assumed") for name in names]
    else:
        names = [joint.name for joint in joints]
        lines = [_seen(joint) for joint in joints]
    text = _TEMPLATE.format(
        name=dumps(name),
        origin=_NEW if joints is None else _SEEN.format(log=plain(log)),
        joints="\n".join(lines),
        first=plain(names[0]),
    )
    return parse_robot(text, name, {})


def _seen(joint: SeenJoint) -> str:
    beyond = max(_MARGIN * (joint.upper - joint.lower), 0.01)
    lower = math.floor((joint.lower - beyond) * 1000) / 1000
    upper = math.ceil((joint.upper + beyond) * 1000) / 1000
    rate = max(math.ceil(joint.rate * (1 + _MARGIN) * 1000) / 1000, 0.001)
    mark = f"seen: {joint.lower:.4g} to {joint.upper:.4g} rad, at most {joint.rate:.4g} rad/s"
    return _line(joint.name, lower, upper, rate, mark)


def _line(name: str, lower: float, upper: float, rate: float, mark: str) -> str:
    return (
        f'  {{ name = {dumps(name)}, plane = "horizontal", lower = {lower}, upper = {upper}, '
        f"max_velocity = {rate} }},  # {mark}"
    )
