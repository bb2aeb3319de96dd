"""Long chains by their length, and meshes that travel with the description."""

import re

import pytest
from mcap.reader import make_reader

from support.bus_robots import LINK
from undulog.capture import Session, SessionWriter, load_robot
from undulog.capture.common.errors import RobotFileError
from undulog.capture.robot.description import parse_robot
from undulog.capture.robot.model import Plane

CHAIN = f"""
name = "eel"
clock = "host"

[chain]
joints = {{joints}}
planes = {{planes}}
{LINK}"""
BOTH, YAW = '["horizontal", "vertical"]', '["horizontal"]'
STL = b"\0" * 80 + (0).to_bytes(4, "little")  # a mesh without triangles


def chain(joints, planes="[]"):
    return CHAIN.format(joints=joints, planes=planes)


def eel(text):
    return parse_robot(text, "eel.toml", {})


@pytest.mark.parametrize("count", [2, 12, 25, 99, 100])
def test_a_chain_has_as_many_joints_as_it_says(count):
    robot = eel(chain(count, BOTH))
    assert len(robot.links) == count + 1
    assert [joint.plane for joint in robot.joints[:3]] == (list(Plane) * 2)[: min(count, 3)]
    assert list(robot.joint_names) == sorted(robot.joint_names)  # names sort as the chain stands
    assert [link.name for link in robot.links] == sorted(link.name for link in robot.links)


def test_a_chain_may_bend_in_one_plane_alone():
    assert {joint.plane for joint in eel(chain(12, YAW)).joints} == {Plane.HORIZONTAL}


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        (chain(0), "chain.joints: found 0; valid: a whole number >= 1"),
        (chain(10**9), "chain.joints: found 1000000000; valid: at most"),
        (chain(3, '["up"]'), "chain.planes[0]"),
        ('joints = [{ name = "a", plane = "vertical" }]' + chain(3), "joints: found [{"),
    ],
)
def test_faults_of_a_chain_are_named(text, fault):
    with pytest.raises(RobotFileError, match=re.escape(f"  {fault}")):
        eel(text)


def meshed(folder, name="shell.stl", write=True):
    text = chain(2, YAW).replace("radius", f'mesh = "{name}"\nmesh_scale = 0.001\nradius')
    path = folder / "eel.toml"
    path.write_text(text)
    if write:
        (folder / name).write_bytes(STL)
    return path


def test_a_mesh_travels_with_the_session(tmp_path):
    robot = load_robot(meshed(tmp_path))
    assert robot.meshes == (("shell.stl", STL),)
    path = tmp_path / "run.mcap"
    with SessionWriter(path, session_id="x", epoch_ns=0, robot=robot) as writer:
        writer.string("/note").write(1, "hello")
    with path.open("rb") as file:  # the foreign reader's view
        stored = {item.name: item for item in make_reader(file).iter_attachments()}
    assert stored["shell.stl"].data == STL
    assert stored["shell.stl"].media_type == "model/stl"
    with Session.open(path) as session:
        assert session.robot.meshes == robot.meshes
        assert {link.mesh_scale for link in session.robot.links} == {0.001}


def test_a_missing_mesh_is_named(tmp_path):
    with pytest.raises(RobotFileError, match=r'mesh of link01: found "shell.stl"'):
        load_robot(meshed(tmp_path, write=False))


def test_a_mesh_is_a_file_that_viewers_know(tmp_path):
    with pytest.raises(RobotFileError, match=r"\.glb, \.obj, \.stl"):
        load_robot(meshed(tmp_path, "shell.step"))
