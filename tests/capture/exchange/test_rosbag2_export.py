"""rosbag2 folders: opened and decoded by rosbags, held against the session's own bytes."""

import io

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer
from rosbags.interfaces import QosDurability
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from support.written_sessions import EPOCH_NS, NAMES, samples, write_session
from undulog.capture import Session
from undulog.capture.common.errors import DataError
from undulog.capture.exchange.formats.rosbag.exporting import export_rosbag2
from undulog.capture.log.edited_log import EDIT_RECORD, RawLog
from undulog.capture.log.health.contract import check_contract


def messages_of(path):
    reader = make_reader(io.BytesIO(path.read_bytes()))
    return [
        (schema.name, channel.topic, message.log_time, message.publish_time, message.data)
        for schema, channel, message in reader.iter_messages(log_time_order=False)
    ]


@pytest.fixture
def bag(tmp_path):
    write_session(tmp_path / "run.mcap")
    report = export_rosbag2(tmp_path / "run.mcap", tmp_path / "bag")
    return tmp_path / "bag", report


def test_messages_are_those_of_the_session_byte_for_byte(bag, tmp_path):
    folder, report = bag
    assert {path.name for path in folder.iterdir()} == {"metadata.yaml", "bag_0.mcap"}
    expected = messages_of(tmp_path / "run.mcap")
    assert messages_of(folder / "bag_0.mcap") == expected
    assert sum(report.facts["messages"].values()) == len(expected)
    with Reader(folder) as reader:
        by_rosbags = [(c.msgtype, c.topic, t, bytes(data)) for c, t, data in reader.messages()]
        counts = {connection.topic: connection.msgcount for connection in reader.connections}
    assert sorted(by_rosbags) == sorted((n, t, log, data) for n, t, log, _, data in expected)
    assert counts == report.facts["messages"]


def test_rosbags_decodes_every_type(bag):
    folder, report = bag
    store = get_typestore(Stores.EMPTY)
    seen = dict.fromkeys(report.facts["messages"], 0)
    positions = []
    with Reader(folder) as reader:
        assert (reader.start_time, reader.message_count) == (
            EPOCH_NS,
            sum(report.facts["messages"].values()),
        )
        assert reader.duration == 299 * 10_000_000 + 1
        for connection in reader.connections:
            store.register(get_types_from_msg(connection.msgdef.data, connection.msgtype))
        for connection, _, data in reader.messages():
            message = store.deserialize_cdr(data, connection.msgtype)
            seen[connection.topic] += 1
            if connection.topic == "/joint_states":
                assert tuple(message.name) == NAMES
                positions.append(message.position)
    assert seen == report.facts["messages"]
    np.testing.assert_array_equal(positions, samples()[:, 0])


def test_a_topic_whose_last_message_stays_valid_is_offered_so(bag):
    with Reader(bag[0]) as reader:
        offered = {
            connection.topic: connection.ext.offered_qos_profiles
            for connection in reader.connections
        }
    assert [offer.durability for offer in offered["/gait/mode"]] == [QosDurability.TRANSIENT_LOCAL]
    assert offered["/joint_states"] == []


def test_the_bag_is_read_as_the_session(bag, tmp_path):
    with Session.open(bag[0]) as back, Session.open(tmp_path / "run.mcap") as session:
        assert back.session_id == session.session_id
        assert back.verdict == session.verdict == "good"
        expected, got = session.joints("/joint_states"), back.joints("/joint_states")
        for name in NAMES:
            np.testing.assert_array_equal(got.signal(name).values, expected.signal(name).values)


def records_of(path):
    with RawLog(path) as log:
        records = [record for record in log.metadata if record.name != EDIT_RECORD]
        return records, log.attachments


