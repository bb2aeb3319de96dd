"""The straight robot as a block, a log and a stone: closed forms, on both engines."""

import dataclasses
import math

import numpy as np
import pytest

from support.twin_runs import energies, simulate
from undulog.sim import FrictionLaw, Ground, World
from undulog.sim.scenario.scenario import EngineKind
from undulog.sim.scenario.world import tilted_gravity

G, MASS, RADIUS = 9.81, 0.1, 0.025
STIFFNESS, SLIP_SPEED = Ground.stiffness, Ground.slip_speed
MU = {"along": Ground.mu_tangential, "across": Ground.mu_normal}
TURN = {"along": 0.0, "across": math.pi / 2}  # of the body, seen from the way it slides
COULOMB = tuple(law for law in FrictionLaw if law is not FrictionLaw.VISCOUS)

along_and_across = pytest.mark.parametrize("axis", ["along", "across"])
both_engines = pytest.mark.parametrize("engine", EngineKind)
every_coulomb_law = pytest.mark.parametrize(
    ("engine", "law"),
    [*((EngineKind.BULLET, law) for law in COULOMB), (EngineKind.MUJOCO, FrictionLaw.ELLIPSE)],
)


@pytest.fixture
def slide(make_robot, make_scenario):
    """Let a straight robot slide along x, its body along or across; samples at 100 Hz."""

    def build(
        engine,
        *,
        axis,
        law=FrictionLaw.ELLIPSE,
        slope=0.0,
        radius=1e-9,
        speed=0.0,
        lift=0.0,
        **fields,
    ):
        pytest.importorskip(engine.package)
        robot = make_robot(4)
        # A link touches in one point below its centre, so a straight body pushed sideways rolls.
        # With a thin body friction has no lever: it slides, as a block does.
        links = tuple(dataclasses.replace(link, radius=radius) for link in robot.links)
        world = World(
            gravity=tilted_gravity(slope, 0.0),
            heading=TURN[axis],
            velocity=(speed, 0.0, lift),
            ground=Ground(law=law),
        )
        scenario = make_scenario(
            dataclasses.replace(robot, links=links),
            amplitude=0.0,
            world=world,
            engine=engine,
            **({"physics_rate_hz": 2000} | fields),
        )
        return simulate(scenario)

    return build


def centre(sample):
    return sample.step.body.position.mean(axis=1)


def velocity(sample):
    return sample.step.body.velocity.mean(axis=1)


@both_engines
@along_and_across
@pytest.mark.parametrize("share", [0.0, 0.5])
def test_it_rests_m_g_cos_over_k_deep(slide, engine, axis, share):
    # On a slope below the angle of friction the spring bears the normal part of the weight.
    slope = math.atan(share * MU[axis])
    last = slide(engine, axis=axis, slope=slope, duration_s=0.6)[-1].step
    expected = MASS * G * math.cos(slope) / STIFFNESS
    np.testing.assert_allclose(last.contact.depth, expected, rtol=1e-9)


@along_and_across
@every_coulomb_law
def test_below_the_angle_of_friction_it_only_creeps(slide, engine, axis, law):
    share = 0.8
    # tan(slope) = share mu: smoothed friction bears it at v / sqrt(v^2 + eps^2) = share.
    samples = slide(engine, axis=axis, law=law, slope=math.atan(share * MU[axis]), duration_s=1.0)
    creep = SLIP_SPEED * share / math.sqrt(1 - share**2)
    assert velocity(samples[-1])[0] == pytest.approx(creep, rel=1e-3)


@along_and_across
@every_coulomb_law
def test_beyond_it_it_slides_with_g_sin_less_mu_cos(slide, engine, axis, law):
    mu, slope = MU[axis], math.atan(1.05 * MU[axis])
    samples = slide(engine, axis=axis, law=law, slope=slope, speed=1.0, duration_s=0.5)
    speeds = [velocity(sample)[0] for sample in samples]
    expected = G * (math.sin(slope) - mu * math.cos(slope))
    # Smoothing weakens friction by (eps/v)^2 / 2 at most.
    smoothing = 0.5 * (SLIP_SPEED / min(speeds)) ** 2 * mu * G * math.cos(slope)
    assert expected - 1e-6 < (speeds[-1] - speeds[0]) / 0.5 < expected + smoothing + 1e-6


