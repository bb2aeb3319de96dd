"""Merged logs against other readers: each message once, in order, and what differs is reported."""

import hashlib
import json

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from rosbags.highlevel import AnyReader

from support.edited_logs import EPOCH_NS, MAKES, MS, STRING, read, records, text, ticks, write_log
from support.foreign_logs import foreign_log
from support.read_back import summary_of
from undulog.capture import Session, SessionWriter, load_robot
from undulog.capture.common.errors import DataError, UsageError
from undulog.capture.log.cut import cut_log
from undulog.capture.log.merge import merge_logs

# -- merge -----------------------------------------------------------------------------------


@settings(max_examples=30, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(
    times=st.lists(st.integers(0, 60), min_size=3, max_size=80),
    bounds=st.lists(st.integers(0, 61), min_size=3, max_size=3, unique=True).map(sorted),
    make=st.sampled_from(sorted(MAKES)),
)
def test_cuts_side_by_side_make_the_whole_again(tmp_path_factory, times, bounds, make):
    folder = tmp_path_factory.mktemp("cuts")
    a, b, c = bounds
    inside = [t - min(times) for t in times]
    if not (any(a <= t < b for t in inside) and any(b <= t < c for t in inside)):
        return  # an empty cut is refused
    texts = [(f"/{'abc'[k % 3]}", t * MS, f"{k}" * (k % 40)) for k, t in enumerate(times)]
    facts = {"undulog": {"session_id": "s", "robot": "r"}, "undulog.health": {"verdict": "good"}}
    more = {"metadata": facts.items(), "attachments": [("x", b"x")]}
    whole = write_log(folder / "whole.mcap", texts, **more, **MAKES[make])
    for name, start, stop in [("ab", a, b), ("bc", b, c), ("ac", a, c)]:
        cut_log(whole, folder / f"{name}.mcap", start_s=start / 1e3, stop_s=stop / 1e3)
    report = merge_logs([folder / "ab.mcap", folder / "bc.mcap"], folder / "merged.mcap")
    assert read(folder / "merged.mcap") == read(folder / "ac.mcap")
    merged, cut = records(folder / "merged.mcap"), records(folder / "ac.mcap")
    assert merged[1] == cut[1]
    assert merged[0]["undulog"] == cut[0]["undulog"]
    assert merged[0]["undulog.health"] == cut[0]["undulog.health"]
    assert report.warnings == [w for w in report.warnings if "overlap" not in w]


def test_a_merge_interleaves_by_log_time_and_is_stable(tmp_path):
    log = write_log(tmp_path / "one.mcap", [("/a", t * MS, f"one {t}") for t in (0, 2, 2, 4, 9)])
    texts = [("/b", t * MS, f"two {t}") for t in (1, 2, 4, 5)]
    two = write_log(tmp_path / "two.mcap", texts, use_chunking=False)
    three = write_log(tmp_path / "three.mcap", [("/c", 2 * MS, "three")], **MAKES["lz4"])
    merge_logs([log, two, three], tmp_path / "all.mcap")
    messages = read(tmp_path / "all.mcap", log_time_order=False)
    assert [(m[1], (m[0] - EPOCH_NS) // MS) for m in messages] == [
        *[("/a", 0), ("/b", 1), ("/a", 2), ("/a", 2), ("/b", 2), ("/c", 2)],
        *[("/a", 4), ("/b", 4), ("/b", 5), ("/a", 9)],
    ]
    assert sorted(messages) == sorted(m for path in (log, two, three) for m in read(path))


def test_a_topic_of_several_logs_becomes_one_channel(tmp_path):
    log = write_log(tmp_path / "one.mcap", ticks(50))
    two = write_log(tmp_path / "two.mcap", ticks(50, start_ms=5000))
    report = merge_logs([log, two], tmp_path / "both.mcap")
    assert report.warnings == []
    assert report.messages == {"/a": 50, "/b": 50}
    summary = summary_of(tmp_path / "both.mcap")
    assert sorted(c.topic for c in summary.channels.values()) == ["/a", "/b"]
    assert len(summary.schemas) == 1
    assert read(tmp_path / "both.mcap") == read(log) + read(two)


def test_a_merge_warns_when_the_same_topics_overlap(tmp_path):
    log = write_log(tmp_path / "one.mcap", ticks(50))
    two = write_log(tmp_path / "two.mcap", ticks(50, start_ms=405))
    warnings = merge_logs([log, two], tmp_path / "both.mcap").warnings
    assert ["overlap by 0.09 s" in text for text in warnings] == [True]


def test_a_merge_keeps_ids_hashes_and_what_differs(tmp_path):
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
    kept = [("same.txt", b"="), ("cal.v1.yaml", b"one"), ("cal.v1-2.yaml", b"two")]
    assert [a[:2] for a in attached] == kept
    assert any("kept as cal.v1-2.yaml" in warning for warning in report.warnings)
    edit, facts = stored["undulog.edit"], stored["undulog"]
    assert json.loads(edit["session_ids"]) == ["one", "two"]
    digests = [hashlib.sha256(log.read_bytes()).hexdigest() for log in logs]
    assert json.loads(edit["sha256"]) == digests
    assert (facts["operator"], facts["epoch_ns"]) == ("Ada", "900")
    assert facts["session_id"].startswith("merge-")
    assert stored["undulog.source.2"]["session_id"] == "two"
    assert (stored["place"], stored["place.2"]) == ({"room": "one"}, {"room": "two"})
    assert stored["undulog.health"]["verdict"] == "bad"
    reasons = ["one.mcap: good", "two.mcap: bad", "two.mcap: hot"]
    assert json.loads(stored["undulog.health"]["reasons"]) == reasons


def test_a_merge_refuses_topics_of_other_type_or_unit(tmp_path, command):
    log = write_log(tmp_path / "one.mcap", ticks(20), units={"/b": "rad"})
    two = write_log(tmp_path / "two.mcap", ticks(20), units={"/b": "deg"})
    with pytest.raises(DataError, match=r"^/b is in rad in .*one.mcap and in deg in .*two"):
        merge_logs([log, two], tmp_path / "both.mcap")
    silent = write_log(tmp_path / "silent.mcap", ticks(20))  # of another make, without units
    merge_logs([log, silent], tmp_path / "both.mcap")
    (tmp_path / "both.mcap").unlink()
    path = tmp_path / "three.mcap"
    with foreign_log(path, "sensor_msgs/msg/Range") as (writer, schema):
        writer.add_message(writer.register_channel("/a", "cdr", schema), EPOCH_NS, b"", 0)
    refused = command("log", "merge", log, path, "-o", tmp_path / "x.mcap", code=1).err
    assert "/a is std_msgs/msg/String" in refused
    assert "sensor_msgs/msg/Range in" in refused
    assert set(tmp_path.iterdir()) == {log, two, silent, path}


def test_a_definition_with_other_comments_is_the_same_type(tmp_path, opened):
    definitions = ["string data", "# a text\nstring   data  # a word\n", "float64 data"]
    *logs, other = [tmp_path / f"{k}.mcap" for k in range(3)]
    for k, definition in enumerate(definitions):
        with foreign_log(tmp_path / f"{k}.mcap", STRING, definition) as (writer, schema):
            channel = writer.register_channel("/a", "cdr", schema)
            writer.add_message(channel, EPOCH_NS + k, text(f"{k}"), 0)
    merge_logs(logs, tmp_path / "both.mcap")
    assert [m.data for _, m in opened(tmp_path / "both.mcap").messages("/a")] == ["0", "1"]
    merge_logs(logs[::-1], tmp_path / "other.mcap")
    with pytest.raises(DataError, match="the same name with another definition"):
        merge_logs([logs[0], other], tmp_path / "never.mcap")


def test_a_merge_of_different_robots_needs_the_name_of_one(tmp_path, command):
    logs = {name: tmp_path / f"{name}.mcap" for name in ("snake13", "snake25")}
    for name, path in logs.items():
        facts = {"session_id": name, "epoch_ns": EPOCH_NS, "robot": load_robot(name)}
        with SessionWriter(path, **facts) as writer:
            writer.string(f"/{name}").write(EPOCH_NS, name)
    merge = ("log", "merge", *logs.values(), "-o", tmp_path / "both.mcap")
    for extra in ([], ["--force"]):
        assert "different robots: snake13 (" in command(*merge, *extra, code=2).err
    assert "robots are: snake13, snake25" in command(*merge, "--robot", "snake7", code=2).err
    assert "warning: robot.toml of" in command(*merge, "--robot", "snake25").out
    with Session.open(tmp_path / "both.mcap") as session:
        assert session.robot.name == "snake25"
        assert session.metadata["undulog"]["robot"] == "snake25"
        assert b"snake13" in session.attachments["robot-2.toml"]
    with AnyReader([tmp_path / "both.mcap"]) as reader:
        assert reader.message_count == 2


def test_a_merge_refuses_one_log_and_the_same_log(tmp_path):
    log = write_log(tmp_path / "one.mcap", ticks(20))
    (tmp_path / "copy.mcap").write_bytes(log.read_bytes())
    with pytest.raises(UsageError, match="two logs or more"):
        merge_logs([log], tmp_path / "both.mcap")
    with pytest.raises(UsageError, match="byte for byte"):
        merge_logs([log, tmp_path / "copy.mcap"], tmp_path / "both.mcap")
