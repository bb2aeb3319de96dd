"""Robot descriptions: TOML files with their DBC databases, read strictly.

A description has the head first::

    name = "two-links"
    description = "One yaw joint."
    serial = "0007"                     # of this robot among those of its name, may be left out
    clock = "host"                      # host, device or simulated
    assumed = ["servo"]                 # parts that were assumed rather than known
    joints = [{ name = "joint01", plane = "horizontal" }]

    [defaults.link]                     # of every link; an entry of `links` may differ
    length = 0.06                       # m, kg, kg m^2, rad: SI throughout
    radius = 0.025
    mass = 0.1
    inertia = [4e-5, 5e-5, 5e-5]

A ``[chain]`` with ``joints = 100`` and ``planes = ["horizontal", "vertical"]`` (taken in turn from
the head) stands for ``joints`` of a long chain. ``links`` may be left out: then there is one more
than joints, ``link01`` the head, all with default values. ``[defaults.joint]``,
``[defaults.servo]`` and ``[defaults.<sensor kind>]`` work the same way. ``[safety]`` limits how far
the robot may be driven, ``[safety_of.joint07]`` what is otherwise for one joint. In an entry of
``bus.signals`` whose target is ``{joint}``, the entry stands for one a joint, and ``{joint}`` in
its message and signal for that joint's name. The keys are the fields of the classes of
:mod:`.capture.robot`. Every fault of a file is reported at once.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from itertools import cycle
from pathlib import Path
from typing import Any

from ..common.config import read, read_field, read_fields, read_required
from ..common.errors import DescriptionFault, RobotFileError
from ..common.files import Shelf, check_regular
from ..common.strict_table import Faults, StrictTable, listed
from ..common.untrusted_text import read_toml
from .bus_map import read_bus
from .kinematics import MESH_TYPES, mesh_type, read_meshes
from .model import (
    JOINT_LIMITS,
    ClockDomain,
    Joint,
    Link,
    Plane,
    Robot,
    Safety,
    Sensor,
    SensorKind,
    Servo,
)

_LONGEST_CHAIN = 1000  # joints of a chain given by its length; more are a typing error

_RANGED = (SensorKind.IR, SensorKind.SONAR)
_RANGE_FIELDS = ("range_min", "range_max", "field_of_view")

_SHELF = Shelf("robot", "undulog.capture.robot", "shipped", RobotFileError)
_PARTS = ("links", "joints", "servo", "sensors", "bus")


def _note_repeated(faults: Faults, what: str, names: Sequence[str]) -> None:
    """Note names that occur more than once; empty ones are faults already."""
    for name in sorted({name for name in names if name and names.count(name) > 1}):
        faults.add(what, f"{names.count(name)} times {name}", "every name once")


def _read_joints(top: StrictTable, defaults: StrictTable) -> tuple[Joint, ...]:
    """Read ``joints``, or a ``chain`` of equal ones, head to tail."""
    common, servo = defaults.table("joint"), defaults.table("servo")
    tables = _chain(top) if "chain" in top else top.tables("joints")
    if not tables:
        top.fault("joints", "an array of at least one table, the joint next to the head first")

    def joint(table: StrictTable) -> Joint:
        return read(table, Joint, servo=lambda: read(table.table("servo", servo), Servo))

    joints = tuple(joint(table.over(common)) for table in tables)
    if tables:
        common.close()
        servo.close()
    return joints


def _chain(top: StrictTable) -> list[StrictTable]:
    """Return tables for ``joints`` of a chain that is given by its length."""
    if "joints" in top:
        top.fault("joints", "leave it out: the chain has them")
    table = top.table("chain")
    count = table.integer("joints", 1)
    if count > _LONGEST_CHAIN:
        table.fault("joints", f"at most {_LONGEST_CHAIN}")
        count = 1
    planes = table.words("planes", valid=Plane) or tuple(Plane)
    table.close()
    return [
        table.replaced({"name": name, "plane": plane})
        for name, plane in zip(numbered("joint", count), cycle(planes))
    ]


def numbered(word: str, count: int) -> list[str]:
    """Return names whose order is that of the chain: ``joint01``, ..., or ``joint001``, ..."""
    width = max(2, len(str(count)))
    return [f"{word}{i:0{width}d}" for i in range(1, count + 1)]


def _read_links(top: StrictTable, defaults: StrictTable, joint_count: int) -> tuple[Link, ...]:
    """Read ``links``, by default one more than joints with default values, head to tail."""
    common = defaults.table("link")
    tables = top.tables("links")
    if "links" not in top:
        tables = [common.replaced({"name": name}) for name in numbered("link", joint_count + 1)]
    elif len(tables) != joint_count + 1:
        top.fault("links", f"{joint_count + 1}, one more than joints", str(len(tables)))
    links = tuple(_link(table.over(common)) for table in tables)
    if tables:
        common.close()
    _note_repeated(top.faults, "links", [link.name for link in links])
    return links


def _link(table: StrictTable) -> Link:
    link = read_fields(table, Link)
    if link.mesh and mesh_type(link.mesh) is None:
        table.fault("mesh", f"a file {listed(MESH_TYPES)}, or leave it out")
    # Each principal moment of a rigid body is at most the sum of the other two.
    if 2 * max(link.inertia) > sum(link.inertia) * (1 + 1e-12):
        table.fault("inertia", "moments of which none exceeds the sum of the other two")
    table.close()
    return link


def _read_safety(top: StrictTable, joints: tuple[Joint, ...]) -> Safety | None:
    """Read ``safety``, and ``safety_of`` with the limits of single joints."""
    if "safety" not in top:
        if "safety_of" in top:
            top.fault("safety_of", "leave it out: there is no safety for it to differ from")
        return None

    safety = read(top.table("safety"), Safety, of=tuple)
    singles = top.table("safety_of")
    of: list[tuple[str, str, float]] = []
    for joint in joints:
        limits = singles.table(joint.name)
        given = ((limit, read_field(limits, Safety, limit)) for limit in JOINT_LIMITS)
        of += [(joint.name, limit, value) for limit, value in given if value is not None]
        limits.close()
    singles.close()
    return replace(safety, of=tuple(of))


def _read_sensors(
    top: StrictTable, defaults: StrictTable, links: tuple[Link, ...]
) -> tuple[Sensor, ...]:
    """Read ``sensors``, with ``defaults`` of each kind."""
    common = {kind: defaults.table(kind) for kind in SensorKind}
    used: set[SensorKind] = set()
    sensors: list[Sensor] = []
    for entry in top.tables("sensors"):
        kind = entry.choice("kind", SensorKind)
        if kind is not None:
            used.add(kind)
            table = entry.over(common[kind])
            sensors.append(_sensor(table, kind, [link.name for link in links]))
    for kind, table in common.items():
        if kind in used:
            table.close()
        elif kind in defaults:
            defaults.fault(kind, f"leave it out: no sensor is of kind {kind}")
    _note_repeated(top.faults, "topics of the sensors", [sensor.topic for sensor in sensors])
    return tuple(sensors)


def _sensor(table: StrictTable, kind: SensorKind, link_names: list[str]) -> Sensor:
    ranges = _RANGE_FIELDS if kind in _RANGED else ()
    fields = ("link", "position", "rpy", *(ranges or ("axes",)))

    def link() -> str:
        name = table.text("link")
        if name and name not in link_names:
            table.fault("link", listed(link_names, name))
        return name

    def given(name: str) -> Callable[[], Any]:
        return lambda: read_required(table, Sensor, name) if name in ranges else None

    def axes() -> tuple[str, ...]:
        measured = table.words("axes", valid=("x", "y", "z")) if not ranges else ()
        if not ranges and not measured:
            table.fault("axes", 'an array of the measured axes, e.g. ["x", "y"]')
        return measured

    readers = {name: given(name) for name in _RANGE_FIELDS}
    sensor = read_fields(table, Sensor, link=link, axes=axes, assumed=tuple, **readers)
    sensor = replace(sensor, assumed=table.words("assumed", valid=fields))
    table.close()
    return sensor


def robot_names() -> tuple[str, ...]:
    """Return names of the shipped robots, sorted."""
    return _SHELF.names()


def load_robot(name_or_path: str | Path) -> Robot:
    """Read a shipped robot by name, or a robot description from a file.

    Args:
        name_or_path: A name of :func:`robot_names`, or the path of a TOML file; the DBC files that
            it lists lie beside it.

    Returns:
        The robot.

    Example::

        robot = undulog.load_robot("snake25")

    Raises:
        UsageError: If no robot has that name.
        InputFileError: If it is a path, and the file isn't there or can't be read.
        RobotFileError: If the description has faults; lists all of them.
    """
    file = _SHELF.read(name_or_path)
    return _parse(
        file.text,
        file.source,
        lambda name: _decoded(file.folder / name),
        lambda name: _bytes(file.folder / name),
    )


def parse_robot(text: str, source: str | Path, databases: Mapping[str, str]) -> Robot:
    """Read a robot description from text.

    Args:
        source: Where it comes from, for messages.
        databases: DBC file name to text; those that the description lists are used. Meshes are
            left out.

    Raises:
        RobotFileError: If the description has faults; lists all of them.
    """
    return _parse(text, Path(source), databases.get)


def check_bus(robot: Robot) -> None:
    """Hold the bus map of a robot against its databases.

    A session's description isn't, until frames are decoded: parsing a DBC takes as long as
    analysing a short session.

    Raises:
        RobotFileError: If they have faults; lists all of them.
    """
    if robot.databases:
        _check(robot.toml, f"{robot.name}.toml", robot.databases)


@lru_cache(maxsize=16)  # every session of a robot carries the same description
def _check(text: str, source: str, databases: tuple[tuple[str, str], ...]) -> None:
    parse_robot(text, source, dict(databases))


def robot_in_session(
    attachments: Mapping[str, bytes], source: str | Path, *, in_full: bool = True
) -> Robot | None:
    """Read the robot description of a session.

    Args:
        in_full: Whether the databases are parsed; else that is left to :func:`check_bus`.

    Returns:
        The robot with its databases and those of its meshes that are there; None if no
        description is attached.

    Raises:
        RobotFileError: If the description has faults; lists all of them.
    """
    data = attachments.get("robot.toml")
    if data is None:
        return None
    source = Path(f"{source}:robot.toml")
    try:
        text = data.decode()
    except UnicodeDecodeError as error:
        raise RobotFileError(source, [DescriptionFault("text", str(error), "UTF-8")]) from error
    files = {
        name: content.decode("utf-8", "replace")
        for name, content in attachments.items()
        if name.endswith(".dbc")
    }
    robot = _parse(text, source, files.get, in_full=in_full)
    named = dict.fromkeys(link.mesh for link in robot.links if link.mesh in attachments)
    return replace(robot, meshes=tuple((name, attachments[name]) for name in named))


def _bytes(path: Any) -> bytes | None:  # a Path, or a Traversable inside the package
    """Return the content of a file; None if it cannot be read."""
    try:
        if isinstance(path, Path):
            check_regular(path)
        return path.read_bytes()
    except OSError:
        return None


def _decoded(path: Any) -> str | None:
    """Return the text of a DBC file; None if it cannot be read."""
    data = _bytes(path)
    if data is None:
        return None
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        return data.decode("cp1252", errors="replace")  # what the tools of the DBC format write


def _parse(
    text: str,
    source: Path,
    read_database: Callable[[str], str | None],
    read_mesh: Callable[[str], bytes | None] | None = None,
    *,
    in_full: bool = True,
) -> Robot:
    try:
        values = read_toml(text)
    except ValueError as error:
        raise RobotFileError(
            source, [DescriptionFault("syntax", str(error), "TOML 1.0")]
        ) from error
    faults = Faults()
    top = StrictTable(values, "", faults)
    defaults = top.table("defaults")
    name, description = top.name("name"), top.text("description", "")
    serial = top.text("serial", "")
    clock = top.choice("clock", ClockDomain) or ClockDomain.HOST
    assumed = top.words("assumed", valid=_PARTS)
    joints = _read_joints(top, defaults)
    links = _read_links(top, defaults, len(joints))
    sensors = _read_sensors(top, defaults, links)
    _note_repeated(faults, "joints and sensors", [part.name for part in (*joints, *sensors)])
    bus, databases = None, ()
    if "bus" in top:
        table = top.table("bus")
        bus, databases = read_bus(table, joints, sensors, read_database, in_full=in_full)
    safety = _read_safety(top, joints)
    meshes = () if read_mesh is None else read_meshes(links, faults, read_mesh)
    defaults.close()
    top.close()
    if noted := faults.all():
        raise RobotFileError(source, noted)
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
        meshes=meshes,
        assumed=assumed,
        safety=safety,
        serial=serial,
    )
