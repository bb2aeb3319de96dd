"""Each kind of channel: what is written is what mcap-ros2-support decodes, field by field."""

import math

import numpy as np
import pytest
from mcap.reader import make_reader

from support.read_back import decoded_of, messages_of, metadata_of
from undulog.capture import SessionWriter, load_robot
from undulog.capture.common.errors import DataError, LogWriteError
from undulog.capture.log.messages.definitions import DiagnosticStatus
from undulog.capture.log.messages.frames import empty_fd_frames, empty_frames
from undulog.capture.log.write.writer import open_sensor
from undulog.capture.robot.model import Sensor, SensorKind

EPOCH_NS = 1_700_000_000_123_456_789
FACTS = {"session_id": "s", "epoch_ns": EPOCH_NS}
LOGGED_NS = EPOCH_NS + 5
QUATERNION = np.array([0.1, 0.2, 0.3, math.sqrt(0.86)])


def written(path, open_channel, *writes, **options):
    """Write by one channel; return times and contents of its messages."""
    with SessionWriter(path, **FACTS, **options) as writer:
        channel = open_channel(writer)
        for arguments, more in writes:
            channel.write(EPOCH_NS, *arguments, **more)
    raw = [(m.log_time, m.publish_time, m.sequence) for *_, m in messages_of(path)]
    return raw, [content for _, _, content in decoded_of(path)]


def stamp_ns(header):
    return header.stamp.sec * 10**9 + header.stamp.nanosec


def row(vector, axes="xyz"):
    return [getattr(vector, axis) for axis in axes]


LOGGED = {"log_time_ns": LOGGED_NS}
TIMES = [(EPOCH_NS, EPOCH_NS, 0), (LOGGED_NS, EPOCH_NS, 1)]
"""Log time, sampling time, counter of two messages, the second one recorded later."""


def test_joint_states(tmp_path):
    raw, (first, second) = written(
        tmp_path / "x.mcap",
        lambda writer: writer.joint_state("/j", ["a", "b"], unit="rad", velocity=True, effort=True),
        (([1.0, 2.0], [3.0, 4.0], [5.0, 6.0]), {}),
        (([math.nan, 7.0], [8.0, 9.0], [10.0, 11.0]), LOGGED),
    )
    assert raw == TIMES
    assert stamp_ns(first.header) == stamp_ns(second.header) == EPOCH_NS
    assert first.name == ["a", "b"]
    assert [list(values) for values in (first.position, first.velocity, first.effort)] == [
        [1.0, 2.0], [3.0, 4.0], [5.0, 6.0],
    ]  # fmt: skip
    assert np.isnan(second.position[0])
    assert list(second.effort) == [10.0, 11.0]


def test_joints_without_velocity_and_effort_and_some_of_them(tmp_path):
    path = tmp_path / "x.mcap"
    with SessionWriter(path, **FACTS) as writer:
        channel = writer.joint_state("/j", ["a", "b", "c"], unit="rad", effort=True)
        some = channel.part(["c", "a"])
        channel.write(EPOCH_NS, [1.0, 2.0, 3.0], effort=[4.0, 5.0, 6.0])
        some.write(EPOCH_NS + 1, [7.0, 8.0], effort=[9.0, 10.0])
        with pytest.raises(ValueError, match="broadcast"):
            some.write(EPOCH_NS, [1.0, 2.0, 3.0], effort=[0.0, 0.0])
    whole, part = (content for *_, content in decoded_of(path))
    assert list(whole.velocity) == list(part.velocity) == []
    assert (whole.name, part.name) == (["a", "b", "c"], ["c", "a"])
    assert (list(part.position), list(part.effort)) == ([7.0, 8.0], [9.0, 10.0])


def test_odometry(tmp_path):
    position, linear, angular = np.arange(3.0), np.arange(3.0) + 10, np.arange(3.0) + 20
    raw, (message, _) = written(
        tmp_path / "x.mcap",
        lambda writer: writer.odometry("/odom", frame="world", child="head"),
        ((position, QUATERNION, linear, angular), {}),
        ((position, QUATERNION, linear, angular), LOGGED),
    )
    assert raw == TIMES
    assert (message.header.frame_id, message.child_frame_id) == ("world", "head")
    assert stamp_ns(message.header) == EPOCH_NS
    assert row(message.pose.pose.position) == position.tolist()
    assert row(message.pose.pose.orientation, "xyzw") == QUATERNION.tolist()
    assert row(message.twist.twist.linear) == linear.tolist()
    assert row(message.twist.twist.angular) == angular.tolist()


