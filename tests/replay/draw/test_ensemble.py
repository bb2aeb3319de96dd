"""The mean cycle against closed forms: sines in, harmonics out."""

import dataclasses

import numpy as np
import pytest

from undulog.capture.robot.kinematics import link_poses
from undulog.replay.draw.ensemble import DEGREES, body_frame, mean_cycles, pace_of
from undulog.replay.samples.content import BodyPlaces
from undulog.replay.samples.timeline import LoggedRhythm
from undulog.replay.samples.tracks import Track

EPOCH_NS = 1_735_689_600_000_000_000
PHASE = np.radians(DEGREES)


def ns(t):
    """Unix times of seconds since the start."""
    return EPOCH_NS + np.round(t * 1e9).astype(np.int64)


def chirp(t):
    """A phase that quickens from 0.5 to 0.9 Hz in 20 s [rad]."""
    return 2 * np.pi * (0.5 * t + 0.01 * t**2)


@pytest.fixture
def rhythm():
    """The chirp as logged at 100 Hz for 20 s, wrapped."""
    t = np.arange(2001) / 100
    return LoggedRhythm.from_phase(ns(t), np.angle(np.exp(1j * chirp(t))))


def pace(rhythm, analysis=None, **options):
    """The pace of a rhythm."""
    return pace_of(
        rhythm, analysis, start_ns=EPOCH_NS, **{"commanded": (), "places": None} | options
    )


def jittered(seed=3, count=2000):
    """A servo's own times, on no grid of the phase [s]."""
    return np.arange(count) / 100 + np.random.default_rng(seed).uniform(0, 0.006, count)


def test_harmonics_come_out_of_a_gait_that_quickens(rhythm):
    t = jittered()
    phase = chirp(t)
    track = Track("a", ns(t), 0.3 + 0.4 * np.sin(phase - 0.2) + 0.05 * np.cos(3 * phase))
    means = mean_cycles([track], pace(rhythm))
    truth = 0.3 + 0.4 * np.sin(PHASE - 0.2) + 0.05 * np.cos(3 * PHASE)
    assert means.cycles.tolist() == [14]
    np.testing.assert_allclose(means.of("a")[0], truth, atol=2e-6)
    assert means.of("a")[1].max() < 1e-6


def test_what_three_harmonics_do_not_hold_is_kept(rhythm):
    t = jittered()
    flat = np.clip(0.5 * np.sin(chirp(t)), -0.3, 0.3)
    means = mean_cycles([Track("a", ns(t), flat)], pace(rhythm))
    np.testing.assert_allclose(means.of("a")[0], np.clip(0.5 * np.sin(PHASE), -0.3, 0.3), atol=3e-3)


def test_the_interval_holds_the_truth_as_often_as_it_says(rhythm):
    t = jittered()
    waves = 0.4 * np.sin(chirp(t)) + 0.02 * np.random.default_rng(11).standard_normal((60, t.size))
    tracks = [Track(str(i), ns(t), wave) for i, wave in enumerate(waves)]
    means = mean_cycles(tracks, pace(rhythm))
    assert 0.93 < (np.abs(means.value - 0.4 * np.sin(PHASE)) <= means.half)[:, :-1].mean() < 0.97


def test_a_gap_costs_its_cycles_only(rhythm):
    t = jittered()
    kept = (t < 6.0) | (t > 6.4)
    means = mean_cycles([Track("a", ns(t[kept]), np.sin(chirp(t[kept])))], pace(rhythm))
    assert means.cycles.tolist() == [13]
    np.testing.assert_allclose(means.of("a")[0], np.sin(PHASE), atol=1e-5)


def test_a_phase_that_runs_backwards_is_turned_round():
    t = np.arange(1001) / 100
    rhythm = LoggedRhythm.from_phase(ns(t), -2 * np.pi * 0.5 * t)
    means = mean_cycles([Track("a", ns(t), np.sin(2 * np.pi * 0.5 * t))], pace(rhythm))
    np.testing.assert_allclose(means.of("a")[0], np.sin(PHASE), atol=1e-6)


