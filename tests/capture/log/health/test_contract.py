"""Logs written by others' libraries, held to the log contract: each violation is named."""

import json
from dataclasses import dataclass, field

import numpy as np
import pytest
from mcap.writer import CompressionType, Writer
from rosbags.typesys import Stores, get_typestore

from support.paths import DOCS
from undulog.capture import load_robot
from undulog.capture.log.health.contract import RULES, check_contract

STORE = get_typestore(Stores.ROS2_HUMBLE)
JOINTS = "sensor_msgs/msg/JointState"
START_NS = 1_767_225_600 * 10**9
ROBOT = load_robot("arcsnake-joint")
(JOINT,) = ROBOT.joint_names


def joints(names=(JOINT,), positions=(0.1,), velocity=(), stamp_ns=START_NS):
    stamp = STORE.types["builtin_interfaces/msg/Time"](*divmod(stamp_ns, 10**9))
    header = STORE.types["std_msgs/msg/Header"](stamp, "")
    arrays = [np.array(values, float) for values in (positions, velocity, ())]
    return STORE.types[JOINTS](header, list(names), *arrays)


def raw(label="frame", size=32, count=1, record="x"):
    kind = STORE.types
    dims = [
        kind["std_msgs/msg/MultiArrayDimension"](label, count, count * size),
        kind["std_msgs/msg/MultiArrayDimension"](record, size, size),
    ]
    layout = kind["std_msgs/msg/MultiArrayLayout"](dims, 0)
    return kind["std_msgs/msg/UInt8MultiArray"](layout, np.zeros(count * size, np.uint8))


@dataclass
class Log:
    """What a foreign writer writes; in order as it stands."""

    profile: str = "ros2"
    compression: CompressionType = CompressionType.ZSTD
    crcs: bool = True
    finished: bool = True
    encoding: str = "cdr"
    log_ns: int = START_NS
    unit: str = "rad"
    late_record: bool = False
    messages: dict = field(default_factory=lambda: {"/joint_states": [joints(), joints()]})
    definition: str = ""
    record: dict = field(
        default_factory=lambda: {
            "session_id": "s1",
            "contract": "1",
            "epoch_ns": str(START_NS),
            "robot": ROBOT.name,
            "clock.can0": "device",
        }
    )
    health: dict = field(default_factory=dict)
    robot: str = ROBOT.toml
    files: dict = field(default_factory=lambda: dict(ROBOT.databases))

    def write(self, path):
        with path.open("wb") as stream:
            size = 64 if self.late_record else 1 << 20
            writer = Writer(
                stream, chunk_size=size, compression=self.compression, enable_crcs=self.crcs
            )
            writer.start(profile=self.profile, library="foreign")
            if self.record and not self.late_record:
                writer.add_metadata("undulog", self.record)
            for topic, messages in self.messages.items():
                self._topic(writer, topic, messages)
            if self.robot:
                for name, text in {"robot.toml": self.robot, **self.files}.items():
                    writer.add_attachment(0, 0, name, "text/plain", text.encode())
            if self.record and self.late_record:
                writer.add_metadata("undulog", self.record)
            if self.health:
                writer.add_metadata("undulog.health", self.health)
            writer.finish()
        if not self.finished:
            path.write_bytes(path.read_bytes()[:-60])
        return path

    def _topic(self, writer, topic, messages):
        kind = messages[0].__msgtype__
        text = self.definition or STORE.generate_msgdef(kind, ros_version=2)[0]
        schema = writer.register_schema(kind, "ros2msg", text.encode())
        unit = {"unit": self.unit} if self.unit else {}
        channel = writer.register_channel(topic, self.encoding, schema, unit)
        for k, message in enumerate(messages):
            data = bytes(STORE.serialize_cdr(message, kind))
            writer.add_message(channel, self.log_ns + k, data, self.log_ns + k)


def broken(log, path):
    return [
        (violation.rule, violation.where, str(violation))
        for violation in check_contract(log.write(path))
    ]


def test_a_foreign_log_that_follows_the_contract(tmp_path):
    assert broken(Log(), tmp_path / "a.mcap") == []


STRING = STORE.types["std_msgs/msg/String"]("walk")


