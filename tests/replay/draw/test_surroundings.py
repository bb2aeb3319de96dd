"""Obstacles and target: where the scenario has them, read back from the recording."""

import numpy as np
import pytest

from support.written_topics import EPOCH_NS, write_topics
from undulog.capture import Session
from undulog.replay.recording import write_recording
from undulog.sim import Cylinder, Wall, load_scenario


@pytest.fixture(scope="module")
def world():
    """A shipped world with cylinders, walls and a target."""
    return load_scenario("target-following").world


@pytest.fixture
def recorded(snake25, tmp_path):
    """A function that records a straight robot with a scenario attached, and converts it."""

    def convert(scenario):
        path = write_topics(
            tmp_path / "run.mcap",
            EPOCH_NS + np.arange(4) * 10_000_000,
            {"/joint_states": (snake25.joint_names, "rad", np.zeros((4, 25)))},
            begin=lambda writer: writer.attach("scenario.toml", "application/toml", scenario),
            robot=snake25,
        )
        with Session.open(path) as session:
            return write_recording(session, tmp_path / "run.rrd")

    return convert


def test_obstacles_and_target_stand_where_the_scenario_has_them(world, recorded, read_back):
    back = read_back(recorded(load_scenario("target-following").toml().encode()).path)
    cylinders = [obstacle for obstacle in world.obstacles if isinstance(obstacle, Cylinder)]
    walls = [obstacle for obstacle in world.obstacles if isinstance(obstacle, Wall)]
    radii = back.static("/world/obstacles/cylinders", "Cylinders3D:radii")
    np.testing.assert_allclose(radii, [cylinder.radius for cylinder in cylinders], rtol=1e-6)
    half = back.static("/world/obstacles/boxes", "Boxes3D:half_sizes")
    length = [np.hypot(*np.subtract(wall.end, wall.start)) for wall in walls]
    np.testing.assert_allclose(2 * np.array(half)[:, 0], length, rtol=1e-6)
    strips = back.static("/world/target", "LineStrips3D:strips")
    away = np.array(strips[0])[:, :2] - world.target.position
    np.testing.assert_allclose(np.hypot(*away.T), world.target.radius, rtol=1e-5)


def test_a_faulty_scenario_is_reported_and_the_rest_drawn(recorded):
    recording = recorded(b"[world]\nheading = 'north'\n")
    assert any("obstacles are not drawn: world.heading" in text for text in recording.warnings)
