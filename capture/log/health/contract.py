"""Check of a log against the log contract: each violation by rule, place, finding and fix.

The contract is ``docs/reference/log-contract.md``; a writer of any make may follow it. Health is
another question: a log with gaps can follow the contract, and a log without fault can break it.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain, islice
from pathlib import Path
from types import MappingProxyType
from typing import Any

from mcap.opcode import Opcode

from ...common.errors import DataError, some_names
from ...common.process import threads_or_default
from ...common.remote import as_path
from ..columns.names import several_of_one_name
from ..columns.topics import Channel
from ..mcap.chunk import MAGIC, walk_records
from ..mcap.file import McapFile
from ..messages import frames as wire
from ..messages.definitions import (
    CONTRACT_VERSION,
    JOINT_STATE,
    VERDICTS,
    PowerTopic,
    is_of_contract,
)
from ..read.open_log import OpenLog
from ..read.session_view import SessionView

RULES: Mapping[str, str] = MappingProxyType(
    {
        "profile": "the MCAP header has the profile ros2",
        "summary": "a finished file has its summary and indexes",
        "compression": "chunks are compressed with zstd",
        "crc": "each chunk has its CRC",
        "chunks": "each JointState topic, each bus and /tf has chunks of its own",
        "encoding": "messages are CDR, their schemas ros2msg",
        "type": "a topic of the contract has the type and the fields that the contract gives it",
        "unit": "a JointState topic has the unit of its position in the channel's metadata",
        "names": "all messages of a topic have the same names, those of the robot in its order",
        "lengths": "position has a value for each name; velocity and effort have, or are empty",
        "stamp": "header.stamp is the sampling time in Unix ns",
        "log-time": "log times are Unix times",
        "frames": "raw frames are records of the layout that the message names",
        "record": "the metadata record undulog is there, first, with its keys",
        "health": "the record undulog.health has a verdict and its reasons",
        "robot": "the robot that the record undulog names is attached, and without faults",
    }
)
"""Name of each rule to what it asks for."""

_FRAME_PREFIXES = (*wire.FRAME_TOPIC_PREFIXES, wire.SERIAL_TOPIC_PREFIX)
_UNITS = {
    "/joint_commands": "rad",
    "/joint_states": "rad",
    "/joint_velocity": "rad/s",
    "/joint_effort": "N m",
    "/joint_sample_offset": "s",
    "/joint_command_offset": "s",
    "/joint_current": "A",
    "/joint_voltage": "V",
    "/joint_temperature": "degC",
    **dict.fromkeys(PowerTopic, "W"),
    "/gate/wanted": "rad",
    "/energy_ledger": "J",
}
_TYPES = dict.fromkeys([*_UNITS, "/gait"], JOINT_STATE) | {
    "/sonar": "sensor_msgs/msg/Range",
    "/imu": "sensor_msgs/msg/Imu",
    "/compass": "sensor_msgs/msg/MagneticField",
    "/gait/mode": "std_msgs/msg/String",
    "/gate/phase": "std_msgs/msg/String",
    "/odom": "nav_msgs/msg/Odometry",
    "/tf": "tf2_msgs/msg/TFMessage",
    "/robot_description": "std_msgs/msg/String",
    "/rosout": "rcl_interfaces/msg/Log",
    "/diagnostics": "diagnostic_msgs/msg/DiagnosticArray",
}
_TYPES_BELOW = {
    "/ir/": "sensor_msgs/msg/Range",
    "/clock/": "sensor_msgs/msg/TimeReference",
    **dict.fromkeys(_FRAME_PREFIXES, wire.FRAMES_TYPE),
}
_OTHER_NAMES = {"/gait", "/energy_ledger"}
"""JointStates whose names are no joints."""

_REQUIRED = ("session_id", "contract", "epoch_ns", "robot")
_CLOCKS = ("host", "device", "simulated")
_YEAR_2000_NS = 946_684_800 * 10**9
_DAY_NS = 86_400 * 10**9
_MOST_LISTED = 3


@dataclass(frozen=True)
class Violation:
    """One place where a log breaks the contract.

    Attributes:
        rule: One of :data:`RULES`.
        where: File, topic, record or attachment, and the field of it.
        found: What is there.
        fix: What the writer has to do.
    """

    rule: str
    where: str
    found: str
    fix: str

    def __str__(self) -> str:
        """Return the violation in one line."""
        return f"{self.rule}: {self.where}: found {self.found}; fix: {self.fix}"


def check_contract(path: Path | str) -> tuple[Violation, ...]:
    """Return all violations of a log, in the order of the rules.

    Args:
        path: An MCAP file, of any make; of a split session any part, or the folder.

    Raises:
        NotALogError: If it is not an MCAP file or nothing in it can be read.
        LogError: If it can't be opened.
    """
    log = OpenLog(as_path(path), None, threads_or_default(None))
    try:
        order = list(RULES)
        violations = chain(_container(log), _topics(log), _record(log), _health(log), _robot(log))
        return tuple(sorted(violations, key=lambda violation: order.index(violation.rule)))
    finally:
        log.file.close()


# -- the container -----------------------------------------------------------------------------


def _container(log: OpenLog) -> Iterator[Violation]:
    for file in log.file.files:
        name = file.path.name
        if file.profile != "ros2":
            yield Violation("profile", f"{name}: header", repr(file.profile), "write 'ros2'")
        if file.cut:
            yield Violation("summary", name, file.cut, "finish the file: summary, then footer")
        chunks = [block for block in file.blocks if block.record_at and not block.is_empty]
        other = sorted({chunk.compression or "none" for chunk in chunks} - {"zstd"})
        if other or len(chunks) < len([block for block in file.blocks if not block.is_empty]):
            actual = ", ".join(other) or "messages outside of chunks"
            yield Violation("compression", f"{name}: chunks", actual, "compress them with zstd")
        bare = sum(not chunk.crc for chunk in chunks)
        if bare:
            actual = f"{bare} of {len(chunks)} without a CRC"
            yield Violation("crc", f"{name}: chunks", actual, "write uncompressed_crc")
        yield from _shared_chunks(file, name)
        yield from _record_first(file, name)


def _shared_chunks(file: McapFile, name: str) -> Iterator[Violation]:
    alone = {
        key: channel.topic
        for key, channel in file.channels.items()
        if channel.topic == "/tf"
        or channel.topic.startswith(_FRAME_PREFIXES)
        or _is_joint(file, key)
    }
    topics = {key: channel.topic for key, channel in file.channels.items()}
    mixed: dict[str, set[str]] = {}
    for block in file.blocks:
        held = {topics[key] for key in block.index_at if key in topics}
        for topic in held & set(alone.values()):
            if len(held) > 1:
                mixed.setdefault(topic, set()).update(held - {topic})
    for topic, others in sorted(mixed.items()):
        actual = f"chunks with {_listed(sorted(others))} in them"
        yield Violation("chunks", f"{name}: {topic}", actual, "give the topic chunks of its own")


def _is_joint(file: McapFile, key: int) -> bool:
    schema = file.schemas.get(file.channels[key].schema_id)
    return schema is not None and schema.name == JOINT_STATE


def _record_first(file: McapFile, name: str) -> Iterator[Violation]:
    if "undulog" not in file.metadata:
        return
    with file.whole() as data:
        for opcode, _, _ in walk_records(data, len(MAGIC), len(data)):
            if opcode == Opcode.METADATA:
                return
            if opcode in (Opcode.CHUNK, Opcode.MESSAGE):
                fix = "write it before the first chunk, so that a cut file describes itself"
                yield Violation("record", f"{name}: record undulog", "it behind messages", fix)
                return


# -- topics and their messages -----------------------------------------------------------------


def _topics(log: OpenLog) -> Iterator[Violation]:
    view = SessionView(log)
    for topic, channel in sorted(view.channels.items()):
        if not channel.is_ros2:
            actual = f"{channel.encoding or 'nothing'} and {channel.schema_encoding or 'no schema'}"
            yield Violation("encoding", f"{topic}: channel", actual, "write cdr with ros2msg")
            continue
        try:
            yield from _topic(view, topic, channel)
        except DataError as error:
            actual = str(error).removeprefix(f"{log.path}: ")
            yield Violation("encoding", f"{topic}: messages", actual, "write CDR of the schema")


def _topic(view: SessionView, topic: str, channel: Channel) -> Iterator[Violation]:
    expected = _type_of(topic)
    if expected is not None and channel.type_name != expected:
        fix = f"write {expected}, or name the topic otherwise"
        yield Violation("type", f"{topic}: schema", channel.type_name, fix)
        return
    if expected is not None and not is_of_contract(view.message_type(topic)):
        fix = "take the definition of ROS 2"
        yield Violation("type", f"{topic}: schema", f"{expected} with other fields", fix)
        return
    if topic in _UNITS and channel.metadata.get("unit") != _UNITS[topic]:
        actual = repr(channel.metadata["unit"]) if "unit" in channel.metadata else "nothing"
        yield Violation("unit", f"{topic}: channel metadata unit", actual, f"{_UNITS[topic]!r}")
    for log_ns, message in islice(view.messages(topic), 1):
        yield from _stamp(topic, log_ns, message)
        if channel.type_name == JOINT_STATE:
            yield from _lengths(topic, message)
        if topic.startswith(_FRAME_PREFIXES):
            yield from _frames(topic, message)
    if topic in _UNITS and topic not in _OTHER_NAMES:
        yield from _names(view, topic)


def _type_of(topic: str) -> str | None:
    below = (kind for prefix, kind in _TYPES_BELOW.items() if topic.startswith(prefix))
    return _TYPES.get(topic) or next(below, None)


def _stamp(topic: str, log_ns: int, message: Any) -> Iterator[Violation]:
    where = f"{topic}: log_time of the first message"
    if log_ns < _YEAR_2000_NS:
        fix = "write Unix time in ns: the start's, plus the time that went by"
        yield Violation("log-time", where, f"{log_ns} ns", fix)
    header = getattr(message, "header", None)
    if header is None:
        return
    stamp_ns = header.stamp.sec * 10**9 + header.stamp.nanosec
    where = f"{topic}: header.stamp of the first message"
    if stamp_ns == 0 or abs(stamp_ns - log_ns) > _DAY_NS:
        actual = "0" if stamp_ns == 0 else f"{(stamp_ns - log_ns) / 1e9:+.0f} s off the log time"
        yield Violation("stamp", where, actual, "write the sampling time in Unix ns")


def _lengths(topic: str, message: Any) -> Iterator[Violation]:
    names = len(message.name)
    for field in ("position", "velocity", "effort"):
        values = len(getattr(message, field))
        if values != names and (values or field == "position"):
            empty = "" if field == "position" else ", or none"
            fix = f"write {names} values{empty}; NaN where one is not known"
            where = f"{topic}: {field} of the first message"
            yield Violation("lengths", where, f"{values} values for {names} names", fix)


def _names(view: SessionView, topic: str) -> Iterator[Violation]:
    orders = view.joint_orders(topic)
    if len(orders) > 1:
        fix = "write the same names in each message, NaN for a joint without a value"
        yield Violation("names", f"{topic}: name", f"{len(orders)} different lists", fix)
    for name in dict.fromkeys(name for order in orders for name in several_of_one_name(order)):
        fix = "give each joint a name of its own"
        yield Violation("names", f"{topic}: name", f"{name} more than once", fix)
    robot = view.robot
    if robot is None or not orders:
        return
    joints = robot.joint_names
    foreign = [name for name in orders[0] if name not in joints]
    if foreign:
        fix = f"take the names of robot.toml: {_listed(joints)}"
        yield Violation("names", f"{topic}: name", _listed(foreign), fix)
    elif list(orders[0]) != [name for name in joints if name in set(orders[0])]:
        fix = "write joints in the order of robot.toml, from the head"
        yield Violation("names", f"{topic}: name", f"the order {_listed(orders[0])}", fix)


def _frames(topic: str, message: Any) -> Iterator[Violation]:
    fd = not topic.startswith("/can/")
    layout, dtype = (
        (wire.FD_FRAME_LAYOUT, wire.FD_FRAME_DTYPE) if fd else (wire.FRAME_LAYOUT, wire.FRAME_DTYPE)
    )
    size = dtype.itemsize
    dims = [(dim.label, dim.size) for dim in message.layout.dim]
    count = len(message.data) // size
    if dims != [("frame", count), (layout, size)] or len(message.data) != count * size:
        actual = f"{dims} and {len(message.data)} bytes"
        fix = f"label dim[0] 'frame' with their number, dim[1] '{layout}' with {size}"
        yield Violation("frames", f"{topic}: layout of the first message", actual, fix)


# -- records and attachments -------------------------------------------------------------------


def _record(log: OpenLog) -> Iterator[Violation]:
    record = log.file.metadata.get("undulog")
    if record is None:
        fix = f"write a metadata record with {', '.join(_REQUIRED)}"
        yield Violation("record", "record undulog", "nothing", fix)
        return
    for key in _REQUIRED:
        if key not in record:
            yield Violation("record", f"record undulog: {key}", "nothing", "write the key")
    version = str(CONTRACT_VERSION)
    if record.get("contract", version) != version:
        actual, fix = repr(record["contract"]), f"follow version {version}, and write it"
        yield Violation("record", "record undulog: contract", actual, fix)
    if not re.fullmatch(r"\d{1,19}", record.get("epoch_ns", "0")):
        fix = "write the Unix time of the start, whole ns"
        yield Violation("record", "record undulog: epoch_ns", repr(record["epoch_ns"]), fix)
    for key, value in record.items():
        if key.startswith("clock.") and value not in _CLOCKS:
            fix = f"write one of {', '.join(_CLOCKS)}"
            yield Violation("record", f"record undulog: {key}", repr(value), fix)


def _health(log: OpenLog) -> Iterator[Violation]:
    record = log.file.metadata.get("undulog.health")
    if record is None:
        return
    if record.get("verdict") not in VERDICTS:
        actual, fix = repr(record.get("verdict")), f"write one of {', '.join(VERDICTS)}"
        yield Violation("health", "record undulog.health: verdict", actual, fix)
    try:
        is_list = isinstance(json.loads(record.get("reasons", "[]")), list)
    except (ValueError, RecursionError):
        is_list = False
    if not is_list:
        fix = "write a JSON list of sentences"
        yield Violation("health", "record undulog.health: reasons", "no JSON list", fix)


def _robot(log: OpenLog) -> Iterator[Violation]:
    named = log.file.metadata.get("undulog", {}).get("robot", "")
    attached = "robot.toml" in log.file.attachments
    if named and not attached:
        fix = "attach the robot's description, with the DBC files that it lists"
        yield Violation("robot", "attachment robot.toml", f"nothing, for {named!r}", fix)
    before = len(log.warnings)
    if attached and log.checked_robot is None:
        actual = "; ".join(log.warnings[before:]) or "a description with faults"
        yield Violation("robot", "attachment robot.toml", actual, "correct it: undulog robot check")
    elif log.robot is not None and named and log.robot.name != named:
        actual, fix = repr(named), f"write the attached robot's name, {log.robot.name!r}"
        yield Violation("robot", "record undulog: robot", actual, fix)


def _listed(names: Sequence[str]) -> str:
    return some_names(names, _MOST_LISTED)
