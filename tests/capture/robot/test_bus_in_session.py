"""A session's robot: its databases are parsed where frames are decoded, and nowhere before."""

import re
import subprocess
import sys
from dataclasses import replace

import pytest

from undulog.capture.bus.map_entry import bus_messages
from undulog.capture.common.errors import RobotFileError
from undulog.capture.robot.description import load_robot, robot_in_session

ROBOTS = ("snake25", "arcsnake-joint")


def attached(robot):
    files = {name: text.encode() for name, text in robot.databases}
    return {"robot.toml": robot.toml.encode()} | files


@pytest.mark.parametrize("name", ROBOTS)
def test_a_map_is_the_same_with_and_without_its_databases(name):
    robot = load_robot(name)
    quick = robot_in_session(attached(robot), "a.mcap", in_full=False)
    assert quick.bus == robot.bus
    assert quick.databases == robot.databases
    assert replace(quick, meshes=robot.meshes) == robot
    assert bus_messages(quick)[1].keys() == bus_messages(robot)[1].keys()


@pytest.mark.parametrize("fault", ["signal", "database"])
def test_faults_are_raised_where_frames_are_decoded(fault):
    robot = load_robot("snake25")
    files = attached(robot)
    if fault == "database":
        (name, text), *_ = robot.databases
        files[name] = text.replace("BO_", "B0_").encode()
    else:
        text = re.sub(r'\bsignal = "\w+"', 'signal = "nosuch"', robot.toml, count=1)
        assert text != robot.toml
        files["robot.toml"] = text.encode()
    quick = robot_in_session(files, "a.mcap", in_full=False)
    with pytest.raises(RobotFileError):
        bus_messages(quick)
    with pytest.raises(RobotFileError):
        robot_in_session(files, "a.mcap")


def test_joints_are_read_without_the_parser_of_databases():
    code = """
import sys
from undulog.capture.robot.description import load_robot, robot_in_session
robot = load_robot("snake25")
before = {"cantools", "can", "asammdf"} & set(sys.modules)
for module in before | {name for name in sys.modules if name.split(".")[0] in before}:
    del sys.modules[module]
files = {name: text.encode() for name, text in robot.databases}
robot_in_session({"robot.toml": robot.toml.encode()} | files, "a.mcap", in_full=False)
print({"cantools", "can", "asammdf"} & set(sys.modules))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "set()\n"
