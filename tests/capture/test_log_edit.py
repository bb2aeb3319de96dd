"""The verbs log cut and log merge, held against the readers of mcap and rosbags."""

from __future__ import annotations

import hashlib
import json
import signal
import subprocess
import sys
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import CompressionType, IndexType, Writer
from rosbags.highlevel import AnyReader

import undulog
from capture import Session, SessionWriter, load_robot
from capture.errors import DataError, UndulogError, UsageError
from capture.interruption import StopRequest
from capture.log.cdr import encode
from capture.log.cut import cut_log
from capture.log.merge import merge_logs
from capture.log.schemas import message_type, schema_text

EPOCH_NS = 1_700_000_000_000_000_000
MS = 1_000_000
STRING = "std_msgs/msg/String"

MAKES = {
    "zstd": {"compression": CompressionType.ZSTD},
    "lz4": {"compression": CompressionType.LZ4},
    "uncompressed": {"compression": CompressionType.NONE},
    "unchunked": {"use_chunking": False},
    "no index": {"index_types": IndexType.NONE},
    "no summary": {
        "index_types": IndexType.NONE,
        "use_statistics": False,
        "repeat_channels": False,
        "repeat_schemas": False,
        "use_summary_offsets": False,
    },
    "uncompressed, no index": {"compression": CompressionType.NONE, "index_types": IndexType.NONE},
}


def text(value: str) -> bytes:
    return encode(message_type(STRING), {"data": value})


def write_log(path: Path, messages, *, attachments=(), metadata=(), units=None, **options) -> Path:
    """A foreign log of Strings: (topic, log time [ns after the epoch], text)."""
    with path.open("wb") as stream:
        writer = Writer(stream, chunk_size=512, **options)
        writer.start(profile="ros2", library="elsewhere")
        for name, facts in metadata:
            writer.add_metadata(name, facts)
        for name, data in attachments:
            writer.add_attachment(11, 22, name, "text/plain", data)
        schema = writer.register_schema(STRING, "ros2msg", schema_text(STRING).encode())
        channels: dict[str, int] = {}
        for k, (topic, t_ns, said) in enumerate(messages):
            if topic not in channels:
                facts = {"unit": (units or {}).get(topic, ""), "made": "elsewhere"}
                channels[topic] = writer.register_channel(topic, "cdr", schema, facts)
            log_ns = EPOCH_NS + t_ns
            writer.add_message(channels[topic], log_ns, text(said), log_ns - 5, 7 * k)
        writer.finish()
    return path


def ticks(count: int = 200, topics=("/a", "/b"), start_ms: int = 0):
    return [
        (topics[k % len(topics)], (start_ms + 10 * k) * MS, f"word {k} " + "x" * (k % 30))
        for k in range(count)
    ]


def entry(schema, channel, message):
    return (
        message.log_time,
        channel.topic,
        message.publish_time,
        message.sequence,
        message.data,
        schema.name,
        schema.data,
        schema.encoding,
        channel.message_encoding,
        sorted(channel.metadata.items()),
    )


def read(path: Path, **window):
    """Every message as mcap's own reader gives it, by log time."""
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        return [entry(*item) for item in reader.iter_messages(**window)]


def in_file_order(path: Path):
    with path.open("rb") as stream:
        reader = make_reader(stream)
        return [entry(*item) for item in reader.iter_messages(log_time_order=False)]


def records(path: Path):
    with path.open("rb") as stream:
        reader = make_reader(stream)
        stored = {record.name: record.metadata for record in reader.iter_metadata()}
        attached = [
            (a.name, a.data, a.media_type, a.create_time, a.log_time)
            for a in reader.iter_attachments()
        ]
    return stored, attached


def in_window(messages, start_ms, stop_ms):
    low, high = EPOCH_NS + round(start_ms * MS), EPOCH_NS + round(stop_ms * MS)
    return [message for message in messages if low <= message[0] < high]


# -- cut -------------------------------------------------------------------------------------


@pytest.mark.parametrize("make", MAKES)
def test_a_cut_holds_exactly_the_messages_of_its_window(tmp_path: Path, make: str):
    whole = write_log(tmp_path / "whole.mcap", ticks(), **MAKES[make])
    same = write_log(tmp_path / "same.mcap", ticks())  # mcap reads it whatever the make
    report = cut_log(whole, tmp_path / "cut.mcap", start_s=0.5, stop_s=1.21)
    wanted = in_window(read(same), 500, 1210)
    assert len(wanted) == 71
    assert read(tmp_path / "cut.mcap") == wanted
    assert sum(report.messages.values()) == 71
    assert report.start_ns == EPOCH_NS + 500 * MS


