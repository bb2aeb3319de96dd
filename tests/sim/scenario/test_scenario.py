"""Scenario files: read strictly, every fault at once, and written back whole."""

import dataclasses

import pytest

from support.twin_chains import chain
from support.twin_runs import SNAKE13, check_keys, faults_of
from undulog.capture.common.errors import RobotFileError, ScenarioError, UsageError
from undulog.capture.robot.model import Plane
from undulog.sim import FrictionLaw, Wave, load_scenario, parse_scenario, scenario_names

FULL = """
name = "full"
description = "every key, \\"quoted\\", \u00e9"
robot = "snake13"
duration_s = 3
settle_s = 1.5
seed = 7
epoch_s = 1700000000
physics_rate_hz = 2000
engine = "mujoco"
[gait]
ramp_s = 1.0
[gait.horizontal]
amplitude = 0.3
frequency_hz = 0.5
lag = 0.5
wave = "tail-to-head"
offset = 0.1
phase = 0.2
[gait.vertical]
amplitude = 0.1
frequency_hz = 1.0
lag = 0.0
[world]
gravity = [0.1, 0.0, -9.81]
heading = 0.3
velocity = [0.1, 0.0, 0.0]
[world.ground]
stiffness = 1000.0
damping = 10.0
mu_tangential = 0.1
mu_normal = 0.6
slip_speed = 0.02
law = "box"
[servo]
stall_torque = 0.25
[servo_of.joint03]
stall_torque = 0.2
coulomb_friction = 0
[link_of.link04]
mass_factor = 1.5
[noise]
position = 1e-3
"""


def test_what_is_left_out_has_defaults():
    scenario = parse_scenario(SNAKE13, "some/where/short.toml")
    gait, world = scenario.gait, scenario.world
    assert (scenario.name, scenario.robot.name, gait.ramp_s) == ("short", "snake13", 2.0)
    assert gait.planes[Plane.HORIZONTAL].wave is Wave.HEAD_TO_TAIL
    assert (world.ground.law, world.gravity) == (FrictionLaw.ELLIPSE, (0.0, 0.0, -9.81))
    assert (scenario.epoch_ns, scenario.tick_count) == (1_735_689_600_000_000_000, 201)


def test_every_key_is_read_and_written_back():
    scenario = parse_scenario(FULL, "x.toml")
    assert scenario.gait.planes[Plane.HORIZONTAL].signed_lag == 0.5
    assert scenario.world.ground.law is FrictionLaw.BOX
    joints, links = scenario.robot.joints, scenario.robot.links
    assert [joint.servo.stall_torque for joint in joints] == [0.25, 0.25, 0.2, *[0.25] * 9]
    assert joints[2].servo.coulomb_friction == 0.0
    assert [link.mass for link in links] == pytest.approx([0.1] * 3 + [0.15] + [0.1] * 9, rel=1e-15)
    assert links[3].inertia == pytest.approx((6e-5, 7.5e-5, 7.5e-5), rel=1e-15)
    assert parse_scenario(scenario.toml(), "y.toml") == scenario


@pytest.mark.parametrize("name", scenario_names())
def test_shipped_scenarios_read_and_write_back(name):
    scenario = load_scenario(name)
    assert scenario.name == name
    assert len(scenario.description) > 20
    assert parse_scenario(scenario.toml(), "y.toml") == scenario


def test_the_weak_servo_scenario_is_the_papers():
    scenario = load_scenario("weak-servo-pi3")
    gait = scenario.gait.planes[Plane.HORIZONTAL]
    assert (gait.amplitude, gait.frequency_hz) == (0.4, 0.5)
    assert gait.signed_lag == pytest.approx(-3.141592653589793 / 3)
    assert {joint.servo.stall_torque for joint in scenario.robot.joints} == {0.25}
    assert len(scenario.robot.joint_indices(Plane.HORIZONTAL)) == 13
    assert (scenario.settle_s, scenario.duration_s) == (8.0, 16.0)


def test_without_ground():
    text = f'{SNAKE13}\n[world]\nsurface = "none"\n'
    scenario = parse_scenario(text, "x.toml")
    assert scenario.world.ground is None
    assert parse_scenario(scenario.toml(), "x.toml") == scenario
    assert "world.ground" in faults_of(f"{text}[world.ground]\nmu_normal = 0.4\n")


