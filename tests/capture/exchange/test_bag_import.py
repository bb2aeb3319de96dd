"""Recordings of ROS 1 and 2, written by rosbags, into sessions."""

import shutil
import sqlite3
import tempfile

import numpy as np
import pytest
from rosbags.rosbag2 import StoragePlugin

from support.ros_bags import (
    CONTROLLER,
    EPOCH_NS,
    NAMES,
    Filler,
    commanded,
    filling,
    header,
    message,
    ticks,
    typestore,
    write_bag,
)
from undulog.capture import Session
from undulog.capture.common.errors import UndulogError
from undulog.capture.exchange.formats.rosbag import importing
from undulog.capture.exchange.formats.rosbag.importing import import_bag

pytestmark = pytest.mark.slow

KINDS = {
    "bag": ("a.bag", None),
    "db3": ("a", StoragePlugin.SQLITE3),
    "mcap": ("a", StoragePlugin.MCAP),
}


def fill_all(bag):
    """Everything: states and currents, trajectories, an IMU, frames, words, and pictures."""
    fill, store = Filler(bag), bag.store
    for k, tick in enumerate(ticks(4.0)):
        t_ns = tick[0]
        fill.dynamic(*tick)
        fill.controller(*tick)
        fill.state(*tick, "/second/encoders")
        head = header(store, t_ns)
        bag.write("/imu", t_ns, message(store, "sensor_msgs/msg/Imu", header=head))
        if k % 50 == 0:
            kind = "sensor_msgs/msg/CompressedImage"
            bag.write("/camera", t_ns, message(store, kind, header=head))
            bag.write("/word", t_ns, message(store, "std_msgs/msg/String", data=f"word {k}"))


@pytest.mark.parametrize("kind", KINDS)
def test_all_that_has_a_place_is_kept_and_the_rest_is_named(kind, tmp_path, report_of):
    name, storage = KINDS[kind]
    bag, output = write_bag(tmp_path / name, fill_all, storage=storage), tmp_path / "x.mcap"
    dynamic = "/dynamic_joint_states"
    report = report_of("import", bag, "-o", output, "--response-topic", dynamic)
    every = dict.fromkeys(
        (*("/joint_commands", "/joint_states", "/joint_current", "/imu", "/second/encoders"),), 400
    )
    assert report["messages"] == every | {"/word": 8}
    assert (report["verdict"], report["problems"]) == ("good", [])
    notes = "\n".join(report["notes"])
    assert "/joint_commands is /arm/controller_state.reference of the recording" in notes
    assert "stiffness" in notes
    assert "left out: /camera (sensor_msgs/msg/CompressedImage, 8)" in notes
    with Session.open(bag) as before, Session.open(output) as after:
        old, new = before.with_joints(response=dynamic), after
        for topic, field in (
            *(("/joint_states", part) for part in ("position", "velocity", "effort")),
            *(("/joint_commands", "position"), ("/joint_current", "position")),
            ("/second/encoders", "position"),
        ):
            original, other = old.joints(topic, field), new.joints(topic, field)
            assert (original.names, original.unit) == (other.names, other.unit)
            np.testing.assert_array_equal(original.t_ns, other.t_ns)
            np.testing.assert_array_equal(original.values, other.values)
        np.testing.assert_array_equal(
            np.transpose(new.joints("/joint_commands").values),
            [commanded(t_s) for _, t_s in ticks(4.0)],
        )
        assert [m.data for _, m in new.messages("/word")] == [f"word {50 * k}" for k in range(8)]
        assert new.metadata["undulog"]["import.commands"] == "/arm/controller_state.reference"
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted([name, "x.mcap"])


def test_the_same_bag_gives_the_same_bytes(tmp_path):
    bag = write_bag(tmp_path / "a.bag", fill_all)
    import_bag(bag, tmp_path / "x.mcap")
    import_bag(bag, tmp_path / "y.mcap")
    assert (tmp_path / "x.mcap").read_bytes() == (tmp_path / "y.mcap").read_bytes()


