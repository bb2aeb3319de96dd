"""The free planar chain: its mass matrix, and its joints' response in closed form."""

import dataclasses
import math

import numpy as np
import pytest

from support.twin_runs import simulate
from undulog.capture.robot.model import Plane
from undulog.sim import PlaneGait, Serpentine, World
from undulog.sim.physics.engine import BodyStart, engine_type
from undulog.sim.scenario.scenario import EngineKind

IN_SPACE = BodyStart((0, 0, 0), 0.0, 0.4, (0.1, 0.0, 0.0), 1e-3)


def joint_mass(robot, turn):
    """Inertia that the joints of a free planar chain see, M_qq - M_qb M_bb^-1 M_bq.

    The plane is complex numbers: a turn about p moves the point z at i (z - p).

    Args:
        robot: Links and joints, all in one plane.
        turn: Directions of the links [rad].
    """
    n, half = len(robot.links), np.array([link.length / 2 for link in robot.links])
    mass = np.array([link.mass for link in robot.links])
    inertia = np.array([link.inertia[2] for link in robot.links])
    along = half * np.exp(1j * turn)
    centre = -np.append(0, np.cumsum(along[:-1] + along[1:]))
    moves = np.zeros((2 + n, n), dtype=complex)  # along, across, about the head, about each joint
    turns = np.zeros((2 + n, n))
    moves[0], moves[1] = 1, 1j
    moves[2], turns[2] = 1j * centre, 1
    for k in range(n - 1):
        behind, pivot = np.arange(n) > k, centre[k] - along[k]
        moves[3 + k] = 1j * (centre - pivot) * behind
        turns[3 + k] = behind
    full = (moves * mass @ moves.conj().T).real + turns * inertia @ turns.T
    base, joints = slice(0, 3), slice(3, None)
    shared = full[base, joints]
    return full[joints, joints] - shared.T @ np.linalg.solve(full[base, base], shared)


@pytest.fixture
def uneven(make_uneven):
    return make_uneven(6, planar=True)


@pytest.mark.parametrize("kind", EngineKind)
def test_a_torque_speeds_joints_up_by_the_inverse_of_the_mass_matrix(uneven, kind):
    pytest.importorskip(kind.package)
    torque = np.array([0.3, -0.1, 0.2, 0.4, -0.2])

    def bent(last):
        body = engine_type(kind)(uneven, IN_SPACE)
        for k in range(300):
            body.step(0.02 * np.sin(0.02 * k + np.arange(5)))
        before = body.read()
        body.step(last)
        after = body.read()
        body.close()
        return before, after

    state, pushed = bent(torque)
    _, left_alone = bent(np.zeros(5))  # the same motion, but for the last torque
    assert np.abs(state.angle).max() > 0.2
    turn = 2 * np.arctan2(state.quaternion[2], state.quaternion[3])
    expected = IN_SPACE.dt * np.linalg.solve(joint_mass(uneven, turn), torque)
    np.testing.assert_allclose(pushed.rate - left_alone.rate, expected, rtol=1e-9)


def linear_response(servo, mass, omega):
    """H of a = H c without contact and Coulomb friction, H = (Z + D_q)^-1 D_r, with held commands.

    Z is the chain's, D_q and D_r are the servo's: how its gear torque answers angle and command.
    """
    jw, kt = 1j * omega, servo.torque_constant
    kappa = kt * servo.supply_v * servo.proportional_gain / servo.resistance_ohm
    motor = jw**2 * servo.rotor_inertia
    motor += jw * (servo.viscous_friction + kt**2 / servo.resistance_ohm)
    gear = servo.gear_stiffness + jw * servo.gear_damping
    from_command = gear * kappa / (motor + gear)
    from_angle = gear * (kappa + motor) / (motor + gear)
    held = (1 - np.exp(-jw / 100)) / (jw / 100)  # a command stays for 10 ms
    joints = np.eye(len(mass))
    return np.linalg.solve(jw**2 * mass + from_angle * joints, from_command * held * joints)


@pytest.mark.nightly
@pytest.mark.parametrize("stall_torque", [0.25, 1.5])
def test_joints_respond_as_the_linear_chain(make_robot, make_scenario, stall_torque):
    frequency_hz, m = 1.0, 5
    robot = make_robot(m + 1, planar=True, stall_torque=stall_torque, coulomb_friction=0.0)
    # Heavier to turn than the default links, so that long steps are stable.
    links = tuple(dataclasses.replace(link, inertia=(2e-4, 2e-4, 2e-4)) for link in robot.links)
    robot = dataclasses.replace(robot, links=links)

    def response(rate_hz):
        scenario = make_scenario(
            robot,
            gait=Serpentine({Plane.HORIZONTAL: PlaneGait(0.01, frequency_hz, math.pi / 3)}, 2.0),
            world=World(gravity=(0.0, 0.0, 0.0), ground=None),
            physics_rate_hz=rate_hz,
            duration_s=20.0,
        )
        settled = simulate(scenario)[-301:-1]
        turn = np.exp(-2j * math.pi * frequency_hz * np.arange(300) / 100) / 150
        command = turn @ np.array([sample.gait.command for sample in settled])
        return command, turn @ np.array([sample.step.body.angle for sample in settled])

    command, whole = response(1000)
    _, half = response(2000)
    mass = joint_mass(robot, np.zeros(m + 1))
    # A held command has images about 100 Hz and its multiples; samples at 100 Hz take them back.
    images = 2 * math.pi * (frequency_hz + 100 * np.arange(-5, 6))
    expected = sum(linear_response(robot.joints[0].servo, mass, w) for w in images) @ command
    scale = np.abs(expected).max()
    np.testing.assert_allclose(half, expected, atol=2e-3 * scale)
    # Extrapolated to no step at all.
    np.testing.assert_allclose(2 * half - whole, expected, atol=1e-4 * scale)