def test_all_faults_are_listed_at_once():
    faults = faults_of(
        """
        description = 3
        robot = "snake31"
        duration_s = "long"
        seed = -1
        epoch_s = 12
        physics_rate_hz = 1050
        gaits = 1
        [gait.horizontal]
        amplitude = -0.3
        frequency_hz = 0
        wave = "sideways"
        lagg = 0.5
        [world]
        gravity = [0, 0]
        surface = "wet"
        [world.ground]
        stiffness = 0
        law = "elipse"
        [servo]
        stall_torque = 0
        stal_torque = 1
        [noise]
        position = nan
        """
    )
    check_keys(
        faults,
        "description robot duration_s seed epoch_s physics_rate_hz gaits gait.horizontal.amplitude "
        "gait.horizontal.frequency_hz gait.horizontal.wave gait.horizontal.lag "
        "gait.horizontal.lagg world.gravity world.surface world.ground.stiffness world.ground.law "
        "servo.stall_torque servo.stal_torque noise.position",
    )
    meant = {"robot": "snake13", "world.ground.law": "ellipse", "gaits": "gait"}
    for key, name in {**meant, "gait.horizontal.lagg": "lag"}.items():
        assert f"did you mean {name}?" in faults[key]


@pytest.mark.parametrize(
    ("before", "after", "key"),
    [
        ("settle_s = 3.0", "", "settle_s"),
        ("epoch_s = 2147483647", "", "epoch_s"),
        ("gait.ramp_s = -1", "", "gait.ramp_s"),
        ("", "[servo_of.joint99]\nstall_torque = 1", "servo_of.joint99"),
        ("", "[link_of.link01]\nmass_factor = 0", "link_of.link01.mass_factor"),
        ("", "[link_of.link14]\nmass_factor = 2", "link_of.link14"),
    ],
)
def test_faults_that_depend_on_other_keys(before, after, key):
    assert set(faults_of(f"{before}\n{SNAKE13}\n{after}")) == {key}


def test_a_gait_needs_a_plane_that_the_robot_has(tmp_path):
    assert "gait.horizontal" in faults_of(SNAKE13.split("[gait", maxsplit=1)[0])
    robot, path = tmp_path / "planar.toml", tmp_path / "s.toml"
    robot.write_text(chain(1, planes=["horizontal"]))
    text = SNAKE13.replace("snake13", robot.name)
    path.write_text(text)
    assert load_scenario(path).robot.name == "chain1"  # a robot beside its scenario
    path.write_text(text.replace("gait.horizontal", "gait.vertical"))
    with pytest.raises(ScenarioError, match="chain1 has no vertical joints"):
        load_scenario(path)
    robot.write_text("name = 3")
    with pytest.raises(RobotFileError, match=r"planar\.toml"):
        load_scenario(path)


def test_not_a_scenario_at_all(tmp_path):
    with pytest.raises(UsageError, match=r"no scenario 'flatt'.*did you mean flat"):
        load_scenario("flatt")
    with pytest.raises(ScenarioError, match="syntax"):
        parse_scenario("robot = ", "x.toml")
    (tmp_path / "s.toml").write_bytes(b"\xff\xfe")
    with pytest.raises(ScenarioError, match="not UTF-8"):
        load_scenario(tmp_path / "s.toml")


def test_changes_are_checked_and_settle_is_cut():
    scenario = load_scenario("flat").changed(duration_s=4.0, seed=9)
    assert (scenario.duration_s, scenario.settle_s, scenario.seed) == (4.0, 4.0, 9)
    assert parse_scenario(scenario.toml(), "x.toml") == scenario
    for bad in ({"duration_s": 0.0}, {"duration_s": float("nan")}, {"seed": -1}):
        with pytest.raises(UsageError):
            scenario.changed(**bad)


def test_the_session_id_changes_with_whatever_changes_the_run():
    scenario = parse_scenario(SNAKE13, "x.toml")
    other_robot = dataclasses.replace(scenario.robot, toml=scenario.robot.toml + "# later\n")
    variants = [
        scenario,
        scenario.changed(seed=2),
        scenario.changed(duration_s=1.0),
        dataclasses.replace(scenario, robot=other_robot),
        parse_scenario(SNAKE13.replace("0.3", "0.31"), "x.toml"),
    ]
    assert len({variant.session_id for variant in variants}) == len(variants)
    assert parse_scenario(SNAKE13, "x.toml").session_id == scenario.session_id
