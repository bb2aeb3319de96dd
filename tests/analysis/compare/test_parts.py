"""Changes, motion and mean cycles by themselves."""

import numpy as np
import pytest

from undulog.analysis.compare.quantities import Quantities
from undulog.analysis.compare.side import changes, cycles_by_phase, phases_rad, turned
from undulog.analysis.estimators.harmonic import HarmonicModel, fit_at
from undulog.analysis.estimators.series import Series
from undulog.analysis.parts.body.travel import (
    GRAVITY,
    CycleSteps,
    centre_of_mass,
    cost_of_transport,
    speed,
)
from undulog.analysis.results.comparison import MetadataChange
from undulog.capture import load_robot
from undulog.capture.robot.kinematics import quaternion_from_rotation


def test_changes_are_what_only_one_side_has_or_has_otherwise():
    same = {"robot": "snake", "session: engine": "bullet"}
    a = [same | {"scenario.toml: world.ground.mu_normal": "0.5"}] * 2
    b = [same | {"scenario.toml: world.ground.mu_normal": v, "robot.toml: x": "1"} for v in "23"]
    assert changes(a, b) == (
        MetadataChange("robot.toml: x", None, "1"),
        MetadataChange("scenario.toml: world.ground.mu_normal", "0.5", "2, 3"),
    )


def test_speed_and_cost_of_transport_of_even_steps():
    steps = CycleSteps(np.full(5, 0.2), cycle_s=2.0, mass_kg=3.0)
    assert speed(steps)[:2] == pytest.approx((0.1, 0.0))
    value, variance, dof = cost_of_transport(steps, np.full(5, 1.5))
    assert (value, variance, dof) == (pytest.approx(1.5 / (3.0 * GRAVITY * 0.2)), 0.0, 4.0)


def test_nothing_is_carried_where_the_steps_are_noise():
    steps = CycleSteps(np.array([0.1, -0.11, 0.1, -0.08]), cycle_s=1.0, mass_kg=1.0)
    assert cost_of_transport(steps, np.ones(4)) is None


def test_error_of_the_cost_of_transport_covers():
    """Ratio of two noisy means, 800 sessions of 8 cycles."""
    rng = np.random.default_rng(0)
    truth, inside = 1.0 / (GRAVITY * 0.2), 0
    for _ in range(800):
        steps = CycleSteps(rng.normal(0.2, 0.01, 8), cycle_s=1.0, mass_kg=1.0)
        value, variance, _ = cost_of_transport(steps, rng.normal(1.0, 0.03, 8))
        inside += abs(value - truth) < 2.365 * variance**0.5
    assert 0.925 < inside / 800 < 0.975


def test_the_centre_of_mass_of_a_straight_robot_is_half_a_body_behind_its_head():
    """Turned by half a turn about the vertical in the middle, with a quaternion's sign flipped."""
    robot = load_robot("snake25")
    assert len({link.length for link in robot.links}) == 1
    yaw = np.linspace(0.0, 1.0, 11)
    turn = np.zeros((11, 3, 3))
    turn[:, 0, 0] = turn[:, 1, 1] = np.cos(yaw)
    turn[:, 1, 0], turn[:, 0, 1], turn[:, 2, 2] = np.sin(yaw), -np.sin(yaw), 1.0
    quaternion = quaternion_from_rotation(turn)
    quaternion[4:] *= -1
    t_s = np.arange(11.0)
    centre = centre_of_mass(
        robot, t_s[::2], (t_s, np.zeros((11, 3)), quaternion), np.zeros((6, 25))
    )
    behind = robot.links[0].length * 25 / 2
    expected = -behind * np.stack([np.cos(yaw), np.sin(yaw), 0 * yaw], axis=-1)[::2]
    np.testing.assert_allclose(centre, expected, atol=1e-12)


def test_cycles_by_phase_keep_every_harmonic():
    """Sampled unevenly; a fit of one harmonic leaves the rest to interpolation."""
    rng = np.random.default_rng(1)
    omega = 2 * np.pi * 0.8
    t = np.sort(np.arange(0, 10, 0.005) + rng.uniform(0, 1e-3, 2000))

    def motion(phase):
        return 0.4 * np.cos(phase - 0.3) + 0.05 * np.cos(5 * phase) + 0.1

    series = Series("a", t, motion(omega * t + 1.1))
    fit = fit_at([series], omega, HarmonicModel(harmonics=1))
    cut = cycles_by_phase(series, fit, 0, zero_rad=1.1, start_s=0.0, stop_s=10.0)
    assert cut.shape == (7, 72)
    np.testing.assert_allclose(cut, np.tile(motion(phases_rad()), (7, 1)), atol=2e-4)


def test_a_cycle_with_a_gap_is_left_out():
    t = np.concatenate([np.arange(0, 3.2, 0.01), np.arange(3.7, 6.0, 0.01)])
    series = Series("a", t, np.cos(2 * np.pi * t))
    fit = fit_at([series], 2 * np.pi, HarmonicModel(harmonics=1))
    assert len(cycles_by_phase(series, fit, 0, zero_rad=0.0, start_s=0.0, stop_s=6.0)) == 5


def test_a_cycle_by_another_joints_phase():
    phase = phases_rad()
    shifted = turned(Quantities(np.cos(phase) + np.sin(3 * phase), np.ones(72), np.ones(72)), 0.7)
    expected = np.cos(phase + 0.7) + np.sin(3 * (phase + 0.7))
    np.testing.assert_allclose(shifted.value, expected, atol=1e-12)
