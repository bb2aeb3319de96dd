"""The response of one joint: known servos, recovered though a third of the record is faulty."""

import numpy as np
import pytest
from scipy import signal

from undulog.capture.judgement.response import JointResponse, fit_response

STEP = 0.02
T = np.arange(0.0, 40.0, STEP)
COMMANDS = {
    "sine": 0.5 * np.sin(2 * np.pi * 0.6 * T),
    "chirp": 0.5 * signal.chirp(T, 0.1, T[-1], 2.0),
    "steps": 0.3 * np.sign(np.random.default_rng(3).normal(size=T.size // 50)).repeat(50),
}


def servo(command, delay_s, constant_s):
    """Exact for a command that is linear between its samples: by SciPy's own simulation."""
    delayed = np.interp(T - delay_s, T, command)
    if constant_s == 0:
        return delayed
    return signal.lsim(([1.0], [constant_s, 1.0]), delayed, T, X0=delayed[0] * constant_s)[1]


def at(frequency_hz, response):
    turn = 2j * np.pi * frequency_hz
    lag = turn * response.constant_s
    pole = (1, 1 + lag, 1 + 2 * response.damping * lag + lag**2)[response.order]
    return response.gain * np.exp(-turn * response.delay_s) / pole


def spoil(position, faulty, first):
    wrong = position.copy()
    third = slice(int(first * T.size), int(first * T.size) + T.size // 3)
    wrong[third] = position[third.start] if faulty == "held" else -position[third]
    return wrong


@pytest.mark.parametrize("name", COMMANDS)
@pytest.mark.parametrize(("delay_s", "constant_s"), [(0.0, 0.0), (0.11, 0.0), (0.03, 0.1)])
def test_gain_offset_and_lag_are_those_of_the_servo(name, delay_s, constant_s):
    noise = 0.002 * np.random.default_rng(1).normal(size=T.size)
    position = 0.85 * servo(COMMANDS[name], delay_s, constant_s) + 0.04 + noise
    response = fit_response(COMMANDS[name], position, np.ones(T.size, bool), STEP)
    truth = JointResponse(1.0, 0.0, delay_s, constant_s, order=1)
    if name == "sine":  # at one frequency a delay and a pole replace each other
        assert at(0.6, response) == pytest.approx(0.85 * at(0.6, truth), rel=0.01)
    else:
        assert response.gain == pytest.approx(0.85, rel=0.02)
        assert response.lag_s == pytest.approx(truth.lag_s, abs=0.012)
    assert response.offset_rad == pytest.approx(0.04, abs=0.003)
    assert response.explained > 0.99


@pytest.mark.parametrize("faulty", ["held", "mirrored"])
@pytest.mark.parametrize("first", [0.0, 0.33, 0.66])
def test_a_third_of_the_record_may_be_faulty(faulty, first):
    position = spoil(0.9 * servo(COMMANDS["sine"], 0.05, 0.0), faulty, first)
    response = fit_response(COMMANDS["sine"], position, np.ones(T.size, bool), STEP)
    assert response.gain == pytest.approx(0.9, rel=0.03)
    assert response.lag_s == pytest.approx(0.05, abs=0.012)


def test_a_joint_that_stands_has_no_gain_and_an_inverted_one_a_negative_gain():
    there = np.ones(T.size, bool)
    still = fit_response(COMMANDS["sine"], np.full(T.size, 0.2), there, STEP)
    assert still.gain == 0
    inverted = fit_response(COMMANDS["sine"], -servo(COMMANDS["sine"], 0.05, 0.0), there, STEP)
    assert inverted.gain == pytest.approx(-1.0, rel=0.02)
