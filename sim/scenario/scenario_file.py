"""Scenario files: TOML, read strictly, every fault reported at once.

A scenario::

    description = "Lateral undulation on flat ground."
    robot = "snake25"               # a shipped robot, or a TOML file beside the scenario
    duration_s = 20.0
    settle_s = 8.0                  # the start, not fit for steady-state analysis
    seed = 1                        # of the noise
    epoch_s = 1735689600            # Unix time at which the session starts
    physics_rate_hz = 1000
    engine = "bullet"               # or "mujoco": what solves the body's dynamics; the default is
                                    # "mujoco" where PyBullet is not installed

    [gait]
    kind = "serpentine"             # or "delay-blocks", "oscillators": see docs/reference/gaits.md
    ramp_s = 2.0                    # amplitude and offset grow from nothing over this time

    [gait.horizontal]               # and [gait.vertical]; rad throughout
    amplitude = 0.4
    frequency_hz = 0.5
    lag = 1.0471975511965976        # from one joint of the plane to the next
    wave = "head-to-tail"           # or "tail-to-head"
    offset = 0.0
    phase = 0.0

    [world]
    gravity = [0.0, 0.0, -9.81]     # m/s^2; tilt it for an incline
    heading = 0.0                   # rad
    velocity = [0.0, 0.0, 0.0]      # m/s, of the whole robot at the start
    surface = "flat"                # or "none": no ground
    slope = 0.1                     # rad, instead of gravity: tilts the ground, downhill towards
    slope_heading = 0.0             # rad

    [world.ground]
    stiffness = 2000.0              # N/m
    damping = 20.0                  # N s/m
    mu_tangential = 0.05
    mu_normal = 0.5
    slip_speed = 0.01               # m/s, smoothing of friction
    law = "ellipse"                 # or "box", "transeth"; or "viscous", with drag for friction
    drag_tangential = 1.0           # N s/m, of a link, viscous law
    drag_normal = 10.0

    [[world.obstacles]]             # docs/reference/twin-world.md: all that can stand in the way,
    shape = "cylinder"              # for [world.field], [world.obstacle_contact] and the sensors
    position = [1.5, 0.2]           # m
    radius = 0.1                    # m

    [world.target]
    position = [3.6, 0.0]           # m
    radius = 0.3                    # m

    [servo]                         # instead of the robot's own parameters
    stall_torque = 0.25

    [servo_of.joint07]              # and of single joints
    stall_torque = 0.2

    [link_of.link07]                # and of single links
    mass_factor = 1.5               # its mass and moments of inertia, times this

    [noise]                         # standard deviations of what the servos report
    position = 0.0                  # rad
    velocity = 0.0                  # rad/s
    effort = 0.0                    # N m

    [sensing.servo]                 # how the servos are polled
    slot_s = 0.0                    # s, from one servo's turn to the next; 0: all at once
    resolution = 0.0                # rad, of the encoders
    dead_band = 0.0                 # rad, of the encoders
    command_resolution = 0.0        # rad, step in which the servos take commands

    [[disturbances]]                # a push from outside
    link = "link07"
    force = [0.0, 2.0, 0.0]         # N, in the world, on the link's centre
    start_s = 10.0
    duration_s = 0.5

    [[faults]]                      # of the bus that `sim serve` offers: see sim.serve.faults
    kind = "lost"
    joint = "joint07"
    value = 0.1

Required are ``description``, ``robot``, ``duration_s`` and one plane of the gait with amplitude,
frequency and lag (``delay_s`` of delay blocks).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, cast

from undulog.capture.common.config import read, read_field
from undulog.capture.common.errors import DescriptionFault, ScenarioError, UsageError
from undulog.capture.common.files import Description, Shelf, is_file
from undulog.capture.common.strict_table import NAME_PATTERN, Faults, StrictTable, listed
from undulog.capture.common.untrusted_text import read_toml
from undulog.capture.robot.description import load_robot, robot_names
from undulog.capture.robot.model import Plane, Robot

from ..gait.contract import CONTROL_RATE_HZ
from .bus_faults import read_faults
from .motion import read_controller, read_gait
from .scenario import LONGEST_S, Scenario, read_modules
from .sensors import Noise, read_sensing
from .world import read_pushes, read_world

_LATEST_EPOCH_S = 2**31 - 1  # stamps hold seconds as int32
_SHELF = Shelf("scenario", "undulog.sim", "scenarios", ScenarioError)


def scenario_names() -> tuple[str, ...]:
    """Names of the shipped scenarios, sorted."""
    return _SHELF.names()


def load_scenario(name_or_path: str | Path, changes: Mapping[str, Any] | None = None) -> Scenario:
    """Read a shipped scenario by name, or a scenario from a file.

    Args:
        name_or_path: A name of :func:`scenario_names`, or the path of a TOML file.
        changes: Keys, with dots, to the values that they are to have instead.

    Returns:
        The scenario.

    Example::

        scenario = undulog.load_scenario("flat", {"gait.horizontal.amplitude": 0.2})

    Raises:
        UsageError: If no scenario has that name.
        InputFileError: If it is a path, and the file isn't there or can't be read.
        ScenarioError: If it has faults; lists all of them.
        RobotFileError: If the robot's own file has faults.
    """
    document = scenario_text(name_or_path)
    return parse_scenario(document.text, document.source, changes=changes)


def scenario_text(name_or_path: str | Path) -> Description:
    """Read a scenario's text, not yet parsed.

    Raises:
        UsageError: If no scenario has that name.
        InputFileError: If it is a path, and the file isn't there or can't be read.
        ScenarioError: If it is not UTF-8.
    """
    return _SHELF.read(name_or_path)


def parse_scenario(
    text: str,
    source: str | Path,
    robot: Robot | None = None,
    changes: Mapping[str, Any] | None = None,
) -> Scenario:
    """Read a scenario from text.

    Args:
        source: Where it comes from: for messages, for the default name, and to find a robot's
            file beside it.
        robot: The robot that it names, where it is at hand already, as in a session that carries
            its description.
        changes: Keys, with dots, e.g. ``servo.stall_torque``, to the values that they are to have
            instead of the text's.

    Raises:
        ScenarioError: If it has faults; lists all of them.
        RobotFileError: If the robot's own file has faults.
    """
    source = Path(source)
    try:
        values = read_toml(text)
    except ValueError as error:
        raise ScenarioError(source, [DescriptionFault("syntax", str(error), "TOML 1.0")]) from error
    faults = Faults()
    for key, value in (changes or {}).items():
        _change(values, key, value, faults)
    world = values.get("world")
    if "world.slope" in (changes or {}) and isinstance(world, dict):
        cast("dict[str, object]", world).pop("gravity", None)  # the slope replaces it
    top = StrictTable(values, "", faults)
    stem = source.stem if NAME_PATTERN.fullmatch(source.stem) else "scenario"
    robot_name = top.text("robot")
    robot = robot or _robot(top, robot_name, source.parent)
    seed: int = read_field(top, Scenario, "seed")
    parts: dict[str, Any] = {
        "name": read_field(top, Scenario, "name", stem),
        "description": read_field(top, Scenario, "description"),
        "robot_name": robot_name,
        "gait": read_gait(top.table("gait"), robot),
        "world": read_world(top.table("world"), robot, seed),
        "noise": read(top.table("noise"), Noise),
        "sensing": read_sensing(top.table("sensing"), robot, 1 / CONTROL_RATE_HZ),
        "modules": read_modules(top, robot),
        "disturbances": read_pushes(top, robot),
        "faults": read_faults(top, robot),
        "seed": seed,
        "engine": read_field(top, Scenario, "engine"),
        **_times(top),
    }
    if "controller" in top:
        parts["controller"] = read_controller(
            top.table("controller"),
            robot,
            horizontal=Plane.HORIZONTAL in parts["gait"].planes,
            target=parts["world"].target is not None,
        )
    top.close()
    if (problems := faults.all()) or robot is None:
        raise ScenarioError(source, problems)
    return Scenario(robot=parts["modules"].fitted(robot), **parts)


def read_changes(words: Sequence[str]) -> dict[str, Any]:
    """Read the words of ``--set``.

    Args:
        words: ``KEY=VALUE``, the key with dots and the value as in TOML; a bare word is a string.

    Returns:
        Key to value, as :func:`parse_scenario` takes them.

    Raises:
        UsageError: If a word has another form.
    """
    changes: dict[str, Any] = {}
    for word in words:
        key, equals, text = word.partition("=")
        if not (equals and key and text) or not all(key.split(".")):
            raise UsageError(f"--set {word}: expected KEY=VALUE, e.g. servo.stall_torque=0.2")
        try:
            changes[key] = read_toml(f"value = {text}")["value"]
        except ValueError:
            changes[key] = text
    return changes


def _change(values: dict[str, Any], key: str, value: object, faults: Faults) -> None:
    """Set one value of nested tables; a fault where its place is no table."""
    *path, last = key.split(".")
    table: object = values
    for name in path:
        if isinstance(table, dict):
            table = cast("dict[str, object]", table).setdefault(name, {})
    if isinstance(table, dict):
        cast("dict[str, object]", table)[last] = value
    else:
        faults.add(key, "a part of what is no table", "a key of a table, e.g. servo.stall_torque")


def _times(top: StrictTable) -> dict[str, Any]:
    names = ("duration_s", "settle_s", "physics_rate_hz", "epoch_s")
    times = {name: read_field(top, Scenario, name) for name in names}
    if times["settle_s"] > times["duration_s"]:
        top.fault("settle_s", f"at most duration_s = {times['duration_s']:g}")
    if times["physics_rate_hz"] % (2 * CONTROL_RATE_HZ):  # whole steps in half a control period
        top.fault("physics_rate_hz", f"a multiple of {2 * CONTROL_RATE_HZ}")
    if times["epoch_s"] + LONGEST_S > _LATEST_EPOCH_S:
        top.fault("epoch_s", f"at most {_LATEST_EPOCH_S - round(LONGEST_S)}")
    return times


def _robot(top: StrictTable, name: str, folder: Path) -> Robot | None:
    """The robot: a shipped name, or a file beside the scenario; None after a fault."""
    if name in robot_names():
        return load_robot(name)
    if name and is_file(folder / name):
        return load_robot(folder / name)
    if name:  # a missing name is a fault already
        top.fault(
            "robot", f"a TOML file beside the scenario, or one of {listed(robot_names(), name)}"
        )
    return None
