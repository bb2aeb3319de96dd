"""Healthy robots of the bench: motions, servos and noise against closed forms."""

from dataclasses import replace

import numpy as np
import pytest

from zoo import motions
from zoo.adapter import stated
from zoo.disturbances import Noise, quantised, repeated
from zoo.healthy import DEGREE, Healthy
from zoo.independent_fit import EXPLAINED, independent_fit
from zoo.planted_faults import KINDS, draw, record
from zoo.servos import alike, first_order, played, respond, stuck

DRAWN = [name for name in KINDS if name != "twin"]
"""Kinds in closed form: the twin compiles its laws."""

SESSION = motions.Drawn(3, 50.0, 30.0, np.full(3, 0.4), np.array([0.0, 0.1, -0.1]))


def test_there_are_enough_kinds():
    assert len(KINDS) >= 21
    assert "twin" in KINDS


@pytest.mark.parametrize("name", DRAWN)
def test_a_kind_is_drawn_within_its_limits_and_by_its_seed(name):
    for seed in range(2):
        robot, again = draw(name, seed), draw(name, seed)
        rate = 1 / robot.step_s
        assert 3 <= robot.m <= 60
        assert 20 <= rate <= 200.001
        assert 9.9 <= robot.t_s.size / rate <= 120.1
        assert 0.25 * DEGREE <= robot.motion.amplitude.max() <= 60.001 * DEGREE
        assert robot.way.shape == (robot.t_s.size, robot.m)
        assert robot.commands().shape == robot.way.shape
        np.testing.assert_array_equal(robot.way, again.way)
        signals, same = record(robot, seed=seed), record(again, seed=seed)
        np.testing.assert_array_equal(signals.positions, same.positions)
        assert np.isfinite(signals.positions).all()
        assert (signals.efforts is not None) == (name == "efforts")
    assert not np.array_equal(draw(name, 0).way, draw(name, 1).way)


@pytest.mark.parametrize("name", ["white", "ar90", "soft", "delayed", "wander", "chirp", "arm"])
def test_healthy_joints_follow_by_the_independent_fit(name):
    """But for the noise, a joint explains 95 % of its motion by its command."""
    robot = draw(name, 4)
    signals = record(robot, seed=4)
    large = [j for j in robot.moved if np.ptp(robot.way[:, j]) > 12 * robot.noise.deviation]
    for j in large[:5]:
        fit = independent_fit(robot.t_s, signals.commands[:, j], signals.positions[:, j], (0, None))
        assert fit.explained > EXPLAINED
        assert fit.refutes


def test_a_sine_answers_with_gain_delay_and_pole():
    motion = motions.gait(np.random.default_rng(1), SESSION)
    servos = alike(3, gain=0.9, delay_s=0.043, pole_s=0.06)
    t_s = np.arange(0, 30, 0.02)
    way = respond(servos, motion, t_s)
    late = t_s > 1  # ten time constants
    for j in range(3):
        angle = 2 * np.pi * t_s[late] / motion.period_s
        model = np.stack([np.cos(angle), np.sin(angle), np.ones(angle.size)], axis=1)
        asked, moved = (
            np.linalg.lstsq(model, values[late])[0]
            for values in (motion.at(t_s[:, None])[:, j], way[:, j])
        )
        response = complex(moved[0], -moved[1]) / complex(asked[0], -asked[1])
        omega = 2 * np.pi / motion.period_s
        expected = 0.9 * np.exp(-0.043j * omega) / (1 + 0.06j * omega)
        assert response == pytest.approx(expected, abs=2e-3)
        assert moved[2] == pytest.approx(motion.middle[j], abs=1e-3)


def test_joints_are_unlike_where_gain_or_lag_is_beyond_the_margins():
    motion = motions.gait(np.random.default_rng(1), SESSION)
    t_s = np.arange(0, 30, 0.02)

    def unlike(gain=0.0, lag=0.0):
        delay_s = np.array([0.0, 0.0, lag]) * DEGREE * motion.period_s / (2 * np.pi)
        servos = replace(alike(3), gain=np.array([1.0, 1.0, 1.0 + gain]), delay_s=delay_s)
        way = respond(servos, motion, t_s)
        return Healthy("arm", "abc", t_s, motion, servos, way, Noise(1e-3), differs=True).unlike

    assert not unlike()
    assert not unlike(gain=0.029)  # 1.9 % from the mean of three
    assert unlike(gain=0.032)
    assert not unlike(lag=1.4)
    assert unlike(lag=1.6)


def test_a_step_through_a_pole_is_an_exponential():
    t_s = np.arange(0, 1, 0.01)
    ramp = np.maximum(t_s - 0.1, 0)
    after = np.maximum(t_s - 0.1, 0)
    expected = after - 0.2 * (1 - np.exp(-after / 0.2))  # a ramp through T y' + y = u
    np.testing.assert_allclose(first_order(ramp, 0.2, 0.01), expected, atol=1e-12)
    np.testing.assert_array_equal(first_order(ramp, 0.0, 0.01), ramp)


def test_play_lags_by_half_of_itself_on_both_ways():
    way = np.concatenate([np.linspace(0, 1, 101), np.linspace(1, 0, 101)])[:, None]
    out = played(way, np.array([0.1]))[:, 0]
    np.testing.assert_allclose(out[15:101], way[15:101, 0] - 0.1)
    np.testing.assert_allclose(out[125:], way[125:, 0] + 0.1)
    np.testing.assert_allclose(out[102:120], 0.9)


