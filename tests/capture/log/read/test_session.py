"""Sessions that we write, read by others and by ourselves."""

from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader

from support.read_back import decoded_of, metadata_of
from support.written_frames import frames_of
from support.written_sessions import EPOCH_NS, NAMES, STEP_NS, write_session
from support.written_topics import write_topics
from undulog.capture import Session, SessionWriter, load_robot
from undulog.capture.common.errors import DataError, LogWriteError, OutputExistsError
from undulog.capture.log.messages.frames import DIR_TX, EXTENDED_FLAG, empty_frames

# -- writing -----------------------------------------------------------------------------------


def test_foreign_readers_find_every_number_and_the_description(tmp_path):
    path, robot = tmp_path / "s.mcap", load_robot("snake13")
    facts = {"operator": "a person"}
    data = write_session(path, robot=robot, clock={"twin": "simulated"}, metadata=facts)
    with AnyReader([path]) as reader:
        rows = [
            reader.deserialize(raw, connection.msgtype)
            for connection, _, raw in reader.messages()
            if connection.topic == "/joint_states"
        ]
        topics = {connection.topic: connection.msgtype for connection in reader.connections}
    np.testing.assert_array_equal([(r.position, r.velocity, r.effort) for r in rows], data)
    stamps = [r.header.stamp.sec * 10**9 + r.header.stamp.nanosec for r in rows]
    assert stamps == [EPOCH_NS + k * STEP_NS for k in range(len(data))]
    assert tuple(rows[0].name) == NAMES
    assert topics["/odom"] == "nav_msgs/msg/Odometry"
    metadata = metadata_of(path)
    with path.open("rb") as stream:
        reader = make_reader(stream)
        assert reader.get_header().profile == "ros2"
        attached = {record.name: record.data for record in reader.iter_attachments()}
        channels = reader.get_summary().channels.values()
    units = {channel.topic: channel.metadata.get("unit") for channel in channels}
    facts |= {"session_id": "s1", "clock.twin": "simulated"}
    assert metadata["undulog"].items() >= facts.items()
    assert metadata["undulog.health"]["verdict"] == "good"
    assert attached["robot.toml"].decode() == robot.toml
    assert units["/joint_states"] == "rad"


def test_the_other_channels_read_back_elsewhere(tmp_path):
    path = tmp_path / "s.mcap"
    pose = np.array([[1.0, 2.0, 3.00001], [4.0, 5.0, 6.0]])
    turn = np.array([[0.0, 0.0, 0.0, 1.0], [0.5, 0.5, 0.5, 0.5]])
    with SessionWriter(path, session_id="s", epoch_ns=EPOCH_NS) as writer:
        writer.transforms("/tf", parent="world", children=["a", "b"]).write(EPOCH_NS, pose, turn)
        ir = writer.range("/ir/01", frame="a", min_range=0.2, max_range=1.5, field_of_view=0.1)
        ir.write(EPOCH_NS, 0.75)
        writer.imu("/imu", frame="a").write(EPOCH_NS, np.array([0.1, 0.2, 9.8]))
        writer.magnetic_field("/compass", frame="a").write(EPOCH_NS, np.array([2e-5, 0, -4e-5]))
    by_topic = {topic: content for topic, _, content in decoded_of(path)}
    assert [t.child_frame_id for t in by_topic["/tf"].transforms] == ["a", "b"]
    assert abs(by_topic["/tf"].transforms[0].transform.translation.z - 3.00001) <= 2**-15
    assert by_topic["/tf"].transforms[1].transform.rotation.w == 0.5
    assert (by_topic["/ir/01"].range, by_topic["/imu"].linear_acceleration.z) == (0.75, 9.8)
    assert by_topic["/imu"].orientation_covariance[0] == -1.0
    assert by_topic["/imu"].angular_velocity_covariance[0] == -1.0
    assert by_topic["/compass"].magnetic_field.z == -4e-5


def test_an_existing_file_stays_unless_forced(tmp_path):
    path = tmp_path / "s.mcap"
    path.write_bytes(b"precious")
    with pytest.raises(OutputExistsError, match="--force"):
        SessionWriter(path, session_id="s", epoch_ns=EPOCH_NS)
    assert path.read_bytes() == b"precious"
    write_session(path, 3, force=True)
    assert Session.open(path).channels["/joint_states"].count == 3


def test_a_block_left_by_an_exception_leaves_a_whole_file(tmp_path):
    path = tmp_path / "s.mcap"

    def record_and_fail():
        with SessionWriter(path, session_id="s", epoch_ns=EPOCH_NS) as writer:
            writer.joint_state("/joint_commands", NAMES, unit="rad").write(EPOCH_NS, [1, 2, 3])
            raise RuntimeError("robot fell")

    with pytest.raises(RuntimeError, match="robot fell"):
        record_and_fail()
    with Session.open(path) as session:
        assert session.joints("/joint_commands").values[2].tolist() == [3.0]
        assert session.warnings == []


def test_a_full_disk_is_an_error_that_names_the_file():
    with pytest.raises(LogWriteError, match="/dev/full: can't be written: No space left"):
        write_session(Path("/dev/full"), 3000, force=True)


