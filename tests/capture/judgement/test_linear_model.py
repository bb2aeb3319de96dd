"""Commands that are no rhythm, to second-order servos with a delay, sound or broken."""

import numpy as np
import pytest
from scipy import signal

from undulog.capture.judgement.judge import judge
from undulog.capture.judgement.motion import RecordedJoint, Samples

T = np.arange(0.0, 80.0, 0.01)
SERVO = signal.TransferFunction([1.0], [1 / 12.0**2, 1 / 12.0, 1.0])
RNG = np.random.default_rng(0)
COMMANDS = {
    "chirp": 0.3 * signal.chirp(T, 0.1, T[-1], 5.0),
    "falling": 0.3 * signal.chirp(T, 5.0, T[-1], 0.1),
    "logarithmic": 0.3 * signal.chirp(T, 0.1, T[-1], 5.0, method="logarithmic"),
    "noise": signal.lfilter([0.1], [1, -0.9], RNG.normal(size=T.size)),
    "steps": 0.2 * np.sign(RNG.normal(size=T.size // 20)).repeat(20),
    "sines": sum(0.1 * np.sin(2 * np.pi * f * T + f) for f in (0.3, 0.7, 1.9, 3.1, 4.4)),
}
LATER = T > 50.0


def response(command):
    delayed = np.concatenate([np.zeros(3), signal.lsim(SERVO, command, T)[1][:-3]])
    return delayed + 0.001 * np.random.default_rng(1).normal(size=T.size)


def judged(command, *positions):
    motions = [
        RecordedJoint(f"j{k + 1}", Samples(T, command), Samples(T, position))
        for k, position in enumerate(positions)
    ]
    return {fault.joint: fault for fault in judge(motions).faults}


SOME = [
    name if name in ("chirp", "steps") else pytest.param(name, marks=pytest.mark.slow)
    for name in COMMANDS
]
"""All of them, some by slow tests."""


@pytest.mark.nightly
@pytest.mark.parametrize("name", COMMANDS)
@pytest.mark.parametrize("joints", [1, 4])
def test_a_sound_servo_is_not_named_though_its_lag_passes_half_a_turn(name, joints):
    command = COMMANDS[name]
    assert judged(command, *[response(command)] * joints) == {}


@pytest.mark.parametrize("name", SOME)
def test_an_inverted_joint_is_named(name):
    command = COMMANDS[name]
    faults = judged(command, -response(command), response(command), response(command))
    assert list(faults) == ["j1"]
    assert faults["j1"].kinds == ("inverted", "inverted_sensor")


@pytest.mark.parametrize("name", SOME)
def test_a_joint_that_stands_is_named(name):
    command = COMMANDS[name]
    still = 0.001 * np.random.default_rng(2).normal(size=T.size)
    faults = judged(command, response(command), still, response(command))
    assert list(faults) == ["j2"]
    assert "dead" in faults["j2"].kinds


@pytest.mark.parametrize(
    "name",
    [
        "chirp",
        "steps",
        *(pytest.param(name, marks=pytest.mark.slow) for name in ("falling", "logarithmic")),
    ],
)
def test_a_jam_in_the_middle_is_named_with_its_time(name):
    command = COMMANDS[name]
    stopped = response(command)
    stopped[LATER] = stopped[LATER][0]
    faults = judged(command, response(command), stopped, response(command))
    assert list(faults) == ["j2"]
    assert "jammed" in faults["j2"].kinds
