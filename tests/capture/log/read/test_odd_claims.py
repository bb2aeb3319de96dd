"""Logs whose numbers and types no recorder writes: an answer or an error in words, soon."""

import json
import re

import numpy as np
import pytest
from hostile_logs import EPOCH_NS, NS, HostileLog, gait, joint_state

import undulog
from undulog.capture import Session
from undulog.capture.common.errors import DataError
from undulog.capture.log.health.session_check import check_session
from undulog.capture.log.merge import merge_logs
from undulog.capture.log.messages.definitions import parse_message_type
from undulog.replay.samples.tracks import drawn_topics

RULE = "=" * 80


def ticks(count=100, start_ns=EPOCH_NS):
    return [
        (channel, t_ns, joint_state(EPOCH_NS + tick * 10_000_000, ["a"], [tick / 100]))
        for tick in range(count)
        for t_ns in [start_ns + tick * 10_000_000]
        for channel in (1, 2)
    ]


def joints():
    log = HostileLog()
    kind = log.schema()
    for topic in ("/joint_commands", "/joint_states"):
        log.channel(topic, kind)
    return log


@pytest.mark.parametrize("kind", ["sensor_msgs/msg/JointState", "std_msgs/msg/String"])
def test_an_empty_message_at_the_end_of_a_chunk_is_counted_as_unreadable(tmp_path, kind):
    log = joints()
    channel = log.channel("/other", log.schema(kind))
    log.chunk([*ticks(), (channel, EPOCH_NS, b"")])
    health = check_session(log.write(tmp_path / "run.mcap"))
    (other,) = (channel for channel in health.channels if channel.topic == "/other")
    assert (other.count, other.unread) == (1, 1)


@pytest.mark.slow
def test_a_topic_whose_joints_change_from_message_to_message_is_refused_soon(tmp_path, command):
    log = joints()
    times = [EPOCH_NS + NS + k * 10_000 for k in range(5_000)]
    log.chunk([*ticks(), *((2, t, joint_state(t, [f"joint{t}"], [0.5])) for t in times)])
    path = log.write(tmp_path / "run.mcap")
    (states,) = (
        channel for channel in check_session(path).channels if channel.topic == "/joint_states"
    )
    assert states.unread == 5_000 - 255  # with the list of the sound messages, 256
    why = "/joint_states has more than 256 different lists of joints"
    assert f"error: {path}: {why}" in command("analyse", path, code=1).err


def test_more_joints_than_are_judged_are_a_finding(tmp_path):
    log = joints()
    message = joint_state(EPOCH_NS, [f"j{k}" for k in range(2001)], np.zeros(2001))
    log.chunk([(channel, EPOCH_NS, message) for channel in (1, 2)])
    health = check_session(log.write(tmp_path / "run.mcap"))
    assert any(
        "/joint_commands has 2001 joints; at most 2000" in reason for reason in health.reasons
    )