def test_a_topic_has_one_channel_and_a_shape(tmp_path):
    with SessionWriter(tmp_path / "s.mcap", session_id="s", epoch_ns=EPOCH_NS) as writer:
        channel = writer.joint_state("/joint_commands", NAMES, unit="rad")
        with pytest.raises(DataError, match="open already"):
            writer.joint_state("/joint_commands", NAMES, unit="rad")
        with pytest.raises(ValueError, match="broadcast"):
            channel.write(EPOCH_NS, [1.0, 2.0])
    with pytest.raises(LogWriteError, match="the session is closed"):
        channel.write(EPOCH_NS, [1.0, 2.0, 3.0])


# -- reading our own ---------------------------------------------------------------------------


def test_columns_come_back_bit_for_bit(tmp_path):
    data = write_session(tmp_path / "s.mcap", 3000)  # several chunks
    with Session.open(tmp_path / "s.mcap") as session:
        for k, field in enumerate(("position", "velocity", "effort")):
            signals = session.joints("/joint_states", field)
            np.testing.assert_array_equal(np.array(signals.values).T, data[:, k])
            assert signals.names == NAMES
        assert session.joints("/joint_states", "effort").unit == "N m"
        assert session.duration_s == pytest.approx(29.99)
        assert (session.verdict, session.warnings) == ("good", [])
        start, stop = EPOCH_NS + 1000 * STEP_NS, EPOCH_NS + 1500 * STEP_NS  # half-open
        signals = session.joints("/joint_states", start_ns=start, stop_ns=stop)
    assert signals.t_ns[0][0] == start
    assert signals.t_ns[0][-1] == stop - STEP_NS
    np.testing.assert_array_equal(np.array(signals.values).T, data[1000:1500, 0])


def test_tables_events_messages_and_a_long_frame(tmp_path):
    data = write_session(tmp_path / "s.mcap")
    with Session.open(tmp_path / "s.mcap") as session:
        odometry = session.table("/odom")
        np.testing.assert_array_equal(odometry["pose.pose.position.y"], data[:, 0, 1])
        assert odometry.index[1] == EPOCH_NS + STEP_NS
        assert session.table("/gait/mode")["data"].tolist() == ["walk"]
        (_, event), *_ = session.messages("/rosout")
        assert (event.level, event.msg) == (30, "clamped")
        frame = session.joints("/joint_states", "velocity").frame()
    second = frame[frame["joint"] == "joint02"]
    np.testing.assert_array_equal(second["velocity [rad/s]"], data[:, 1, 1])


def test_frames_come_back_bit_for_bit(tmp_path):
    rng = np.random.default_rng(3)
    frames = empty_frames(1000)
    frames["t_host_ns"] = EPOCH_NS + np.arange(1000)
    frames["id_flags"] = rng.integers(0, 2**29, 1000) | EXTENDED_FLAG
    frames["dlc"], frames["dir"] = rng.integers(0, 9, 1000), DIR_TX
    frames["data"] = rng.integers(0, 256, (1000, 8))
    with SessionWriter(tmp_path / "s.mcap", session_id="s", epoch_ns=EPOCH_NS) as writer:
        channel = writer.frames("/can/can0")
        for start, stop in ((0, 1), (1, 400), (400, 400), (400, 1000)):
            channel.write(EPOCH_NS + start, frames[start:stop])
    assert frames_of(tmp_path / "s.mcap").tobytes() == frames.tobytes()


def test_each_joint_gets_its_own_sampling_time(tmp_path):
    path = tmp_path / "s.mcap"
    base = EPOCH_NS + np.arange(10) * STEP_NS
    angles = np.tile([1.0, 2.0, 3.0], (10, 1))
    offsets = [[0.0, 0.005, 0.001 * tick] for tick in range(10)]
    topics = {f"/joint_{kind}": (NAMES, "rad", angles) for kind in ("states", "commands")}
    topics["/joint_sample_offset"] = (NAMES, "s", offsets)
    with Session.open(write_topics(path, base, topics, epoch_ns=EPOCH_NS)) as session:
        signals = session.joints("/joint_states")
        np.testing.assert_array_equal(signals.t_ns[0], base)
        np.testing.assert_array_equal(signals.t_ns[1], base + 5_000_000)
        np.testing.assert_array_equal(signals.t_ns[2], base + np.arange(10) * 1_000_000)
        np.testing.assert_array_equal(session.joints("/joint_commands").t_ns[1], base)


def test_joints_come_in_chain_order(tmp_path):
    robot = load_robot("snake13")
    names = robot.joint_names[::-1]
    path = tmp_path / "s.mcap"
    with SessionWriter(path, session_id="s", epoch_ns=EPOCH_NS, robot=robot) as writer:
        channel = writer.joint_state("/joint_states", names, unit="rad")
        channel.write(EPOCH_NS, np.arange(len(names)))
    with Session.open(path) as session:
        signals = session.joints("/joint_states")
        assert session.robot == robot
    assert signals.names == robot.joint_names
    assert [values[0] for values in signals.values] == list(range(len(names)))[::-1]
