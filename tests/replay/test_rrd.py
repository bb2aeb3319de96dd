"""Recordings read back with Rerun's own reader hold the session's columns, under their names."""

import numpy as np
import pytest

from support.written_topics import EPOCH_NS as START
from support.written_topics import write_topics
from undulog.capture import Session
from undulog.capture.common.errors import DataError, LogWriteError
from undulog.capture.common.palette import joint_colors
from undulog.replay.draw.body import ROUNDING
from undulog.replay.recording import recording_id, write_recording


def converted(file, path, **options):
    """Convert a session; what was reported."""
    with Session.open(file) as session:
        return write_recording(session, path, **options)


@pytest.fixture
def made(write, tmp_path, read_back):
    """Writes and converts the session without some parts: report, file."""

    def make(**parts):
        written = converted(write(tmp_path / "a.mcap", **parts), tmp_path / "a.rrd")
        return written, read_back(written.path)

    return make


def rows(column):
    """Rows of equal length as an array."""
    return np.array(column, dtype=float)


def assert_drawn(shown, truth):
    """Lines are rounded by at most a thousandth of their range, and to 32 bits."""
    assert shown.shape == truth.shape
    np.testing.assert_array_equal(np.isnan(shown), np.isnan(truth))
    room = np.nanmax(truth, axis=0) - np.nanmin(truth, axis=0)
    apart = np.nanmax(np.abs(shown - truth), axis=0)
    assert (apart <= 1e-3 * room + 1e-7 * np.nanmax(np.abs(truth))).all()


def test_all_entities_are_there_by_name(recording):
    below = {
        "/world": ("snake/measured", "snake/commanded", "snake/places", "trail"),
        "/joints": ("measured", "commanded", "error", "places/measured", "places/commanded"),
        "/power": ("mechanical", "total/mechanical", "total/electrical"),
        "": ("signals/joint_current", "segments/lag_degrees/estimate/joint01"),
    }
    entities = {f"{root}/{name}" for root, names in below.items() for name in names}
    assert recording[1].entities >= entities | {"/gait/mode", "/events", "/session"}


def test_what_is_drawn_follows_from_the_columns(recording, truth):
    _, recorded = recording
    power = truth.effort * truth.velocity
    for entity, values in {
        "/joints/measured": np.degrees(truth.position),
        "/joints/commanded": np.degrees(truth.command),
        "/joints/error": np.degrees(truth.position - truth.command),
        "/joints/places/measured": np.degrees(truth.position[:, [0, 12, 24]]),
        "/power/mechanical": power,
        "/power/total/mechanical": power.sum(axis=1, keepdims=True),
        "/power/total/electrical": 6.0 * truth.effort.sum(axis=1, keepdims=True),
        "/signals/joint_current": truth.effort,  # in its own unit
    }.items():
        is_angle = entity.startswith("/joints") and "places" not in entity
        component = "Angle:degrees" if is_angle else "Scalars:scalars"
        assert_drawn(rows(recorded.column(entity, component)), values)
        np.testing.assert_array_equal(recorded.times(entity), truth.t_ns - START)
    names = ["joint01 head", "joint13 middle", "joint25 tail"]
    assert recorded.static("/joints/places/measured", "SeriesLines:names") == names
    assert recorded.static("/joints/places/measured", "SeriesLines:widths") == [2.0, 2.0, 2.0]
    cycles = recorded.times("/joints/measured", "gait_cycle") / 1e9
    np.testing.assert_allclose(cycles, truth.phase / (2 * np.pi), atol=1e-9)


def test_joints_are_named_and_keep_their_colours(recording, snake25):
    _, recorded = recording
    assert recorded.static("/joints/measured", "SeriesLines:names") == list(snake25.joint_names)
    packed = joint_colors(25).astype(int) @ [1 << 24, 1 << 16, 1 << 8, 1]
    assert recorded.static("/joints/measured", "SeriesLines:colors") == packed.tolist()
    assert set(recorded.static("/joints/commanded", "SeriesLines:colors")) == {0x8C8C8CFF}


def test_the_body_is_drawn_at_50_hz_where_the_head_was(recording, truth, snake25):
    _, recorded = recording
    origin = rows(recorded.column("/world/snake/measured", "Capsules3D:translations"))
    assert origin.shape == (150, 26, 3)
    np.testing.assert_array_equal(
        recorded.times("/world/snake/measured"), (truth.t_ns - START)[::2]
    )
    length = recorded.column("/world/snake/measured", "Capsules3D:lengths")[0][0]
    # The head looks along x, so its capsule starts half its length behind its centre.
    expected = truth.head[::2] - [length / 2, 0.0, 0.0]
    np.testing.assert_allclose(origin[:, 0], expected, atol=ROUNDING / 2 + 1e-9)


