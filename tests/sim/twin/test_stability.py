"""The bound on the physics step, against what the twin then does."""

import dataclasses

import numpy as np
import pytest

from support.twin_runs import simulate
from undulog import sim
from undulog.capture.commands.robot import SeenJoint, draft
from undulog.capture.common.errors import SimulationError
from undulog.capture.robot.model import Plane
from undulog.sim.twin.stability import likely_cause, stability, warnings

IN_SPACE = sim.World(gravity=(0.0, 0.0, 0.0), ground=None)


def restless(scenario):
    """Fastest joint or link in the last tenth of a run; infinite where the run fails."""
    try:
        last = simulate(scenario)[-round(10 * scenario.duration_s) :]
    except SimulationError:
        return np.inf
    bodies = [sample.step.body for sample in last]
    return float(max(np.abs(np.concatenate((b.rate, *b.velocity))).max() for b in bodies))


@pytest.fixture
def nudged(make_scenario, make_robot):
    """A robot that bends each joint a little, each in its own way, and stays so."""

    def build(links, *, planar=True, rate_hz=1000, world=None, plane=Plane.HORIZONTAL, **servo):
        # Weak and without Coulomb friction: the servos neither hold the motion nor drive it.
        servo = {"coulomb_friction": 0.0, "stall_torque": 1e-2} | servo
        return make_scenario(
            make_robot(links, planar=planar, **servo),
            gait=sim.Serpentine(
                {plane: sim.PlaneGait(amplitude=1e-4, frequency_hz=0.01, lag=1.0)}, 0.0
            ),
            world=world or IN_SPACE,
            physics_rate_hz=rate_hz,
            duration_s=1.0,
        )

    return build


def largest(scenario):
    return max(use.share for use in stability(scenario).values())


@pytest.mark.parametrize("links", [2, 5])
@pytest.mark.parametrize("planar", [True, False], ids=["planar", "alternating"])
def test_gears_are_unstable_from_a_share_of_one(nudged, links, planar):
    # k_g and c_g in proportion, and the motor's damping small: so is the share.
    limit = largest(nudged(links, planar=planar))

    def scaled(share):
        gear = {"gear_stiffness": 40.0 * share / limit, "gear_damping": 0.05 * share / limit}
        return nudged(links, planar=planar, **gear)

    assert largest(scaled(0.97)) == pytest.approx(0.97, abs=1e-3)
    assert restless(scaled(0.97)) < 1e-3
    assert not restless(scaled(1.03)) < 1.0
    assert likely_cause(scaled(1.03)).startswith("likely cause: servo.gear_damping is too stiff")


