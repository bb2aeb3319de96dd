"""Cuts of logs against other readers: each message of the window, and what explains it."""

import hashlib
import json

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer
from rosbags.highlevel import AnyReader

from support.edited_logs import EPOCH_NS, MAKES, MS, between, read, records, text, ticks, write_log
from support.foreign_logs import foreign_log
from support.read_back import summary_of
from support.written_topics import write_topics
from undulog.capture import Session, load_robot
from undulog.capture.log.cut import cut_log
from undulog.capture.log.messages.definitions import schema_text

# -- cut -------------------------------------------------------------------------------------


@pytest.mark.parametrize("make", MAKES)
def test_a_cut_holds_exactly_the_messages_of_its_window(tmp_path, make):
    whole = write_log(tmp_path / "whole.mcap", ticks(), **MAKES[make])
    same = write_log(tmp_path / "same.mcap", ticks())  # mcap reads it whatever the make
    report = cut_log(whole, tmp_path / "cut.mcap", start_s=0.5, stop_s=1.21)
    expected = between(read(same), 500, 1210)
    assert len(expected) == 71
    assert read(tmp_path / "cut.mcap") == expected
    assert sum(report.messages.values()) == 71
    assert report.start_ns == EPOCH_NS + 500 * MS


def test_the_window_is_half_open_and_its_ends_are_exact(tmp_path):
    moments = [("/a", 0, "first"), ("/a", 1, "1 ns"), ("/a", 2, "2 ns"), ("/a", 300 * MS, "last")]
    whole = write_log(tmp_path / "whole.mcap", moments)
    cut_log(whole, tmp_path / "cut.mcap", start_s=1e-9, stop_s=0.3)
    assert [m[0] - EPOCH_NS for m in read(tmp_path / "cut.mcap")] == [1, 2]
    cut_log(whole, tmp_path / "rest.mcap", start_s=2e-9)
    assert [m[0] - EPOCH_NS for m in read(tmp_path / "rest.mcap")] == [2, 300 * MS]


def test_a_cut_keeps_topics_by_pattern(tmp_path):
    whole = write_log(tmp_path / "whole.mcap", ticks(topics=("/ir/01", "/ir/02", "/imu")))
    cut_log(whole, tmp_path / "cut.mcap", topics=["/ir/*"])
    assert read(tmp_path / "cut.mcap") == [m for m in read(whole) if m[1] != "/imu"]


def test_a_cut_keeps_what_explains_the_log_and_says_what_it_is(tmp_path):
    attachments = [("robot.urdf", b"<robot/>"), ("notes", b"one"), ("notes", b"two")]
    metadata = [("undulog", {"session_id": "s7"})]
    metadata += [("place", {"room": "4"}), ("place", {"bed": "2"})]
    whole = write_log(tmp_path / "whole.mcap", ticks(), attachments=attachments, metadata=metadata)
    cut_log(whole, tmp_path / "one.mcap", start_s=0.25, stop_s=1.5)
    stored, attached = records(tmp_path / "one.mcap")
    assert attached == records(whole)[1]
    assert stored["undulog"] == {"session_id": "s7"}
    with (tmp_path / "one.mcap").open("rb") as stream:  # with the records of one name apart
        names = [(r.name, r.metadata) for r in make_reader(stream).iter_metadata()]
    assert names[:3] == metadata
    edit = stored["undulog.edit"]
    assert edit["source.session_id"] == "s7"
    assert edit["source.sha256"] == hashlib.sha256(whole.read_bytes()).hexdigest()
    assert (edit["source"], edit["start_s"], edit["stop_s"]) == ("whole.mcap", "0.25", "1.5")
    assert int(edit["start_ns"]) == EPOCH_NS + 250 * MS
    # A cut of a cut still says where the first one came from.
    cut_log(tmp_path / "one.mcap", tmp_path / "two.mcap", start_s=0.1)
    cut_log(tmp_path / "two.mcap", tmp_path / "three.mcap", start_s=0.1)
    stored, _ = records(tmp_path / "three.mcap")
    assert stored["undulog.edit.1"] == edit
    assert stored["undulog.edit.2"]["source"] == "one.mcap"
    assert stored["undulog.edit"]["source"] == "two.mcap"