@pytest.mark.slow
@pytest.mark.parametrize("start_ns", [2**63 - NS // 2, 2**63, 2**64 - 10 * NS])
@pytest.mark.parametrize("whole", [True, False])
def test_log_times_that_no_signed_number_holds(tmp_path, start_ns, whole, capsys):
    log = joints()
    if not whole:
        log.chunk(ticks())
    log.chunk(ticks(300, start_ns))
    path = log.write(tmp_path / "run.mcap")
    with Session.open(path) as session:
        assert any("beyond the year 2262" in text for text in session.warnings)
        assert len(session.joints("/joint_states").t_ns[0]) == (300 if whole else 400)
        assert 0 <= session.start_ns <= session.end_ns < 2**63
    for verb in (["log", "check"], ["log", "info"], ["analyse"]):
        assert undulog.run([*verb, str(path)]) in (0, 1)
    for verb, output in ((["log", "cut"], "cut.mcap"), (["report"], "run.html")):
        assert undulog.run([*verb, str(path), "-o", str(tmp_path / output)]) == 0
    assert "Traceback" not in capsys.readouterr().err


def nested(depth, fields):
    """A schema of types in types; each has the fields, with the next type for ``T``."""
    bodies = [fields.replace("T", f"T{k + 1}") for k in range(depth)]
    sections = [f"{RULE}\nMSG: p/T{k}\n{body}" for k, body in enumerate([*bodies, "int32 x\n"])]
    return fields.replace("T", "T0") + "".join(sections)


SCHEMAS = {
    "5,000 types deep": (nested(5000, "T a\n"), "nested more than 64 deep"),
    "2^40 fields": (nested(40, "T a\nT b\n"), "fields, more than 4096"),
    "a number of 5,000 digits": (f"int32[{'9' * 5000}] a\n", "no array has the length 999"),
}


@pytest.mark.parametrize("kind", SCHEMAS)
def test_types_that_no_reader_could_hold_are_refused(tmp_path, kind):
    text, complaint = SCHEMAS[kind]
    with pytest.raises(DataError, match=complaint):
        parse_message_type("p/msg/Top", text)
    paths = [tmp_path / f"{name}.mcap" for name in ("one", "two")]
    for path in paths:
        log = joints()
        channel = log.channel("/odd", log.schema("p/msg/Top", text))
        log.chunk([*ticks(), (channel, EPOCH_NS, b"\0\1\0\0\1\0\0\0" + path.stem.encode())])
        log.write(path)
    health = check_session(paths[0])
    assert [channel.count for channel in health.channels if channel.topic == "/odd"] == [1]
    assert any(complaint in note for note in health.notes)
    assert merge_logs(paths, tmp_path / "both.mcap").messages["/odd"] == 2


def test_a_million_million_elements_without_a_byte_are_no_message(tmp_path):
    text = f"E[1000000] a\n{RULE}\nMSG: p/E\nF[1000000] f\n{RULE}\nMSG: p/F\n"
    log = joints()
    channel = log.channel("/odd", log.schema("p/msg/Top", text))
    log.chunk([*ticks(), (channel, EPOCH_NS, b"\0\1\0\0\1\0\0\0")])
    health = check_session(log.write(tmp_path / "run.mcap"))
    assert [channel.unread for channel in health.channels if channel.topic == "/odd"] == [1]


@pytest.mark.slow
def test_a_merge_of_more_channels_than_can_be_numbered_is_refused(tmp_path):
    paths = [tmp_path / f"{name}.mcap" for name in ("one", "two")]
    for path in paths:
        log = joints()
        for k in range(33_000):
            log.channel(f"/{path.stem}/{k}", 1)
        log.chunk(ticks())
        log.write(path)
    with pytest.raises(DataError, match=r"more than 65535.*leave topics out first"):
        merge_logs(paths, tmp_path / "both.mcap")
    assert not (tmp_path / "both.mcap").exists()


def test_a_summary_that_lists_a_chunk_again_and_again_is_not_believed(tmp_path):
    log = joints()
    log.attachment("notes.txt", bytes(1 << 20), listed=1000)
    log.chunk(ticks(), listed=1000)
    path = log.write(tmp_path / "run.mcap")
    with Session.open(path) as session:
        assert any("overlap" in text for text in session.warnings)
        assert session.channels["/joint_states"].count == 100
        np.testing.assert_allclose(session.joints("/joint_states").values[0], np.arange(100) / 100)
    assert json.loads(json.dumps(check_session(path).file.damage)) == []


@pytest.mark.parametrize("verb", ["analyse", "report", "compare", "view"])
def test_more_joints_than_a_robot_has_are_an_error(tmp_path, verb, command):
    path = gait(tmp_path / "many.mcap", ticks=5, joints=6000)
    outputs = {"view": ["--save", tmp_path / "x.rrd"], "report": ["-o", tmp_path / "x.html"]}
    err = command(verb, path, *(outputs | {"compare": [path]}).get(verb, []), code=1).err
    assert re.search(r"many\.mcap: .*\b6000 joints.*; at most \d+ are", err)
    assert not list(tmp_path.glob("x.*"))


def test_of_many_joint_topics_some_are_drawn_and_a_table_asks_which(tmp_path, command, opened):
    log = HostileLog()
    kind = log.schema()
    for number in range(600):
        log.channel(f"/t{number}", kind)
    log.channel("/joint_states", kind)
    rows = [
        (channel, EPOCH_NS + tick, joint_state(EPOCH_NS + tick, ["a"], [0.1 * tick]))
        for tick in range(0, 3 * NS, NS // 10)
        for channel in range(1, 602)
    ]
    log.chunk(rows)
    path = log.write(tmp_path / "many.mcap")
    drawn, left_out = drawn_topics(opened(path))
    assert (len(drawn), left_out) == (100, 501)
    assert "/joint_states" in drawn
    every = [word for topic in range(600) for word in ("--topics", f"/t{topic}")]
    export = ("log", "export", path, "-o", tmp_path / "x.csv")
    assert "600 joint topics" in command(*export, *every, code=2).err
    command(*export, "--topics", "/t7")
    assert len((tmp_path / "x.csv").read_text().splitlines()) == 31