def test_stick_rests_at_a_reversal_and_then_is_right_behind():
    way = np.concatenate([np.linspace(0, 1, 101), np.linspace(0.99, 0, 100)])[:, None]
    out = stuck(way, np.array([0.105]))[:, 0]
    np.testing.assert_allclose(out[:11], 0.0)
    np.testing.assert_allclose(out[11:101], way[11:101, 0])
    np.testing.assert_allclose(out[101:111], 1.0)
    np.testing.assert_allclose(out[112:], way[112:, 0])


def test_a_motion_ends_and_holds_and_goes_on():
    motion = motions.gait(np.random.default_rng(2), SESSION)
    t = np.arange(0, 30, 0.1)[:, None]
    ended = motions.ending(motion, 12.0).at(t)
    np.testing.assert_allclose(ended[:121], motion.at(t)[:121])
    np.testing.assert_allclose(ended[120:], np.broadcast_to(ended[120], ended[120:].shape))
    held = motions.holding(motion, [(5.0, 2.0), (15.0, 3.0)]).at(t)
    np.testing.assert_allclose(held[:51], motion.at(t)[:51])
    np.testing.assert_allclose(held[50:71], np.broadcast_to(held[50], (21, 3)))
    np.testing.assert_allclose(held[70:151], motion.at(t - 2.0)[70:151], atol=1e-12)
    np.testing.assert_allclose(held[180:], motion.at(t - 5.0)[180:], atol=1e-12)


@pytest.mark.parametrize("kind", ["gait", "chirp", "multisine", "steps", "binary", "work"])
def test_motions_stay_within_their_amplitude_and_are_no_faster_than_a_joint(kind):
    motion = getattr(motions, kind)(np.random.default_rng(3), SESSION)
    t = np.arange(0, 30, 1e-3)[:, None]
    away = motion.at(t) - motion.middle
    most = 1.0 if kind != "multisine" else (motions.TONES / 2) ** 0.5
    assert (np.abs(away) <= most * motion.amplitude + 1e-12).all()
    assert (np.ptp(away, axis=0) > 0.3).all()
    if kind not in ("steps", "binary", "multisine"):
        assert np.abs(np.diff(away, axis=0)).max() / 1e-3 <= motions.SPEED_RAD_S * 1.01


def test_noise_has_its_variance_correlation_and_share():
    rng, way = np.random.default_rng(1), np.zeros((100_000, 2))
    drawn = Noise(0.0, 2.0, 0.9, shared=0.5).draw(rng, way)
    assert drawn.std() == pytest.approx(2.0, rel=0.05)
    assert np.mean(drawn[1:] * drawn[:-1]) / 4 == pytest.approx(0.9, abs=0.02)
    assert np.mean(drawn[:, 0] * drawn[:, 1]) / 4 == pytest.approx(0.5, abs=0.05)
    heavy = Noise(1.0, tail=6.0).draw(rng, way)
    assert heavy.std() == pytest.approx(1.0, rel=0.03)
    assert np.mean(heavy**4) == pytest.approx(6.0, rel=0.25)  # 3 + 6 / (6 - 4)
    along = Noise(0.0, relative=0.1).draw(rng, way + np.array([2.0, 0.0]))
    assert along[:, 0].std() == pytest.approx(0.2, rel=0.03)
    assert not along[:, 1].any()


@pytest.mark.parametrize(
    "noise", [Noise(0.3), Noise(0.0, 0.5, 0.98), Noise(0.3, 0.5, 0.9), Noise(0.2, 1.0, 0.999)]
)
def test_whitened_noise_is_white_with_a_variance_of_1(noise):
    way = np.zeros((40_000, 1))
    drawn = noise.draw(np.random.default_rng(7), way)
    white = noise.whitened(drawn.T, way[:, 0])[0]
    assert white.var() == pytest.approx(1.0, abs=0.03)
    for shift in (1, 2, 5, 50):
        assert abs(np.mean(white[shift:] * white[:-shift])) < 0.02


def test_encoders_count_in_steps_and_pauses_repeat():
    values = np.array([0.04, 0.06, 0.26])
    np.testing.assert_allclose(quantised(values, 0.1), [0.0, 0.1, 0.3])
    np.testing.assert_array_equal(quantised(values, 0.0), values)
    rows = np.arange(10.0)[:, None]
    paused = repeated(rows, [(3, 2), (7, 1)])[:, 0]
    np.testing.assert_array_equal(paused, [0, 1, 2, 2, 2, 5, 6, 6, 8, 9])


@pytest.mark.nightly
def test_the_twin_is_healthy():
    robot = draw("twin", 1)
    assert robot.moved.size == 13
    np.testing.assert_allclose(
        robot.commands()[:, robot.moved].min(), -robot.motion.amplitude.max()
    )
    signals = record(robot, seed=1)
    for j in robot.moved:
        fit = independent_fit(robot.t_s, signals.commands[:, j], signals.positions[:, j], (0, None))
        assert fit.explained > EXPLAINED


@pytest.mark.slow
@pytest.mark.parametrize("seed", [8103, 8203])
def test_edges_of_steps_between_samples_are_no_motion_of_a_joint(seed):
    """What no response fits of them is a share of what the command moves at a frequency."""
    statement = stated(record(draw("binary", seed), seed=seed))
    assert [
        difference for difference in statement.different if difference.quantity == "motion"
    ] == []
