"""Estimators of lag sweep and multisine, against planted matrices and the servo's own equations."""

import dataclasses

import numpy as np
import pytest

from undulog.analysis.estimators.series import Series
from undulog.analysis.experiment.sweep_coupling import (
    impedance,
    impedance_behind_servos,
    servo_side,
    transfer,
)
from undulog.analysis.experiment.sweep_runs import CommandTones, find_sweep
from undulog.analysis.experiment.tones import Phasors, common_step, find_tones, fit_tones
from undulog.capture.robot.model import Servo

LINEAR = dataclasses.replace(Servo(), coulomb_friction=0.0)


def random_matrix(rng, m):
    return rng.normal(size=(m, m)) + 1j * rng.normal(size=(m, m))


def dft(m, amplitude):
    place = np.arange(m)
    return amplitude * np.exp(2j * np.pi / m * np.outer(place, place))


def noisy_phasors(rng, Y, sigma, *, rate=50.0, seconds=10.0, omega=np.pi):
    """A record of every joint in every run, with white noise, fitted."""
    t = np.arange(round(rate * seconds)) / rate - seconds / 2
    values = np.real(Y.reshape(-1, 1) * np.exp(1j * omega * t))
    values += rng.normal(0.0, sigma, values.shape)
    channels = [Series(str(k), t, row) for k, row in enumerate(values)]
    fit = fit_tones(channels, np.array([omega]), omega * np.array([2.0, 3.0]))
    return Phasors(*(x[:, 0].reshape(Y.shape) for x in (fit.amplitude, fit.variance, fit.dof)))


def covered(rng, estimate):
    """Share of the real and imaginary parts of random matrices that lie in their intervals."""
    inside = []
    for _ in range(120):
        truth = random_matrix(rng, 4)
        matrix = estimate(truth)
        off = matrix.value - truth
        inside.append(np.abs([off.real, off.imag]) <= matrix.half)
    return np.mean(inside)


@pytest.mark.parametrize("design", ["dft", "random"])
def test_element_intervals_cover(design):
    rng = np.random.default_rng(7)

    def estimate(H):
        C = dft(4, 0.02) if design == "dft" else 0.02 * random_matrix(rng, 4)
        return transfer(C, noisy_phasors(rng, H @ C, 0.003))

    assert 0.93 < covered(rng, estimate) < 0.97


def test_intervals_of_an_impedance_cover():
    """Noise in torques and in responses, both."""
    rng = np.random.default_rng(8)

    def estimate(Z):
        Y = dft(4, 0.02) + 0.004 * random_matrix(rng, 4)
        return impedance(noisy_phasors(rng, Y, 3e-4), noisy_phasors(rng, Z @ Y, 5e-4))

    assert 0.93 < covered(rng, estimate) < 0.97


def test_the_error_of_a_lag_sweep_is_the_known_one():
    """Element sd 2 sigma / (A sqrt(N m)), of the complex error."""
    rng = np.random.default_rng(9)
    m, A, sigma, N = 5, 0.02, 0.001, 500
    H, C = np.eye(m) + 0.1 * random_matrix(rng, m), dft(m, A)
    matrices = [transfer(C, noisy_phasors(rng, H @ C, sigma)) for _ in range(60)]
    expected = 2 * sigma / (A * np.sqrt(N * m))
    scatter = np.sqrt(np.mean([np.abs(matrix.value - H) ** 2 for matrix in matrices]))
    assert scatter == pytest.approx(expected, rel=0.05)
    stated = np.sqrt(2 * np.mean([matrix.error**2 for matrix in matrices]))
    assert stated == pytest.approx(expected, rel=0.05)
    assert matrices[0].condition_number == pytest.approx(1.0)


def test_more_runs_than_joints_are_all_used():
    rng = np.random.default_rng(10)
    H, C = random_matrix(rng, 3), np.tile(dft(3, 0.02), 4)
    once = transfer(C[:, :3], noisy_phasors(rng, H @ C[:, :3], 0.001))
    four = transfer(C, noisy_phasors(rng, H @ C, 0.001))
    assert np.mean(four.error) == pytest.approx(np.mean(once.error) / 2, rel=0.1)
    assert np.abs(four.value - H).max() < 5 * four.error.max()


def servo_torque(servo, omega, command, angle):
    """Gear torque in the steady state, from the servo's equations solved as they stand.

    Unknown phasors: duty, current, rotor angle, torque.
    """
    s = 1j * omega
    Kt, R = servo.torque_constant, servo.resistance_ohm
    # u = Kp (c - q);  R i = V u - Kt s th;  t = (k + c s)(th - q);  J s^2 th = Kt i - b s th - t
    gear = servo.gear_stiffness + s * servo.gear_damping
    A = np.array(
        [
            [1, 0, 0, 0],
            [-servo.supply_v, R, Kt * s, 0],
            [0, 0, -gear, 1],
            [0, -Kt, servo.rotor_inertia * s**2 + servo.viscous_friction * s, 1],
        ]
    )
    return np.linalg.solve(A, [servo.proportional_gain * (command - angle), 0, -gear * angle, 0])[3]


