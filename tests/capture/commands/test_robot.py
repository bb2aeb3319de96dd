"""``robot list``, ``show``, ``check`` and ``new``; and a robot for a log without one."""

import tomllib

import numpy as np
import pytest
from mcap.reader import make_reader

from support.joint_runs import write_joints
from support.paths import ROOT
from undulog.capture import Session, load_robot, robot_names
from undulog.capture.common.errors import JointSetError

GOLDEN = ROOT / "tests/replay/golden/session.mcap"


def write(path, names=("hip", "knee"), **options):
    """A log of a swing of +-0.3 rad about 0.1 rad at 1 Hz: at most 0.3 * 2 pi rad/s."""
    angle = 0.1 + 0.3 * np.sin(np.pi * np.arange(1000)[:, None] / 50) * np.ones(len(names))
    return write_joints(path, names, angle, [angle], rate_hz=100, **options)


def test_list_and_show_name_the_shipped_robots(report_of, command):
    assert [robot["name"] for robot in report_of("robot", "list")] == list(robot_names())
    facts = report_of("robot", "show", "snake25")
    assert [fact["name"] for fact in facts["joints"]] == list(load_robot("snake25").joint_names)
    text = command("robot", "show", "snake25").out
    assert all(name in text for name in load_robot("snake25").joint_names)
    assert "1000000 bit/s" in text


def test_check_lists_all_faults(tmp_path, command, report_of):
    path = tmp_path / "r.toml"
    path.write_text('name = "r"\njoints = [{ name = "a", plane = "sideways" }]\n')
    err = command("robot", "check", path, code=1).err
    assert "sideways" in err
    assert "link" in err
    faults = report_of("robot", "check", path, code=1)["faults"]
    assert len(faults) > 1
    assert "joints[0].plane" in {fault["key"] for fault in faults}
    assert "no fault" in command("robot", "check", "snake13").out


def test_new_has_the_log_s_joints_and_the_limits_it_shows(tmp_path, command):
    log, path = write(tmp_path / "log.mcap"), tmp_path / "mine.toml"
    command("robot", "new", "-o", path, "--from", log)
    robot = load_robot(path)
    assert (robot.name, robot.joint_names) == ("mine", ("hip", "knee"))
    for joint in robot.joints:
        assert joint.lower == pytest.approx(-0.2 - 0.03, abs=2e-3)
        assert joint.upper == pytest.approx(0.4 + 0.03, abs=2e-3)
        assert joint.max_velocity == pytest.approx(1.05 * 0.3 * 2 * np.pi, rel=5e-3)
    assert "# seen: -0.2 to 0.4 rad, at most 1.88" in path.read_text()
    assert "joints" in robot.assumed
    command("robot", "check", path)
    command("robot", "new", "-o", path, code=2)  # it is there


def test_new_without_a_log_is_valid_and_commented(tmp_path, command):
    path = tmp_path / "r.toml"
    command("robot", "new", "-o", path)
    assert tomllib.loads(path.read_text())["name"] == "r"
    assert load_robot(path).joint_names == ("joint01", "joint02")


def test_a_robot_given_for_a_foreign_log_orders_and_limits_it(tmp_path, command, report_of, opened):
    log, path = write(tmp_path / "log.mcap"), tmp_path / "mine.toml"
    command("robot", "new", "-o", path, "--from", log)
    text = path.read_text()
    first, second = (line for line in text.splitlines() if "# seen" in line)
    path.write_text(text.replace(first, "@").replace(second, first).replace("@", second))
    with Session.open(log, robot=path) as session:
        assert session.robot == load_robot(path)
        assert session.joints("/joint_states").names == ("knee", "hip")
    assert opened(log).robot is None
    report = report_of("analyse", log, "--robot", path)
    assert report["session"]["robot"] == "mine"
    assert [joint["plane"] for joint in report["joints"]] == ["horizontal"] * 2
    assert f"--robot {path}" in report["provenance"]["command"]


@pytest.mark.parametrize(
    ("names", "words"),
    [
        (("arm1", "arm2"), ("none of its joints", "hip, knee", "arm1")),
        (("hip",), ("lacks knee",)),
        (("hip", "knee", "toe"), ("has, but not the log, toe",)),
    ],
)
def test_a_robot_of_other_joints_is_an_error(names, words, tmp_path, command):
    log = write(tmp_path / "log.mcap")
    other, path = write(tmp_path / "other.mcap", names), tmp_path / "other.toml"
    command("robot", "new", "-o", path, "--from", other)
    with pytest.raises(JointSetError) as error:
        Session.open(log, robot=path)
    assert all(word in str(error.value) for word in words)


def test_a_log_with_a_robot_keeps_it():
    with Session.open(GOLDEN, robot="snake13") as session:
        assert session.robot.name == "snake25"
        assert any("snake13" in warning for warning in session.warnings)
    with GOLDEN.open("rb") as stream:  # as another reader sees it
        assert {attachment.name for attachment in make_reader(stream).iter_attachments()} >= {
            "robot.toml"
        }