def test_a_session_that_was_cut_reads_as_one(tmp_path):
    robot = load_robot("snake13")
    facts = {"session_id": "s1", "epoch_ns": EPOCH_NS, "robot": robot, "verdict": "good"}
    values = 0.001 * np.arange(300)[:, None] * np.ones(len(robot.joint_names))
    topics = {"/joint_states": (robot.joint_names, "rad", values, values + 1)}
    write_topics(tmp_path / "run.mcap", EPOCH_NS + np.arange(300) * 10 * MS, topics, **facts)
    cut_log(tmp_path / "run.mcap", tmp_path / "cut.mcap", start_s=1.0, stop_s=2.0)
    with Session.open(tmp_path / "cut.mcap") as session:
        assert session.warnings == []
        assert (session.session_id, session.verdict) == ("s1", "good")
        assert session.robot.name == "snake13"
        angles = session.joints("/joint_states").values[0]
        assert angles == pytest.approx(0.001 * np.arange(100, 200), abs=1e-15)
    with AnyReader([tmp_path / "cut.mcap"]) as reader:
        assert reader.message_count == 100
        connection, t_ns, raw = next(iter(reader.messages()))
        assert t_ns == EPOCH_NS + 1000 * MS
        message = reader.deserialize(raw, connection.msgtype)
        assert message.position == pytest.approx([0.1] * len(robot.joint_names))


def test_the_last_states_before_a_cut_are_reported_and_carried_on_request(tmp_path):
    states = [("/robot_description", 0, "<robot/>"), ("/gait/mode", 10 * MS, "walk")]
    states += [("/gait/mode", 500 * MS, "avoid"), ("/gait/mode", 900 * MS, "walk")]
    whole = write_log(tmp_path / "whole.mcap", states)
    report = cut_log(whole, tmp_path / "pure.mcap", start_s=0.6)
    assert [m[0] - EPOCH_NS for m in read(tmp_path / "pure.mcap")] == [900 * MS]
    assert "/robot_description (0.60 s earlier), /gait/mode (0.10 s earlier)" in report.notes[0]
    report = cut_log(whole, tmp_path / "carried.mcap", start_s=0.6, carry_state=True)
    assert report.notes == []
    carried = read(tmp_path / "carried.mcap")
    assert [(m[1], m[0] - EPOCH_NS, m[2] - EPOCH_NS, m[4]) for m in carried] == [
        ("/robot_description", 600 * MS, -5, text("<robot/>")),
        ("/gait/mode", 600 * MS, 500 * MS - 5, text("avoid")),
        ("/gait/mode", 900 * MS, 900 * MS - 5, text("walk")),
    ]
    edit = records(tmp_path / "carried.mcap")[0]["undulog.edit"]
    assert json.loads(edit["carried"])["/gait/mode"] == EPOCH_NS + 500 * MS


