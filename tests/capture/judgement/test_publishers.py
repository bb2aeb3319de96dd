"""Two nodes on one topic, and single series that alternate by themselves."""

import numpy as np
import pytest

from undulog.capture.judgement.publishers import are_of_two_nodes

T_S = np.arange(750) * 0.02
JOINTS = np.arange(5)[:, None]
WAVE = 0.4 * np.sin(2 * np.pi * 0.8 * T_S - 0.6 * JOINTS)


def in_turn(first, second):
    return np.stack(np.broadcast_arrays(first, second), axis=-1).reshape(5, -1)


@pytest.mark.parametrize(
    "other",
    [
        np.zeros_like(WAVE),
        0.6 * WAVE,
        0.4 * np.sin(2 * np.pi * 0.3 * T_S - 0.2 * JOINTS),
        WAVE + 0.5,
    ],
    ids=["zeros", "another gain", "another gait", "another zero"],
)
def test_two_series_in_turn_are_found_whichever_is_first(other):
    assert are_of_two_nodes(in_turn(WAVE, other))
    assert are_of_two_nodes(in_turn(other, WAVE))


@pytest.mark.parametrize(
    "values",
    [
        WAVE,
        WAVE + np.random.default_rng(1).normal(0, 0.3, WAVE.shape),
        np.random.default_rng(2).normal(0, 0.3, WAVE.shape),
        0.3 * np.sign(np.random.default_rng(3).normal(size=WAVE.shape)),
        0.4 * np.sin(2 * np.pi * 24.4 * T_S + JOINTS),
        0.4 * np.cos(np.pi * np.arange(750) + 0 * JOINTS),
        np.round(WAVE / 0.3) * 0.3,
        1e-3 * (np.arange(750) % 2) + 0 * JOINTS,
        np.zeros((5, 750)),
        np.full((5, 750), np.nan),
        WAVE[:, :3],
    ],
    ids=lambda _: "",
)
def test_single_series_are_not(values):
    assert not are_of_two_nodes(values)


def test_one_joint_decides_nothing():
    assert not are_of_two_nodes(in_turn(WAVE, 0 * WAVE)[:1])