@pytest.mark.parametrize("frequency_hz", [0.1, 0.5, 3.0])
def test_the_servo_side_solves_the_servos_equations(frequency_hz):
    omega = 2 * np.pi * frequency_hz
    servo = dataclasses.replace(LINEAR, stall_torque=0.7)
    D_r, D_q = servo_side([servo], omega)
    assert D_r[0] == pytest.approx(servo_torque(servo, omega, 1.0, 0.0), rel=1e-12)
    assert D_q[0] == pytest.approx(-servo_torque(servo, omega, 0.0, 1.0), rel=1e-12)


def test_both_routes_find_the_same_impedance():
    rng = np.random.default_rng(11)
    m, omega = 4, np.pi
    servos = [dataclasses.replace(LINEAR, stall_torque=torque) for torque in (0.3, 0.7, 1.5, 1.5)]
    Z, C = 0.05 * random_matrix(rng, m), dft(m, 0.02)
    # Each run solved joint by joint: body torque = servo torque.
    command = np.array([servo_torque(servo, omega, 1.0, 0.0) for servo in servos])
    angle = np.array([servo_torque(servo, omega, 0.0, 1.0) for servo in servos])
    Y = np.linalg.solve(Z - np.diag(angle), command[:, None] * C)
    noise = np.full(Y.shape, 1e-16), np.full(Y.shape, 24.0)
    sharp, torque = Phasors(Y, *noise), Phasors(Z @ Y, *noise)
    by_servo = impedance_behind_servos(transfer(C, sharp), *servo_side(servos, omega))
    np.testing.assert_allclose(impedance(sharp, torque).value, Z, atol=1e-10)
    np.testing.assert_allclose(by_servo.value, Z, atol=1e-10)
    # Errors by first-order propagation agree with those drawn through the whole formula.
    drawn = np.sqrt(np.mean(np.abs(by_servo.draws) ** 2, axis=0) / 2)
    np.testing.assert_allclose(drawn / by_servo.error, np.sqrt(24 / 22), rtol=0.15)


def test_tones_are_found_on_uneven_times_between_steps():
    rng = np.random.default_rng(12)
    omega = 2 * np.pi * np.array([0.4, 0.88, 1.36])
    channels = []
    for k in range(5):
        t = np.sort(np.arange(1500) / 60 + rng.uniform(-3e-3, 3e-3, 1500))
        turn = np.exp(1j * (omega * t[:, None] + rng.uniform(-3, 3, 3)))
        value = 0.1 + np.real(turn) @ [0.02, 0.015, 0.01]
        channels.append(Series(f"j{k}", t, np.round(value / 1.5e-3) * 1.5e-3))
    np.testing.assert_allclose(find_tones(channels), omega, rtol=2e-4)
    assert common_step(omega) == pytest.approx(2 * np.pi * 0.08)


def test_what_is_no_multisine():
    t = np.arange(2000) / 100
    gait = np.sin(np.pi * t) + 0.3 * np.sin(2 * np.pi * t) + 0.1 * np.sin(3 * np.pi * t)
    for values in (gait, t, np.random.default_rng(1).normal(size=t.size), np.zeros_like(t)):
        assert find_tones([Series("j1", t, values)]) is None


def sessions(columns, omega=np.pi, names="abcde"):
    return [
        CommandTones(tuple(names), "robot", np.array([omega]), column[:, None])
        for column in np.asarray(columns)
    ]


def test_a_sweep_is_recognised_by_its_commands():
    waves = dft(5, 0.02)
    turned = waves * np.exp(1j * np.arange(5))[:, None]  # each started at another time
    sweep = find_sweep([None, *sessions(turned), None])
    assert sweep.index == (1, 2, 3, 4, 5)
    assert (sweep.lines, sweep.tones, sweep.lacking) == (1, (0,), 0)
    assert find_sweep(sessions(turned[:4])).lacking == 1
    # The gait that it was planned around is no run of it, nor is one of another frequency.
    others = [*sessions([0.3 * np.exp(1j * np.arange(5))]), *sessions(waves[:1], 3.2)]
    assert find_sweep([*others, *sessions(turned)]).index == (2, 3, 4, 5, 6)


def test_what_is_no_sweep():
    wave = 0.3 * np.exp(-1j * np.pi / 3 * np.arange(5))
    assert find_sweep(sessions([wave] * 6)) is None
    assert find_sweep(sessions([wave, wave[::-1]] * 6)) is None
    kicks = wave * np.exp(0.05j * np.concatenate([np.eye(5), -np.eye(5)]))
    assert find_sweep(sessions([wave, *kicks])) is None
    pair = np.exp(1j * np.array([[0, 1], [0, -1]]))
    assert (find_sweep(sessions([*pair, *pair], names="ab")), find_sweep([])) == (None, None)
