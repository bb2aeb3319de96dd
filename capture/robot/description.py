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

A ``[chain]`` with ``joints = 100`` and ``planes = ["horizontal", "vertical"]`` (taken in turn from
the head) stands for ``joints`` of a long chain. ``links`` may be left out: then there is one more
than joints, ``link01`` the head, all as the defaults say. ``[defaults.joint]``,
``[defaults.servo]`` and ``[defaults.<sensor kind>]`` work the same way. ``[safety]`` says how far
the robot may be driven, ``[safety_of.joint07]`` what is otherwise for one joint. In an entry of
``bus.signals`` whose target is ``{joint}``, the entry stands for one a joint, and ``{joint}`` in
its message and signal for that joint's name. The keys are the fields of the classes of
:mod:`.capture.robot`. Every fault of a file is reported at once.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from ..common.errors import Fault, RobotFileError
from ..common.shipped import Shelf
from ..common.strict_table import Faults, Table, read_toml
from .bus_map import read_bus
from .chain_table import read_joints, read_links
from .mesh import read_meshes
from .model import ClockDomain, Robot
from .repeated import note_repeated
from .safety_table import read_safety
from .sensor_table import read_sensors

_SHELF = Shelf("robot", "undulog.capture.robot", "shipped", RobotFileError)
_PARTS = ("links", "joints", "servo", "sensors", "bus")


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
        UsageError: If no robot has that name.
        InputFileError: If it is a path, and the file isn't there or can't be read.
        RobotFileError: If the description has faults; lists all of them.
    """
    found = _SHELF.read(name_or_path)
    return _parse(
        found.text,
        found.source,
        lambda name: _decoded(found.folder / name),
        lambda name: _bytes(found.folder / name),
    )


def parse_robot(text: str, source: str | Path, databases: Mapping[str, str]) -> Robot:
    """Read a robot description from text.

    Args:
        text: The TOML text.
        source: Where it comes from, for messages.
        databases: DBC file name to text; those that the description lists are used. Meshes are
            left out.

    Returns:
        The robot.

    Raises:
        RobotFileError: If the description has faults; lists all of them.
    """
    return _parse(text, Path(source), databases.get)


def robot_in_session(attachments: Mapping[str, bytes], source: str | Path) -> Robot | None:
    """The robot that a session carries.

    Args:
        attachments: The session's attached files, by name.
        source: The session, for messages.

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
        raise RobotFileError(source, [Fault("text", str(error), "UTF-8")]) from error
    files = {
        name: content.decode("utf-8", "replace")
        for name, content in attachments.items()
        if name.endswith(".dbc")
    }
    robot = _parse(text, source, files.get)
    named = dict.fromkeys(link.mesh for link in robot.links if link.mesh in attachments)
    return replace(robot, meshes=tuple((name, attachments[name]) for name in named))


def _bytes(path: Any) -> bytes | None:  # a Path, or a Traversable inside the package
    """Content of a file; None when it cannot be read."""
    try:
        return path.read_bytes()
    except OSError:
        return None


def _decoded(path: Any) -> str | None:
    """Text of a DBC file; None when it cannot be read."""
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
) -> Robot:
    try:
        values = read_toml(text)
    except ValueError as error:
        raise RobotFileError(source, [Fault("syntax", str(error), "TOML 1.0")]) from error
    faults = Faults()
    top = Table(values, "", faults)
    defaults = top.table("defaults")
    name, description = top.name("name"), top.text("description", "")
    clock = top.choice("clock", ClockDomain) or ClockDomain.HOST
    assumed = top.words("assumed", valid=_PARTS)
    joints = read_joints(top, defaults)
    links = read_links(top, defaults, len(joints))
    sensors = read_sensors(top, defaults, links)
    note_repeated(faults, "joints and sensors", [part.name for part in (*joints, *sensors)])
    bus, databases = None, ()
    if "bus" in top:
        bus, databases = read_bus(top.table("bus"), joints, sensors, read_database)
    safety = read_safety(top, joints)
    meshes = () if read_mesh is None else read_meshes(links, faults, read_mesh)
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
        meshes=meshes,
        assumed=assumed,
        safety=safety,
    )
