"""Joints in messages of ros2_control: gain and lag come out of each type, without an option."""

import numpy as np
import pytest
from rosbags.rosbag2 import StoragePlugin

from support.ros_bags import (
    EPOCH_NS,
    GAIN,
    LAG,
    NAMES,
    Filler,
    filling,
    ticks,
    typestore,
    write_bag,
)

pytestmark = pytest.mark.nightly

fill_controller = filling(Filler.controller)


def fill_trajectory(bag, **how):
    fill = Filler(bag)
    for k, tick in enumerate(ticks()):
        fill.state(*tick)
        if k % 2 == 0:
            fill.trajectory(*tick, **how)


def fill_horizons(bag):
    """Each trajectory has 0.2 s of points and replaces the rest of that before it."""
    fill_trajectory(bag, count=20, stamped=False)


def dynamic(log, *tick):
    log.dynamic(*tick)
    log.trajectory(*tick)


def array(log, *tick):
    log.state(*tick)
    log.array(*tick)


def check(result):
    assert result["gait"]["frequency_hz"] == pytest.approx(0.8, abs=1e-3)
    assert [joint["name"] for joint in result["joints"]] == list(NAMES)
    assert [joint["gain"] for joint in result["joints"]] == pytest.approx(GAIN, abs=1e-3)
    assert [joint["lag_rad"] for joint in result["joints"]] == pytest.approx(LAG, abs=1e-3)


KINDS = {
    "controller": (fill_controller, "/arm/controller_state.reference", "feedback"),
    "trajectory": (fill_trajectory, "commands on /arm/joint_trajectory", ""),
    "horizons": (fill_horizons, "commands on /arm/joint_trajectory", ""),
    "dynamic": (filling(dynamic), "commands on /arm/joint_trajectory", "/dynamic_joint_states"),
}


@pytest.mark.parametrize("storage", StoragePlugin)
@pytest.mark.parametrize("kind", KINDS)
def test_the_response_comes_out_of_each_type(kind, storage, tmp_path, report_of):
    fill, command, response = KINDS[kind]
    result = report_of("analyse", write_bag(tmp_path / "bag", fill, storage=storage))
    check(result)
    (by_type,) = [note for note in result["notes"] if "found by type" in note]
    assert command in by_type
    assert response in by_type
    assert "--command-topic and --response-topic" in by_type


@pytest.mark.parametrize("version", ["foxy", "galactic", "humble", "iron", "jazzy"])
@pytest.mark.parametrize("storage", StoragePlugin)
def test_every_release_of_the_controller_state(version, storage, tmp_path, report_of):
    old = version in ("foxy", "galactic", "humble")
    how = ("/arm/state", ("desired", "actual")) if old else ()
    fill = filling(lambda log, *tick: log.controller(*tick, *how))
    path = write_bag(tmp_path / "bag", fill, storage=storage, store=typestore(version))
    check(report_of("analyse", path))


def test_the_joints_of_an_array_are_those_of_the_states_or_of_the_option(
    tmp_path, report_of, command
):
    bag = write_bag(tmp_path / "bag", filling(array))
    result = report_of("analyse", bag)
    check(result)
    (note,) = [note for note in result["notes"] if "names no joints" in note]
    assert "--command-topic /forward/commands:JOINT,JOINT,..." in note
    named = f"/forward/commands:{','.join(NAMES)}"
    check(report_of("analyse", bag, "--command-topic", named))
    check(report_of("analyse", bag, "--command-topic", "/forward/commands"))
    err = command("analyse", bag, "--command-topic", "/forward/commands:a,b", code=1).err
    assert "3 values in a message, but 2 joints are named" in err
    err = command("analyse", bag, "--command-topic", "/forward/commands:a,a,b", code=1).err
    assert "each joint has one name" in err


def test_a_controller_is_named_as_a_whole_or_by_its_part(tmp_path, report_of, command):
    def write(log, *tick):
        log.controller(*tick)
        log.controller(*tick, "/leg/controller_state")
        log.state(*tick, "/other/encoders")

    bag = write_bag(tmp_path / "bag", filling(write))
    result = report_of("analyse", bag)
    check(result)
    (by_type,) = [note for note in result["notes"] if "found by type" in note]
    assert "/leg/controller_state.reference" in by_type.partition("; other joints: ")[2]
    whole = ["--command-topic", "/leg/controller_state", "--response-topic", "/other/encoders"]
    result = report_of("analyse", bag, *whole)
    check(result)
    assert result["provenance"]["options"]["command_topic"] == "/leg/controller_state.reference"
    err = command("analyse", bag, "--command-topic", "/leg/controller_state.none", code=1).err
    assert "name one of /leg/controller_state.reference" in err
    err = command("analyse", bag, "--command-topic", "/none", code=1).err
    assert "--command-topic and --response-topic" in err


def test_further_interfaces_are_read_or_named(tmp_path):
    from undulog.capture import Session

    with Session.open(write_bag(tmp_path / "bag", filling(dynamic))) as session:
        topics = session.joint_topics()
        assert topics.quantities == {"/joint_current": "/dynamic_joint_states.current"}
        assert any("stiffness" in note and "lamp" in note for note in topics.notes)
        view = session.with_joints()
        current = view.joints("/joint_current")
        assert (current.names, current.unit) == (NAMES, "A")
        np.testing.assert_array_equal([v[0] for v in current.values], [0.3, 1.3, 2.3])
        assert view.joints("/joint_states", "effort").values[0][0] == 0.2
        commands = view.joints("/joint_commands")
        assert commands.t_ns[0][0] == EPOCH_NS + 10**8
