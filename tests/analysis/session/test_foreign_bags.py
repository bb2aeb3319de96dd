"""A bag of another make, written by rosbags: commands and states on topics of its own names."""

import numpy as np
import pytest
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

EPOCH_NS = 1_700_000_000_000_000_000
NAMES = ["front_yaw", "mid_yaw", "rear_yaw"]
GAIN = np.array([0.95, 0.9, 0.85])
LAG = np.array([0.1, 0.2, 0.3])
OMEGA = 2 * np.pi * 0.8


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    """No robot, no torque; the commands at 50 Hz, the states at 100 Hz, nothing undulog wrote."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    state = store.types["sensor_msgs/msg/JointState"]
    header, stamp = store.types["std_msgs/msg/Header"], store.types["builtin_interfaces/msg/Time"]
    folder = tmp_path_factory.mktemp("foreign") / "bag"
    with Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        topics = {
            topic: writer.add_connection(topic, state.__msgtype__, typestore=store)
            for topic in ("/snake/targets", "/snake/encoders")
        }

        def write(topic, t_ns, position):
            head = header(stamp=stamp(sec=t_ns // 10**9, nanosec=t_ns % 10**9), frame_id="")
            lacking = {"velocity": np.zeros(0), "effort": np.zeros(0)}
            message = state(header=head, name=NAMES, position=position, **lacking)
            writer.write(topics[topic], t_ns, store.serialize_cdr(message, state.__msgtype__))

        rng = np.random.default_rng(3)
        for tick in range(1000):
            phase = OMEGA * tick / 100 - np.arange(3)
            if tick % 2 == 0:
                write("/snake/targets", EPOCH_NS + tick * 10**7, 0.4 * np.sin(phase))
            answer = 0.4 * GAIN * np.sin(phase - LAG) + rng.normal(0, 1e-3, 3)
            write("/snake/encoders", EPOCH_NS + tick * 10**7, answer)
    (file,) = folder.glob("*.mcap")
    return file


def test_naming_the_topics_is_enough(bag, report_of):
    topics = ["--command-topic", "/snake/targets", "--response-topic", "/snake/encoders"]
    result = report_of("analyse", bag, *topics)
    assert result["gait"]["frequency_hz"] == pytest.approx(0.8, abs=1e-3)
    assert [joint["name"] for joint in result["joints"]] == NAMES
    assert [joint["gain"] for joint in result["joints"]] == pytest.approx(GAIN, abs=5e-4)
    assert [joint["lag_rad"] for joint in result["joints"]] == pytest.approx(LAG, abs=5e-4)
    assert result["artefacts"] == []
    # Its limits, one by one: no torque, no current, no robot, no phase.
    for joint in result["joints"]:
        assert {joint[key] for key in ("energy_net_j", "energy_el_j", "plane")} == {None}
    assert (result["over_time"], result["energy"]["electrical"]) == (None, None)
    assert (result["energy"]["closure"], result["energy"]["transport"]["abs"]) == (None, None)
    found = " ".join(result["notes"])
    for note in (
        "/snake/encoders carries no effort and velocity: mechanical energies are null",
        "no /joint_current and no /joint_voltage: electrical energies are null",
        "cost of transport is not applicable: ",
        "gain and lag over time are null: the session has no /gait",
    ):
        assert note in found
    assert f"{topics[0]} {topics[1]}" in result["provenance"]["command"]


def test_topics_that_are_not_named_are_found_and_reported(bag, command, report_of):
    result = report_of("analyse", bag)
    assert [joint["gain"] for joint in result["joints"]] == pytest.approx(GAIN, abs=5e-4)
    assert (
        "commands on /snake/targets and positions on /snake/encoders, found by type (choose with "
        "--command-topic and --response-topic)"
    ) in result["notes"]
    err = command("analyse", bag, "--reference-topic", "/none", code=1).err
    assert "has no /none" in err