@along_and_across
@every_coulomb_law
def test_it_stops_after_v2_over_2_mu_g(slide, engine, axis, law):
    mu = MU[axis]
    v = {"along": 0.5, "across": 3.0}[axis]
    samples = slide(engine, axis=axis, law=law, speed=v, duration_s=round(v / (mu * G) + 0.3, 1))
    way = centre(samples[-1])[0] - centre(samples[0])[0]
    assert way == pytest.approx(v**2 / (2 * mu * G), rel=2e-3)
    # Smoothing lengthens it to the integral of sqrt(v^2 + eps^2) dv / (mu g), and the
    # semi-implicit rule shortens it by half a step.
    eps = SLIP_SPEED
    smoothed = (v * math.hypot(v, eps) + eps**2 * math.asinh(v / eps)) / (2 * mu * G)
    assert way == pytest.approx(smoothed - v / 2000 / 2, rel=1e-4)
    # All of its kinetic energy went into friction along that axis of the body.
    energy = energies(samples[-1], samples[0])
    taken = {"along": "friction_tangential", "across": "friction_normal"}
    other = energy[taken[{"along": "across", "across": "along"}[axis]]]
    assert energy[taken[axis]] == pytest.approx(0.5 * 4 * MASS * v**2, rel=1e-3)
    assert abs(other) < 1e-9


@both_engines
@along_and_across
def test_viscous_drag_stops_it_after_m_v_over_c(slide, engine, axis):
    c = {"along": Ground.drag_tangential, "across": Ground.drag_normal}[axis]
    samples = slide(engine, axis=axis, law=FrictionLaw.VISCOUS, speed=1.0, duration_s=0.3)
    speeds = np.array([velocity(sample)[0] for sample in samples])
    expected = np.exp(-c / MASS * 0.01 * np.arange(31))
    np.testing.assert_allclose(speeds, (1 - c / MASS * 5e-4) ** (20 * np.arange(31)), atol=1e-9)
    np.testing.assert_allclose(speeds, expected, atol=0.02)


@both_engines
def test_pushed_sideways_a_straight_robot_rolls_as_a_log(slide, engine):
    # a = g sin / (1 + I / (m r^2)): its contact points follow below the centres.
    slope = 0.1
    samples = slide(engine, axis="across", slope=slope, radius=RADIUS, duration_s=1.0)
    expected = G * math.sin(slope) / (1 + 4e-5 / (MASS * RADIUS**2))
    # From 0.5 s on, when the creep that passes the friction on is steady.
    acceleration = (velocity(samples[-1]) - velocity(samples[50]))[0] / 0.5
    assert acceleration == pytest.approx(expected, rel=1e-6)


@both_engines
def test_thrown_up_it_leaves_its_energy_in_the_ground_s_damper(slide, engine):
    # It starts and ends m g / k deep, so spring and height hold the same in the end.
    first, *_, last = slide(engine, axis="along", lift=0.3, duration_s=0.6, physics_rate_hz=4000)
    spring = 4 * (MASS * G) ** 2 / (2 * STIFFNESS)
    assert energies(first)["contact_spring"] == pytest.approx(spring, rel=1e-12)
    energy = energies(last, first)
    assert energy["kinetic"] == pytest.approx(-0.5 * 4 * MASS * 0.3**2, rel=1e-9)
    assert energy["contact_damping"] == pytest.approx(0.5 * 4 * MASS * 0.3**2, rel=2e-3)
    assert abs(energy["contact_spring"]) < 1e-9
    assert abs(energy["potential"]) < 1e-9