@pytest.mark.parametrize("kind", KINDS)
def test_the_response_of_an_import_is_that_of_the_bag(kind, tmp_path, report_of):
    name, storage = KINDS[kind]
    bag = write_bag(tmp_path / name, filling(Filler.controller), storage=storage)
    output = tmp_path / "x.mcap"
    report_of("import", bag, "-o", output)
    first, second = report_of("analyse", bag), report_of("analyse", output)
    for key in ("gain", "lag_rad"):
        values = [[joint[key] for joint in report["joints"]] for report in (first, second)]
        np.testing.assert_array_equal(*values)


@pytest.mark.parametrize("version", ["foxy", "galactic", "humble", "iron", "jazzy"])
def test_a_db3_without_definitions_finds_the_release(version, tmp_path):
    old = version in ("foxy", "galactic")
    parts = ("desired", "actual") if old else ("reference", "feedback")

    def write(log, *tick):
        log.controller(*tick, "/arm/state", parts)
        log.dynamic(*tick)

    kind = {"storage": StoragePlugin.SQLITE3, "store": typestore(version)}
    folder = write_bag(tmp_path / "bag", filling(write, 0.5), **kind)
    (path,) = folder.glob("*.db3")
    with sqlite3.connect(path) as base:
        base.execute("DELETE FROM message_definitions")
    base.close()
    with Session.open(path) as session:
        topics = session.joint_topics()
        assert topics.command == f"/arm/state.{parts[0]}"
        values = np.transpose(session.joints(topics.command).values)
        np.testing.assert_array_equal(values, [commanded(t_s) for _, t_s in ticks(0.5)])
        assert session.joints("/dynamic_joint_states.current").names == NAMES


def test_a_set_of_joints_that_changes_has_gaps(tmp_path):
    """One joint a message, and one more halfway: none is lost, and none is made up."""

    def fill(bag):
        filler = Filler(bag)
        for k, (t_ns, t_s) in enumerate(ticks(2.0)):
            at = k % 2 if k < 100 else k % 3
            filler.state(t_ns, t_s, positions=[commanded(t_s)[at]], names=[NAMES[at]])

    bag = write_bag(tmp_path / "bag", fill)
    import_bag(bag, tmp_path / "x.mcap")
    with Session.open(bag) as before, Session.open(tmp_path / "x.mcap") as after:
        original, other = before.joints("/joint_states"), after.joints("/joint_states")
        assert original.names == other.names == NAMES
        for name in NAMES:
            kept = np.isfinite(other.signal(name).values)
            np.testing.assert_array_equal(
                other.signal(name).values[kept], original.signal(name).values
            )
            np.testing.assert_array_equal(other.signal(name).t_ns[kept], original.signal(name).t_ns)


def test_refusals_name_the_option(tmp_path, command, monkeypatch):
    def none(bag):
        for t_ns, _ in ticks(0.1):
            bag.write("/word", t_ns, message(bag.store, "std_msgs/msg/String", data="x"))

    output = tmp_path / "x.mcap"
    empty = write_bag(tmp_path / "none", none)
    how = "choose with --command-topic and --response-topic"
    assert how in command("import", empty, "-o", output, code=1).err
    bag = write_bag(tmp_path / "arrays", filling(Filler.array, 0.1))
    err = command("import", bag, "-o", output, code=1).err
    assert "/forward/commands:JOINT" in err
    assert how in err
    err = command("import", bag, "-o", output, "--command-topic", "/forward/commands", code=1).err
    assert "--command-topic /forward/commands:JOINT,JOINT" in err
    named = f"/forward/commands:{','.join(NAMES)}"
    assert command("import", bag, "-o", output, "--command-topic", named).err == ""
    assert "exists already" in command("import", bag, "-o", output, code=2).err
    err = command("import", output, "-o", tmp_path / "y.mcap", code=1).err
    assert "is a session of undulog already; use it as it is: undulog analyse x.mcap" in err
    err = command("import", bag, "-o", tmp_path / "y.mcap", "--bus", "can0", code=2).err
    assert "is a bag of ROS; --bus: for logs of another kind" in err
    full = shutil._ntuple_diskusage(10, 10, 0)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: full)
    assert "choose a larger disk" in command("import", bag, "-o", tmp_path / "y.mcap", code=1).err
    assert not (tmp_path / "y.mcap").exists()