def test_transforms_are_rounded_for_viewers(tmp_path):
    positions = np.array([[0.1, 0.2, 0.3], [1.0, -2.0, 3.0]])
    turns = np.array([QUATERNION, [0.0, 0.0, 0.0, 1.0]])
    raw, (message, _) = written(
        tmp_path / "x.mcap",
        lambda writer: writer.transforms("/tf", parent="world", children=["a", "b"]),
        ((positions, turns), {}),
        ((positions, turns), LOGGED),
    )
    assert raw == TIMES
    for k, transform in enumerate(message.transforms):
        assert stamp_ns(transform.header) == EPOCH_NS
        assert (transform.header.frame_id, transform.child_frame_id) == ("world", "ab"[k])
        got = [*row(transform.transform.translation), *row(transform.transform.rotation, "xyzw")]
        np.testing.assert_allclose(got, [*positions[k], *turns[k]], rtol=0, atol=2.0**-15)
        assert (np.array(got) * 2**14 % 1 == 0).all()


@pytest.mark.parametrize("infrared", [True, False])
def test_ranges(infrared, tmp_path):
    kind = SensorKind.IR if infrared else SensorKind.SONAR
    sensor = Sensor("front", kind, "head", (0.0, 0.0, 0.0), range_min=0.1, range_max=4.0)
    raw, (first, second) = written(
        tmp_path / "x.mcap",
        lambda writer: open_sensor(writer, sensor),
        ((0.75,), {}),
        ((math.inf,), LOGGED),
    )
    assert raw == TIMES
    assert (first.header.frame_id, first.radiation_type) == ("front", int(infrared))
    limits = first.min_range, first.max_range, first.field_of_view
    assert limits == pytest.approx((0.1, 4.0, sensor.field_of_view or 0.0))
    assert (first.range, second.range) == (0.75, math.inf)
    with SessionWriter(tmp_path / "y.mcap", **FACTS) as writer:
        writer.range("/r", frame="f", min_range=0.5, max_range=1.5, field_of_view=0.25).write(
            EPOCH_NS, 1.0
        )
    ((_, _, message),) = decoded_of(tmp_path / "y.mcap")
    assert (message.field_of_view, message.radiation_type) == (0.25, 1)  # infrared by default


def test_an_accelerometer_says_that_it_has_no_gyroscope(tmp_path):
    raw, (first, second) = written(
        tmp_path / "x.mcap",
        lambda writer: writer.imu("/imu", frame="head"),
        ((np.array([1.0, 2.0, 3.0]),), {}),
        ((np.array([4.0, 5.0, 6.0]), np.array([7.0, 8.0, 9.0])), LOGGED),
    )
    assert raw == TIMES
    assert (row(first.linear_acceleration), row(first.angular_velocity)) == ([1, 2, 3], [0, 0, 0])
    assert list(first.angular_velocity_covariance) == [-1.0] + [0.0] * 8
    assert list(first.orientation_covariance) == [-1.0] + [0.0] * 8
    assert (row(second.linear_acceleration), row(second.angular_velocity)) == ([4, 5, 6], [7, 8, 9])
    assert list(second.angular_velocity_covariance) == [0.0] * 9
    assert second.header.frame_id == "head"


def test_many_of_an_accelerometer_after_one_with_a_gyroscope(tmp_path):
    with SessionWriter(tmp_path / "x.mcap", **FACTS) as writer:
        channel = writer.imu("/imu", frame="head")
        channel.write(EPOCH_NS, np.ones(3), np.ones(3))
        times = EPOCH_NS + np.arange(1, 3)
        channel.write_rows(times, np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]), times + 9)
    *_, last = (content for *_, content in decoded_of(tmp_path / "x.mcap"))
    assert (row(last.linear_acceleration), row(last.angular_velocity)) == ([4, 5, 6], [0, 0, 0])
    assert last.angular_velocity_covariance[0] == -1.0
    assert [m.log_time for *_, m in messages_of(tmp_path / "x.mcap")][1:] == (times + 9).tolist()