def test_the_window_is_half_open_and_its_ends_are_exact(tmp_path: Path):
    moments = [("/a", 0, "first"), ("/a", 1, "1 ns"), ("/a", 2, "2 ns"), ("/a", 300 * MS, "last")]
    whole = write_log(tmp_path / "whole.mcap", moments)
    cut_log(whole, tmp_path / "cut.mcap", start_s=1e-9, stop_s=0.3)
    assert [m[0] - EPOCH_NS for m in read(tmp_path / "cut.mcap")] == [1, 2]
    cut_log(whole, tmp_path / "rest.mcap", start_s=2e-9)
    assert [m[0] - EPOCH_NS for m in read(tmp_path / "rest.mcap")] == [2, 300 * MS]


def test_a_cut_keeps_topics_by_pattern(tmp_path: Path):
    whole = write_log(tmp_path / "whole.mcap", ticks(topics=("/ir/01", "/ir/02", "/imu")))
    cut_log(whole, tmp_path / "cut.mcap", topics=["/ir/*"])
    assert read(tmp_path / "cut.mcap") == [m for m in read(whole) if m[1] != "/imu"]


def test_a_cut_keeps_what_explains_the_log_and_says_what_it_is(tmp_path: Path):
    attachments = [("robot.urdf", b"<robot/>"), ("notes", b"one"), ("notes", b"two")]
    metadata = [
        ("undulog", {"session_id": "s7"}),
        ("place", {"room": "4"}),
        ("place", {"bed": "2"}),
    ]
    whole = write_log(tmp_path / "whole.mcap", ticks(), attachments=attachments, metadata=metadata)
    cut_log(whole, tmp_path / "one.mcap", start_s=0.25, stop_s=1.5)
    stored, attached = records(tmp_path / "one.mcap")
    assert attached == records(whole)[1]
    assert stored["undulog"] == {"session_id": "s7"}
    with (tmp_path / "one.mcap").open("rb") as stream:
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


def test_a_session_that_was_cut_reads_as_one(tmp_path: Path):
    robot = load_robot("snake13")
    with SessionWriter(
        tmp_path / "run.mcap", session_id="s1", epoch_ns=EPOCH_NS, robot=robot
    ) as writer:
        states = writer.joint_state("/joint_states", robot.joint_names, unit="rad", velocity=True)
        for k in range(300):
            values = np.full(len(robot.joint_names), 0.001 * k)
            states.write(EPOCH_NS + k * 10 * MS, values, values + 1)
        writer.set_verdict("good")
    cut_log(tmp_path / "run.mcap", tmp_path / "cut.mcap", start_s=1.0, stop_s=2.0)
    with Session.open(tmp_path / "cut.mcap") as session:
        assert session.warnings == []
        assert (session.session_id, session.verdict) == ("s1", "good")
        assert session.robot is not None
        assert session.robot.name == "snake13"
        found = session.joints("/joint_states").values[0]
        assert found == pytest.approx(0.001 * np.arange(100, 200), abs=1e-15)
    with AnyReader([tmp_path / "cut.mcap"]) as reader:
        assert reader.message_count == 100
        connection, t_ns, raw = next(iter(reader.messages()))
        assert t_ns == EPOCH_NS + 1000 * MS
        message = reader.deserialize(raw, connection.msgtype)
        assert message.position == pytest.approx([0.1] * len(robot.joint_names))