def test_windows_do_not_show(tmp_path, monkeypatch):
    bag = write_bag(tmp_path / "bag", fill_all)
    import_bag(bag, tmp_path / "x.mcap")
    monkeypatch.setattr(importing, "_WINDOW_NS", 170_000_000)
    import_bag(bag, tmp_path / "y.mcap")
    with Session.open(tmp_path / "x.mcap") as session, Session.open(tmp_path / "y.mcap") as other:
        for topic in ("/joint_states", "/joint_commands"):
            first, second = session.joints(topic), other.joints(topic)
            np.testing.assert_array_equal(first.values, second.values)
            np.testing.assert_array_equal(first.t_ns, second.t_ns)


@pytest.mark.nightly
@pytest.mark.parametrize("kind", ["bag", "mcap", pytest.param("db3", marks=pytest.mark.nightly)])
def test_a_mutated_bag_is_imported_or_refused_in_words(kind, tmp_path, monkeypatch):
    def write(log, *tick):
        log.controller(*tick)
        log.dynamic(*tick)
        log.trajectory(*tick, count=3)

    scratch = tmp_path / "scratch"
    scratch.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(scratch))
    name, storage = KINDS[kind]
    bag = write_bag(tmp_path / name, filling(write, 0.3), storage=storage)
    draw = np.random.default_rng(23)
    files = [bag] if bag.is_file() else sorted(bag.iterdir())
    whole = {path: path.read_bytes() for path in files}
    output = tmp_path / "x.mcap"
    for case in range(24):
        path = files[case % len(files)]
        data = bytearray(whole[path])
        for place in draw.integers(len(data), size=1 + case):
            data[place] = draw.integers(256)
        path.write_bytes(data[: len(data) // 2] if case % 12 == 11 else data)
        text = str(bag)
        try:
            import_bag(bag, output, force=True)
            with Session.open(bag) as session:
                session.with_joints().joints("/joint_states")
        except UndulogError as error:
            text = str(error)
        assert str(bag) in text
        path.write_bytes(whole[path])
        assert not any(scratch.iterdir())
        assert {path.name for path in tmp_path.iterdir()} <= {name, "x.mcap", "scratch"}


@pytest.mark.parametrize("topic", ["/arm/joint_trajectory", "/arm/controller_state", "/states"])
def test_damaged_messages_are_read_or_counted(topic, tmp_path):
    """Bytes of messages are changed before they are written, so that the bag itself is whole."""
    draw = np.random.default_rng(5)

    class Damaging:
        def __init__(self, writer):
            self._writer = writer

        def __getattr__(self, name):
            return getattr(self._writer, name)

        def write(self, way, t_ns, data):
            data = bytearray(data)
            if draw.random() < 0.5:
                for place in draw.integers(4, len(data), size=3):
                    data[place] = draw.integers(256)
                data = data[: draw.integers(4, len(data) + 1)] if draw.random() < 0.3 else data
            self._writer.write(way, t_ns, bytes(data))

    def fill(bag):
        filler = Filler(bag)
        bag.writer = Damaging(bag.writer)
        for tick in ticks(1.0):
            filler.trajectory(*tick, count=4)
            filler.controller(*tick)
            filler.dynamic(*tick, "/states")

    bag = write_bag(tmp_path / "bag", fill)
    name = f"{topic}.feedback" if topic.endswith("controller_state") else topic
    with Session.open(bag) as session:
        assert session.joint_channel(name) is not None
        assert set(NAMES) & set(session.joints(name).names)
        assert session.warnings


def test_big_endian_and_other_types_are_counted(tmp_path):
    def fill(bag):
        store, filler = bag.store, Filler(bag)
        for k, tick in enumerate(ticks(1.0)):
            filler.controller(*tick)
            if k % 10 == 0:
                sample = message(store, CONTROLLER, joint_names=list(NAMES))
                data = store.serialize_cdr(sample, CONTROLLER, little_endian=False)
                bag.writer.write(bag.ways["/arm/controller_state"], tick[0], bytes(data))

    with Session.open(write_bag(tmp_path / "bag", fill)) as session:
        series = session.joints("/arm/controller_state.feedback")
        assert len(series.t_ns[0]) == 100
        assert series.t_ns[0][0] == EPOCH_NS
        assert any("10 messages can't be read" in text for text in session.warnings)
