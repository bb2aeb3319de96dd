"""TUM trajectories: read by numpy and decimal, held against the poses that were written."""

from decimal import Decimal

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap_ros2.writer import Writer as RosWriter
from scipy.spatial.transform import Rotation

from support.written_sessions import write_foreign, write_session
from undulog.capture import SessionWriter
from undulog.capture.common.errors import DataError, MissingChannelError, UsageError
from undulog.capture.exchange.formats.tum import export_tum
from undulog.capture.log.messages.definitions import schema_text

T0 = 1_700_000_000 * 10**9
TF = "tf2_msgs/msg/TFMessage"


def poses(count, seed=0):
    rng = np.random.default_rng(seed)
    turns = Rotation.random(count, random_state=seed).as_quat()
    return rng.normal(size=(count, 3)), turns


def read(path):
    """Return the comments, the times [ns] and the numbers of a trajectory."""
    lines = path.read_text().splitlines()
    comments = [line for line in lines if line.startswith("#")]
    times = [int(Decimal(line.split()[0]) * 10**9) for line in lines if not line.startswith("#")]
    table = np.loadtxt(path, ndmin=2)
    assert table.shape == (len(times), 8)
    return comments, times, table[:, 1:]


def write_odometry(path, times, positions, turns, child="base"):
    with SessionWriter(path, session_id="s", epoch_ns=T0) as writer:
        channel = writer.odometry("/odom", frame="map", child=child)
        for t_ns, position, turn in zip(times, positions, turns, strict=True):
            channel.write(t_ns, position, turn, [0, 0, 0], [0, 0, 0])
    return path


def test_the_base_of_a_session(tmp_path, report_of):
    positions, turns = poses(50)
    times = [T0 + k * 10_000_001 for k in range(50)]
    write_odometry(tmp_path / "run.mcap", times, positions, turns)
    line = ("log", "export", tmp_path / "run.mcap", "--to", "tum", "-o", tmp_path / "base.tum")
    report = report_of(*line)
    assert [report[key] for key in ("poses", "frame", "parent")] == [50, "base", "map"]
    comments, stamps, numbers = read(tmp_path / "base.tum")
    assert comments == ["# pose of base in map, from /odom", "# timestamp tx ty tz qx qy qz qw"]
    assert stamps == times
    np.testing.assert_array_equal(numbers, np.hstack([positions, turns]))  # bit for bit


@pytest.mark.slow
@given(st.lists(st.floats(allow_nan=False, allow_infinity=False), min_size=3, max_size=3))
def test_numbers_come_back_bit_for_bit(tmp_path_factory, position):
    folder = tmp_path_factory.mktemp("tum")
    write_odometry(folder / "run.mcap", [T0 + 1], [position], [[0, 0, 0, 1]])
    export_tum(folder / "run.mcap", folder / "x.txt")
    _, times, numbers = read(folder / "x.txt")
    assert times == [T0 + 1]
    assert numbers[0].tobytes() == np.array([*position, 0, 0, 0, 1.0]).tobytes()


def test_what_is_no_pose_is_left_out_and_times_are_sorted(tmp_path):
    positions, turns = poses(4)
    positions[1, 2], turns[2] = np.nan, 0.0
    times = [T0 + 9, T0, T0, T0 + 5]
    write_odometry(tmp_path / "run.mcap", times, positions, turns)
    report = export_tum(tmp_path / "run.mcap", tmp_path / "x.tum")
    assert report.warnings[-1].startswith("2 poses left out: not finite, or")
    _, stamps, numbers = read(tmp_path / "x.tum")
    assert stamps == [T0 + 5, T0 + 9]
    np.testing.assert_array_equal(numbers[:, :3], positions[[3, 0]])


def test_a_stamped_pose_has_the_name_of_its_topic(tmp_path):
    pose = {"position": {"x": 1.5}, "orientation": {"w": 1.0}}
    stamp = {"sec": T0 // 10**9, "nanosec": 7}
    message = {"header": {"stamp": stamp, "frame_id": "map"}, "pose": pose}
    kind = "geometry_msgs/msg/PoseStamped"
    text = schema_text("nav_msgs/msg/Odometry")  # of the definitions the pose is one
    with (tmp_path / "run.mcap").open("wb") as stream:
        writer = RosWriter(stream)
        fields = "std_msgs/Header header\ngeometry_msgs/Pose pose\n"
        schema = writer.register_msgdef(kind, fields + text[text.index("=" * 80) :])
        writer.write_message("/mocap", schema, message, log_time=T0, publish_time=T0)
        writer.finish()
    report = export_tum(tmp_path / "run.mcap", tmp_path / "x.tum")
    assert (report.facts["frame"], report.facts["parent"]) == ("/mocap", "map")
    assert read(tmp_path / "x.tum")[1] == [T0 + 7]


def transform(t_ns, parent, child, position, turn):
    stamp = {"sec": t_ns // 10**9, "nanosec": t_ns % 10**9}
    return {
        "header": {"stamp": stamp, "frame_id": parent},
        "child_frame_id": child,
        "transform": {
            "translation": dict(zip("xyz", position, strict=True)),
            "rotation": dict(zip("xyzw", turn, strict=True)),
        },
    }


def test_a_link_of_transforms_that_change_from_message_to_message(tmp_path, command):
    positions, turns = poses(40, seed=3)
    messages = []
    for k in range(40):
        t_ns = T0 + k * 1_000
        transforms = [transform(t_ns, "base", f"link{k % 2}", positions[k], turns[k])]
        if k % 3 == 0:
            transforms.insert(0, transform(t_ns, "map", "base", positions[k], turns[k]))
        messages.append(("/tf", t_ns + 77, {"transforms": transforms}))
    write_foreign(tmp_path / "run.mcap", messages, TF)
    report = export_tum(tmp_path / "run.mcap", tmp_path / "x.tum", frame="link1")
    assert (report.facts["parent"], report.facts["topic"]) == ("base", "/tf")
    _, times, numbers = read(tmp_path / "x.tum")
    assert times == [T0 + k * 1_000 for k in range(1, 40, 2)]
    np.testing.assert_array_equal(numbers, np.hstack([positions, turns])[1::2])
    with pytest.raises(DataError, match=r"no Odometry, so name one .* base, link0, link1"):
        export_tum(tmp_path / "run.mcap", tmp_path / "y.tum")
    line = ("log", "export", tmp_path / "run.mcap", "--to", "tum", "-o", tmp_path / "y.tum")
    assert "has no frame 'arm'; it has base, link0" in command(*line, "--frame", "arm", code=1).err


def test_what_has_no_trajectory_is_refused(tmp_path):
    with SessionWriter(tmp_path / "run.mcap", session_id="s", epoch_ns=T0) as writer:
        writer.string("/gait/mode").write(T0, "walk")
    with pytest.raises(MissingChannelError, match="has no poses; it has /gait/mode"):
        export_tum(tmp_path / "run.mcap", tmp_path / "x.tum")
    write_session(tmp_path / "odom.mcap")
    with pytest.raises(UsageError, match=r"end the name of a trajectory in \.tum or \.txt"):
        export_tum(tmp_path / "odom.mcap", tmp_path / "x.csv")
    assert export_tum(tmp_path / "odom.mcap", tmp_path / "x.tum").facts["frame"] == "link01"
