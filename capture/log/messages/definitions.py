"""Message definitions of ROS 2, the schema text of an MCAP channel as a tree of types.

Grammar: https://docs.ros.org/en/rolling/Concepts/Basic/About-Interfaces.html, concatenated as
the MCAP registry has it (https://mcap.dev/spec/registry#ros2msg): the main definition, then each
dependency after a line of ``=`` and a line ``MSG: package/Type``.

The definitions of the messages of the log contract have the fields of ros2/common_interfaces and
ros2/rcl_interfaces (Rolling), without comments.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from functools import cache
from types import MappingProxyType
from typing import TYPE_CHECKING, cast

from ...common.errors import DataError

if TYPE_CHECKING:
    from mcap.records import Channel

CONTRACT_VERSION = 1
"""Version that sessions are written by.

It goes up when a reader of the version before would take a new file for something else. A new
topic, record or entry leaves it: earlier readers ignore it. Every earlier version is read.
"""

PRIMITIVES: dict[str, str] = {
    "bool": "u1",
    "byte": "u1",
    "char": "u1",
    "int8": "i1",
    "uint8": "u1",
    "int16": "<i2",
    "uint16": "<u2",
    "int32": "<i4",
    "uint32": "<u4",
    "int64": "<i8",
    "uint64": "<u8",
    "float32": "<f4",
    "float64": "<f8",
}
"""Fixed-size primitive to numpy type string."""

_FLOATS = ("float32", "float64")

_DEEPEST = 64
"""Deepest nesting of types; those of ROS are rarely deeper than five."""

_MOST_FIELDS = 4096
"""Most fields of a type and of all nested ones: twenty short lines can define a million."""

_LONGEST_NUMBER = 9
"""Most digits of an array's length."""

_SEPARATOR = re.compile(r"^=+\s*$", re.MULTILINE)
_FIELD = re.compile(
    r"^(?P<base>[A-Za-z][\w/]*)(?P<bound><=\d+)?(?P<array>\[(?:<=)?\d*\])?\s+(?P<name>[A-Za-z]\w*)"
    r"(?P<rest>.*)$"
)

JOINT_STATE = "sensor_msgs/msg/JointState"
CONTROLLER_STATE = "control_msgs/msg/JointTrajectoryControllerState"
DYNAMIC_STATE = "control_msgs/msg/DynamicJointState"
TRAJECTORY = "trajectory_msgs/msg/JointTrajectory"
FLOAT_ARRAYS = ("std_msgs/msg/Float64MultiArray", "std_msgs/msg/Float32MultiArray")
"""Values without names and without a stamp."""

JOINT_LISTS = (JOINT_STATE, CONTROLLER_STATE, DYNAMIC_STATE)
"""Types whose messages each have one sample of some joints, and their names."""