def test_mode_and_events_are_as_logged(recording):
    _, recorded = recording
    assert recorded.column("/gait/mode", "StateChange:state") == [["walk"], ["avoid"]]
    assert recorded.times("/gait/mode").tolist() == [0, 1_000_000_000]
    assert recorded.column("/events", "TextLog:text") == [["drive: start"], ["drive: wall ahead"]]
    assert recorded.column("/events", "TextLog:level") == [["INFO"], ["ERROR"]]
    assert recorded.times("/events").tolist() == [5, 1_000_000_000]


def test_the_facts_begin_with_the_answer(recording, analysis):
    text = recording[1].static("/session", "TextDocument:text")[0]
    assert text.startswith(f"**{analysis.answer.sentence}**")
    for fact in ("made-for-tests", "snake25, 25 joints", "2025-01-01", "head-to-tail", "good"):
        assert fact in text


def test_the_same_session_gives_the_same_recording(
    recording, session_file, analysis, tmp_path, rerun_command
):
    again = converted(session_file, tmp_path / "again.rrd", analysis=analysis)
    assert again.recording_id == recording[0].recording_id == recording_id("made-for-tests")
    assert recording[1].stores == [("undulog", again.recording_id)]
    rerun_command("rrd", "compare", recording[0].path, again.path)
    rerun_command("rrd", "verify", again.path)


def test_a_recording_is_replaced_by_a_whole_one_only(session_file, tmp_path):
    path = tmp_path / "made.rrd"
    path.write_bytes(b"the former one")

    def fail(_content):
        raise RuntimeError("no layout")

    with pytest.raises(RuntimeError, match="no layout"):
        converted(session_file, path, layout=fail)
    assert (path.read_bytes(), list(tmp_path.iterdir())) == (b"the former one", [path])


def test_a_folder_that_is_not_there_is_an_error(session_file, tmp_path):
    with pytest.raises(LogWriteError, match="can't be written"):
        converted(session_file, tmp_path / "nowhere" / "made.rrd")


@pytest.mark.filterwarnings("ignore:RRD file has no footer")
def test_a_full_disk_is_an_error_and_leaves_nothing(session_file, disk_of):
    disk = disk_of("64k")
    with pytest.raises(LogWriteError, match="can't be written"):
        converted(session_file, disk / "run.rrd")
    assert list(disk.iterdir()) == []


def test_a_file_cut_short_by_a_full_disk_is_an_error(session_file, tmp_path, monkeypatch):
    import rerun as rr

    whole = rr.RecordingStream.disconnect

    def cut(self):
        whole(self)
        for draft in tmp_path.glob("*.part"):
            draft.write_bytes(draft.read_bytes()[:-4000])

    monkeypatch.setattr(rr.RecordingStream, "disconnect", cut)
    with pytest.raises(LogWriteError, match="couldn't be written whole"):
        converted(session_file, tmp_path / "made.rrd")
    assert list(tmp_path.iterdir()) == []


def test_lost_samples_stay_holes(made, truth):
    position = truth.position.copy()
    position[100:110, 6] = np.nan
    _, recorded = made(position=position)
    assert_drawn(rows(recorded.column("/joints/measured", "Angle:degrees")), np.degrees(position))
    links = [
        len(row) for row in recorded.column("/world/snake/measured", "Capsules3D:translations")
    ]
    assert links == [7 if 50 <= i < 55 else 26 for i in range(150)]


def test_a_pause_is_not_bridged(made, truth):
    keep = (truth.t < 1.0) | (truth.t >= 2.0)
    _, recorded = made(keep=keep)
    measured = rows(recorded.column("/joints/measured", "Angle:degrees"))
    assert measured.shape == (201, 25)
    assert np.isnan(measured[100]).all()
    assert_drawn(np.delete(measured, 100, axis=0), np.degrees(truth.position[keep]))
    assert recorded.times("/joints/measured")[100] == 1_000_000_000
    body = recorded.column("/world/snake/measured", "Capsules3D:translations")
    assert [i for i, row in enumerate(body) if not row] == [50]
    trail = recorded.times("/world/trail")
    assert not ((trail > 1_000_000_000) & (trail <= 2_000_000_000)).any()


