"""Worlds in scenarios: obstacles, targets, slopes and fields of cylinders drawn at random."""

import math

import numpy as np
import pytest

from support.twin_runs import SNAKE13, check_keys, faults_of
from undulog import sim
from undulog.capture.common.errors import UsageError

WORLD = """
[world]
slope = 0.1
slope_heading = 0.5
[[world.obstacles]]
shape = "cylinder"
position = [1.5, 0.2]
radius = 0.1
height = 0.4
[[world.obstacles]]
shape = "box"
position = [2.5, 0.2]
size = [0.4, 0.2]
heading = 0.3
[[world.obstacles]]
shape = "wall"
from = [0.0, 1.0]
to = [3.0, 1.5]
thickness = 0.05
[world.obstacle_contact]
stiffness = 8000.0
mu = 0.2
[world.target]
position = [3.6, 0.0]
"""

FIELD = """
[world.target]
position = [3.6, 0.0]
[world.field]
count = 12
size = [4.0, 3.0]
centre = [1.8, 0.0]
radius = [0.05, 0.12]
clear = 0.25
gap = 0.15
"""


def test_obstacles_are_read_and_written_back():
    scenario = sim.parse_scenario(SNAKE13 + WORLD, "x.toml")
    world = scenario.world
    assert world.obstacles == (
        sim.Cylinder((1.5, 0.2), 0.1, 0.4),
        sim.Box((2.5, 0.2), (0.4, 0.2), 0.3),
        sim.Wall((0.0, 1.0), (3.0, 1.5), 0.05),
    )
    assert world.obstacle_contact == sim.ObstacleMaterial(stiffness=8000.0, mu=0.2)
    assert (world.target, world.ground) == (sim.Target((3.6, 0.0)), sim.Ground())
    assert sim.parse_scenario(scenario.toml(), "y.toml") == scenario


def test_a_slope_tilts_gravity():
    gravity = sim.parse_scenario(SNAKE13 + WORLD, "x.toml").world.gravity
    assert math.hypot(*gravity) == pytest.approx(9.81)
    assert math.atan2(math.hypot(*gravity[:2]), -gravity[2]) == pytest.approx(0.1)
    assert math.atan2(gravity[1], gravity[0]) == pytest.approx(0.5)
    for key, text in (
        ("world.gravity", "slope = 0.1\ngravity = [0.0, 0.0, -1.0]"),
        ("world.slope_heading", "slope_heading = 0.1"),
    ):
        assert key in faults_of(f"{SNAKE13}[world]\n{text}\n")


def test_a_wall_is_a_box_along_it():
    box = sim.Wall((1.0, 1.0), (4.0, 5.0), 0.1, 0.5).box
    assert box == sim.Box((2.5, 3.0), (5.0, 0.1), math.atan2(4, 3), 0.5)


def test_faults_are_listed_at_once():
    faults = faults_of(
        SNAKE13
        + """
        [world.obstacle_contact]
        stiffness = 0
        [world.target]
        position = [1.0]
        [world.field]
        count = 0
        size = [1.0, -1.0]
        radius = [0.2, 0.1]
        [[world.obstacles]]
        shape = "pyramid"
        [[world.obstacles]]
        shape = "cylinder"
        position = [1.0, 1.0]
        size = [1.0, 1.0]
        [[world.obstacles]]
        shape = "wall"
        from = [1.0, 1.0]
        to = [1.0, 1.0]
        """
    )
    check_keys(
        faults,
        "world.obstacle_contact.stiffness world.target.position world.field.count world.field.size "
        "world.field.radius world.obstacles[0].shape world.obstacles[1].radius "
        "world.obstacles[1].size world.obstacles[2].to",
    )


@pytest.mark.parametrize("seed", range(1, 9))
def test_a_field_keeps_its_distances(seed):
    scenario = sim.parse_scenario(f"seed = {seed}\n{SNAKE13}{FIELD}", "x.toml")
    placed = scenario.world.obstacles
    assert len(placed) == 12
    at = np.array([obstacle.position for obstacle in placed])
    radius = np.array([obstacle.radius for obstacle in placed])
    assert ((radius >= 0.05) & (radius <= 0.12)).all()
    assert (np.abs(at - (1.8, 0.0)) <= (2.0, 1.5)).all()
    between = np.hypot(*(at[:, None] - at).T) - radius[:, None] - radius
    assert between[~np.eye(12, dtype=bool)].min() >= 0.15 - 1e-12
    assert (np.hypot(*(at - (3.6, 0.0)).T) - radius).min() >= 0.3 + 0.25 - 1e-12
    # The robot lies from the origin along -x.
    length = sum(link.length for link in scenario.robot.links[1:]) + 0.03
    for x in np.linspace(-length, 0.0, 200):
        assert (np.hypot(*(at - (x, 0.0)).T) - radius).min() >= 0.25 - 1e-9


def test_a_field_follows_the_seed_and_is_stored_as_its_obstacles():
    scenario = sim.parse_scenario(SNAKE13 + FIELD, "x.toml")
    assert "[world.field]" not in scenario.toml()
    assert sim.parse_scenario(scenario.toml(), "y.toml") == scenario
    assert scenario.world.field == sim.RandomField(
        12, (4.0, 3.0), (1.8, 0.0), (0.05, 0.12), clear=0.25, gap=0.15
    )
    assert sim.parse_scenario(SNAKE13 + FIELD, "z.toml").world.obstacles == scenario.world.obstacles
    ninth = sim.parse_scenario(f"seed = 9\n{SNAKE13}{FIELD}", "x.toml").world.obstacles
    assert scenario.changed(seed=9).world.obstacles == ninth != scenario.world.obstacles
    assert scenario.changed(duration_s=1.0).world.obstacles == scenario.world.obstacles
    fixed = sim.parse_scenario(f"{SNAKE13}{FIELD}seed = 4\n", "x.toml")
    assert fixed.changed(seed=9).world.obstacles == fixed.world.obstacles


def test_a_field_stands_clear_of_what_is_there_and_joins_it():
    box = "[[world.obstacles]]\nshape = 'box'\nposition = [2.0, 0.0]\nsize = [1.0, 1.0]\n"
    world = sim.parse_scenario(SNAKE13 + FIELD + box, "x.toml").world
    assert world.obstacles[0] == sim.Box((2.0, 0.0), (1.0, 1.0))
    for obstacle in world.obstacles[1:]:
        x, y = (
            max(abs(c - m) - 0.5, 0.0) for c, m in zip(obstacle.position, (2.0, 0.0), strict=True)
        )
        assert math.hypot(x, y) - obstacle.radius >= 0.15 - 1e-12
    redrawn = world.redrawn(5, 0.8)
    assert redrawn.obstacles[0] == world.obstacles[0]
    assert len(redrawn.obstacles) == len(world.obstacles) == 13


def test_no_room_is_reported():
    text = FIELD.replace("[4.0, 3.0]", "[0.4, 0.4]")
    assert "room for" in faults_of(SNAKE13 + text)["world.field"]
    scenario = sim.parse_scenario(SNAKE13 + FIELD, "x.toml")
    tight = sim.RandomField(12, (0.4, 0.4))
    with pytest.raises(UsageError, match=r"room for \d of 12"):
        scenario.world.scattered(tight, 1, 0.8)
