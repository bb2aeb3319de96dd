"""The whole twin against statics, friction, symmetry and its energy balance."""

import math

import numpy as np
import pytest

from support.twin_runs import energies, simulate
from undulog.capture.common.errors import SimulationError
from undulog.capture.robot.model import Plane
from undulog.sim import FrictionLaw, Ground, PlaneGait, Serpentine, Twin, World
from undulog.sim.physics.sensing import JointSample


def centre_of_mass(samples):
    # All links weigh the same here.
    return np.array([sample.step.body.position.mean(axis=1) for sample in samples])


@pytest.fixture(scope="module")
def two_cycles(make_scenario, make_robot):
    """Mean velocity over whole cycles, by heading."""

    def speed(heading):
        scenario = make_scenario(
            make_robot(stall_torque=0.25),
            frequency_hz=1.0,
            ramp_s=1.0,
            duration_s=3.0,
            world=World(heading=heading),
        )
        track = centre_of_mass(simulate(scenario))
        return (track[300] - track[100]) / 2.0

    return {degrees: speed(math.radians(degrees)) for degrees in (0, 30, 45, 90)}


@pytest.mark.nightly
@pytest.mark.parametrize("degrees", [30, 45, 90])
def test_speed_does_not_depend_on_the_heading(two_cycles, degrees):
    reference, turned = two_cycles[0], two_cycles[degrees]
    assert np.linalg.norm(turned) == pytest.approx(np.linalg.norm(reference), rel=1e-9)
    angle = math.radians(degrees)
    back = complex(turned[0], turned[1]) * complex(math.cos(angle), -math.sin(angle))
    assert (back.real, back.imag) == pytest.approx(tuple(reference[:2]), rel=1e-9)


LATERAL = {Plane.HORIZONTAL: PlaneGait(0.4, 1.0, math.pi / 3)}
CATERPILLAR = {Plane.VERTICAL: PlaneGait(0.4, 1.0, math.pi / 3)}
SIDEWINDING = {
    Plane.HORIZONTAL: PlaneGait(0.4, 1.0, math.pi / 6),
    Plane.VERTICAL: PlaneGait(0.15, 1.0, math.pi / 6, phase=math.pi / 2),
}


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("planes", "backlash"),
    [(LATERAL, 0.0), (CATERPILLAR, 0.0), (SIDEWINDING, 0.0), (LATERAL, 0.03)],
    ids=["lateral", "caterpillar", "sidewinding", "lateral with backlash"],
)
def test_power_closes_over_five_cycles(make_scenario, make_robot, planes, backlash):
    robot = make_robot(13, stall_torque=0.5, backlash=backlash)
    samples = simulate(make_scenario(robot, gait=Serpentine(planes, 1.0), duration_s=8.0))
    flow = energies(samples[800], samples[300])
    assert flow["mechanical_abs"] > 0.1
    assert abs(flow["mechanical_residual"]) < 1e-3 * flow["mechanical_abs"]
    assert abs(flow["electrical_residual"]) < 1e-3 * flow["mechanical_abs"]
    losses = ("copper", "viscous", "coulomb", "gear_damping")
    ground = ("friction_tangential", "friction_normal", "contact_damping")
    assert min(flow[term] for term in losses) > 0.0
    assert min(flow[term] for term in ground) >= 0.0
    net, stored = flow["mechanical_net"], ("kinetic", "potential", "contact_spring")
    spent = sum(flow[t] for t in (*ground, *stored, "mechanical_residual"))
    drawn = sum(flow[t] for t in (*losses, "rotor_kinetic", "gear_spring", "electrical_residual"))
    assert net == pytest.approx(spent, rel=1e-9)
    assert flow["electrical_net"] == pytest.approx(net + drawn, rel=1e-9)
    assert net == pytest.approx(2 * flow["mechanical_plus"] - flow["mechanical_abs"], rel=1e-9)


def test_the_ledger_agrees_with_the_logged_torques(make_scenario, make_robot):
    # The same energies from 100 Hz samples: E_net = sum of the integral of tau q'.
    with Twin(make_scenario(make_robot(9, stall_torque=0.25), duration_s=4.0)) as twin:
        samples = list(twin.samples())
        sensed = [reading for sample in samples for reading in sample.sensed] + twin.flush()
    joints = [reading for reading in sensed if isinstance(reading, JointSample)]
    assert len(joints) == len(samples) == 401
    power = [(joint.effort * joint.velocity).sum() for joint in joints]
    electrical = [(joint.voltage * joint.current).sum() for joint in joints]
    energy = energies(samples[-1])
    assert np.trapezoid(power, dx=0.01) == pytest.approx(energy["mechanical_net"], rel=0.02)
    assert np.trapezoid(electrical, dx=0.01) == pytest.approx(energy["electrical_net"], rel=0.02)


def test_without_ground_nothing_is_lost_to_it(make_scenario, make_robot):
    world = World(gravity=(0.0, 0.0, 0.0), ground=None)
    samples = simulate(make_scenario(make_robot(7), frequency_hz=1.0, duration_s=2.0, world=world))
    energy = energies(samples[-1])
    assert energy["friction_tangential"] == energy["friction_normal"] == 0.0
    drift = centre_of_mass(samples)[-1] - centre_of_mass(samples)[0]
    assert np.linalg.norm(drift) < 0.01 * 0.06  # a hundredth of a link, the integrator's
    assert abs(energy["mechanical_residual"]) < 1e-2 * energy["mechanical_abs"]


def test_a_failure_without_a_stiff_part_says_so(make_scenario, make_robot):
    world = World(velocity=(11.0, 0.0, 0.0))
    shown = r"at 0\.000 s: link01 moves at 11 m/s.*look at the gait"
    with pytest.raises(SimulationError, match=shown):
        simulate(make_scenario(make_robot(3), amplitude=0.0, world=world))


@pytest.mark.nightly
def test_lags_agree_with_an_independent_program(make_scenario, make_robot, response):
    # An earlier program of the same equations, with PyBullet and with MuJoCo as its engine:
    # 7.46 degrees at the ends and 13.66 in the middle, with the friction law "transeth".
    robot = make_robot(stall_torque=0.25)
    world = World(ground=Ground(law=FrictionLaw.TRANSETH))
    samples = simulate(make_scenario(robot, duration_s=16.0, world=world))[800:-1]
    yaw = robot.joint_indices(Plane.HORIZONTAL)
    commands = np.array([sample.gait.command[yaw] for sample in samples])
    angles = np.array([sample.step.body.angle[yaw] for sample in samples])
    responses = [response(c, q, 0.5) for c, q in zip(commands.T, angles.T, strict=True)]
    lag = -np.degrees(np.angle(responses))
    assert lag[[0, -1]].mean() == pytest.approx(7.46, abs=0.01)
    assert lag[4:9].mean() == pytest.approx(13.66, abs=0.01)