def test_the_last_words_before_a_cut_are_told_and_carried_on_request(tmp_path: Path):
    said = [("/robot_description", 0, "<robot/>"), ("/gait/mode", 10 * MS, "walk")]
    said += [("/gait/mode", 500 * MS, "avoid"), ("/gait/mode", 900 * MS, "walk")]
    whole = write_log(tmp_path / "whole.mcap", said)
    report = cut_log(whole, tmp_path / "pure.mcap", start_s=0.6)
    assert [m[0] - EPOCH_NS for m in read(tmp_path / "pure.mcap")] == [900 * MS]
    assert "/robot_description (0.60 s earlier), /gait/mode (0.10 s earlier)" in report.notes[0]
    report = cut_log(whole, tmp_path / "carried.mcap", start_s=0.6, carry_state=True)
    assert report.notes == []
    found = [
        (m[1], m[0] - EPOCH_NS, m[2] - EPOCH_NS, m[4]) for m in read(tmp_path / "carried.mcap")
    ]
    assert found == [
        ("/robot_description", 600 * MS, -5, text("<robot/>")),
        ("/gait/mode", 600 * MS, 500 * MS - 5, text("avoid")),
        ("/gait/mode", 900 * MS, 900 * MS - 5, text("walk")),
    ]
    edit = records(tmp_path / "carried.mcap")[0]["undulog.edit"]
    assert json.loads(edit["carried"])["/gait/mode"] == EPOCH_NS + 500 * MS