_BODIES: dict[str, str] = {
    "builtin_interfaces/Time": "int32 sec\nuint32 nanosec\n",
    "std_msgs/Header": "builtin_interfaces/Time stamp\nstring frame_id\n",
    "std_msgs/String": "string data\n",
    "std_msgs/MultiArrayDimension": "string label\nuint32 size\nuint32 stride\n",
    "std_msgs/MultiArrayLayout": "MultiArrayDimension[] dim\nuint32 data_offset\n",
    "std_msgs/UInt8MultiArray": "MultiArrayLayout layout\nuint8[] data\n",
    "geometry_msgs/Vector3": "float64 x\nfloat64 y\nfloat64 z\n",
    "geometry_msgs/Point": "float64 x\nfloat64 y\nfloat64 z\n",
    "geometry_msgs/Quaternion": "float64 x 0\nfloat64 y 0\nfloat64 z 0\nfloat64 w 1\n",
    "geometry_msgs/Pose": "Point position\nQuaternion orientation\n",
    "geometry_msgs/Twist": "Vector3 linear\nVector3 angular\n",
    "geometry_msgs/PoseWithCovariance": "Pose pose\nfloat64[36] covariance\n",
    "geometry_msgs/TwistWithCovariance": "Twist twist\nfloat64[36] covariance\n",
    "geometry_msgs/Transform": "Vector3 translation\nQuaternion rotation\n",
    "geometry_msgs/TransformStamped": (
        "std_msgs/Header header\nstring child_frame_id\nTransform transform\n"
    ),
    "tf2_msgs/TFMessage": "geometry_msgs/TransformStamped[] transforms\n",
    "nav_msgs/Odometry": (
        "std_msgs/Header header\nstring child_frame_id\n"
        "geometry_msgs/PoseWithCovariance pose\ngeometry_msgs/TwistWithCovariance twist\n"
    ),
    "sensor_msgs/JointState": (
        "std_msgs/Header header\nstring[] name\n"
        "float64[] position\nfloat64[] velocity\nfloat64[] effort\n"
    ),
    "sensor_msgs/Range": (
        "uint8 ULTRASOUND=0\nuint8 INFRARED=1\nstd_msgs/Header header\nuint8 radiation_type\n"
        "float32 field_of_view\nfloat32 min_range\nfloat32 max_range\nfloat32 range\n"
        "float32 variance\n"
    ),
    "sensor_msgs/Imu": (
        "std_msgs/Header header\ngeometry_msgs/Quaternion orientation\n"
        "float64[9] orientation_covariance\ngeometry_msgs/Vector3 angular_velocity\n"
        "float64[9] angular_velocity_covariance\ngeometry_msgs/Vector3 linear_acceleration\n"
        "float64[9] linear_acceleration_covariance\n"
    ),
    "sensor_msgs/MagneticField": (
        "std_msgs/Header header\ngeometry_msgs/Vector3 magnetic_field\n"
        "float64[9] magnetic_field_covariance\n"
    ),
    "sensor_msgs/TimeReference": (
        "std_msgs/Header header\nbuiltin_interfaces/Time time_ref\nstring source\n"
    ),
    "diagnostic_msgs/KeyValue": "string key\nstring value\n",
    "diagnostic_msgs/DiagnosticStatus": (
        "byte OK=0\nbyte WARN=1\nbyte ERROR=2\nbyte STALE=3\n"
        "byte level\nstring name\nstring message\nstring hardware_id\nKeyValue[] values\n"
    ),
    "diagnostic_msgs/DiagnosticArray": "std_msgs/Header header\nDiagnosticStatus[] status\n",
    "rcl_interfaces/Log": (
        "byte DEBUG=10\nbyte INFO=20\nbyte WARN=30\nbyte ERROR=40\nbyte FATAL=50\n"
        "builtin_interfaces/Time stamp\nuint8 level\nstring name\nstring msg\nstring file\n"
        "string function\nuint32 line\n"
    ),
}

VERDICTS = ("good", "degraded", "bad")
"""Verdicts on a session, the worst last."""

OK, WARN, ERROR, STALE = 0, 1, 2, 3
"""Levels of ``diagnostic_msgs/DiagnosticStatus``."""

NO_VALUES: Mapping[str, str] = MappingProxyType({})

_LATCHED = re.compile(r"durability:\s*(1\b|transient_local)")


def newer_contract(facts: Mapping[str, str]) -> str | None:
    """Return a warning if a session follows a version that is not known here, else None.

    Args:
        facts: The metadata record ``undulog``.
    """
    stated = facts.get("contract", "")
    if not (stated.isascii() and stated.isdigit()) or int(stated[:9]) <= CONTRACT_VERSION:
        return None
    return (
        f"it follows version {stated[:9]} of the log contract, and this undulog reads up to "
        f"{CONTRACT_VERSION}: what has changed since may be misread; update undulog"
    )


@dataclass(frozen=True)
class Field:
    """One field of a message.

    Attributes:
        base: A key of :data:`PRIMITIVES`, ``string``, ``wstring``, or None for a nested message.
        nested: The nested message type, or None.
        length: 1 for a plain field, n for a fixed array, None for a sequence.
        is_array: Whether it is a fixed array or a sequence.
    """

    name: str
    base: str | None
    nested: MessageType | None
    length: int | None
    is_array: bool


