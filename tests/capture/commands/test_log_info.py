"""``log info`` on MCAP files of other makes: whatever they hold, it says what is there."""

import itertools
import json

import pytest
from mcap.writer import CompressionType, IndexType, Writer
from rosbags.typesys import Stores, get_typestore

T0 = 1_700_000_000_000_000_000
STEP = 100_000_000
NOETIC = get_typestore(Stores.ROS1_NOETIC)
HUMBLE = get_typestore(Stores.ROS2_HUMBLE)


def std_string(store, serialize):
    return bytes(serialize(store.types["std_msgs/msg/String"](data="walk"), "std_msgs/msg/String"))


ROS1_TEXT, _ = NOETIC.generate_msgdef("std_msgs/msg/String")
ROS2_TEXT, _ = HUMBLE.generate_msgdef("std_msgs/msg/String", ros_version=2)

# topic, encoding of its messages, its schema (name, encoding, data) or None, one message or None
CHANNELS = {
    "/json": ("json", ("foxglove.Log", "jsonschema", b'{"type": "object"}'), b'{"message": "hi"}'),
    "/protobuf": ("protobuf", ("foxglove.RawImage", "protobuf", b"\n\0"), b"\x12\x02hi"),
    "/schemaless": ("json", None, b"{}"),
    "/unnamed": ("", ("raw", "", b""), b"\x01"),
    "/ros1": (
        "ros1",
        ("std_msgs/String", "ros1msg", ROS1_TEXT.encode()),
        std_string(NOETIC, NOETIC.serialize_ros1),
    ),
    "/ros2": (
        "cdr",
        ("std_msgs/msg/String", "ros2msg", ROS2_TEXT.encode()),
        std_string(HUMBLE, HUMBLE.serialize_cdr),
    ),
    "/idl": ("cdr", ("pkg/msg/Name", "ros2idl", b"module pkg {};"), b"\0\1\0\0"),
    "/garbled": ("cdr", ("pkg/msg/Garbled", "ros2msg", b"\xff\xfe }} 1"), b"\0\1\0\0"),
    "/empty": ("json", ("foxglove.Log", "jsonschema", b"{}"), None),
    # names of ours on what is none of ours
    "/joint_states": ("json", ("JointState", "jsonschema", b"{}"), b"{}"),
    "/can/can0": ("protobuf", ("Frames", "protobuf", b""), b"\x08\x01"),
    "/can/can1": ("cdr", ("std_msgs/msg/UInt8MultiArray", "ros2msg", b""), b"\0\1"),
}
FOREIGN = [t for t, (enc, s, _) in CHANNELS.items() if (enc, s and s[1]) != ("cdr", "ros2msg")]


def make(path, channels=CHANNELS, count=20, library="foreign 1.0", **options):
    with path.open("wb") as stream:
        writer = Writer(stream, **options)
        writer.start(library=library)
        ids = {}
        for topic, (encoding, schema, _) in channels.items():
            schema_id = writer.register_schema(*schema) if schema is not None else 0
            ids[topic] = writer.register_channel(topic, encoding, schema_id)
        for i in range(count):
            for topic, (_, _, message) in channels.items():
                if message is not None:
                    writer.add_message(ids[topic], T0 + i * STEP, message, T0 + i * STEP, i)
        writer.finish()
    return path


@pytest.fixture
def described(command):
    """The object, and the text, of a file."""

    def run(path):
        out, err = command("log", "info", path, "--json")
        assert err == ""
        return json.loads(out), command("log", "info", path).out

    return run


NO_SUMMARY = {
    "index_types": IndexType.NONE,
    "use_statistics": False,
    "use_summary_offsets": False,
    "repeat_channels": False,
    "repeat_schemas": False,
}
MAKES = {
    "zstd": {},
    "lz4": {"compression": CompressionType.LZ4},
    "plain": {"compression": CompressionType.NONE},
    "many chunks": {"chunk_size": 100},
    "no chunks": {"use_chunking": False},
    "no statistics": {"use_statistics": False},
    "no index": {"index_types": IndexType.NONE},
    "no message index": {"index_types": IndexType.CHUNK},
    "no channels in the summary": {"repeat_channels": False, "repeat_schemas": False},
    "no summary": NO_SUMMARY,
    "no summary, no chunks": {**NO_SUMMARY, "use_chunking": False},
    "no checksums": {"enable_crcs": False},
}


