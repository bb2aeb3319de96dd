"""Robot descriptions: TOML files with their DBC databases, read strictly.

A description has the head first::

    name = "two-links"
    description = "One yaw joint."
    clock = "host"                      # host, device or simulated
    assumed = ["servo"]                 # parts that were assumed rather than known
    joints = [{ name = "joint01", plane = "horizontal" }]

    [defaults.link]                     # of every link; an entry of `links` may differ
    length = 0.06                       # m, kg, kg m^2, rad: SI throughout
    radius = 0.025
    mass = 0.1
    inertia = [4e-5, 5e-5, 5e-5]

``links`` may be left out: then there is one more than joints, ``link01`` the head, all as the
defaults say. ``[defaults.joint]``, ``[defaults.servo]`` and ``[defaults.<sensor kind>]`` work the
same way. In an entry of ``bus.signals`` whose target is ``{joint}``, the entry stands for one a
joint, and ``{joint}`` in its message and signal for that joint's name. The keys are the fields of
the classes of :mod:`capture.robot`. Every fault of a file is reported at once.
"""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from ..errors import Fault, RobotFileError
from ..shipped import Shelf
from ..strict_table import Faults, Table, listed
from .bus_map import read_bus
from .model import ClockDomain, Joint, Link, Plane, Robot, Sensor, SensorKind, Servo

_SHELF = Shelf("robot", "capture.robot", "shipped", RobotFileError)
_PARTS = ("links", "joints", "servo", "sensors", "bus")
_RANGED = (SensorKind.IR, SensorKind.SONAR)


def robot_names() -> tuple[str, ...]:
    """Names of the shipped robots, sorted."""
    return _SHELF.names()


def load_robot(name_or_path: str | Path) -> Robot:
    """Read a shipped robot by name, or a robot description from a file.

    Args:
        name_or_path: A name of :func:`robot_names`, or the path of a TOML file; the DBC files that
            it lists lie beside it.

    Returns:
        The robot.

    Raises:
        UsageError: If there is no such robot or the file cannot be read.
        RobotFileError: If the description has faults; lists all of them.
    """
    found = _SHELF.read(name_or_path)
    return _parse(found.text, found.source, lambda name: _decoded(found.folder / name))


def parse_robot(text: str, source: str | Path, databases: Mapping[str, str]) -> Robot:
    """Read a robot description from text, as a session carries it.

    Args:
        text: The TOML text.
        source: Where it comes from, for messages.
        databases: DBC file name to text; those that the description lists are used.

    Returns:
        The robot.

    Raises:
        RobotFileError: If the description has faults; lists all of them.
    """
    return _parse(text, Path(source), databases.get)


def _decoded(path: Any) -> str | None:  # a Path, or a Traversable inside the package
    """Text of a DBC file; None when it cannot be read."""
    try:
        data: bytes = path.read_bytes()
    except OSError:
        return None
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        return data.decode("cp1252", errors="replace")  # what the tools of the DBC format write


def _parse(text: str, source: Path, read_database: Callable[[str], str | None]) -> Robot:
    try:
        values = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise RobotFileError(source, [Fault("syntax", str(error), "TOML 1.0")]) from error
    faults = Faults()
    top = Table(values, "", faults)
    defaults = top.table("defaults")
    name, description = top.name("name"), top.text("description", "")
    clock = top.choice("clock", ClockDomain) or ClockDomain.HOST
    assumed = top.words("assumed", valid=_PARTS)
    joints = _joints(top, defaults)
    links = _links(top, defaults, len(joints))
    sensors = _sensors(top, defaults, links)
    _note_repeated(faults, "joints and sensors", [part.name for part in (*joints, *sensors)])
    bus, databases = None, ()
    if "bus" in top:
        bus, databases = read_bus(top.table("bus"), joints, sensors, read_database)
    defaults.close()
    top.close()
    if found := faults.all():
        raise RobotFileError(source, found)
    return Robot(
        name=name,
        description=description,
        clock=clock,
        links=links,
        joints=joints,
        sensors=sensors,
        bus=bus,
        toml=text,
        databases=databases,
        assumed=assumed,
    )


def _joints(top: Table, defaults: Table) -> tuple[Joint, ...]:
    common, servo = defaults.table("joint"), defaults.table("servo")
    entries = top.tables("joints")
    if not entries:
        top.fault("joints", "an array of at least one table, the joint next to the head first")
    joints: list[Joint] = []
    for values, where in entries:
        table = Table(values, where, top.faults, common)
        joint = Joint(
            name=table.name("name"),
            plane=table.choice("plane", Plane) or Plane.HORIZONTAL,
            lower=table.number("lower", default=Joint.lower),
            upper=table.number("upper", default=Joint.upper),
            max_velocity=table.number("max_velocity", default=Joint.max_velocity, above=0),
            servo=_servo(table.table("servo", servo)),
        )
        if joint.lower >= joint.upper:
            table.fault("upper", f"more than lower = {joint.lower:g}", f"{joint.upper:g}")
        table.close()
        joints.append(joint)
    if entries:
        common.close()
        servo.close()
    return tuple(joints)