@dataclass(frozen=True)
class MessageType:
    """A message type with its fields, nested types resolved.

    Attributes:
        name: Full name, e.g. ``sensor_msgs/msg/JointState``.
        fields: In wire order; constants left out.
        size: Number of fields, those of nested types among them.
        has_floats: Whether any of them is a float, which may be NaN.
    """

    name: str
    fields: tuple[Field, ...]
    size: int = field(default=0, compare=False)
    has_floats: bool = field(default=False, compare=False)


def parse_message_type(name: str, text: str) -> MessageType:
    """Parse a ``ros2msg`` schema.

    Args:
        name: Full name of the main type, e.g. ``sensor_msgs/msg/JointState``.

    Returns:
        The type with all dependencies resolved.

    Raises:
        DataError: If a line cannot be parsed or a dependency is missing or circular.
    """
    sections = _SEPARATOR.split(text)
    bodies = {_short(name): sections[0]}
    for section in sections[1:]:
        head, _, body = section.lstrip().partition("\n")
        if not head.startswith("MSG:"):
            raise DataError(f"schema {name}: a section starts with {head!r}, not with 'MSG: TYPE'")
        bodies[_short(head.removeprefix("MSG:").strip())] = body
    return _Parser(name, bodies).message(_short(name), ())


def _short(name: str) -> str:
    """Return ``package/msg/Type`` or ``package/Type`` as ``package/Type``."""
    return name.replace("/msg/", "/")


class _Parser:
    """Resolves the sections of one schema."""

    def __init__(self, name: str, bodies: dict[str, str]) -> None:
        self._name, self._bodies = name, bodies
        self._done: dict[str, MessageType] = {}

    def message(self, short: str, path: tuple[str, ...]) -> MessageType:
        if short in path:
            raise DataError(f"schema {self._name}: {short} contains itself")
        if len(path) == _DEEPEST:
            raise DataError(f"schema {self._name}: types nested more than {_DEEPEST} deep")
        if short not in self._done:
            if short not in self._bodies:
                defined = ", ".join(sorted(self._bodies))
                raise DataError(f"schema {self._name}: no definition of {short}; it has {defined}")
            lines = self._bodies[short].splitlines()
            parsed = (self._field(line, short, (*path, short)) for line in lines)
            fields = tuple(part for part in parsed if part is not None)
            self._done[short] = self._type(short, fields)
        return self._done[short]

    def _type(self, short: str, fields: tuple[Field, ...]) -> MessageType:
        package, _, type_name = short.partition("/")
        nested = [part.nested for part in fields if part.nested is not None]
        size = len(fields) + sum(kind.size for kind in nested)
        if size > _MOST_FIELDS:
            raise DataError(
                f"schema {self._name}: {short} has {size} fields, more than {_MOST_FIELDS}"
            )
        floats = any(part.base in _FLOATS for part in fields) or any(
            kind.has_floats for kind in nested
        )
        return MessageType(f"{package}/msg/{type_name}", fields, size, floats)

    def _field(self, line: str, owner: str, path: tuple[str, ...]) -> Field | None:
        line = line.partition("#")[0].strip()
        if not line:
            return None
        match = _FIELD.match(line)
        if match is None:
            raise DataError(f"schema {self._name}: cannot read the line {line!r} of {owner}")
        if match["rest"].lstrip().startswith("="):
            return None  # a constant takes no bytes on the wire
        base, array = match["base"], match["array"]
        digits = array.strip("[]<=") if array else "1"
        if len(digits) > _LONGEST_NUMBER:
            raise DataError(f"schema {self._name}: no array has the length {digits[:20]}...")
        length = None if array and (not digits or "<=" in array) else int(digits)
        if base in PRIMITIVES or base in {"string", "wstring"}:
            return Field(match["name"], base, None, length, array is not None)
        if "/" not in base:
            base = {"Header": "std_msgs/Header"}.get(base, f"{owner.partition('/')[0]}/{base}")
        nested = self.message(_short(base), path)
        return Field(match["name"], None, nested, length, array is not None)