def test_an_exported_session_comes_back_bit_for_bit(bag, tmp_path, command, report_of):
    folder, exported = bag
    session, back = tmp_path / "run.mcap", tmp_path / "back.mcap"
    report = report_of("import", folder, "-o", back)
    assert report["messages"] == exported.facts["messages"]
    assert (report["verdict"], report["problems"]) == ("good", [])
    assert "exported by undulog, is copied as it is" in report["notes"][0]
    assert sorted(messages_of(back)) == sorted(messages_of(session))
    assert records_of(back) == records_of(session)
    with Session.open(back) as returned, Session.open(session) as other:
        assert (returned.session_id, returned.start_ns) == (other.session_id, other.start_ns)
        for topic in ("/joint_states", "/joint_commands"):
            got, expected = returned.joints(topic), other.joints(topic)
            np.testing.assert_array_equal(got.t_ns, expected.t_ns)
            np.testing.assert_array_equal(got.values, expected.values)
    assert "exists already" in command("import", folder, "-o", back, code=2).err
    other = tmp_path / "other.mcap"
    chosen = ("--response-topic", "/encoders")
    refused = command("import", folder, "-o", other, *chosen, code=1).err
    assert "copied as it is; leave out --robot, --command-topic and --response-topic" in refused
    assert not other.exists()


def test_an_edit_keeps_the_chunks_of_the_contract(bag, tmp_path, command):
    back, part = tmp_path / "back.mcap", tmp_path / "part.mcap"
    command("import", bag[0], "-o", back)
    command("log", "cut", back, "--start", 1, "-o", part)
    assert [violation for path in (back, part) for violation in check_contract(path)] == []


def write_mcap(path, channels):
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        for topic, encoding, name, kind, text, data in channels:
            schema = writer.register_schema(name, kind, text)
            channel = writer.register_channel(topic, encoding, schema)
            writer.add_message(channel, 5, data, 6)
        writer.finish()
    return path


TEXT = ("cdr", "std_msgs/msg/String", "ros2msg", b"string data", b"\0\1\0\0\2\0\0\0a\0")


def test_what_is_no_message_of_ros_is_left_out(tmp_path):
    json_channel = ("/status", "json", "Status", "jsonschema", b"{}", b"{}")
    path = write_mcap(tmp_path / "run.mcap", [("/a/01", *TEXT), json_channel])
    report = export_rosbag2(path, tmp_path / "bag")
    assert report.facts["messages"] == {"/a/01": 1}
    assert "not messages of ROS 2, left out: /status" in report.warnings
    assert report.warnings[-1].endswith("of ros2 bag play: /a/01")
    with Reader(tmp_path / "bag") as reader:
        assert [(c.topic, t) for c, t, _ in reader.messages()] == [("/a/01", 5)]
    path = write_mcap(tmp_path / "json.mcap", [json_channel])
    with pytest.raises(DataError, match="has no messages of ROS 2"):
        export_rosbag2(path, tmp_path / "none")
    other = ("/a/01", "cdr", "std_msgs/msg/Bool", "ros2msg", b"bool data", b"\0\1\0\0\1")
    path = write_mcap(tmp_path / "two.mcap", [("/a/01", *TEXT), other])
    with pytest.raises(DataError, match="a topic of a bag has one type"):
        export_rosbag2(path, tmp_path / "none")
    assert not list(tmp_path.glob("none*"))


def test_the_verb(tmp_path, command, report_of):
    write_session(tmp_path / "run.mcap")
    line = ("log", "export", tmp_path / "run.mcap", "--to", "rosbag2", "-o", tmp_path / "bag")
    assert report_of(*line)["messages"]["/joint_states"] == 300
    assert "exists already" in command(*line, code=2).err
    command(*line, "--force")
    refused = command(*line, tmp_path / "run.mcap", "--force", code=2).err
    assert "--to rosbag2 takes one session, not 2" in refused
    refused = command(*line, "--fps", 3, "--force", code=2).err
    assert "--fps is for LeRobot; --to rosbag2 has all messages" in refused


def test_a_folder_with_the_metadata_of_another_tool_is_not_replaced(tmp_path, command):
    write_session(tmp_path / "run.mcap", count=20)
    (tmp_path / "set").mkdir()
    (tmp_path / "set/metadata.yaml").write_text("name: a tool\n")
    words = ("log", "export", tmp_path / "run.mcap", "--to", "rosbag2", "-o", tmp_path / "set")
    assert "not of rosbag2" in command(*words, "--force", code=2).err
    assert (tmp_path / "set/metadata.yaml").read_text() == "name: a tool\n"