@pytest.mark.parametrize(
    ("change", "rule", "where", "fix"),
    [
        ({"profile": ""}, "profile", "header", "write 'ros2'"),
        ({"finished": False}, "summary", "a.mcap", "finish the file"),
        ({"compression": CompressionType.LZ4}, "compression", "chunks", "found lz4"),
        ({"crcs": False}, "crc", "chunks", "without a CRC"),
        ({"encoding": "json"}, "encoding", "/joint_states: channel", "write cdr"),
        ({"messages": {"/imu": [STRING]}}, "type", "/imu", "write sensor_msgs/msg/Imu"),
        ({"messages": {"/ir/01": [STRING]}}, "type", "/ir/01", "write sensor_msgs/msg/Range"),
        (
            {"messages": {"/gait/mode": [STRING]}, "definition": "string text"},
            "type",
            "/gait/mode",
            "definition of ROS 2",
        ),
        ({"unit": "deg"}, "unit", "/joint_states", "found 'deg'; fix: 'rad'"),
        ({"unit": ""}, "unit", "/joint_states", "found nothing; fix: 'rad'"),
        (
            {"messages": {"/joint_states": [joints(), joints((), ())]}},
            "names",
            "/joint_states: name",
            "the same names",
        ),
        (
            {"messages": {"/joint_states": [joints(("elbow",))]}},
            "names",
            "/joint_states: name",
            f"found elbow; fix: take the names of robot.toml: {JOINT}",
        ),
        (
            {"messages": {"/joint_states": [joints(velocity=(1.0, 2.0))]}},
            "lengths",
            "velocity of the first",
            "2 values for 1 names",
        ),
        ({"messages": {"/joint_states": [joints(stamp_ns=0)]}}, "stamp", "header.stamp", "found 0"),
        (
            {"messages": {"/joint_states": [joints(stamp_ns=5 * 10**9)]}, "log_ns": 5 * 10**9},
            "log-time",
            "log_time",
            "write Unix time",
        ),
        ({"messages": {"/can/can0": [raw()]}}, "frames", "/can/can0", "t_device_ns:u64"),
        ({"messages": {"/serial/arm": [raw(size=8)]}}, "frames", "/serial/arm", "len:u8"),
        ({"record": {}, "robot": ""}, "record", "record undulog", "session_id, contract"),
        ({"late_record": True}, "record", "record undulog", "before the first chunk"),
        ({"health": {"verdict": "fine"}}, "health", "verdict", "good, degraded, bad"),
        (
            {"health": {"verdict": "good", "reasons": "none"}},
            "health",
            "reasons",
            "a JSON list",
        ),
        ({"robot": ""}, "robot", "robot.toml", f"found nothing, for '{ROBOT.name}'"),
        ({"robot": "name = 1"}, "robot", "robot.toml", "undulog robot check"),
    ],
)
def test_a_violation_is_named_with_its_fix(change, rule, where, fix, tmp_path):
    ((broken_rule, place, line),) = broken(Log(**change), tmp_path / "a.mcap")
    assert broken_rule == rule
    assert where in place
    assert fix in line


@pytest.mark.parametrize(
    ("key", "value"),
    [("contract", "2"), ("epoch_ns", "now"), ("clock.can0", "mine"), ("session_id", None)],
)
def test_a_key_of_the_record_is_named(key, value, tmp_path):
    log = Log()
    log.record = {k: v for k, v in (log.record | {key: value}).items() if v is not None}
    ((rule, where, _),) = broken(log, tmp_path / "a.mcap")
    assert (rule, where) == ("record", f"record undulog: {key}")


def test_topics_that_share_chunks_are_named(tmp_path):
    log = Log(messages={"/joint_states": [joints()], "/gait/mode": [STRING]})
    ((rule, where, line),) = broken(log, tmp_path / "a.mcap")
    assert (rule, where) == ("chunks", "a.mcap: /joint_states")
    assert "/gait/mode" in line


def test_the_page_has_every_rule():
    page = (DOCS / "reference/log-contract.md").read_text()
    assert [rule for rule in RULES if f"| `{rule}` | {RULES[rule]} |" not in page] == []


def test_the_command_prints_them_and_ends_with_1(tmp_path, command):
    path = Log(unit="").write(tmp_path / "a.mcap")
    lines = command("log", "check", "--contract", path, code=1).out.splitlines()
    assert lines[0] == "a.mcap: 1 violation of the log contract, version 1"
    assert lines[1].startswith("  unit: /joint_states: channel metadata unit: found nothing")
    report = json.loads(command("log", "check", "--contract", path, "--json", code=1).out)
    assert report["follows"] is False
    assert [violation["rule"] for violation in report["violations"]] == ["unit"]
    good = Log().write(tmp_path / "b.mcap")
    assert "follows all" in command("log", "check", "--contract", good).out
    table = command("log", "check", "--contract", path, good, code=1).out
    assert "1 violation " in table
