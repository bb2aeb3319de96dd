"""A bag of another make, written by rosbags: commands and states on topics of its own names."""

import pytest

from support.ros_bags import GAIN, LAG, NAMES, commanded, filling, write_bag


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    """No robot, no torque; the commands at 50 Hz, the states at 100 Hz, nothing undulog wrote."""

    def write(log, t_ns, t_s):
        if round(100 * t_s) % 2 == 0:
            log.state(t_ns, t_s, "/snake/targets", commanded(t_s))
        log.state(t_ns, t_s, "/snake/encoders")

    (file,) = write_bag(tmp_path_factory.mktemp("foreign") / "bag", filling(write)).glob("*.mcap")
    return file


def test_naming_the_topics_is_enough(bag, report_of):
    topics = ["--command-topic", "/snake/targets", "--response-topic", "/snake/encoders"]
    result = report_of("analyse", bag, *topics)
    assert result["gait"]["frequency_hz"] == pytest.approx(0.8, abs=1e-3)
    assert [joint["name"] for joint in result["joints"]] == list(NAMES)
    assert [joint["gain"] for joint in result["joints"]] == pytest.approx(GAIN, abs=5e-4)
    assert [joint["lag_rad"] for joint in result["joints"]] == pytest.approx(LAG, abs=5e-4)
    assert result["artefacts"] == []
    # Its limits, one by one: no torque, no current, no robot, no phase.
    for joint in result["joints"]:
        assert {joint[key] for key in ("energy_net_j", "energy_el_j", "plane")} == {None}
    assert (result["over_time"], result["energy"]["electrical"]) == (None, None)
    assert (result["energy"]["closure"], result["energy"]["transport"]["abs"]) == (None, None)
    text = " ".join(result["notes"])
    for note in (
        "/snake/encoders carries no effort and velocity: mechanical energies are null",
        "no /joint_current and no /joint_voltage: electrical energies are null",
        "cost of transport is not applicable: ",
        "gain and lag over time are null: the session has no /gait",
    ):
        assert note in text
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