def test_latched_topics_of_ros_are_known(tmp_path: Path):
    path = tmp_path / "bag.mcap"
    kind = "sensor_msgs/msg/Range"
    latched = "- history: 3\n  depth: 0\n  reliability: 1\n  durability: 1\n"
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start(profile="ros2")
        schema = writer.register_schema(kind, "ros2msg", schema_text(kind).encode())
        quality = {"offered_qos_profiles": latched}
        ids = [
            writer.register_channel("/map", "cdr", schema, quality),
            writer.register_channel("/tf_static", "cdr", schema, {}),
            writer.register_channel(
                "/scan", "cdr", schema, {"offered_qos_profiles": latched.replace("y: 1", "y: 2")}
            ),
        ]
        for k, channel in enumerate([*ids, *ids, *ids]):
            writer.add_message(channel, EPOCH_NS + k * MS, bytes([k // 6]), 0, k)
        writer.add_message(ids[2], EPOCH_NS + 100 * MS, b"z", 0, 9)
        writer.finish()
    cut_log(path, tmp_path / "cut.mcap", start_s=0.05, carry_state=True)
    # /map: the last one; /tf_static: each different one; /scan is volatile.
    found = [(m[1], m[3]) for m in in_file_order(tmp_path / "cut.mcap")]
    assert found == [("/tf_static", 4), ("/map", 6), ("/tf_static", 7), ("/scan", 9)]


def test_a_truncated_log_is_cut_as_far_as_it_goes(tmp_path: Path, capsys):
    whole = write_log(tmp_path / "whole.mcap", ticks(), attachments=[("a.txt", b"a")])
    data = whole.read_bytes()
    (tmp_path / "torn.mcap").write_bytes(data[: len(data) // 2])
    run = ["log", "cut", str(tmp_path / "torn.mcap"), "--start", "0.2"]
    assert undulog.run([*run, "-o", str(tmp_path / "cut.mcap")]) == 0
    assert "warning: the file is cut short (no footer)" in capsys.readouterr().out
    found = read(tmp_path / "cut.mcap")
    assert 10 < len(found) < 150
    assert found == in_window(read(whole), 200, 1e6)[: len(found)]
    stored, attached = records(tmp_path / "cut.mcap")
    assert "cut short" in stored["undulog.edit"]["warnings"]
    assert [a[:2] for a in attached] == [("a.txt", b"a")]


@pytest.mark.parametrize("make", ["zstd", "uncompressed"])
def test_a_corrupt_chunk_is_not_passed_on(tmp_path: Path, make: str):
    whole = write_log(tmp_path / "whole.mcap", ticks(), **MAKES[make])
    data = bytearray(whole.read_bytes())
    with whole.open("rb") as stream:
        index = make_reader(stream).get_summary().chunk_indexes[3]
    data[index.chunk_start_offset + index.chunk_length - 5] ^= 0xFF
    (tmp_path / "bad.mcap").write_bytes(data)
    report = cut_log(tmp_path / "bad.mcap", tmp_path / "cut.mcap")
    assert any("its messages are missing" in warning for warning in report.warnings)
    lost = in_window(
        read(whole),
        (index.message_start_time - EPOCH_NS) / MS,
        (index.message_end_time + 1 - EPOCH_NS) / MS,
    )
    assert read(tmp_path / "cut.mcap") == [m for m in read(whole) if m not in lost]


def test_a_torn_uncompressed_log_keeps_each_attachment_once(tmp_path: Path):
    path = tmp_path / "torn.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream, chunk_size=256, compression=CompressionType.NONE)
        writer.start(profile="ros2")
        schema = writer.register_schema(STRING, "ros2msg", schema_text(STRING).encode())
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


@pytest.mark.parametrize(("code", "options", "said"), WRONG_CUTS)
def test_a_cut_refuses_and_leaves_nothing(tmp_path: Path, capsys, code, options, said):
    whole = write_log(tmp_path / "whole.mcap", ticks())
    run = ["log", "cut", str(whole), "-o", str(tmp_path / "cut.mcap"), *options]
    assert undulog.run(run) == code
    assert said in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == [whole]


def test_the_output_is_a_new_file(tmp_path: Path, capsys):
    whole = write_log(tmp_path / "whole.mcap", ticks())
    before = whole.read_bytes()
    link = tmp_path / "link.mcap"
    link.symlink_to(whole)
    for output, said in [(whole, "is a source"), (link, "is a source"), ("x.bag", "an .mcap file")]:
        assert undulog.run(["log", "cut", str(whole), "-o", str(output), "--force"]) == 2
        assert said in capsys.readouterr().err
    other = tmp_path / "other.mcap"
    other.write_bytes(b"precious")
    assert undulog.run(["log", "cut", str(whole), "-o", str(other)]) == 2
    assert other.read_bytes() == b"precious"
    assert undulog.run(["log", "cut", str(whole), "-o", str(other), "--force", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["messages"] == {"/a": 100, "/b": 100}
    assert read(other) == read(whole)
    assert whole.read_bytes() == before


# -- merge -----------------------------------------------------------------------------------


@settings(max_examples=30, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(
    times=st.lists(st.integers(0, 60), min_size=3, max_size=80),
    bounds=st.lists(st.integers(0, 61), min_size=3, max_size=3, unique=True).map(sorted),
    make=st.sampled_from(sorted(MAKES)),
)
def test_cuts_side_by_side_make_the_whole_again(tmp_path_factory, times, bounds, make):
    folder = tmp_path_factory.mktemp("cuts")
    first = min(times)
    a, b, c = bounds
    inside = [t - first for t in times]
    if not (any(a <= t < b for t in inside) and any(b <= t < c for t in inside)):
        return  # an empty cut is refused
    said = [(f"/{'abc'[k % 3]}", t * MS, f"{k}" * (k % 40)) for k, t in enumerate(times)]
    facts = [
        ("undulog", {"session_id": "s", "robot": "r"}),
        ("undulog.health", {"verdict": "good"}),
    ]
    whole = write_log(
        folder / "whole.mcap", said, metadata=facts, attachments=[("x", b"x")], **MAKES[make]
    )
    for name, start, stop in [("ab", a, b), ("bc", b, c), ("ac", a, c)]:
        cut_log(whole, folder / f"{name}.mcap", start_s=start / 1e3, stop_s=stop / 1e3)
    report = merge_logs([folder / "ab.mcap", folder / "bc.mcap"], folder / "merged.mcap")
    assert read(folder / "merged.mcap") == read(folder / "ac.mcap")
    merged, cut = records(folder / "merged.mcap"), records(folder / "ac.mcap")
    assert merged[1] == cut[1]
    assert merged[0]["undulog"] == cut[0]["undulog"]
    assert merged[0]["undulog.health"] == cut[0]["undulog.health"]
    assert report.warnings == [w for w in report.warnings if "overlap" not in w]


def test_a_merge_interleaves_by_log_time_and_is_stable(tmp_path: Path):
    one = write_log(tmp_path / "one.mcap", [("/a", t * MS, f"one {t}") for t in (0, 2, 2, 4, 9)])
    two = write_log(
        tmp_path / "two.mcap",
        [("/b", t * MS, f"two {t}") for t in (1, 2, 4, 5)],
        use_chunking=False,
    )
    three = write_log(tmp_path / "three.mcap", [("/c", 2 * MS, "three")], **MAKES["lz4"])
    merge_logs([one, two, three], tmp_path / "all.mcap")
    found = in_file_order(tmp_path / "all.mcap")
    assert [(m[1], (m[0] - EPOCH_NS) // MS) for m in found] == [
        *[("/a", 0), ("/b", 1), ("/a", 2), ("/a", 2), ("/b", 2), ("/c", 2)],
        *[("/a", 4), ("/b", 4), ("/b", 5), ("/a", 9)],
    ]
    everything = [m for path in (one, two, three) for m in read(path)]
    assert sorted(found) == sorted(everything)


def test_a_topic_of_several_logs_becomes_one_channel(tmp_path: Path):
    one = write_log(tmp_path / "one.mcap", ticks(50))
    two = write_log(tmp_path / "two.mcap", ticks(50, start_ms=5000))
    report = merge_logs([one, two], tmp_path / "both.mcap")
    assert report.warnings == []
    assert report.messages == {"/a": 50, "/b": 50}
    with (tmp_path / "both.mcap").open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert sorted(c.topic for c in summary.channels.values()) == ["/a", "/b"]
    assert len(summary.schemas) == 1
    assert read(tmp_path / "both.mcap") == read(one) + read(two)


def test_a_merge_warns_when_the_same_topics_overlap(tmp_path: Path):
    one = write_log(tmp_path / "one.mcap", ticks(50))
    two = write_log(tmp_path / "two.mcap", ticks(50, start_ms=405))
    warnings = merge_logs([one, two], tmp_path / "both.mcap").warnings
    assert len(warnings) == 1
    assert "overlap by 0.09 s" in warnings[0]


def test_a_merge_keeps_ids_hashes_and_what_differs(tmp_path: Path):
    health = [{"verdict": "good", "reasons": "[]"}, {"verdict": "bad", "reasons": '["hot"]'}]
    logs = [
        write_log(
            tmp_path / f"{name}.mcap",
            ticks(20, start_ms=1000 * k),
            attachments=[("same.txt", b"="), ("cal.v1.yaml", name.encode())],
            metadata=[
                ("undulog", {"session_id": name, "epoch_ns": str(900 + k), "operator": "Ada"}),
                ("place", {"room": name}),
                ("undulog.health", health[k]),
            ],
        )
        for k, name in enumerate(["one", "two"])
    ]
    report = merge_logs(logs, tmp_path / "both.mcap")
    cut_log(tmp_path / "both.mcap", tmp_path / "cut.mcap", stop_s=1.1)
    merge_logs([tmp_path / "cut.mcap", logs[1]], tmp_path / "again.mcap")
    edits = {k: v["verb"] for k, v in records(tmp_path / "again.mcap")[0].items() if "edit" in k}
    assert edits == {"undulog.edit.1": "merge", "undulog.edit.2": "cut", "undulog.edit": "merge"}
    stored, attached = records(tmp_path / "both.mcap")
    assert [a[:2] for a in attached] == [
        *[("same.txt", b"="), ("cal.v1.yaml", b"one"), ("cal.v1-2.yaml", b"two")]
    ]
    assert any("kept as cal.v1-2.yaml" in warning for warning in report.warnings)
    edit = stored["undulog.edit"]
    assert json.loads(edit["session_ids"]) == ["one", "two"]
    digests = [hashlib.sha256(log.read_bytes()).hexdigest() for log in logs]
    assert json.loads(edit["sha256"]) == digests
    assert stored["undulog"]["operator"] == "Ada"
    assert stored["undulog"]["epoch_ns"] == "900"
    assert stored["undulog"]["session_id"].startswith("merge-")
    assert stored["undulog.source.2"]["session_id"] == "two"
    assert (stored["place"], stored["place.2"]) == ({"room": "one"}, {"room": "two"})
    assert stored["undulog.health"]["verdict"] == "bad"
    assert json.loads(stored["undulog.health"]["reasons"]) == [
        *["one.mcap: good", "two.mcap: bad", "two.mcap: hot"]
    ]


def test_a_merge_refuses_topics_of_other_type_or_unit(tmp_path: Path, capsys):
    one = write_log(tmp_path / "one.mcap", ticks(20), units={"/b": "rad"})
    two = write_log(tmp_path / "two.mcap", ticks(20), units={"/b": "deg"})
    with pytest.raises(DataError, match=r"^/b is in rad in .*one.mcap and in deg in .*two"):
        merge_logs([one, two], tmp_path / "both.mcap")
    silent = write_log(tmp_path / "silent.mcap", ticks(20))  # of another make, without units
    merge_logs([one, silent], tmp_path / "both.mcap")
    (tmp_path / "both.mcap").unlink()
    path = tmp_path / "three.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start(profile="ros2")
        kind = "sensor_msgs/msg/Range"
        schema = writer.register_schema(kind, "ros2msg", schema_text(kind).encode())
        writer.add_message(writer.register_channel("/a", "cdr", schema), EPOCH_NS, b"", 0)
        writer.finish()
    assert (
        undulog.run(["log", "merge", *map(str, [one, path]), "-o", str(tmp_path / "x.mcap")]) == 1
    )
    said = capsys.readouterr().err
    assert "/a is std_msgs/msg/String" in said
    assert "sensor_msgs/msg/Range in" in said
    assert sorted(p.name for p in tmp_path.iterdir()) == [
        *["one.mcap", "silent.mcap", "three.mcap", "two.mcap"]
    ]


def test_a_definition_with_other_comments_is_the_same_type(tmp_path: Path):
    logs = []
    for k, definition in enumerate(["string data", "# what is said\nstring   data  # a word\n"]):
        logs.append(tmp_path / f"{k}.mcap")
        with logs[-1].open("wb") as stream:
            writer = Writer(stream)
            writer.start(profile="ros2")
            schema = writer.register_schema(STRING, "ros2msg", definition.encode())
            channel = writer.register_channel("/a", "cdr", schema)
            writer.add_message(channel, EPOCH_NS + k, text(f"{k}"), 0)
            writer.finish()
    merge_logs(logs, tmp_path / "both.mcap")
    with Session.open(tmp_path / "both.mcap") as session:
        assert [m.data for _, m in session.messages("/a")] == ["0", "1"]
    merge_logs(logs[::-1], tmp_path / "other.mcap")
    write_other = tmp_path / "other_type.mcap"
    with write_other.open("wb") as stream:
        writer = Writer(stream)
        writer.start(profile="ros2")
        schema = writer.register_schema(STRING, "ros2msg", b"float64 data")
        writer.add_message(writer.register_channel("/a", "cdr", schema), EPOCH_NS, b"", 0)
        writer.finish()
    with pytest.raises(DataError, match="the same name with another definition"):
        merge_logs([logs[0], write_other], tmp_path / "never.mcap")


def test_a_merge_of_different_robots_must_be_told_which(tmp_path: Path, capsys):
    for k, name in enumerate(["snake13", "snake25"]):
        with SessionWriter(
            tmp_path / f"{name}.mcap", session_id=name, epoch_ns=EPOCH_NS, robot=load_robot(name)
        ) as writer:
            writer.string(f"/said{k}").write(EPOCH_NS + k, name)
    run = ["log", "merge", *(str(tmp_path / f"{n}.mcap") for n in ("snake13", "snake25"))]
    run += ["-o", str(tmp_path / "both.mcap")]
    for extra in ([], ["--force"]):
        assert undulog.run([*run, *extra]) == 2
        assert "different robots: snake13 (" in capsys.readouterr().err
    assert undulog.run([*run, "--robot", "snake7"]) == 2
    assert "robots are: snake13, snake25" in capsys.readouterr().err
    assert undulog.run([*run, "--robot", "snake25"]) == 0
    assert "warning: robot.toml of" in capsys.readouterr().out
    with Session.open(tmp_path / "both.mcap") as session:
        assert session.robot is not None
        assert session.robot.name == "snake25"
        assert session.metadata["undulog"]["robot"] == "snake25"
        assert b"snake13" in session.attachments["robot-2.toml"]
    with AnyReader([tmp_path / "both.mcap"]) as reader:
        assert reader.message_count == 2


def test_a_merge_refuses_one_log_and_the_same_log(tmp_path: Path):
    one = write_log(tmp_path / "one.mcap", ticks(20))
    (tmp_path / "copy.mcap").write_bytes(one.read_bytes())
    with pytest.raises(UsageError, match="two logs or more"):
        merge_logs([one], tmp_path / "both.mcap")
    with pytest.raises(UsageError, match="byte for byte"):
        merge_logs([one, tmp_path / "copy.mcap"], tmp_path / "both.mcap")


# -- both ------------------------------------------------------------------------------------


def test_the_same_edit_gives_the_same_bytes(tmp_path: Path):
    logs = [write_log(tmp_path / f"{k}.mcap", ticks(50, topics=(f"/{k}",))) for k in range(2)]
    for k in range(2):
        cut_log(logs[0], tmp_path / f"cut{k}.mcap", stop_s=0.3)
        merge_logs(logs, tmp_path / f"both{k}.mcap")
    for name in ("cut", "both"):
        first, second = ((tmp_path / f"{name}{k}.mcap").read_bytes() for k in range(2))
        assert first == second


def test_a_topic_by_topic_log_is_edited_in_its_own_order(tmp_path: Path):
    said = [(topic, t * 10 * MS, f"{topic} {t}" + "y" * 40) for topic in "abc" for t in range(100)]
    whole = write_log(tmp_path / "whole.mcap", [(f"/{topic}", t, word) for topic, t, word in said])
    cut_log(whole, tmp_path / "cut.mcap", start_s=0.2, stop_s=0.8)
    assert in_file_order(tmp_path / "cut.mcap") == in_window(in_file_order(whole), 200, 800)
    other = write_log(tmp_path / "other.mcap", ticks(50, topics=("/d",)))
    merge_logs([whole, other], tmp_path / "both.mcap")
    assert sorted(read(tmp_path / "both.mcap")) == sorted(read(whole) + read(other))


def test_memory_holds_a_few_chunks_however_long_the_log(tmp_path: Path):
    logs = []
    for k in range(3):
        logs.append(tmp_path / f"{k}.mcap")
        with logs[-1].open("wb") as stream:
            writer = Writer(stream, chunk_size=1 << 20)
            writer.start(profile="ros2")
            schema = writer.register_schema(STRING, "ros2msg", schema_text(STRING).encode())
            channel = writer.register_channel(f"/{k}", "cdr", schema)
            for tick in range(500):
                writer.add_message(channel, EPOCH_NS + tick * MS, bytes(1 << 16), 0)
            writer.finish()
    tracemalloc.start()
    cut_log(logs[0], tmp_path / "cut.mcap")
    cut_peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.reset_peak()
    merge_logs(logs, tmp_path / "merged.mcap")
    merge_peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert cut_peak < 10 << 20  # of 31 MiB
    assert merge_peak < 16 << 20  # of 94 MiB


def test_a_stop_leaves_nothing(tmp_path: Path):
    logs = [write_log(tmp_path / f"{k}.mcap", ticks(20, topics=(f"/{k}",))) for k in range(2)]
    stop = StopRequest()
    stop.signal = signal.SIGTERM
    said = "stopped by SIGTERM; nothing was written"
    with pytest.raises(UndulogError, match=said):
        cut_log(logs[0], tmp_path / "x.mcap", stop=stop)
    with pytest.raises(UndulogError, match=said):
        merge_logs(logs, tmp_path / "x.mcap", stop=stop)
    assert sorted(tmp_path.iterdir()) == logs


SLOW = """
import sys, time, undulog
from capture.log import edit
write = edit.EditedLog.write
def slowly(*arguments):
    print("writing", flush=True)
    time.sleep(0.001)
    write(*arguments)
edit.EditedLog.write = slowly
sys.exit(undulog.run(sys.argv[1:]))
"""


def test_sigterm_leaves_no_half_file_and_the_former_one_whole(tmp_path: Path):
    whole = write_log(tmp_path / "whole.mcap", ticks(5000))
    former = tmp_path / "cut.mcap"
    former.write_bytes(b"former")
    process = subprocess.Popen(
        [sys.executable, "-c", SLOW, "log", "cut", str(whole), "-o", str(former), "--force"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "writing\n"
    assert (tmp_path / "cut.mcap.part").exists()
    process.send_signal(signal.SIGTERM)
    _, said = process.communicate(timeout=30)
    assert process.returncode == 1
    assert said == "error: stopped by SIGTERM; nothing was written\n"
    assert former.read_bytes() == b"former"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["cut.mcap", "whole.mcap"]


def test_a_full_disk_is_told_and_leaves_nothing(tmp_path: Path):
    messages = [("/a", k * MS, np.random.default_rng(k).bytes(200).hex()) for k in range(200)]
    whole = write_log(tmp_path / "whole.mcap", messages)
    code = (
        "import resource, sys, undulog;"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (4096, 4096));"
        "sys.exit(undulog.run(sys.argv[1:]))"
    )
    run = ["log", "cut", str(whole), "-o", str(tmp_path / "cut.mcap")]
    done = subprocess.run(
        [sys.executable, "-c", code, *run], capture_output=True, text=True, check=False
    )
    assert done.returncode == 1
    assert "cut.mcap: can't be written: File too large" in done.stderr
    assert list(tmp_path.iterdir()) == [whole]
