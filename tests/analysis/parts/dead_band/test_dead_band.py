"""Dead bands against play and friction written out sample by sample: width, step, kind, absence."""

import cmath
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from support.resting import STEP, Joint, found_in, play
from undulog.analysis.parts.dead_band.measure import fundamental_change, rested

pytestmark = pytest.mark.slow

JOINTS = 6


def measured(kind, steps, seed=0, joints=JOINTS, **how):
    rng = np.random.default_rng(seed)
    made = [Joint(rng, kind, steps * STEP, **how) for _ in range(joints)]
    bands, gait = found_in(made)
    return made, bands, gait


@settings(max_examples=50, deadline=None)
@given(seed=st.integers(0, 10_000), width=st.floats(0.0, 1.5))
def test_the_operator_is_the_play_operator(seed, width):
    knots = np.cumsum(np.random.default_rng(seed).normal(size=8))
    command = np.interp(np.linspace(0, 7, 200), np.arange(8), knots)
    command[50:60] = command[50]  # a command may stand, too
    start = command[0]
    np.testing.assert_allclose(
        rested(command, width, 0.0, 0.0) - start, play(command - start, width), atol=1e-12
    )


@pytest.mark.parametrize("share", [0.02, 0.2, 0.5, 0.8])
def test_it_changes_the_fundamental_as_its_describing_function_has_it(share):
    # Gelb and Vander Velde 1968, backlash b over amplitude A: x = 1 - b / A.
    t = np.arange(20_000) / 1000.0
    command = np.sin(2 * np.pi * t)
    followed = rested(command, 2 * share, 0.0, 0.0)
    later = slice(1000, None)  # the first way up starts in the middle of the band
    got = fundamental_change(t[later], command[later], followed[later], 2 * np.pi)
    x = 1 - 2 * share
    real = 0.5 + (math.asin(x) + x * math.sqrt(1 - x * x)) / math.pi
    assert got == pytest.approx(complex(real, -(1 - x * x) / math.pi), abs=2e-3)


@pytest.mark.nightly
@pytest.mark.parametrize("kind", ["play", "play behind a lag", "stick"])
@pytest.mark.parametrize("steps", [5, 20])
def test_its_width_is_found_within_a_tenth_and_the_interval_covers(kind, steps):
    _, bands, _ = measured(kind, steps)
    assert len(bands) == JOINTS
    ends = [end for band in bands.values() for end in (band.top, band.bottom)]
    width = steps * STEP
    within = [abs(end.travel_rad / width - 1) <= 0.1 for end in ends]
    covers = [end.travel_ci95[0] <= width <= end.travel_ci95[1] for end in ends]
    no_step = [end.step_ci95[0] <= 0.0 for end in ends]
    assert np.mean(within) >= 0.95
    assert np.mean(covers) >= 0.91
    assert np.mean(no_step) >= 0.91


@pytest.mark.nightly
@pytest.mark.parametrize("how", [{"frequency": 0.25}, {"noise": 4e-4}, {"rate": 100.0}])
@pytest.mark.parametrize("kind", ["play", "play behind a lag", "stick"])
def test_also_in_step_with_the_gait_in_noise_and_sampled_fast(kind, how):
    within, covers = [], []
    for steps in (6,):
        _, bands, _ = measured(kind, steps, seed=steps, **how)
        assert len(bands) == JOINTS
        for band in bands.values():
            for end in (band.top, band.bottom):
                within.append(abs(end.travel_rad / (steps * STEP) - 1) <= 0.1)
                covers.append(end.travel_ci95[0] <= steps * STEP <= end.travel_ci95[1])
    assert np.mean(within) >= 0.95
    assert np.mean(covers) >= 0.91


@pytest.mark.nightly
def test_a_joint_that_breaks_away_catches_up_by_its_step():
    made, bands, _ = measured("stick", 30, excess=15 * STEP, lag_s=0.02)
    assert len(bands) == JOINTS
    for k, band in bands.items():
        for end in (band.top, band.bottom):
            assert end.travel_rad == pytest.approx(30 * STEP, rel=0.1)
            assert end.step_rad == pytest.approx(made[k].gain * 15 * STEP, rel=0.2)


@pytest.mark.nightly
def test_what_it_does_to_gain_and_lag_is_its_share_of_them():
    made, bands, gait = measured("play", 25)
    for k, band in bands.items():
        joint = made[k]
        ideal = fundamental_change(joint.t_s, joint.command, joint.ideal, gait.fit.omega)
        delay = cmath.exp(-1j * gait.fit.omega * 0.06)
        assert band.gain_change == pytest.approx(abs(ideal / delay), abs=0.01)
        assert band.lag_change_rad == pytest.approx(-cmath.phase(ideal / delay), abs=0.01)


@pytest.mark.parametrize("how", [{}, {"step": 0.0, "noise": 2e-3}, {"lag_s": 0.4}])
def test_a_linear_joint_has_none(how):
    _, bands, _ = measured("linear", 0, **how)
    assert bands == {}


def test_less_than_four_steps_of_the_encoder_are_not_claimed():
    _, bands, _ = measured("play", 2)
    assert bands == {}


def test_a_clipped_sensor_has_none():
    rng = np.random.default_rng(1)
    made = [Joint(rng, "linear", 0.0) for _ in range(3)]
    for joint in made:
        middle = np.median(joint.position)
        joint.position = middle + np.clip(joint.position - middle, -0.1, 0.1)
    bands, _ = found_in(made)
    assert bands == {}


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("witness", "kind"),
    [
        ("none", "stick or play, not separable"),
        ("ramp", "stick"),
        ("load", "stick"),
        ("zero", "play"),
        ("constant", "stick or play, not separable"),
        ("second", "play"),
    ],
)
def test_effort_or_a_second_sensor_tell_stick_from_play(witness, kind):
    rng = np.random.default_rng(2)
    made = [Joint(rng, "play", 20 * STEP, lag_s=0.02) for _ in range(2)]
    seen = {}
    for joint in made:
        pull = np.clip((joint.command - joint.ideal) / (10 * STEP), -1, 1)
        rests = np.concatenate(([False], np.diff(joint.ideal) == 0))
        effort = {
            "ramp": pull,
            "load": np.abs(pull),
            "zero": np.where(rests, 0.0, np.sign(pull)),
            "constant": np.full_like(pull, 0.3),
        }.get(witness)
        if effort is not None:
            noisy = effort + rng.normal(0, 0.01, pull.size)
            seen.setdefault("effort", []).append(np.abs(noisy) if witness == "load" else noisy)
        if witness == "second":
            seen.setdefault("second", []).append(joint.command + rng.normal(0, 1e-4, pull.size))
    bands, _ = found_in(made, **seen)
    assert [band.kind for band in bands.values()] == [kind] * 2
    assert all(band.evidence for band in bands.values())
