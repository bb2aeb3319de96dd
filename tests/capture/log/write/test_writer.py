"""A session writer: what it stores of its robot, its inputs and its sensors."""

import dataclasses
import json

import numpy as np
import pytest
from mcap.reader import make_reader

from support.read_back import decoded_of, metadata_of
from undulog.capture import SessionWriter, load_robot
from undulog.capture.common.errors import DataError, OutputExistsError
from undulog.capture.log.write.channels import ImuChannel, MagneticFieldChannel, RangeChannel
from undulog.capture.log.write.writer import open_sensor
from undulog.capture.robot.model import Sensor, SensorKind

EPOCH_NS = 1_700_000_000_123_456_789
FACTS = {"session_id": "s", "epoch_ns": EPOCH_NS}


def attachments(path):
    with path.open("rb") as stream:
        return {
            attachment.name: attachment for attachment in make_reader(stream).iter_attachments()
        }


def test_a_robot_has_its_files_and_its_serial_number_if_it_has_one(tmp_path):
    robot = dataclasses.replace(
        load_robot("snake25"), meshes=(("a.stl", b"1"), ("b.obj", b"2"), ("c.xyz", b"3"))
    )
    for serial in ("", "no. 7"):
        path = tmp_path / f"{len(serial)}.mcap"
        SessionWriter(path, **FACTS, robot=dataclasses.replace(robot, serial=serial)).close()
        facts = metadata_of(path)["undulog"]
        assert facts.get("serial", "") == serial
        assert ("serial" in facts) == bool(serial)
        files = attachments(path)
        assert {name: files[name].data for name in ("a.stl", "b.obj", "c.xyz")} == {
            "a.stl": b"1", "b.obj": b"2", "c.xyz": b"3",
        }  # fmt: skip
        assert [files[name].media_type for name in ("a.stl", "c.xyz")] == [
            "model/stl", "application/octet-stream",
        ]  # fmt: skip
        assert files["snake25.dbc"].media_type == "text/plain"
    SessionWriter(tmp_path / "none.mcap", **FACTS).close()
    assert metadata_of(tmp_path / "none.mcap")["undulog"]["robot"] == ""
    assert attachments(tmp_path / "none.mcap") == {}


def test_inputs_and_verdicts_are_stored_with_a_session(tmp_path):
    path = tmp_path / "run.mcap"
    with SessionWriter(path, **FACTS, clock={"a": "device", "b": "host"}) as writer:
        texts = {"plan.toml": b"a = 1", "scenario.toml": b"b = 2"}
        writer.explain(texts, {"one": {"k": "1"}, "two": {"k": "2"}})
        writer.set_verdict("good")
        writer.close()
        writer.close()
    files, records = attachments(path), metadata_of(path)
    assert {name: (file.data, file.media_type) for name, file in files.items()} == {
        name: (text, "application/toml") for name, text in texts.items()
    }
    assert {(file.create_time, file.log_time) for file in files.values()} == {(EPOCH_NS, EPOCH_NS)}
    assert (records["one"], records["two"]) == ({"k": "1"}, {"k": "2"})
    assert records["undulog"].items() >= {"clock.a": "device", "clock.b": "host"}.items()
    health = records["undulog.health"]
    assert (health["verdict"], json.loads(health["reasons"])) == ("good", [])
    with pytest.raises(OutputExistsError):
        SessionWriter(path, **FACTS)
    SessionWriter(path, **FACTS, force=True).close()
    assert attachments(path) == {}


KINDS = {
    SensorKind.ACCELEROMETER: ImuChannel,
    SensorKind.COMPASS: MagneticFieldChannel,
    SensorKind.IR: RangeChannel,
    SensorKind.SONAR: RangeChannel,
}


def test_each_kind_of_sensor_has_its_channel_on_its_topic(tmp_path):
    path, limits = tmp_path / "run.mcap", {"range_min": 0.25, "range_max": 2.5}
    sensors = []
    with SessionWriter(path, **FACTS) as writer:
        for number, kind in enumerate(SensorKind):
            for has_range in (False, True):
                given = limits | {"field_of_view": 0.125} if has_range else {}
                sensor = Sensor(f"s{number}{has_range:d}", kind, "head", (0.0, 0.0, 0.0), **given)
                sensors.append(sensor)
                channel = open_sensor(writer, sensor)
                assert type(channel) is KINDS[kind]
                value = np.ones(1 if KINDS[kind] is RangeChannel else 3)
                channel.write(EPOCH_NS, value)
        with pytest.raises(DataError, match="is open already"):
            open_sensor(writer, sensors[0])
    contents = {topic: content for topic, _, content in decoded_of(path)}
    assert set(contents) == {sensor.topic for sensor in sensors}
    for sensor in sensors:
        message = contents[sensor.topic]
        assert message.header.frame_id == sensor.name
        if KINDS[sensor.kind] is RangeChannel:
            has_range = sensor.range_min is not None
            bounds = (message.min_range, message.max_range, message.field_of_view)
            assert bounds == ((0.25, 2.5, 0.125) if has_range else (0.0, 0.0, 0.0))
            assert message.radiation_type == (sensor.kind is SensorKind.IR)


def test_rows_longer_than_a_chunk_are_written_one_by_one(tmp_path):
    path, name, none = tmp_path / "run.mcap", "x" * (1 << 20), np.empty((3, 0))
    with SessionWriter(path, **FACTS) as writer:
        channel = writer.joint_state("/j", [name], unit="rad")
        channel.write_rows(EPOCH_NS + np.arange(3), np.arange(3.0)[:, None], none, none)
    contents = [(t_ns, content) for _, t_ns, content in decoded_of(path)]
    assert [t_ns for t_ns, _ in contents] == [EPOCH_NS + k for k in range(3)]
    assert [(content.name, list(content.position)) for _, content in contents] == [
        ([name], [float(k)]) for k in range(3)
    ]


@pytest.mark.parametrize("at", [0, 1, 2])
def test_of_rows_no_time_may_lie_outside_what_a_stamp_holds(tmp_path, at):
    last = 2**31 * 10**9 - 1
    none = np.empty((3, 0))
    with SessionWriter(tmp_path / "run.mcap", **FACTS) as writer:
        channel = writer.joint_state("/j", ["a"], unit="rad")
        channel.write_rows(np.array([0, 1, last]), np.zeros((3, 1)), none, none)
        for beyond in (last + 1, -1):
            times = np.array([5, 6, 7])
            times[at] = beyond
            text = f"times from {min(times)} to {max(times)} ns don't fit 32 bits of s"
            with pytest.raises(DataError, match=text):
                channel.write_rows(times, np.zeros((3, 1)), none, none)
        channel.write_rows(times[:0], np.zeros((0, 1)), none[:0], none[:0])
    stamps = [c.header.stamp for *_, c in decoded_of(tmp_path / "run.mcap")]
    assert [(stamp.sec, stamp.nanosec) for stamp in stamps] == [
        (0, 0),
        (0, 1),
        (2**31 - 1, 10**9 - 1),
    ]