@pytest.mark.parametrize(
    ("ground", "name"),
    [
        (sim.Ground(stiffness=4e5, damping=0.0, mu_normal=0.0, mu_tangential=0.0), "stiffness"),
        (sim.Ground(damping=200.0, mu_normal=0.0, mu_tangential=0.0), "damping"),
        (sim.Ground(law=sim.FrictionLaw.VISCOUS, drag_normal=75.0), "drag_normal"),
        (sim.Ground(law=sim.FrictionLaw.VISCOUS, drag_tangential=100.0), "drag_tangential"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_a_ground_is_too_stiff_from_a_share_of_one(nudged, ground, name):
    # Thrown flat on the ground with a little speed all ways.
    def scaled(share, limit=1.0):
        field = {name: getattr(ground, name) * share / limit}
        world = sim.World(velocity=(1e-4, 1e-4, -1e-4), ground=dataclasses.replace(ground, **field))
        return nudged(3, planar=False, world=world, gear_stiffness=1.0, gear_damping=1e-4)

    limit = largest(scaled(1.0))
    calm, wild = scaled(0.95, limit), scaled(1.05, limit)
    assert largest(calm) == pytest.approx(0.95, abs=0.01)
    assert restless(calm) < 1e-3
    assert not restless(wild) < 3e-3  # not much where the links leave the ground
    assert any(text.startswith(f"world.ground.{name} is too stiff") for text in warnings(wild))


def test_an_obstacle_uses_the_range_as_the_end_of_the_chain_gives_way(nudged):
    # Two links with a loose gear: 1 / mass at the end, from free links and the joint between them.
    def margin(material):
        world = dataclasses.replace(
            IN_SPACE, obstacles=(sim.Cylinder((1.0, 0.0), 0.1),), obstacle_contact=material
        )
        scenario = nudged(2, world=world, gear_stiffness=1e-9, gear_damping=1e-9)
        return stability(scenario)[Plane.HORIZONTAL]

    material = sim.ObstacleMaterial(stiffness=3e4, damping=5.0, mu=0.0)
    free = np.diag(1 / np.array([0.1, 5e-5, 0.1, 5e-5]))  # shift and turn, shift and turn
    joint = np.array([1.0, -0.03, -1.0, -0.03])
    end = np.array([1.0, 0.03, 0.0, 0.0])
    held = free @ joint
    give = end @ free @ end - (end @ held) ** 2 / (joint @ held)
    expected = (2e-3 * 5.0 + 1e-6 * 3e4) * give / 4
    assert margin(material).share == pytest.approx(expected, rel=1e-6)
    assert margin(material).stiffest == "world.obstacle_contact.stiffness"
    # Friction stops the free link's end, 39 mm from its centre, within a step: 2 dt c = 2 m.
    friction = 2.0 / (1 / 0.1 + (0.03**2 + 0.025**2) / 4e-5) * give / 4
    rough = dataclasses.replace(material, mu=0.3)
    assert margin(rough).share == pytest.approx(expected + friction, rel=1e-6)


def test_a_ground_that_does_not_carry_a_link_is_named(make_scenario, make_robot):
    robot = make_robot(4)
    heavy = dataclasses.replace(robot.links[2], mass=0.025 * 2000.0 / 9.81 + 0.01)
    links = (*robot.links[:2], heavy, robot.links[3])
    scenario = make_scenario(dataclasses.replace(robot, links=links), physics_rate_hz=4000)
    shown = "link03 is too heavy for world.ground.stiffness: with 5.10684 kg it rests 0.025 m deep"
    assert warnings(scenario)[-1] == shown
    assert likely_cause(scenario) == f"likely cause: {shown}"


@pytest.mark.parametrize(
    ("links", "planar", "rate_hz", "stable"),
    [
        (2, True, 1000, False),
        (2, True, 2000, True),
        (4, False, 1000, False),
        (4, False, 2000, True),
        (4, True, 2000, True),
        (5, True, 2000, False),
    ],
)
def test_the_default_robot_on_the_default_ground(nudged, links, planar, rate_hz, stable):
    servo = {"stall_torque": 1.5, "coulomb_friction": 0.03}
    scenario = nudged(links, planar=planar, rate_hz=rate_hz, world=sim.World(), **servo)
    assert bool(warnings(scenario)) is not stable
    assert (restless(scenario) < 1e-4) is stable


@pytest.mark.parametrize("joints", [1, 2, 25])
def test_a_drafted_robot_is_calm_at_the_default_step_and_follows(make_scenario, joints):
    names = [f"joint{k}" for k in range(joints)]
    robot = draft("mine", [SeenJoint(name, -0.5, 0.5, 2.0) for name in names], "run.mcap")
    scenario = make_scenario(robot, amplitude=0.3, ramp_s=0.5)
    assert warnings(scenario) == ()
    samples = simulate(scenario)[-20:]
    rates = np.array([sample.step.body.rate for sample in samples])
    assert np.abs(rates).max() < 2.0  # 0.3 rad at 0.5 Hz: 0.94 rad/s
    errors = [sample.gait.command - sample.step.body.angle for sample in samples]
    assert np.abs(errors).max() < 0.1


@pytest.mark.parametrize("name", sim.scenario_names())
def test_shipped_scenarios_are_within_the_bound(name):
    assert not warnings(sim.load_scenario(name))


def test_among_obstacles_the_shipped_robot_needs_two_kilohertz():
    slow, fast = (sim.load_scenario("random-walk", {"physics_rate_hz": hz}) for hz in (1000, 2000))
    assert any("too stiff for steps of 1 ms" in text for text in warnings(slow))
    assert not warnings(fast)
