"""Bags of ros2_control in the commands that view, plan, drive and repeat."""

import pytest

from support.ros_bags import NAMES, Filler, filling, write_bag


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    return write_bag(tmp_path_factory.mktemp("control") / "bag", filling(Filler.controller))


@pytest.mark.slow
def test_a_view_shows_the_joints_of_a_controller(bag, tmp_path, report_of):
    written = report_of("view", bag, "--save", tmp_path / "a.rrd")
    assert written["joints"] == list(NAMES)
    named = ("--command-topic", "/arm/controller_state", "--response-topic")
    named = (*named, "/arm/controller_state.feedback")
    assert report_of("view", bag, *named, "--save", tmp_path / "b.rrd")["joints"] == list(NAMES)
    both = report_of("view", bag, bag, "--names", "a,b", "--save", tmp_path / "c.rrd")
    assert both["sessions"][1]["joints_compared"] == list(NAMES)


def test_a_plan_is_made_around_commands_found_by_type(bag, tmp_path, report_of, opened):
    files = report_of("plan", "reversal", "--like", bag, "-o", tmp_path / "plan", "--runs", 2)
    assert opened(files["files"][0]).joints("/joint_commands").names == NAMES


def test_what_drives_never_guesses_commands(bag, tmp_path, command, report_of):
    robot = tmp_path / "robot.toml"
    report_of("robot", "new", "-o", robot, "--from", bag)
    refused = command("drive", bag, "--on", "twin:flat", "-o", tmp_path / "a.mcap", code=1).err
    assert "has no /joint_commands" in refused
    assert "choose with --command-topic" in refused
    refused = command("replay", bag, "--on", "twin:flat", "-o", tmp_path / "a.mcap", code=1).err
    assert "choose with --command-topic" in refused
    named = ("--command-topic", "/arm/controller_state")
    given = ("drive", bag, "--on", "twin:flat", "-o", tmp_path / "a.mcap", *named)
    assert "joints that snake25 lacks" in command(*given, code=2).err


def test_predict_and_compare_take_the_topics(bag, command, report_of):
    named = ("--command-topic", "/none", "--response-topic", "/none")
    assert "has no /none" in command("predict", bag, bag, "--eps", "0.3", *named, code=1).err
    assert "has no /none" in command("compare", bag, bag, *named, code=1).err
    assert report_of("compare", bag, bag)["verdict"] is not None


def test_the_check_finds_the_joints(bag, command):
    out = command("log", "check", bag).out
    assert "/joint_states is missing; joints are on /arm/controller_state" in out