@pytest.fixture
def steady(analysis):
    """An analysis of a gait at 0.5 Hz, up to 10 s."""

    def make(start_s):
        window = dataclasses.replace(analysis.gait.windows[0], start_s=start_s, stop_s=10.0)
        gait = dataclasses.replace(analysis.gait, windows=(window,))
        return dataclasses.replace(analysis, gait=gait)

    return make


def test_the_analysed_window_is_averaged_where_there_is_a_gait(steady):
    t = np.arange(1001) / 100
    rhythm = LoggedRhythm.from_phase(ns(t), 2 * np.pi * 0.5 * t)
    swing = np.where(t < 4.0, 9.0, 1.0) * np.sin(2 * np.pi * 0.5 * t)  # a start, then the gait
    means = mean_cycles([Track("a", ns(t), swing)], pace(rhythm, steady(4.0)))
    assert means.cycles.tolist() == [3]
    np.testing.assert_allclose(means.of("a")[0], np.sin(PHASE), atol=1e-6)


def test_without_a_logged_phase_it_is_zero_at_the_commands_crest(steady):
    t = np.arange(1001) / 100
    wave = 2 * np.pi * 0.5 * t - 1.1
    command = Track("a", ns(t), 0.4 * np.cos(wave))
    pacing = pace(None, steady(0.0), commanded=[command], places=BodyPlaces(("a",), None))
    means = mean_cycles([command, Track("b", ns(t), 0.3 * np.cos(wave - 0.2))], pacing)
    np.testing.assert_allclose(means.of("a")[0], 0.4 * np.cos(PHASE), atol=1e-6)
    np.testing.assert_allclose(means.of("b")[0], 0.3 * np.cos(PHASE - 0.2), atol=1e-6)
    assert not pacing.logged


def test_without_a_whole_cycle_there_is_none():
    t = np.arange(150) / 100
    assert (pace(LoggedRhythm.from_phase(ns(t), 2 * np.pi * 0.5 * t)), pace(None)) == (None, None)


def test_the_frame_goes_along_with_the_body(snake25):
    angles = np.random.default_rng(5).uniform(-0.4, 0.4, (7, 25))
    centre, rotation = body_frame(snake25, angles)
    np.testing.assert_allclose(centre.mean(axis=1), 0.0, atol=1e-12)
    # The mean orientation is the identity: no small turn brings the links nearer to it.
    mean = rotation.mean(axis=1)
    np.testing.assert_allclose(mean, np.swapaxes(mean, 1, 2), atol=1e-12)
    assert np.linalg.eigvalsh(mean).min() > 0
    # And it is the same body: a rigid motion of what forward kinematics has.
    world, _ = link_poses(snake25, np.zeros((7, 3)), np.tile(np.eye(3), (7, 1, 1)), angles)
    in_body, other = (np.linalg.norm(x[:, :, None] - x[:, None], axis=-1) for x in (centre, world))
    np.testing.assert_allclose(in_body, other, atol=1e-12)


def test_a_straight_body_lies_along_x_head_first(snake25):
    centre, rotation = body_frame(snake25, np.zeros((1, 25)))
    assert np.all(np.diff(centre[0, :, 0]) < 0)
    np.testing.assert_allclose(centre[0, :, 1:], 0.0, atol=1e-15)
    np.testing.assert_allclose(rotation[0], np.tile(np.eye(3), (26, 1, 1)), atol=1e-15)


def test_a_body_known_to_a_joint_only_is_drawn_up_to_it(snake25):
    angles = np.full((2, 25), 0.1)
    angles[:, 20] = np.nan
    centre, _ = body_frame(snake25, angles)
    assert np.isfinite(centre[:, :21]).all()
    assert np.isnan(centre[:, 21:]).all()
    np.testing.assert_allclose(centre[:, :21].mean(axis=1), 0.0, atol=1e-12)
