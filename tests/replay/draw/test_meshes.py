"""Links with a mesh: drawn where the link is, as it is, in the colour of its power."""

import itertools
import struct
from importlib.resources import files

import numpy as np
import pytest

from support.written_topics import EPOCH_NS, write_topics
from undulog.capture import Session, load_robot
from undulog.capture.robot.kinematics import link_poses

SHAPES = "/world/snake/meshes"


def box(x, y, z):
    """A binary STL of a box about the origin."""
    corner = [np.array(c) * (x, y, z) / 2 for c in itertools.product((-1, 1), repeat=3)]
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = [(a, b, c) for a, b, c, _ in quads] + [(a, c, d) for a, _, c, d in quads]
    rows = [struct.pack("<12fH", 0, 0, 0, *np.ravel([corner[i] for i in f]), 0) for f in faces]
    return b"\0" * 80 + struct.pack("<I", len(rows)) + b"".join(rows)


@pytest.fixture(scope="module")
def robot(tmp_path_factory):
    """The shipped robot; all links but the head are boxes in millimetres."""
    folder = tmp_path_factory.mktemp("robot")
    shipped = files("undulog.capture.robot") / "shipped"
    text = (shipped / "snake25.toml").read_text()
    links = [f'{{ name = "link{i:02d}", mesh = "box.stl" }}' for i in range(2, 27)]
    entries = ",\n".join(['{ name = "link01" }', *links])
    at = text.index("[defaults.link]")
    text = f"{text[:at]}links = [\n{entries}\n]\n\n[defaults.link]\nmesh_scale = 0.001\n" + (
        text[at:].removeprefix("[defaults.link]\n")
    )
    (folder / "boxes.toml").write_text(text)
    (folder / "box.stl").write_bytes(box(45.0, 40.0, 40.0))
    (folder / "snake25.dbc").write_bytes((shipped / "snake25.dbc").read_bytes())
    return load_robot(folder / "boxes.toml")


@pytest.fixture(scope="module")
def angles():
    """A bent body at rest, ten samples."""
    return np.tile(0.3 * np.sin(np.arange(25) / 2), (10, 1))


@pytest.fixture(scope="module")
def file(robot, angles, tmp_path_factory):
    """That robot, recorded and converted."""
    from undulog.replay.recording import write_recording

    folder = tmp_path_factory.mktemp("meshes")
    path = folder / "boxes.mcap"
    drive = np.ones((10, 25)), np.tile(np.linspace(-1, 1, 25), (10, 1))
    topics = {"/joint_states": (robot.joint_names, "rad", angles, *drive)}
    write_topics(path, EPOCH_NS + np.arange(10) * 10_000_000, topics, robot=robot)
    with Session.open(path) as session:
        return write_recording(session, folder / "boxes.rrd").path


def test_a_mesh_lies_where_its_link_is(file, robot, angles, read_back):
    back = read_back(file)
    head = np.zeros((10, 3)), np.tile(np.eye(3), (10, 1, 1))
    centre, _ = link_poses(robot, *head, angles)
    entity = f"{SHAPES}/link14"
    at = np.array([row[0] for row in back.column(entity, "Transform3D:translation")])
    np.testing.assert_allclose(at, centre[::2, 13], atol=1e-6)
    scale = np.array([row[0] for row in back.column(entity, "Transform3D:scale")])
    np.testing.assert_allclose(scale, 0.001, rtol=1e-6)
    assert len(back.column(entity, "Asset3D:albedo_factor")) == len(at)


def test_only_links_without_a_mesh_are_capsules(file, read_back):
    drawn = read_back(file).column("/world/snake/measured", "Capsules3D:lengths")
    assert {len(row) for row in drawn} == {1}


@pytest.mark.nightly
def test_the_viewer_draws_the_boxes(file, show):
    assert show(file, 0.09).complaints() == []
