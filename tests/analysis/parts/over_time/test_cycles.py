"""Gain, lag and power cycle by cycle, against what was written into the session."""

import numpy as np
import pytest

from support.joint_runs import write_joints
from undulog.analysis.estimators.demodulation import amplitudes, starts_of
from undulog.analysis.session.analyse import measure_session
from undulog.analysis.session.cycle_maps import cycle_maps
from undulog.capture import Session

NAMES = ("a", "b", "c")
RATE_HZ = 100
CYCLES = 12
AMPLITUDE = 0.4
LAG = np.array([0.1, 0.2, -0.05])
GAINS = np.array([[0.9, 1.0 - 0.01 * cycle, 1.1] for cycle in range(CYCLES)]).T
"""Joint b gets weaker by 1 % a cycle."""


@pytest.fixture(scope="module")
def maps(tmp_path_factory):
    """One cycle a second; the samples of the fifth second are lost."""
    path = tmp_path_factory.mktemp("session") / "run.mcap"
    turn = 2 * np.pi * np.arange(CYCLES * RATE_HZ)[:, None] / RATE_HZ - np.pi / 3 * np.arange(3)
    size = AMPLITUDE * np.repeat(GAINS.T, RATE_HZ, axis=0)
    size[5 * RATE_HZ : 6 * RATE_HZ] = np.nan
    speed = 2 * np.pi * size * np.cos(turn - LAG)
    states = (size * np.sin(turn - LAG), speed, np.array([0.5, -0.2, 0.1]) * speed)
    write_joints(path, NAMES, AMPLITUDE * np.sin(turn), states, rate_hz=RATE_HZ, gaps=True)
    with Session.open(path) as session:
        return cycle_maps(measure_session(session))


def test_each_cycle_has_its_own_gain_and_lag(maps):
    assert (maps.driven, maps.start_s.size) == (NAMES, CYCLES)
    assert maps.period_s == pytest.approx(1.0, abs=1e-5)
    sampled = np.arange(CYCLES) != 5
    # The period comes from the responses, too, whose steps move it by 1e-6; the limits of the
    # cycles move with it.
    np.testing.assert_allclose(maps.gain[:, sampled], GAINS[:, sampled], atol=1e-4)
    expected = np.tile(LAG[:, None], CYCLES)[:, sampled]
    np.testing.assert_allclose(maps.lag_rad[:, sampled], expected, atol=1e-3)


def test_power_is_torque_times_velocity_with_its_sign(maps):
    # Mean of drag v^2 is drag (2 pi f A)^2 / 2.
    peak = 2 * np.pi * AMPLITUDE * GAINS
    truth = np.array([[0.5], [-0.2], [0.1]]) * peak**2 / 2
    sampled = np.arange(CYCLES) != 5
    assert maps.powered == NAMES
    np.testing.assert_allclose(maps.power_w[:, sampled], truth[:, sampled], rtol=0.02)


def test_a_cycle_without_samples_is_missing_not_zero(maps):
    for values in (maps.gain, maps.lag_rad, maps.power_w):
        assert np.isnan(values[:, 5]).all()
        assert np.isfinite(np.delete(values, 5, axis=1)).all()


def test_amplitudes_are_exact_on_uneven_times():
    t_s = np.sort(np.random.default_rng(2).uniform(0.0, 3.0, 240))
    values = 0.3 + np.real(0.7 * np.exp(0.4j) * np.exp(2j * np.pi * t_s))
    measured = amplitudes(t_s, values, starts_of(t_s, np.arange(4.0)), 2 * np.pi)
    np.testing.assert_allclose(measured, 0.7 * np.exp(0.4j), atol=1e-12)


def test_too_few_samples_tell_nothing():
    t_s = np.array([0.1, 0.2, 0.3, 1.1, 1.2, 1.3, 1.4, 1.5, 1.6])
    measured = amplitudes(t_s, np.cos(2 * np.pi * t_s), starts_of(t_s, np.arange(3.0)), 2 * np.pi)
    assert np.isnan(measured[0])
    assert measured[1] == pytest.approx(1.0)