def is_of_contract(kind: MessageType) -> bool:
    """Whether a type is one of the log contract, with the same fields."""
    return _short(kind.name) in _BODIES and message_type(kind.name) == kind


@cache
def schema_text(name: str) -> str:
    """Return the ``ros2msg`` schema of a message type, dependencies appended.

    Raises:
        DataError: If the log contract doesn't use that type.
    """
    short = _short(name)
    if short not in _BODIES:
        listed = ", ".join(sorted(_BODIES))
        raise DataError(f"no definition of {name}; there are {listed}")
    order: list[str] = []
    _collect(short, order)
    parts = [_BODIES[order[0]], *(f"MSG: {dep}\n{_BODIES[dep]}" for dep in order[1:])]
    return ("=" * 80 + "\n").join(parts)


@cache
def message_type(name: str) -> MessageType:
    """Return the parsed message type of a name.

    Raises:
        DataError: If the log contract doesn't use that type.
    """
    return parse_message_type(name, schema_text(name))


def _collect(short: str, order: list[str]) -> None:
    """Append a type and all it needs, each once, main type first."""
    order.append(short)
    for line in _BODIES[short].splitlines():
        base = line.split()[0].partition("[")[0]
        if base in PRIMITIVES or base == "string":
            continue
        dependency = base if "/" in base else f"{short.partition('/')[0]}/{base}"
        if dependency not in order:
            _collect(dependency, order)


def stated_reasons(health: Mapping[str, str]) -> tuple[str, ...]:
    """Return the reasons of a record ``undulog.health``; what is no JSON list is one reason."""
    text = health.get("reasons", "[]")
    try:
        reasons: object = json.loads(text)
    except (ValueError, RecursionError):
        return (text,)
    return tuple(
        map(str, cast("list[object]", reasons) if isinstance(reasons, list) else [reasons])
    )


@dataclass(frozen=True)
class DiagnosticStatus:
    """One component's state, as ``diagnostic_msgs/DiagnosticStatus`` has it.

    Attributes:
        level: :data:`OK`, :data:`WARN`, :data:`ERROR` or :data:`STALE`.
        name: The component, e.g. ``source can0``.
        hardware_id: The device, e.g. ``can:socketcan:can0``; empty where there is none.
        values: Further facts; numbers as text.
    """

    level: int
    name: str
    message: str
    hardware_id: str = ""
    values: Mapping[str, str] = field(default_factory=lambda: NO_VALUES)


class PowerTopic(StrEnum):
    """A JointState whose ``position`` is a mean power [W] over the interval about its stamp.

    The interval is as long as the topic's sampling interval. The product of a mean torque and a
    mean velocity is not the mean power, so a robot, or the twin, multiplies at the rate of its
    control loop and logs the means.
    """

    MECHANICAL = "/joint_power/mechanical"
    """Torque times velocity, signed."""
    MECHANICAL_PLUS = "/joint_power/mechanical_plus"
    """Its positive part."""
    ELECTRICAL = "/joint_power/electrical"
    """Motor voltage times motor current, signed."""
    ELECTRICAL_PLUS = "/joint_power/electrical_plus"
    """Its positive part."""


def is_latched(type_name: str, channel: Channel) -> bool:
    """Whether a topic's last message stays valid until the next.

    True for Strings, static transforms, and topics of durability transient local in a ROS 2 bag
    (``offered_qos_profiles``, https://github.com/ros2/rosbag2).
    """
    if type_name == "std_msgs/msg/String":
        return True
    offered = channel.metadata.get("offered_qos_profiles", "")
    return adds_up(channel) or bool(_LATCHED.search(offered))


def adds_up(channel: Channel) -> bool:
    """Whether every different message stays valid, not only the last.

    True for static transforms: each message holds some of them.
    """
    return channel.topic.endswith("/tf_static")
