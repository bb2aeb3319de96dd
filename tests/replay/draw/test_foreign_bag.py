"""A bag of another make, written by rosbags: what it has is shown, what can't be is named."""

import json
from contextlib import redirect_stdout

import numpy as np
import pytest

import undulog
from support.ros_bags import NAMES, OMEGA, filling, header, message, write_bag
from undulog.capture import Session
from undulog.capture.common.errors import MissingChannelError
from undulog.replay.draw.plots import is_foreign, log_others

VECTOR = "geometry_msgs/msg/Vector3"
NAMED = ["--command-topic", "/snake/targets", "--response-topic", "/snake/encoders"]


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    """Five seconds of three joints, an IMU, currents, a state machine, a camera and frames."""

    def write(log, t_ns, t_s):
        phase, store = OMEGA * t_s - np.arange(3), log.bag.store
        log.state(t_ns, t_s, "/snake/targets", 0.4 * np.sin(phase))
        log.state(t_ns, t_s, "/snake/encoders", 0.36 * np.sin(phase - 0.2))

        def other(topic, kind, **fields):
            log.bag.write(topic, t_ns, message(store, kind, **fields))

        head = header(store, t_ns)
        still = message(store, "geometry_msgs/msg/Quaternion", w=1.0)
        turning = message(store, VECTOR, x=t_s)
        weight = message(store, VECTOR, z=9.81)
        motion = {"angular_velocity": turning, "linear_acceleration": weight}
        other("/imu/data", "sensor_msgs/msg/Imu", header=head, orientation=still, **motion)
        tick = round(100 * t_s)
        other("/currents", "std_msgs/msg/Float64MultiArray", data=np.array([tick, -tick, 2.0]))
        if tick % 100 == 0:
            other("/state", "std_msgs/msg/String", data="go" if tick < 300 else "turn")
            picture = {"format": "png", "data": np.zeros(999, np.uint8)}
            other("/camera", "sensor_msgs/msg/CompressedImage", header=head, **picture)
            other("/tf", "tf2_msgs/msg/TFMessage")

    folder = write_bag(tmp_path_factory.mktemp("foreign") / "bag", filling(write, 5.0))
    (file,) = folder.glob("*.mcap")
    return file


@pytest.fixture(scope="module")
def shown(bag, tmp_path_factory, read_back):
    """The bag as a recording, its joints named: (what was reported, what is in the file)."""
    path = tmp_path_factory.mktemp("shown") / "bag.rrd"
    report = path.with_suffix(".txt")
    with report.open("w") as out, redirect_stdout(out):
        assert undulog.run(["view", str(bag), *NAMED, "--save", str(path), "--json"]) == 0
    return json.loads(report.read_text()), read_back(path)


def test_the_joints_are_shown_under_the_names_that_were_given(shown):
    written, recorded = shown
    assert written["joints"] == list(NAMES)
    t = recorded.times("/joints/measured") / 1e9
    angle = np.radians(np.array(recorded.column("/joints/measured", "Angle:degrees")))
    truth = 0.36 * np.sin(OMEGA * t[:, None] - np.arange(3) - 0.2)
    np.testing.assert_allclose(angle, truth, atol=1e-3)  # rounded to what a screen shows
    assert "/signals/snake/encoders" not in recorded.entities


def test_they_are_analysed_and_averaged_too(shown):
    _, recorded = shown
    mean = np.array(recorded.column("/ensemble/measured", "Scalars:scalars"))
    # Without a logged phase it is 0 at the crest of the first command.
    phase = np.radians(np.arange(0, 361, 5))[:, None]
    truth = np.degrees(0.36 * np.cos(phase - np.arange(3) - 0.2))
    np.testing.assert_allclose(mean, truth, atol=2e-3)
    lag = np.array(recorded.column("/cycles/lag_degrees", "Scalars:scalars"))
    np.testing.assert_allclose(lag[:-1], np.degrees(0.2), atol=1e-3)


def test_other_numbers_are_plotted_words_are_events_and_the_rest_is_named(shown):
    written, recorded = shown
    names = recorded.static("/others/imu/data", "SeriesLines:names")
    assert {"angular_velocity.x", "linear_acceleration.z"} <= set(names)
    assert not any("covariance" in name for name in names)
    rows = np.array(recorded.column("/others/imu/data", "Scalars:scalars"))
    turned = rows[:, names.index("angular_velocity.x")]
    np.testing.assert_allclose(turned, 0.01 * np.arange(500), atol=1e-6)
    currents = recorded.static("/others/currents", "SeriesLines:names")
    assert currents == ["data[0]", "data[1]", "data[2]"]
    # Words each time that they change.
    assert recorded.column("/events/said", "TextLog:text") == [["/state: go"], ["/state: turn"]]
    np.testing.assert_allclose(recorded.times("/events/said") / 1e9, [0.0, 3.0])
    left_out = "/camera (sensor_msgs/msg/CompressedImage), /tf (tf2_msgs/msg/TFMessage)"
    assert f"not shown: {left_out}" in written["warnings"]


def test_without_names_the_joints_are_found_by_type(bag, tmp_path, report_of):
    written = report_of("view", bag, "--save", tmp_path / "a.rrd")
    assert len(written["joints"]) == 3


def test_a_name_that_is_not_there_fails_and_lists_what_is(bag, tmp_path, command):
    words = ("view", bag, "--command-topic", "/none", "--save", tmp_path / "a.rrd")
    assert (
        "has no /none; it has /currents, /snake/encoders, /snake/targets (choose with"
        in command(*words, code=1).err
    )
    with Session.open(bag) as session, pytest.raises(MissingChannelError):
        session.view(rename={"/joint_commands": "/none"})


def test_a_session_of_our_own_keeps_its_views(session_file):
    with Session.open(session_file) as session:
        assert not is_foreign(session)
        assert log_others(None, None, session, []) == ()
        same = session.view(rename={topic: topic for topic in ("/joint_commands", "/joint_states")})
        assert dict(same.channels) == dict(session.channels)
