"""The servo against the closed forms of a DC motor, and its passivity."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from undulog.capture.robot.model import Servo
from undulog.sim.physics.servo import Rotors, Servos


def rotors(*speeds):
    return Rotors(np.zeros(len(speeds)), np.array(speeds, dtype=float))


def test_at_standstill_full_voltage_gives_the_stall_torque():
    servos = Servos([Servo(stall_torque=0.25), Servo(stall_torque=1.5, torque_constant=0.7)])
    still = np.zeros(2)
    drive = servos.drive(np.full(2, 10.0), still, still, rotors(0, 0))
    assert drive.voltage.tolist() == [6.0, 6.0]
    assert servos.torque_constant * drive.current == pytest.approx([0.25, 1.5])


def test_duty_is_proportional_then_saturated():
    servos = Servos([Servo(proportional_gain=8.0)] * 3)
    still = np.zeros(3)
    drive = servos.drive(np.array([0.05, 0.2, -0.2]), still, still, rotors(0, 0, 0))
    assert drive.voltage == pytest.approx([8 * 0.05 * 6, 6.0, -6.0])


def test_a_free_rotor_speeds_up_as_a_first_order_lag():
    # Jm om' = Kt u V / R - (b + Kt^2/R) om, no gear, no Coulomb friction.
    servo = Servo(gear_stiffness=0.0, gear_damping=0.0, coulomb_friction=0.0)
    servos, dt = Servos([servo]), 1e-5
    drag = servo.viscous_friction + servo.torque_constant**2 / servo.resistance_ohm
    final = servo.stall_torque / drag
    state, zero, speeds = rotors(0.0), np.zeros(1), []
    for _ in range(2000):
        state = servos.advance(state, servos.drive(np.array([1e3]), zero, zero, state), dt)
        speeds.append(state.speed[0])
    expected = final * (1 - np.exp(-(dt * np.arange(1, 2001)) * drag / servo.rotor_inertia))
    np.testing.assert_allclose(speeds, expected, atol=1e-3 * final)


@pytest.mark.parametrize("backlash", [0.0, 0.06])
def test_a_held_joint_winds_up_the_gear_to_the_motor_torque_and_half_its_play_more(backlash):
    # Joint locked at 0, command +-0.1: at rest k_g (|th| - B / 2) = Kt Kp V 0.1 / R.
    servo = Servo(backlash=backlash)
    servos, state, zero = Servos([servo] * 2), rotors(0.0, 0.0), np.zeros(2)
    for _ in range(3000):
        drive = servos.drive(np.array([0.1, -0.1]), zero, zero, state)
        state = servos.advance(state, drive, 1e-3)
    torque = servo.torque_constant * 8.0 * 0.1 * 6.0 / servo.resistance_ohm
    wound = torque / servo.gear_stiffness + backlash / 2
    assert drive.torque == pytest.approx([torque, -torque], rel=1e-9)
    assert state.angle == pytest.approx([wound, -wound], rel=1e-9)


def test_within_the_play_only_the_damper_acts():
    servos = Servos([Servo(backlash=0.1)] * 3 + [Servo()])
    state = Rotors(np.array([0.05, -0.02, 0.07, 0.07]), np.full(4, 0.3))
    drive = servos.drive(np.zeros(4), np.zeros(4), np.full(4, 0.1), state)
    grease = 0.05 * 0.2
    assert drive.torque == pytest.approx([grease, grease, 40 * 0.02 + grease, 40 * 0.07 + grease])


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 1000))
def test_no_more_energy_leaves_the_gear_than_enters_the_motor(seed):
    # Passivity, Ke = Kt: whatever is commanded and however the joint is moved.
    random = np.random.default_rng(seed)
    servos = Servos([Servo(stall_torque=0.25, backlash=play) for play in (0, 0, 0.02, 0.2)])
    dt, m = 1e-3, 4
    state, angle = rotors(*np.zeros(m)), np.zeros(m)
    entered, left = np.zeros(m), np.zeros(m)
    for k in range(400):
        if k % 40 == 0:
            reference, rate = random.normal(size=(2, m))
        drive = servos.drive(reference, angle, rate, state)
        after = servos.advance(state, drive, dt)
        middle = (state.speed + after.speed) / 2
        entered += dt * drive.voltage * servos.current(drive.voltage, middle)
        left += dt * drive.torque * rate
        angle, state = angle + dt * rate, after
    # What may be stored at most is stored: the rest must have been lost, never gained.
    stored = servos.inertia * state.speed**2 / 2
    stored += servos.gear_stiffness * servos.twist(angle, state.angle) ** 2 / 2
    assert (entered - left - stored > -1e-3 * np.abs(left)).all()
