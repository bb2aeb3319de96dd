"""Screws and wheels beside joints that swing."""

import numpy as np
import pytest

from support.analysed import analysed
from support.joint_runs import write_joints
from undulog.analysis.estimators.turning import (
    reversals,
    turning_beside_others,
    turns_without_end,
    unwrapped,
)

T = np.arange(1000) / 50
TURN = 2 * np.pi
SWING = 0.4 * np.sin(5 * T)


def wrapped(angle):
    """The same angle between -pi and pi."""
    return (angle + np.pi) % TURN - np.pi


@pytest.mark.parametrize(
    "angle",
    [
        5 * T,
        -5 * T,
        60 * T,
        5 * np.clip(T - 5, 0, 10),
        5 * T + 0.5 * np.sin(1.1 * T),
        5 * np.minimum(T, 20 - T),
        wrapped(5 * T),
        wrapped(-70 * T),
        wrapped(5 * T) + np.pi,
    ],
)
def test_a_screw_turns_without_end_whichever_way_it_turns_and_is_given(angle):
    assert turns_without_end(angle)


@pytest.mark.parametrize(
    "angle",
    [
        SWING,
        30 * np.sin(5 * T),  # a gait in degrees
        TURN * np.sin(0.3 * T),  # a wrist from -360 to 360 degrees
        0.1 * T,
        2.5 * np.sign(np.sin(5 * T)),
        np.array([0.0, 2.0, -2.0])[np.arange(1000) // 10 % 3],
        np.zeros(1000),
        T[:1],
        T[:0],
    ],
)
def test_a_joint_that_swings_or_stands_does_not_turn_without_end(angle):
    assert not turns_without_end(angle)


def test_wraps_are_undone_and_other_steps_stay():
    angle = 11 * T - 3
    assert unwrapped(wrapped(angle)) == pytest.approx(angle - TURN * np.round(angle[0] / TURN))
    assert unwrapped(angle) is angle
    steps = 2.3 * np.sign(np.sin(5 * T))
    assert unwrapped(steps) == pytest.approx(steps)


def test_a_turn_to_and_fro_at_its_edge_is_no_reversal():
    assert reversals([]) == 0
    assert reversals([1, 2, 1, 2, 1, 2, 3]) == 0
    assert reversals([1, 2, 3, 4, 3, 2, 1, 0, -1]) == 1
    assert reversals([-1, -2, -3, -2, -1, 0, -1, -2]) == 2


def test_joints_that_all_turn_are_not_left_out():
    both = {"screw": 5 * T, "wheel": -9 * T}
    assert turning_beside_others(both) == ()
    assert turning_beside_others(both | {"still": np.ones(1000)}) == ()
    assert turning_beside_others(both | {"yaw": SWING}) == ("screw", "wheel")


@pytest.mark.parametrize("turned", [5 * T, 60 * T, wrapped(5 * T), 5 * np.minimum(T, 20 - T)])
def test_a_screw_does_not_cost_the_others_their_gait(tmp_path, turned):
    names = ["yaw1", "screw", "yaw2", "yaw3"]
    commands = np.stack([0.4 * np.sin(5 * T - 0.6 * k) for k in range(4)], axis=1)
    states = np.stack([0.36 * np.sin(5 * T - 0.6 * k - 0.2) for k in range(4)], axis=1)
    states += 0.002 * np.random.default_rng(2).normal(size=states.shape)
    commands[:, 1], states[:, 1] = turned, turned
    still = np.zeros_like(states)
    path = write_joints(tmp_path / "run.mcap", names, commands, (states, still, still))
    result = analysed(path)
    assert result.gait.frequency_hz.value == pytest.approx(5 / TURN, abs=1e-4)
    for joint in result.joints:
        if joint.name == "screw":
            assert joint.gain.value is None
        else:
            assert joint.gain.value == pytest.approx(0.9, abs=2e-3)
            assert joint.lag_rad.value == pytest.approx(0.2, abs=2e-3)
    assert {fault.joint for fault in result.answer.not_following} <= {"screw"}
    assert "screw turns without end: gain and lag are null" in result.notes