@pytest.mark.parametrize("options", MAKES.values(), ids=MAKES)
def test_files_of_other_makes(options, tmp_path, described):
    facts, text = described(make(tmp_path / "x.mcap", **options))
    topics = {topic["topic"]: topic for topic in facts["topics"]}
    # A channel without messages stands in no chunk's index; only a summary or a look inside has it.
    assert topics.keys() == CHANNELS.keys()
    for topic, (encoding, schema, message) in CHANNELS.items():
        described_topic = topics[topic]
        assert described_topic == described_topic | {
            "messages": 20 if message is not None else 0,
            "type": schema[0] if schema else "",
            "encoding": encoding or None,
            "schema": (schema[1] or None) if schema else None,
            "read": topic not in FOREIGN,
        }
    session = facts["session"]
    assert (session["start_ns"], session["library"]) == (T0, "foreign 1.0")
    assert session["start_utc"] == "2023-11-14 22:13:20 UTC"
    assert session["duration_s"] == pytest.approx(1.9)
    lines = text.splitlines()
    assert lines[0].startswith("x: no robot, 1.90 s from 2023-11-14 22:13:20 UTC, 220 messages, ")
    assert (
        "warning: 9 topics are not of ROS 2 and can't be read, only listed: "
        "json 4, protobuf 2, cdr 1, no encoding 1, ros1 1"
    ) in lines
    assert any("foxglove.RawImage (protobuf, protobuf)" in line for line in lines)
    assert any("(json, no schema)" in line for line in lines)


def test_a_file_without_messages_has_no_start(tmp_path, described):
    facts, text = described(make(tmp_path / "x.mcap", count=0))
    assert (facts["session"]["start_ns"], facts["session"]["start_utc"]) == (None, None)
    assert text.startswith("x: no robot, no messages, ")
    assert "1970" not in text


def test_a_file_of_one_message_and_an_unnamed_writer(tmp_path, described):
    channels = {"/schemaless": CHANNELS["/schemaless"]}
    facts, text = described(make(tmp_path / "x.mcap", channels, count=1, library=""))
    assert facts["topics"][0]["rate_hz"] is None
    assert "1 topic is not of ROS 2" in text
    assert "written by an unnamed program" in text


@pytest.mark.parametrize("options", [{}, {"use_chunking": False}, NO_SUMMARY])
def test_a_cut_file_says_so(options, tmp_path, described):
    path = make(tmp_path / "x.mcap", chunk_size=500, **options)
    whole = path.read_bytes()
    for cut in (len(whole) - 20, len(whole) * 3 // 4, len(whole) // 2):
        path.write_bytes(whole[:cut])
        facts, text = described(path)
        assert any("cut short" in warning for warning in facts["warnings"])
        assert "warning: the file is cut short" in text


def test_two_channels_of_one_topic(tmp_path, described):
    """Several publishers, and two types: the first is counted, the other reported."""
    path = tmp_path / "x.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        kinds = [writer.register_schema(name, "jsonschema", b"{}") for name in ("a", "a", "b")]
        ids = [
            writer.register_channel("/x", "json", kind, {"publisher": str(k)})
            for k, kind in enumerate(kinds)
        ]
        for i, channel in itertools.product(range(5), ids):
            writer.add_message(channel, T0 + i, b"{}", T0 + i)
        writer.finish()
    facts, _ = described(path)
    assert [(t["type"], t["messages"]) for t in facts["topics"]] == [("a", 10)]
    assert facts["warnings"] == ["/x has several types, a, b: a is read"]
