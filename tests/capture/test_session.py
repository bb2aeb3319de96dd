"""The session writer and reader, against foreign readers and writers."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import CompressionType, IndexType
from mcap.writer import Writer as McapWriter
from mcap_ros2.decoder import DecoderFactory
from mcap_ros2.writer import Writer as RosWriter
from rosbags.highlevel import AnyReader

from capture import Session, SessionWriter, load_robot
from capture.errors import (
    DataError,
    LogError,
    LogWriteError,
    MissingChannelError,
    NotALogError,
    OutputExistsError,
)
from capture.log.cdr import encode
from capture.log.frames import DIR_TX, EXTENDED_FLAG, empty_frames
from capture.log.schemas import message_type, schema_text

EPOCH_NS = 1_700_000_000_000_000_000
STEP_NS = 10_000_000
NAMES = ("joint01", "joint02", "joint03")
JOINT_STATE = "sensor_msgs/msg/JointState"


def samples(count: int = 300) -> np.ndarray:
    return np.random.default_rng(7).normal(size=(count, 3, len(NAMES)))


def write_session(path: Path, count: int = 300, **options: object) -> np.ndarray:
    data = samples(count)
    with SessionWriter(path, session_id="s1", epoch_ns=EPOCH_NS, **options) as writer:
        commands = writer.joint_state("/joint_commands", NAMES, unit="rad")
        states = writer.joint_state("/joint_states", NAMES, unit="rad", velocity=True, effort=True)
        odometry = writer.odometry("/odom", frame="world", child="link01")
        events = writer.log("/rosout")
        mode = writer.string("/gait/mode")
        mode.write(EPOCH_NS, "walk")
        events.write(EPOCH_NS, "warn", "twin", "clamped")
        for tick, (position, velocity, effort) in enumerate(data):
            t_ns = EPOCH_NS + tick * STEP_NS
            commands.write(t_ns, position)
            states.write(t_ns, position, velocity, effort)
            odometry.write(t_ns, position, np.array([0, 0, 0, 1.0]), velocity, effort)
        writer.set_verdict("good", ["nothing lost"])
    return data


def write_foreign(
    path: Path, messages: list[tuple[str, int, dict]], type_name: str = JOINT_STATE
) -> None:
    """Messages (topic, log time, content) as mcap-ros2-support writes them."""
    with path.open("wb") as stream:
        writer = RosWriter(stream)
        schema = writer.register_msgdef(type_name, schema_text(type_name))
        for topic, t_ns, content in messages:
            writer.write_message(topic, schema, content, log_time=t_ns, publish_time=t_ns)
        writer.finish()


def joint_state(t_ns: int, names: list[str], position: list[float], **more: object) -> dict:
    stamp = {"sec": t_ns // 10**9, "nanosec": t_ns % 10**9}
    return {"header": {"stamp": stamp}, "name": names, "position": position, **more}


# -- writing -----------------------------------------------------------------------------------


def test_a_foreign_reader_finds_every_number(tmp_path: Path) -> None:
    data = write_session(tmp_path / "s.mcap")
    with AnyReader([tmp_path / "s.mcap"]) as reader:
        rows = [
            reader.deserialize(raw, connection.msgtype)
            for connection, _, raw in reader.messages()
            if connection.topic == "/joint_states"
        ]
        topics = {connection.topic: connection.msgtype for connection in reader.connections}
    np.testing.assert_array_equal([r.position for r in rows], data[:, 0])
    np.testing.assert_array_equal([r.velocity for r in rows], data[:, 1])
    np.testing.assert_array_equal([r.effort for r in rows], data[:, 2])
    stamps = [r.header.stamp.sec * 10**9 + r.header.stamp.nanosec for r in rows]
    assert stamps == [EPOCH_NS + k * STEP_NS for k in range(len(data))]
    assert tuple(rows[0].name) == NAMES
    assert topics["/odom"] == "nav_msgs/msg/Odometry"


def test_the_file_explains_itself_to_any_mcap_reader(tmp_path: Path) -> None:
    robot = load_robot("snake13")
    facts = {"operator": "a person"}
    write_session(tmp_path / "s.mcap", robot=robot, clock={"twin": "simulated"}, metadata=facts)
    with (tmp_path / "s.mcap").open("rb") as stream:
        reader = make_reader(stream)
        assert reader.get_header().profile == "ros2"
        metadata = {record.name: record.metadata for record in reader.iter_metadata()}
        attached = {record.name: record.data for record in reader.iter_attachments()}
        units = {
            channel.topic: channel.metadata.get("unit")
            for channel in reader.get_summary().channels.values()
        }
    assert metadata["undulog"]["session_id"] == "s1"
    assert metadata["undulog"]["operator"] == "a person"
    assert metadata["undulog"]["clock.twin"] == "simulated"
    assert metadata["undulog.health"]["verdict"] == "good"
    assert attached["robot.toml"].decode() == robot.toml
    assert units["/joint_states"] == "rad"


def test_the_other_channels_read_back_elsewhere(tmp_path: Path) -> None:
    path = tmp_path / "s.mcap"
    pose = np.array([[1.0, 2.0, 3.00001], [4.0, 5.0, 6.0]])
    turn = np.array([[0.0, 0.0, 0.0, 1.0], [0.5, 0.5, 0.5, 0.5]])
    with SessionWriter(path, session_id="s", epoch_ns=EPOCH_NS) as writer:
        writer.transforms("/tf", parent="world", children=["a", "b"]).write(EPOCH_NS, pose, turn)
        ir = writer.range("/ir/01", frame="a", min_range=0.2, max_range=1.5, field_of_view=0.1)
        ir.write(EPOCH_NS, 0.75)
        writer.imu("/imu", frame="a").write(EPOCH_NS, np.array([0.1, 0.2, 9.8]))
        writer.magnetic_field("/compass", frame="a").write(EPOCH_NS, np.array([2e-5, 0, -4e-5]))
    found = {}
    with path.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        for _, channel, _, message in reader.iter_decoded_messages():
            found[channel.topic] = message
    assert [t.child_frame_id for t in found["/tf"].transforms] == ["a", "b"]
    assert abs(found["/tf"].transforms[0].transform.translation.z - 3.00001) <= 2**-15
    assert found["/tf"].transforms[1].transform.rotation.w == 0.5
    assert found["/ir/01"].range == 0.75
    assert found["/imu"].linear_acceleration.z == 9.8
    assert found["/imu"].orientation_covariance[0] == -1.0
    assert found["/imu"].angular_velocity_covariance[0] == -1.0
    assert found["/compass"].magnetic_field.z == -4e-5


def test_an_existing_file_stays_unless_forced(tmp_path: Path) -> None:
    path = tmp_path / "s.mcap"
    path.write_bytes(b"precious")
    with pytest.raises(OutputExistsError, match="--force"):
        SessionWriter(path, session_id="s", epoch_ns=EPOCH_NS)
    assert path.read_bytes() == b"precious"
    write_session(path, 3, force=True)
    assert Session.open(path).channels["/joint_states"].count == 3


def test_a_block_left_by_an_exception_leaves_a_whole_file(tmp_path: Path) -> None:
    path = tmp_path / "s.mcap"

    def record_and_fail() -> None:
        with SessionWriter(path, session_id="s", epoch_ns=EPOCH_NS) as writer:
            writer.joint_state("/joint_commands", NAMES, unit="rad").write(EPOCH_NS, [1, 2, 3])
            raise RuntimeError("robot fell")

    with pytest.raises(RuntimeError, match="robot fell"):
        record_and_fail()
    with Session.open(path) as session:
        assert session.joints("/joint_commands").values[2].tolist() == [3.0]
        assert session.warnings == []


def test_a_full_disk_is_an_error_that_names_the_file() -> None:
    with pytest.raises(LogWriteError, match="/dev/full: can't be written: No space left"):
        write_session(Path("/dev/full"), 3000, force=True)


def test_a_topic_has_one_channel_and_a_shape(tmp_path: Path) -> None:
    with SessionWriter(tmp_path / "s.mcap", session_id="s", epoch_ns=EPOCH_NS) as writer:
        channel = writer.joint_state("/joint_commands", NAMES, unit="rad")
        with pytest.raises(DataError, match="open already"):
            writer.joint_state("/joint_commands", NAMES, unit="rad")
        with pytest.raises(ValueError, match="broadcast"):
            channel.write(EPOCH_NS, [1.0, 2.0])
    with pytest.raises(LogWriteError, match="the session is closed"):
        channel.write(EPOCH_NS, [1.0, 2.0, 3.0])


# -- reading our own ---------------------------------------------------------------------------


def test_columns_come_back_bit_for_bit(tmp_path: Path) -> None:
    data = write_session(tmp_path / "s.mcap", 3000)  # several chunks
    with Session.open(tmp_path / "s.mcap") as session:
        for k, field in enumerate(("position", "velocity", "effort")):
            signals = session.joints("/joint_states", field)
            np.testing.assert_array_equal(np.array(signals.values).T, data[:, k])
            assert signals.names == NAMES
        assert session.joints("/joint_states", "effort").unit == "N m"
        assert session.duration_s == pytest.approx(29.99)
        assert session.verdict == "good"
        assert session.warnings == []


def test_a_window_is_half_open(tmp_path: Path) -> None:
    data = write_session(tmp_path / "s.mcap", 3000)
    start, stop = EPOCH_NS + 1000 * STEP_NS, EPOCH_NS + 1500 * STEP_NS
    with Session.open(tmp_path / "s.mcap") as session:
        signals = session.joints("/joint_states", start_ns=start, stop_ns=stop)
    assert signals.t_ns[0][0] == start
    assert signals.t_ns[0][-1] == stop - STEP_NS
    np.testing.assert_array_equal(np.array(signals.values).T, data[1000:1500, 0])


def test_tables_events_and_messages(tmp_path: Path) -> None:
    data = write_session(tmp_path / "s.mcap")
    with Session.open(tmp_path / "s.mcap") as session:
        odometry = session.table("/odom")
        np.testing.assert_array_equal(odometry["pose.pose.position.y"], data[:, 0, 1])
        assert odometry.index[1] == EPOCH_NS + STEP_NS
        assert session.table("/gait/mode")["data"].tolist() == ["walk"]
        (_, event), *_ = session.messages("/rosout")
        assert (event.level, event.msg) == (30, "clamped")


def test_a_long_frame_has_one_row_a_sample(tmp_path: Path) -> None:
    data = write_session(tmp_path / "s.mcap", 5)
    with Session.open(tmp_path / "s.mcap") as session:
        frame = session.joints("/joint_states", "velocity").frame()
    second = frame[frame["joint"] == "joint02"]
    np.testing.assert_array_equal(second["velocity [rad/s]"], data[:, 1, 1])


def test_frames_come_back_bit_for_bit(tmp_path: Path) -> None:
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
    with Session.open(tmp_path / "s.mcap") as session:
        assert session.frames("/can/can0").tobytes() == frames.tobytes()


def test_each_joint_gets_its_own_sampling_time(tmp_path: Path) -> None:
    path = tmp_path / "s.mcap"
    with SessionWriter(path, session_id="s", epoch_ns=EPOCH_NS) as writer:
        states = writer.joint_state("/joint_states", NAMES, unit="rad")
        offsets = writer.joint_state("/joint_sample_offset", NAMES, unit="s")
        commands = writer.joint_state("/joint_commands", NAMES, unit="rad")
        for tick in range(10):
            t_ns = EPOCH_NS + tick * STEP_NS
            states.write(t_ns, [1, 2, 3])
            commands.write(t_ns, [1, 2, 3])
            offsets.write(t_ns, [0.0, 0.005, 0.001 * tick])
    with Session.open(path) as session:
        signals = session.joints("/joint_states")
        base = EPOCH_NS + np.arange(10) * STEP_NS
        np.testing.assert_array_equal(signals.t_ns[0], base)
        np.testing.assert_array_equal(signals.t_ns[1], base + 5_000_000)
        np.testing.assert_array_equal(signals.t_ns[2], base + np.arange(10) * 1_000_000)
        np.testing.assert_array_equal(session.joints("/joint_commands").t_ns[1], base)


def test_joints_come_in_chain_order(tmp_path: Path) -> None:
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


# -- reading logs of other makes ---------------------------------------------------------------


def test_one_message_per_servo_is_read_right(tmp_path: Path) -> None:
    data = samples(200)
    messages = []
    for tick in range(200):
        for j, name in enumerate(NAMES):
            t_ns = EPOCH_NS + tick * STEP_NS + j * 1_000_000
            values = [float(data[tick, 0, j])]
            messages.append(("/joint_states", t_ns, joint_state(t_ns, [name], values)))
    write_foreign(tmp_path / "f.mcap", messages)
    with Session.open(tmp_path / "f.mcap") as session:
        signals = session.joints("/joint_states")
        assert signals.names == NAMES
        for j in range(3):
            np.testing.assert_array_equal(signals.values[j], data[:, 0, j])
            expected = EPOCH_NS + np.arange(200) * STEP_NS + j * 1_000_000
            np.testing.assert_array_equal(signals.t_ns[j], expected)
        assert session.warnings == []


def test_a_changed_joint_set_is_told_and_read(tmp_path: Path) -> None:
    messages = []
    for tick in range(100):
        t_ns = EPOCH_NS + tick * STEP_NS
        names = ["a", "b"] if tick < 50 else ["a", "c"]
        messages.append(("/joint_states", t_ns, joint_state(t_ns, names, [float(tick), 1.0])))
    write_foreign(tmp_path / "f.mcap", messages)
    with Session.open(tmp_path / "f.mcap") as session:
        signals = session.joints("/joint_states")
        assert [len(t) for t in signals.t_ns] == [100, 50, 50]
        np.testing.assert_array_equal(signals.values[0], np.arange(100.0))
        assert any("set of joints changes" in w and "b, c" in w for w in session.warnings)


def test_duplicate_and_backward_stamps_are_told(tmp_path: Path) -> None:
    ticks = [0, 1, 2, 2, 4, 3, 5]
    messages = [
        (
            "/joint_states",
            EPOCH_NS + k * STEP_NS,
            joint_state(EPOCH_NS + tick * STEP_NS, ["a"], [float(tick)]),
        )
        for k, tick in enumerate(ticks)
    ]
    write_foreign(tmp_path / "f.mcap", messages)
    with Session.open(tmp_path / "f.mcap") as session:
        signals = session.joints("/joint_states")
        assert signals.values[0].tolist() == [0, 1, 2, 2, 3, 4, 5]
        text = " ".join(session.warnings)
    assert "1 samples go back in time" in text
    assert "1 samples repeat the stamp" in text


def test_a_field_that_is_never_filled_is_missing_not_zero(tmp_path: Path) -> None:
    messages = [("/joint_states", EPOCH_NS, joint_state(EPOCH_NS, ["a"], [1.0], velocity=[]))]
    write_foreign(tmp_path / "f.mcap", messages)
    with (
        Session.open(tmp_path / "f.mcap") as session,
        pytest.raises(
            MissingChannelError, match=r"has no effort in /joint_states; it has position"
        ),
    ):
        session.joints("/joint_states", "effort")


def test_values_that_do_not_match_the_names_are_left_out_with_a_warning(tmp_path: Path) -> None:
    messages = [
        ("/joint_states", EPOCH_NS, joint_state(EPOCH_NS, ["a", "b"], [1.0])),
        ("/joint_states", EPOCH_NS + 1, joint_state(EPOCH_NS + 1, ["a", "b"], [1.0, 2.0])),
    ]
    write_foreign(tmp_path / "f.mcap", messages)
    with Session.open(tmp_path / "f.mcap") as session:
        assert session.joints("/joint_states").values[1].tolist() == [2.0]
        assert "2 names but 1 values of position" in session.warnings[0]


def test_nan_samples_are_kept(tmp_path: Path) -> None:
    messages = [("/joint_states", EPOCH_NS, joint_state(EPOCH_NS, ["a"], [float("nan")]))]
    write_foreign(tmp_path / "f.mcap", messages)
    with Session.open(tmp_path / "f.mcap") as session:
        assert np.isnan(session.joints("/joint_states").values[0]).all()


def test_zero_stamps_fall_back_to_log_times(tmp_path: Path) -> None:
    messages = [
        ("/joint_states", EPOCH_NS + k, joint_state(0, ["a"], [float(k)])) for k in range(3)
    ]
    write_foreign(tmp_path / "f.mcap", messages)
    with Session.open(tmp_path / "f.mcap") as session:
        assert session.joints("/joint_states").t_ns[0].tolist() == [EPOCH_NS + k for k in range(3)]
        assert "header stamps are zero" in session.warnings[0]


def test_simulated_time_is_shifted_to_the_log_clock(tmp_path: Path) -> None:
    messages = [
        (
            topic,
            EPOCH_NS + k * STEP_NS,
            joint_state(5_000_000_000 + k * STEP_NS, ["a"], [float(k)]),
        )
        for k in range(50)
        for topic in ("/joint_states", "/joint_commands")
    ]
    write_foreign(tmp_path / "f.mcap", messages)
    with Session.open(tmp_path / "f.mcap") as session:
        states = session.joints("/joint_states", start_ns=EPOCH_NS, stop_ns=EPOCH_NS + 10**9)
        commands = session.joints("/joint_commands")
        assert len(states.t_ns[0]) == 50
        np.testing.assert_array_equal(states.t_ns[0], commands.t_ns[0])
        np.testing.assert_array_equal(session.table("/joint_states").index, commands.t_ns[0])
        assert "another clock" in session.warnings[0]


@pytest.mark.parametrize(
    ("options", "warned"),
    [
        ({"compression": CompressionType.LZ4}, False),
        ({"compression": CompressionType.NONE}, False),
        ({"use_chunking": False}, True),
        ({"index_types": IndexType.NONE}, True),
        ({"index_types": IndexType.CHUNK}, False),
        ({"repeat_channels": False}, True),
        ({"use_statistics": False}, True),
    ],
)
def test_any_kind_of_mcap_reads_the_same(tmp_path: Path, options: dict, warned: bool) -> None:
    kind = message_type(JOINT_STATE)
    data = samples(500)
    with (tmp_path / "f.mcap").open("wb") as stream:
        writer = McapWriter(stream, chunk_size=20_000, **options)
        writer.start(profile="ros2")
        schema = writer.register_schema(JOINT_STATE, "ros2msg", schema_text(JOINT_STATE).encode())
        channel = writer.register_channel("/joint_states", "cdr", schema)
        for tick, row in enumerate(data):
            t_ns = EPOCH_NS + tick * STEP_NS
            message = encode(kind, joint_state(t_ns, list(NAMES), row[0].tolist()))
            writer.add_message(channel, t_ns, message, t_ns)
        writer.finish()
    with Session.open(tmp_path / "f.mcap") as session:
        signals = session.joints("/joint_states")
        np.testing.assert_array_equal(np.array(signals.values).T, data[:, 0])
        assert session.channels["/joint_states"].count == 500
        assert bool(session.warnings) == warned


def test_undefined_padding_of_a_foreign_writer_does_no_harm(tmp_path: Path) -> None:
    kind = message_type(JOINT_STATE)
    plain = encode(kind, joint_state(EPOCH_NS, ["ab"], [1.5]))
    padding_at = 4 + 8 + 4 + 1  # header, stamp, length of frame_id, its terminating zero
    assert plain[padding_at : padding_at + 3] == bytes(3)
    with (tmp_path / "f.mcap").open("wb") as stream:
        writer = McapWriter(stream)
        writer.start(profile="ros2")
        schema = writer.register_schema(JOINT_STATE, "ros2msg", schema_text(JOINT_STATE).encode())
        channel = writer.register_channel("/joint_states", "cdr", schema)
        for k in range(20):
            message = bytearray(plain)
            message[padding_at] = k
            writer.add_message(channel, EPOCH_NS + k, bytes(message), EPOCH_NS + k)
        writer.finish()
    decoded = DecoderFactory().decoder_for("cdr", _schema_record())
    assert list(decoded(bytes(message)).position) == [1.5]
    with Session.open(tmp_path / "f.mcap") as session:
        assert session.joints("/joint_states").values[0].tolist() == [1.5] * 20


def _schema_record() -> object:
    from mcap.records import Schema

    return Schema(
        id=1, name=JOINT_STATE, encoding="ros2msg", data=schema_text(JOINT_STATE).encode()
    )


# -- bad input ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("content", "complaint"),
    [
        (b"", "the file is empty"),
        (b"hello world", "not an MCAP file"),
        (b"\x89MCAP0\r\n", "without any channel"),
    ],
)
def test_what_is_no_log_is_refused_in_words(tmp_path: Path, content: bytes, complaint: str) -> None:
    (tmp_path / "x.mcap").write_bytes(content)
    with pytest.raises(NotALogError, match=complaint):
        Session.open(tmp_path / "x.mcap")


def test_a_missing_file_and_a_folder_are_log_errors(tmp_path: Path) -> None:
    with pytest.raises(LogError, match="no such file"):
        Session.open(tmp_path / "none.mcap")
    with pytest.raises(LogError, match=r"no session .* is in this folder"):
        Session.open(tmp_path)


def test_a_missing_topic_lists_those_there(tmp_path: Path) -> None:
    write_session(tmp_path / "s.mcap", 3)
    with (
        Session.open(tmp_path / "s.mcap") as session,
        pytest.raises(MissingChannelError, match="has no /joint_torque; it has /gait/mode"),
    ):
        session.joints("/joint_torque")


def test_a_cut_file_keeps_every_whole_message_before_the_cut(tmp_path: Path) -> None:
    data = write_session(tmp_path / "s.mcap", 6000)
    whole = (tmp_path / "s.mcap").read_bytes()
    previous = 0
    for part in (0.3, 0.5, 0.7, 0.9, 0.999):
        (tmp_path / "cut.mcap").write_bytes(whole[: int(len(whole) * part)])
        with Session.open(tmp_path / "cut.mcap") as session:
            values = np.array(session.joints("/joint_states").values).T
            assert any("cut short" in warning for warning in session.warnings)
        np.testing.assert_array_equal(values, data[: len(values), 0])
        assert len(values) > previous
        previous = len(values)
    assert previous > 5900


def test_a_flipped_bit_in_a_chunk_is_told_and_only_that_chunk_is_missing(tmp_path: Path) -> None:
    write_session(tmp_path / "s.mcap", 6000)
    damaged = bytearray((tmp_path / "s.mcap").read_bytes())
    damaged[len(damaged) // 2] ^= 0x10
    (tmp_path / "d.mcap").write_bytes(damaged)
    with Session.open(tmp_path / "d.mcap") as session:
        count = len(session.joints("/joint_states").t_ns[0])
        assert any("its messages are missing" in warning for warning in session.warnings)
    assert 3000 < count < 6000


def mutations(whole: bytes) -> list[bytes]:
    rng = np.random.default_rng(11)
    mutated = []
    for k in range(400):
        data = bytearray(whole)
        for _ in range(int(rng.integers(1, 8))):
            at = int(rng.integers(0, len(data)))
            data[at] = int(rng.integers(0, 256))
        if k % 3 == 0:
            del data[int(rng.integers(8, len(data))) :]
        if k % 5 == 0:  # a length field that claims very much
            at = int(rng.integers(0, max(len(data) - 8, 1)))
            data[at : at + 8] = b"\xff\xff\xff\xff\xff\xff\xff\x7f"
        mutated.append(bytes(data))
    return mutated


def test_mutated_files_never_end_in_a_traceback(tmp_path: Path) -> None:
    write_session(tmp_path / "s.mcap", 40, robot=load_robot("snake13"))
    read: list[Callable[[Session], object]] = [
        lambda s: s.joints("/joint_states"),
        lambda s: s.table("/odom"),
        lambda s: s.table("/rosout"),
        lambda s: list(s.messages("/gait/mode")),
    ]
    opened = 0
    for data in mutations((tmp_path / "s.mcap").read_bytes()):
        (tmp_path / "m.mcap").write_bytes(data)
        try:
            with Session.open(tmp_path / "m.mcap") as session:
                opened += 1
                for each in read:
                    try:
                        each(session)
                    except (LogError, DataError):
                        continue
        except (LogError, DataError):
            continue
    assert opened > 100