def test_without_odometry_the_head_stays_at_the_origin(made):
    written, recorded = made(odometry=False)
    assert "no /odom in the session: the head is held at the origin" in written.warnings
    origin = rows(recorded.column("/world/snake/measured", "Capsules3D:translations"))
    assert (origin[:, 0] == origin[0, 0]).all()
    assert "/world/trail" not in recorded.entities


def test_without_a_robot_and_a_gait_there_are_plots_on_one_timeline(made, truth):
    written, recorded = made(robot=False, gait=False)
    assert any("no robot description" in warning for warning in written.warnings)
    assert not [entity for entity in recorded.entities if entity.startswith("/world")]
    shown = rows(recorded.column("/joints/measured", "Angle:degrees"))
    assert_drawn(shown, np.degrees(truth.position))
    assert recorded.times("/joints/measured", "gait_cycle").size == 0
    assert "/events" not in recorded.entities


def test_without_torques_the_body_wears_the_colours_of_its_joints(made):
    written, recorded = made(effort=False)
    assert written.content.power_limit_w is None
    packed = joint_colors(26).astype(int) @ [1 << 24, 1 << 16, 1 << 8, 1]
    assert recorded.column("/world/snake/measured", "Capsules3D:colors")[0] == packed.tolist()
    assert "/power/mechanical" not in recorded.entities


def test_servos_polled_in_turn_are_drawn_where_they_were_at_the_first_ones_times(
    snake25, read_back, tmp_path
):
    names = snake25.joint_names
    offset = 2.5e-4 * np.arange(25)
    t = START + np.arange(50, dtype=np.int64) * 10_000_000
    topics = {
        "/joint_states": (names, "rad", (t - START)[:, None] * 1e-9 + offset),
        "/joint_sample_offset": (names, "s", np.tile(offset, (50, 1))),
    }
    write_topics(tmp_path / "a.mcap", t, topics, robot=snake25)
    back = read_back(converted(tmp_path / "a.mcap", tmp_path / "a.rrd").path)
    np.testing.assert_array_equal(back.times("/joints/measured"), t - START)
    shown = np.radians(rows(back.column("/joints/measured", "Angle:degrees")))
    assert np.isnan(shown[0, 1:]).all()  # none of them was sampled before
    assert_drawn(shown[1:], np.broadcast_to((t - START)[1:, None] * 1e-9, (49, 25)))


def test_a_foreign_bag_with_a_message_a_servo_shows_every_servo(read_back, tmp_path):
    t = START + np.arange(60, dtype=np.int64) * 10_000_000
    i = np.arange(60.0)
    angles = np.stack([np.where(i % 2, np.nan, i), np.where(i % 2, i, np.nan)], axis=1)
    topics = {
        "/joint_states": (["left", "right"], "rad", angles),
        "/gripper/state": (["finger"], "m", np.full((60, 1), 0.01)),
    }
    write_topics(tmp_path / "a.mcap", t, topics, session_id="")
    written = converted(tmp_path / "a.mcap", tmp_path / "a.rrd")
    back = read_back(written.path)
    right = rows(back.column("/joints/measured/right", "Angle:degrees"))
    assert_drawn(np.radians(right), np.arange(1.0, 60.0, 2.0)[:, None])
    assert len(back.column("/signals/gripper/state", "Scalars:scalars")) == 60
    assert [signal.title for signal in written.content.signals] == ["gripper/state [m]"]


def test_a_session_without_messages_is_an_error(tmp_path):
    write_topics(tmp_path / "a.mcap", [], {"/joint_states": (["a"], "rad", np.zeros((0, 1)))})
    with pytest.raises(DataError, match="no messages"):
        converted(tmp_path / "a.mcap", tmp_path / "a.rrd")


def test_rerun_opens_our_sessions_itself_with_the_joints_named(
    session_file, truth, read_back, tmp_path, rerun_command
):
    path = tmp_path / "native.rrd"
    names = [f"joint{i:02d}" for i in range(1, 26)]
    rerun_command("mcap", "convert", session_file, "-o", path)
    rerun_command("rrd", "verify", path)
    printed = rerun_command("rrd", "print", "-vvv", "--entity", "/joint_states/position", path)
    assert ", ".join(names[:10]) in printed  # it cuts long lists short
    back = read_back(path)
    assert back.column("/joint_states/position", "SeriesLines:names")[0] == names
    shown = rows(back.column("/joint_states/position", "Scalars:scalars"))
    np.testing.assert_array_equal(shown, truth.position)