def test_latched_topics_of_ros_are_known(tmp_path):
    path = tmp_path / "bag.mcap"
    profile = "- history: 3\n  depth: 0\n  reliability: {0}\n  durability: {0}\n"
    latched, volatile = ({"offered_qos_profiles": profile.format(kind)} for kind in (1, 2))
    topics = {"/map": latched, "/tf_static": {}, "/scan": volatile}
    with foreign_log(path, "sensor_msgs/msg/Range") as (writer, schema):
        ids = [writer.register_channel(topic, "cdr", schema, q) for topic, q in topics.items()]
        for k, channel in enumerate([*ids, *ids, *ids]):
            writer.add_message(channel, EPOCH_NS + k * MS, bytes([k // 6]), 0, k)
        writer.add_message(ids[2], EPOCH_NS + 100 * MS, b"z", 0, 9)
    cut_log(path, tmp_path / "cut.mcap", start_s=0.05, carry_state=True)
    # /map: the last one; /tf_static: each different one; /scan is volatile.
    kept = [(m[1], m[3]) for m in read(tmp_path / "cut.mcap", log_time_order=False)]
    assert kept == [("/tf_static", 4), ("/map", 6), ("/tf_static", 7), ("/scan", 9)]


def test_a_truncated_log_is_cut_as_far_as_it_goes(tmp_path, command):
    whole = write_log(tmp_path / "whole.mcap", ticks(), attachments=[("a.txt", b"a")])
    data = whole.read_bytes()
    (tmp_path / "torn.mcap").write_bytes(data[: len(data) // 2])
    cut = ("log", "cut", tmp_path / "torn.mcap", "--start", "0.2", "-o", tmp_path / "cut.mcap")
    assert "warning: the file is cut short (no footer)" in command(*cut).out
    messages = read(tmp_path / "cut.mcap")
    assert 10 < len(messages) < 150
    assert messages == between(read(whole), 200, 1e6)[: len(messages)]
    stored, attached = records(tmp_path / "cut.mcap")
    assert "cut short" in stored["undulog.edit"]["warnings"]
    assert [a[:2] for a in attached] == [("a.txt", b"a")]


@pytest.mark.parametrize("make", ["zstd", "uncompressed"])
def test_a_corrupt_chunk_is_not_passed_on(tmp_path, make):
    whole = write_log(tmp_path / "whole.mcap", ticks(), **MAKES[make])
    data = bytearray(whole.read_bytes())
    index = summary_of(whole).chunk_indexes[3]
    data[index.chunk_start_offset + index.chunk_length - 5] ^= 0xFF
    (tmp_path / "bad.mcap").write_bytes(data)
    report = cut_log(tmp_path / "bad.mcap", tmp_path / "cut.mcap")
    assert any("its messages are missing" in warning for warning in report.warnings)
    first, last = index.message_start_time, index.message_end_time
    kept = [m for m in read(whole) if not first <= m[0] <= last]
    assert read(tmp_path / "cut.mcap") == kept


def test_a_torn_uncompressed_log_keeps_each_attachment_once(tmp_path):
    path = tmp_path / "torn.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream, chunk_size=256, compression=CompressionType.NONE)
        writer.start(profile="ros2")
        kind = "std_msgs/msg/String"
        schema = writer.register_schema(kind, "ros2msg", schema_text(kind).encode())
        channel = writer.register_channel("/a", "cdr", schema)
        for k in range(40):
            writer.add_message(channel, EPOCH_NS + k, text(f"{k}"), 0)
        writer.flush()
        writer.add_attachment(0, 0, "late.txt", "text/plain", b"late")
    cut_log(path, tmp_path / "cut.mcap")
    assert len(read(tmp_path / "cut.mcap")) == 40
    assert [a[0] for a in records(tmp_path / "cut.mcap")[1]] == ["late.txt"]


WRONG_CUTS = [
    (2, ["--start", "5", "--stop", "5"], "must be later than --start"),
    (2, ["--start=-1"], "0 or more"),
    (2, ["--start", "nan"], "0 or more"),
    (1, ["--start", "99"], "the log lasts 1.99 s"),
    (1, ["--start", "99", "--carry-state"], "the log lasts 1.99 s"),
    (1, ["--topics", "/a", "--start", "1.981"], "no message of /a at or after 1.981 s"),
    (1, ["--topics", "/c*"], "has no /c*; it has /a, /b"),
]


@pytest.mark.parametrize(("code", "options", "fault"), WRONG_CUTS)
def test_a_cut_refuses_and_leaves_nothing(tmp_path, command, code, options, fault):
    whole = write_log(tmp_path / "whole.mcap", ticks())
    cut = ("log", "cut", whole, "-o", tmp_path / "cut.mcap", *options)
    assert fault in command(*cut, code=code).err
    assert list(tmp_path.iterdir()) == [whole]


def test_the_output_is_a_new_file(tmp_path, command):
    whole = write_log(tmp_path / "whole.mcap", ticks())
    before = whole.read_bytes()
    link = tmp_path / "link.mcap"
    link.symlink_to(whole)
    cut, other = ("log", "cut", whole, "-o"), tmp_path / "other.mcap"
    for output, why in ((whole, "is a source"), (link, "is a source"), ("x.bag", "an .mcap file")):
        assert why in command(*cut, output, "--force", code=2).err
    other.write_bytes(b"precious")
    command(*cut, other, code=2)
    assert other.read_bytes() == b"precious"
    report = json.loads(command(*cut, other, "--force", "--json").out)
    assert report["messages"] == {"/a": 100, "/b": 100}
    assert read(other) == read(whole)
    assert whole.read_bytes() == before