def _servo(table: Table) -> Servo:
    servo = Servo(
        supply_v=table.number("supply_v", default=Servo.supply_v, above=0),
        stall_torque=table.number("stall_torque", default=Servo.stall_torque, above=0),
        torque_constant=table.number("torque_constant", default=Servo.torque_constant, above=0),
        proportional_gain=table.number(
            "proportional_gain", default=Servo.proportional_gain, above=0
        ),
        rotor_inertia=table.number("rotor_inertia", default=Servo.rotor_inertia, above=0),
        viscous_friction=table.number(
            "viscous_friction", default=Servo.viscous_friction, at_least=0
        ),
        coulomb_friction=table.number(
            "coulomb_friction", default=Servo.coulomb_friction, at_least=0
        ),
        gear_stiffness=table.number("gear_stiffness", default=Servo.gear_stiffness, above=0),
        gear_damping=table.number("gear_damping", default=Servo.gear_damping, at_least=0),
    )
    table.close()
    return servo


def _links(top: Table, defaults: Table, joint_count: int) -> tuple[Link, ...]:
    common = defaults.table("link")
    entries = top.tables("links")
    if "links" not in top:
        entries = [({"name": f"link{i:02d}"}, "defaults.link") for i in range(1, joint_count + 2)]
    elif len(entries) != joint_count + 1:
        top.fault("links", f"{joint_count + 1}, one more than joints", str(len(entries)))
    links: list[Link] = []
    for values, where in entries:
        table = Table(values, where, top.faults, common)
        link = Link(
            name=table.name("name"),
            length=table.number("length", above=0),
            radius=table.number("radius", above=0),
            mass=table.number("mass", above=0),
            inertia=table.triple("inertia", above=0),
        )
        # Each principal moment of a rigid body is at most the sum of the other two.
        if 2 * max(link.inertia) > sum(link.inertia) * (1 + 1e-12):
            table.fault("inertia", "moments of which none exceeds the sum of the other two")
        table.close()
        links.append(link)
    if entries:
        common.close()
    _note_repeated(top.faults, "links", [link.name for link in links])
    return tuple(links)


def _sensors(top: Table, defaults: Table, links: tuple[Link, ...]) -> tuple[Sensor, ...]:
    common = {kind: defaults.table(kind) for kind in SensorKind}
    used: set[SensorKind] = set()
    sensors: list[Sensor] = []
    for values, where in top.tables("sensors"):
        kind = Table(values, where, top.faults).choice("kind", SensorKind)
        if kind is not None:
            used.add(kind)
            table = Table(values, where, top.faults, common[kind])
            table.choice("kind", SensorKind)
            sensors.append(_sensor(table, kind, [link.name for link in links]))
            table.close()
    for kind, table in common.items():
        if kind in used:
            table.close()
        elif kind in defaults:
            defaults.fault(kind, f"leave it out: no sensor is of kind {kind}")
    topics = [sensor.topic for sensor in sensors]
    _note_repeated(top.faults, "topics of the sensors", topics)
    return tuple(sensors)


def _sensor(table: Table, kind: SensorKind, link_names: list[str]) -> Sensor:
    name, link = table.name("name"), table.text("link")
    if link and link not in link_names:
        table.fault("link", listed(link_names, link))
    position = table.triple("position")
    rpy = table.triple("rpy", default=(0.0, 0.0, 0.0))
    range_min = range_max = field_of_view = None
    axes: tuple[str, ...] = ()
    fields = ["link", "position", "rpy"]
    if kind in _RANGED:
        range_min = table.number("range_min", at_least=0)
        range_max = table.number("range_max", above=0)
        if range_min >= range_max:
            table.fault("range_max", f"more than range_min = {range_min:g}", f"{range_max:g}")
        field_of_view = table.number("field_of_view", above=0, at_most=6.29)
        fields += ["range_min", "range_max", "field_of_view"]
    else:
        axes = table.words("axes", valid=("x", "y", "z"))
        if not axes:
            table.fault("axes", 'an array of the measured axes, e.g. ["x", "y"]')
        fields += ["axes"]
    return Sensor(
        name=name,
        kind=kind,
        link=link,
        position=position,
        rpy=rpy,
        range_min=range_min,
        range_max=range_max,
        field_of_view=field_of_view,
        axes=axes,
        assumed=table.words("assumed", valid=fields),
    )


def _note_repeated(faults: Faults, what: str, names: list[str]) -> None:
    """Note names that occur more than once; empty ones are faults already."""
    for name in sorted({name for name in names if name and names.count(name) > 1}):
        faults.add(what, f"{names.count(name)} times {name}", "every name once")
