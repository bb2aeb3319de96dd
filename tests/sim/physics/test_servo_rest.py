"""Servos with static friction: true rest, break-away and kinetic friction against closed forms."""

import dataclasses
import itertools
import math

import numpy as np
import pytest

from support.twin_runs import energies, simulate
from undulog.capture.common.errors import ScenarioError
from undulog.capture.robot.model import Plane, Servo
from undulog.sim import PlaneGait, Serpentine, World, load_scenario, parse_scenario
from undulog.sim.physics.servo import Rotors, Servos
from undulog.sim.scenario.scenario import EngineKind, Kernels
from undulog.sim.twin.stability import stability

DT = 1e-3


def held(servo, reference, steps=1500):
    """A rotor behind a joint that is held at zero."""
    servos, state, zero = Servos([servo]), Rotors(np.zeros(1), np.zeros(1)), np.zeros(1)
    states = []
    for _ in range(steps):
        drive = servos.drive(np.array([reference]), zero, zero, state)
        state = servos.advance(state, drive, DT)
        states.append((state.angle[0], state.speed[0]))
    return np.array(states).T, drive


@pytest.mark.parametrize(("share", "moves"), [(0.999, False), (1.001, True)])
def test_a_rotor_breaks_away_at_its_static_friction(share, moves):
    servo = Servo(static_friction=0.2, coulomb_friction=0.1)
    stiffness = servo.proportional_gain * servo.stall_torque  # N m a rad of error
    (angle, speed), _ = held(servo, share * 0.2 / stiffness)
    if moves:
        assert angle[-1] > 0
    else:
        assert (angle == 0.0).all()
        assert (speed == 0.0).all()


def test_it_comes_to_rest_where_friction_can_hold_it_and_stays_there_bit_by_bit():
    servo = Servo(static_friction=0.2, coulomb_friction=0.2)
    (angle, speed), drive = held(servo, 0.1)
    assert (speed[-500:] == 0.0).all()
    assert np.ptp(angle[-500:]) == 0.0
    motor = servo.torque_constant * drive.current[0]
    assert 0 < abs(motor - drive.torque[0]) <= 0.2


def test_a_free_rotor_stops_after_j_om2_over_2_t_c():
    nothing = dict.fromkeys(("viscous_friction", "gear_stiffness", "gear_damping"), 0.0)
    # Without drag by the winding either:
    servo = Servo(stall_torque=1e-12, coulomb_friction=0.03, static_friction=0.03, **nothing)
    servos, zero, dt = Servos([servo]), np.zeros(1), 1e-5
    state = Rotors(np.zeros(1), np.array([2.0]))
    steps = 0
    while state.speed[0] != 0.0:
        state = servos.advance(state, servos.drive(zero, zero, zero, state), dt)
        steps += 1
    assert steps * dt == pytest.approx(1.5e-3 * 2.0 / 0.03, abs=2 * dt)
    assert state.angle[0] == pytest.approx(1.5e-3 * 4.0 / (2 * 0.03), rel=1e-3)


def test_friction_falls_with_speed_as_stribeck_has_it():
    servos = Servos([Servo(static_friction=0.3, coulomb_friction=0.1, stribeck_speed=0.2)] * 3)
    state = Rotors(np.zeros(3), np.array([0.2, -0.2, 5.0]))
    drive = servos.drive(np.zeros(3), np.zeros(3), np.zeros(3), state)
    at_speed = 0.1 + 0.2 / math.e
    assert servos.friction(state, drive, DT) == pytest.approx([at_speed, -at_speed, 0.1])


def test_servos_without_it_keep_their_smooth_friction_beside_one_that_has_it():
    both = Servos([Servo(), Servo(static_friction=0.05)])
    alone = Servos([Servo()])
    state = Rotors(np.array([0.01, 0.01]), np.array([0.3, 0.3]))
    rotors = Rotors(state.angle[:1], state.speed[:1])
    drive = both.drive(np.full(2, 0.1), np.zeros(2), np.zeros(2), state)
    single = alone.drive(np.full(1, 0.1), np.zeros(1), np.zeros(1), rotors)
    after, expected = both.advance(state, drive, DT), alone.advance(rotors, single, DT)
    assert after.speed[0] == expected.speed[0]
    assert after.speed[1] != expected.speed[0]


def test_a_scenario_asks_for_it_and_less_than_kinetic_friction_is_a_fault():
    text = load_scenario("flat").toml()
    changes = {"servo.static_friction": 0.05, "servo.stribeck_speed": 0.1}
    scenario = parse_scenario(text, "flat.toml", changes=changes)
    servo = scenario.robot.joints[0].servo
    assert (servo.static_friction, servo.stribeck_speed) == (0.05, 0.1)
    assert parse_scenario(scenario.toml(), "flat.toml").robot.joints[0].servo == servo
    with pytest.raises(ScenarioError, match=r"static_friction.*at least coulomb_friction"):
        parse_scenario(text, "flat.toml", changes={"servo.static_friction": 0.01})


def test_it_needs_no_shorter_step(make_scenario, make_robot):
    rough = make_scenario(make_robot(4, coulomb_friction=0.5))
    resting = make_scenario(make_robot(4, coulomb_friction=0.5, static_friction=0.5))
    for plane in Plane:
        assert stability(resting)[plane].share <= stability(rough)[plane].share
    assert stability(resting)[Plane.HORIZONTAL].parts["servo.coulomb_friction"] == 0.0


@pytest.mark.nightly
def test_rotors_rest_at_every_reversal_and_the_ledger_closes_on_all_engines_and_kernels(
    make_robot, make_scenario
):
    robot = make_robot(3, planar=True, static_friction=0.15, coulomb_friction=0.1)
    scenario = make_scenario(
        robot,
        gait=Serpentine({Plane.HORIZONTAL: PlaneGait(0.3, 1.0, math.pi / 3)}, 0.0),
        world=World(gravity=(0.0, 0.0, 0.0), ground=None),
        physics_rate_hz=4000,
        duration_s=1.2,
    )
    angles = []
    for engine, kernels in itertools.product(EngineKind, Kernels):
        samples = simulate(dataclasses.replace(scenario, engine=engine), kernels=kernels)
        angle = np.array([sample.step.rotors.angle for sample in samples])
        still = np.array([sample.step.rotors.speed == 0.0 for sample in samples])
        energy = energies(samples[-1])
        assert (np.count_nonzero(still[20:], axis=0) >= 4).all()
        between = still[1:] & still[:-1]
        assert (np.diff(angle, axis=0)[between] == 0.0).mean() > 0.9  # but for a start between
        assert abs(energy["electrical_residual"]) < 1e-3 * energy["electrical_net"]
        assert abs(energy["mechanical_residual"]) < 1e-3 * energy["electrical_net"]
        assert energy["coulomb"] > 0
        angles.append(angle)
    for turned in angles[1:]:
        np.testing.assert_allclose(turned, angles[0], atol=1e-12)
