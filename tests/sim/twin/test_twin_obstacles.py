"""The twin among obstacles: collisions in closed form, the energy balance, and both engines."""

import dataclasses
import math

import numpy as np
import pytest

from support.twin_runs import SNAKE13, energies, simulate
from undulog.capture.robot.model import Plane
from undulog.sim import Cylinder, ObstacleMaterial, PlaneGait, Serpentine, Wall, World
from undulog.sim.scenario.scenario import EngineKind

MASS, V = 0.3, 0.4  # of three links; the speed at which they come
WALL = Wall((0.1, -1.0), (0.1, 1.0))  # its face 0.9 - 0.03 - 0.025 m before the head's front
GAP = 0.1 - 0.01 - 0.03 - 0.025


@pytest.fixture
def thrown(make_scenario, make_robot):
    """Three straight links in free space that fly head on into a wall."""

    def throw(seconds, **material):
        world = World(
            gravity=(0.0, 0.0, 0.0),
            velocity=(V, 0.0, 0.0),
            ground=None,
            obstacles=(WALL,),
            obstacle_contact=ObstacleMaterial(**material),
        )
        straight = {"amplitude": 0.0, "duration_s": seconds, "world": world}
        return simulate(make_scenario(make_robot(3), **straight))

    return throw


def test_an_elastic_collision_turns_the_velocity_around(thrown):
    samples = thrown(0.3, stiffness=5000.0, damping=0.0, mu=0.0)
    before, after = samples[0].step.body, samples[-1].step.body
    assert before.velocity[0] == pytest.approx(V)
    assert after.velocity[0] == pytest.approx(-V, rel=2e-3)
    # Half a period of a mass on a spring, pi sqrt(m / k), within a step at either end.
    touched = samples[-1].contact_s
    assert touched[0] == pytest.approx(math.pi * math.sqrt(MASS / 5000.0), abs=1.5e-3)
    assert not touched[1:].any()
    start = GAP / V  # the turning point, a quarter of a period later, has it all in the spring
    tick = round((start + math.pi / 2 * math.sqrt(MASS / 5000.0)) * 100)
    energy, phase = energies(samples[tick]), (tick / 100 - start) * math.sqrt(5000.0 / MASS)
    whole = MASS * V**2 / 2
    assert energy["obstacle_spring"] == pytest.approx(whole * math.sin(phase) ** 2, rel=0.02)
    assert energy["kinetic"] == pytest.approx(whole * math.cos(phase) ** 2, abs=0.02 * whole)
    assert list(samples[tick].step.obstacles.link) == [0]


def test_a_damped_collision_loses_what_the_ledger_says(thrown):
    last = thrown(0.4, stiffness=5000.0, damping=20.0, mu=0.0)[-1]
    # Released at zero force rather than at zero depth: with zeta = d / (2 sqrt(m k)) the speed
    # falls by exp(-zeta / sqrt(1 - zeta^2) (pi - ...)) (Hunt & Crossley, J. Appl. Mech. 42, 1975).
    zeta = 20.0 / (2 * math.sqrt(MASS * 5000.0))
    root = math.sqrt(1 - zeta**2)
    restitution = math.exp(-zeta / root * math.atan2(2 * zeta * root, 2 * zeta**2 - 1))
    speed = -last.step.body.velocity[0, 0]
    assert speed == pytest.approx(restitution * V, rel=0.02)
    energy = energies(last)
    lost = MASS * (V**2 - speed**2) / 2
    # What the spring still held when it let go is gone too: it counts as the damper's.
    assert energy["obstacle_damping"] == pytest.approx(lost, rel=0.02)
    assert abs(energy["obstacle_friction"]) < 1e-9


@pytest.fixture(scope="module")
def forest(make_scenario, make_robot):
    """A snake that undulates between pegs and along a wall, so that it touches both."""
    pegs = tuple(Cylinder((x, y), 0.03) for x in (0.15, -0.1, -0.35, -0.6) for y in (-0.075, 0.075))
    gait = Serpentine({Plane.HORIZONTAL: PlaneGait(0.4, 0.7, math.pi / 3)}, 1.0)
    world = World(obstacles=(*pegs, Wall((-1.0, 0.2), (1.0, 0.16))))
    robot = make_robot(13, stall_torque=0.5)
    return make_scenario(robot, gait=gait, duration_s=4.0, world=world)


@pytest.mark.nightly
def test_power_closes_among_obstacles(forest):
    last = simulate(forest)[-1]
    energy = energies(last)
    assert (last.contact_s > 0.0).sum() >= 8
    assert last.contact_s.max() <= 4.0 + 1e-9
    assert energy["obstacle_friction"] > 1e-2 * energy["mechanical_abs"]
    assert energy["obstacle_damping"] > 0.0
    assert abs(energy["mechanical_residual"]) < 1e-3 * energy["mechanical_abs"]
    assert abs(energy["electrical_residual"]) < 1e-3 * energy["mechanical_abs"]
    ground = ("friction_tangential", "friction_normal", "contact_damping")
    obstacles = ("obstacle_friction", "obstacle_damping")
    stored = ("kinetic", "potential", "contact_spring", "obstacle_spring")
    spent = sum(energy[term] for term in (*ground, *obstacles, *stored))
    before = energies(simulate(dataclasses.replace(forest, duration_s=0.01))[0])
    spent -= sum(before[term] for term in stored)
    assert energy["mechanical_net"] == pytest.approx(spent + energy["mechanical_residual"])


@pytest.mark.nightly
def test_both_engines_meet_the_same_obstacles(forest):
    scenario = dataclasses.replace(forest, duration_s=1.5)
    ours, theirs = (
        simulate(dataclasses.replace(scenario, engine=engine))[-1] for engine in EngineKind
    )
    assert ours.contact_s.any()
    np.testing.assert_array_equal(ours.contact_s, theirs.contact_s)
    assert ours.step.body.position == pytest.approx(theirs.step.body.position, abs=1e-9)
    assert ours.energy == pytest.approx(theirs.energy, abs=1e-9)


def test_obstacles_out_of_reach_change_nothing(make_scenario, make_robot):
    scenario = make_scenario(make_robot(9), ramp_s=0.2, duration_s=0.3)
    far = dataclasses.replace(scenario, world=World(obstacles=(Cylinder((5.0, 0.0), 0.1),)))
    for sample, other in zip(simulate(scenario), simulate(far), strict=True):
        np.testing.assert_array_equal(sample.step.body.position, other.step.body.position)
        np.testing.assert_array_equal(sample.energy, other.energy)


def test_the_command_line_shows_the_time_in_contact(tmp_path, command, report_of):
    peg = '[[world.obstacles]]\nshape = "cylinder"\nposition = [-0.12, 0.06]\nradius = 0.03\n'
    text = f"gait.ramp_s = 0.0\n{SNAKE13.replace('2.0', '0.3').replace('0.5', '1.0')}{peg}"
    path, words = tmp_path / "peg.toml", ("-o", tmp_path / "a.mcap", "--force")
    path.write_text(text)
    touched = report_of("sim", "run", path, *words)["obstacle_contact_s"]
    assert touched
    assert all(0.0 < seconds <= 0.3 for seconds in touched.values())
    longest = max(touched, key=touched.get)
    output = command("sim", "run", path, *words).out
    assert f"touched obstacles, {longest} longest: {touched[longest]:.3g} s\n" in output
    path.write_text(text.replace("0.06]", "2.0]"))
    assert "no link touched an obstacle\n" in command("sim", "run", path, *words).out
