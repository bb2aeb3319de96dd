"""Compensation of the 25 joints in contact, on runs and gaits that were not used for it."""

import math
from dataclasses import replace

import numpy as np
import pytest

from support.compensating import Stage, Wave, indices, ratio

pytestmark = pytest.mark.nightly

M = 13


@pytest.fixture(scope="module")
def stage():
    return Stage(M, 0.25)


@pytest.fixture(scope="module")
def commands(stage):
    """Two steps, from kicks and one run of the first."""
    return stage.compensate(stage.kicks(Wave(M), 1), Wave(M), 2, rounds=2)[-1][1]


def driven(stage, wave, command, stream, runs=3):
    return indices(stage.drive(wave, [command] * runs, [[stream, k] for k in range(runs)]), wave)


def test_the_spread_of_gain_and_lag_is_more_than_halved(stage, commands):
    wave = Wave(M)
    before = driven(stage, wave, wave.phasors, 3)
    after = driven(stage, wave, commands, 4)
    for now, then in zip(after, before, strict=True):
        value, _, high = ratio(now, then)
        assert value < 0.5
        assert high < 0.6


@pytest.mark.parametrize(
    "change",
    [
        {"amplitude": 0.44},
        {"amplitude": 0.36},
        {"frequency_hz": 0.55},
        {"frequency_hz": 0.45},
        {"lag": math.pi / 3 + math.radians(5)},
        {"lag": math.pi / 3 - math.radians(5)},
    ],
    ids=str,
)
def test_gaits_near_by_are_not_worse_with_the_same_change(stage, commands, change):
    wave = replace(Wave(M), **change)
    changed = wave.phasors * (commands / Wave(M).phasors)
    pair = stage.drive(wave, [wave.phasors, changed], [[5, 0], [6, 0]])
    before, after = (indices([run], wave) for run in pair)
    assert np.abs(changed).max() < math.pi / 6
    for now, then in zip(after, before, strict=True):
        assert now.value <= then.value