def test_magnetic_fields(tmp_path):
    _, (message,) = written(
        tmp_path / "x.mcap",
        lambda writer: writer.magnetic_field("/compass", frame="c"),
        ((np.array([1e-5, -2e-5, 3e-5]),), {}),
    )
    assert row(message.magnetic_field) == [1e-5, -2e-5, 3e-5]
    assert message.header.frame_id == "c"


def test_a_devices_clock_against_the_hosts(tmp_path):
    path = tmp_path / "x.mcap"
    with SessionWriter(path, **FACTS) as writer:
        channel = writer.time_reference("/clock/can0", source="can0")
        channel.write(EPOCH_NS, 12_000_000_034)
        channel.write(EPOCH_NS, 2**31 * 10**9 - 1, log_time_ns=LOGGED_NS)
        for beyond in (2**31 * 10**9, -1 - 2**31 * 10**9):
            with pytest.raises(DataError, match=f"a device time of {beyond} ns doesn't fit"):
                channel.write(EPOCH_NS, beyond)
    first, last = (content for *_, content in decoded_of(path))
    assert (first.source, first.time_ref.sec, first.time_ref.nanosec) == ("can0", 12, 34)
    assert stamp_ns(first.header) == EPOCH_NS
    assert (last.time_ref.sec, last.time_ref.nanosec) == (2**31 - 1, 10**9 - 1)


def test_texts_and_events(tmp_path):
    path = tmp_path / "x.mcap"
    with SessionWriter(path, **FACTS) as writer:
        writer.string("/mode").write(EPOCH_NS, "wälk", **LOGGED)
        events = writer.log("/rosout")
        assert writer.log("/rosout") is events
        for level in ("debug", "info", "warn", "error", "fatal"):
            events.write(EPOCH_NS, level, "twin", level * 2)
        with pytest.raises(DataError, match="level 'loud' is none of debug, info, warn"):
            events.write(EPOCH_NS, "loud", "twin", "")
    *events_read, mode = (
        content for *_, content in decoded_of(path)
    )  # the text was recorded later
    assert mode.data == "wälk"
    assert [event.level for event in events_read] == [10, 20, 30, 40, 50]  # rcl_interfaces/msg/Log
    third = events_read[2]
    assert (third.name, third.msg, third.stamp.nanosec) == ("twin", "warnwarn", 123_456_789)
    *_, (*_, last) = messages_of(path)
    assert (last.log_time, last.publish_time) == (LOGGED_NS, EPOCH_NS)


def test_diagnostics(tmp_path):
    statuses = [
        DiagnosticStatus(0, "source a", "fine"),
        DiagnosticStatus(2, "disk", "full", "/dev/x", {"free": "0", "left": "3"}),
    ]
    _, (message,) = written(
        tmp_path / "x.mcap", lambda writer: writer.diagnostics(), ((statuses,), {})
    )
    assert stamp_ns(message.header) == EPOCH_NS
    listed = [
        (status.level, status.name, status.message, status.hardware_id) for status in message.status
    ]
    assert listed == [(0, "source a", "fine", ""), (2, "disk", "full", "/dev/x")]
    assert [(value.key, value.value) for value in message.status[1].values] == [
        ("free", "0"),
        ("left", "3"),
    ]


@pytest.mark.parametrize("fd", [False, True])
def test_frames_of_a_bus(fd, tmp_path):
    frames = (empty_fd_frames if fd else empty_frames)(3)
    frames["id_flags"] = [1, 2, 3]
    frames["data"][:, 0] = [7, 8, 9]
    path = tmp_path / "x.mcap"
    with SessionWriter(path, **FACTS) as writer:
        channel = (writer.fd_frames if fd else writer.frames)("/bus")
        channel.write(EPOCH_NS, frames)
        with pytest.raises(DataError, match="frames have the layout"):
            channel.write(EPOCH_NS, (empty_frames if fd else empty_fd_frames)(1))
    ((_, at_ns, message),) = decoded_of(path)
    assert at_ns == EPOCH_NS
    assert [dimension.size for dimension in message.layout.dim] == [3, frames.dtype.itemsize]
    assert bytes(message.data) == frames.tobytes()


# -- the session around them ----------------------------------------------------------------------


def test_channels_have_units_and_a_topic_has_one(tmp_path):
    path = tmp_path / "x.mcap"
    sensor = {"frame": "f", "min_range": 0.0, "max_range": 1.0, "field_of_view": 0.1}
    with SessionWriter(path, **FACTS) as writer:
        writer.joint_state("/j", ["a"], unit="deg")
        writer.range("/r", **sensor)
        writer.magnetic_field("/m", frame="f")
        writer.messages("/raw", "std_msgs/msg/String", {"k": "v"})(EPOCH_NS, EPOCH_NS, b"")
        writer.string("/s")
        with pytest.raises(DataError, match="/s is open already; a topic has one channel"):
            writer.string("/s")
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    channels = {channel.topic: channel for channel in summary.channels.values()}
    assert {topic: channel.metadata for topic, channel in channels.items()} == {
        "/j": {"unit": "deg"}, "/r": {"unit": "m"}, "/m": {"unit": "T"}, "/raw": {"k": "v"},
        "/s": {},
    }  # fmt: skip
    assert {channel.message_encoding for channel in channels.values()} == {"cdr"}
    assert channels["/raw"].schema_id == channels["/s"].schema_id  # a type has one schema
    names = {key: schema.name for key, schema in summary.schemas.items()}
    assert names[channels["/r"].schema_id] == "sensor_msgs/msg/Range"
    assert len(set(names.values())) == len(names)


def test_a_session_explains_itself(tmp_path):
    path, robot = tmp_path / "x.mcap", load_robot("snake25")
    options = {"robot": robot, "clock": {"can0": "device"}, "metadata": {"operator": "ü"}}
    with SessionWriter(path, **FACTS, **options) as writer:
        writer.note_at_end("late", {"a": "1"})
        writer.note_at_end("late", {"a": "2"})
        writer.set_verdict("degraded", ["one", "two"])
    records = metadata_of(path)
    facts = records["undulog"]
    assert (facts["session_id"], facts["epoch_ns"]) == ("s", str(EPOCH_NS))
    assert (facts["robot"], facts["clock.can0"], facts["operator"]) == ("snake25", "device", "ü")
    assert records["late"] == {"a": "2"}
    assert records["undulog.health"]["verdict"] == "degraded"
    with path.open("rb") as stream:
        attached = {
            attachment.name: attachment for attachment in make_reader(stream).iter_attachments()
        }
    assert attached["robot.toml"].data == robot.toml.encode()
    assert attached["robot.toml"].media_type == "application/toml"
    assert attached["snake25.dbc"].data == dict(robot.databases)["snake25.dbc"].encode()
    assert {attachment.create_time for attachment in attached.values()} == {EPOCH_NS}


def test_a_closed_session_takes_nothing(tmp_path):
    with SessionWriter(tmp_path / "x.mcap", **FACTS) as writer:
        joints = writer.joint_state("/j", ["a"], unit="rad")
        text = writer.string("/s")
    none = np.empty((1, 0))
    for write in (
        lambda: text.write(EPOCH_NS, "late"),
        lambda: joints.write(EPOCH_NS, [0.0]),
        lambda: joints.write_rows(np.array([EPOCH_NS]), np.zeros((1, 1)), none, none),
    ):
        with pytest.raises(LogWriteError, match="the session is closed"):
            write()


def test_rows_go_on_counting(tmp_path):
    path, none = tmp_path / "x.mcap", np.empty((2, 0))
    with SessionWriter(path, **FACTS) as writer:
        channel = writer.joint_state("/j", ["a"], unit="rad")
        channel.write(EPOCH_NS, [1.0])
        times = EPOCH_NS + np.arange(2)
        channel.write_rows(times, np.zeros((2, 1)), none, none, log_time_ns=times + 3)
        channel.write(EPOCH_NS + 9, [1.0])
    numbers = [(m.sequence, m.log_time - EPOCH_NS) for *_, m in messages_of(path)]
    assert numbers == [(0, 0), (1, 3), (2, 4), (3, 9)]
