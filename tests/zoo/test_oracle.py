"""Half-widths of the oracle against closed forms."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import norm

from zoo import motions
from zoo.disturbances import Noise, step_deviation
from zoo.healthy import DEGREE, Healthy
from zoo.oracle import change_times, exposed, half_width, judged_joints, needed_s
from zoo.robot import leverage
from zoo.servos import alike, respond

M, RATE, DURATION, AMPLITUDE = 9, 50.0, 40.0, 0.3
FACTOR = norm.ppf(1 - 0.025 / (3 * M))


def robot_with(noise, **more):
    drawn = motions.Drawn(M, RATE, DURATION, np.full(M, AMPLITUDE), np.zeros(M))
    motion = motions.gait(np.random.default_rng(5), drawn)
    servos, t_s = alike(M), np.arange(int(DURATION * RATE)) / RATE
    names = tuple(f"j{j}" for j in range(M))
    return Healthy("white", names, t_s, motion, servos, respond(servos, motion, t_s), noise, **more)


def spectrum(noise, omega):
    """Power of white noise and of an autoregression at an angle a sample, white noise of 1 as 1."""
    coloured = noise.coloured**2 * (1 - noise.rho**2)
    return noise.white**2 + coloured / abs(1 - noise.rho * np.exp(-1j * omega)) ** 2


NOISES = [Noise(0.004), Noise(0.0, 0.004, 0.9), Noise(0.003, 0.004, 0.98)]


@pytest.mark.parametrize("noise", NOISES)
def test_a_gain_in_coloured_noise(noise):
    """The amplitude of a sine in noise of power S has the variance 2 S / n."""
    robot = robot_with(noise)
    omega = 2 * np.pi * robot.step_s / robot.motion.period_s
    single = (2 * spectrum(noise, omega) / robot.t_s.size) ** 0.5 / AMPLITUDE
    expected = FACTOR * single * (1 + leverage(M, 4)) ** 0.5
    half = half_width(robot, 4, robot.way[:, 4])
    assert half == pytest.approx(expected, rel=0.05)


@pytest.mark.parametrize("noise", NOISES)
def test_an_offset_in_coloured_noise(noise):
    """A mean in noise of power S at zero has the variance S / n."""
    robot = robot_with(noise)
    single = (spectrum(noise, 0.0) / robot.t_s.size) ** 0.5
    expected = FACTOR * single * (1 + leverage(M, 0)) ** 0.5
    half = half_width(robot, 0, np.ones(robot.t_s.size), nuisance=[robot.way[:, 0]])
    assert half == pytest.approx(expected, rel=0.1)


def test_a_change_of_gain_at_a_known_time():
    """After and before have half the samples each: the variance of the change is four times."""
    robot = robot_with(Noise(0.004))
    way = robot.way[:, 3]
    acts = robot.t_s >= DURATION / 2
    half = half_width(robot, 3, way * acts, within=True, nuisance=[way])
    single = 0.004 / AMPLITUDE * (2 / robot.t_s.size) ** 0.5
    assert half == pytest.approx(FACTOR * 2 * single * (1 + 1 / (M - 1)) ** 0.5, rel=0.02)


def test_half_widths_are_those_of_drawn_noise():
    """The estimate of a gain by least squares in white noise scatters as stated."""
    robot = robot_with(Noise(0.01))
    way = robot.way[:, 4]
    drawn = robot.noise.draw(np.random.default_rng(3), np.zeros((robot.t_s.size, 400)))
    errors = drawn.T @ way / (way @ way)
    expected = FACTOR * errors.std() * (1 + leverage(M, 4)) ** 0.5
    assert half_width(robot, 4, way) == pytest.approx(expected, rel=0.1)


def test_with_three_joints_nothing_is_told_from_a_comparison():
    robot = robot_with(Noise(0.004))
    moves = np.arange(M) < 3
    few = replace(robot, motion=motions.partly(robot.motion, moves))
    way, acts = robot.way[:, 1], robot.t_s >= DURATION / 2
    assert half_width(few, 1, way) == np.inf
    assert half_width(few, 1, way * acts, within=True) < 0.1


def test_what_joints_share_cancels_and_proportional_noise_counts_where_it_is():
    alone, shared = (robot_with(Noise(0.004, shared=share)) for share in (0.0, 0.75))
    way = alone.way[:, 4]
    assert half_width(shared, 4, way) == pytest.approx(half_width(alone, 4, way) / 2)
    uneven = robot_with(Noise(1e-9, relative=0.02))
    single = 0.02 / uneven.t_s.size**0.5  # each sample gives the gain with a deviation of 2 %
    expected = FACTOR * single * (1 + leverage(M, 4)) ** 0.5
    assert half_width(uneven, 4, uneven.way[:, 4]) == pytest.approx(expected, rel=0.02)


def test_an_encoder_adds_a_twelfth_of_its_squared_step():
    fast, slow = np.array([0.0, 5.0, 0.0, 5.0]), np.array([0.0, 0.25, 0.5, 0.75])
    assert step_deviation(0.0, fast) == 0
    assert step_deviation(1.0, fast) == pytest.approx(12**-0.5)
    assert step_deviation(1.0, slow) == pytest.approx((4 / 12) ** 0.5)


def test_a_joint_is_exposed_where_it_moves_by_three_rest_errors():
    """A gait that ends: from half a period after its end on nothing is asked."""
    robot = robot_with(Noise(0.001))
    motion = motions.ending(robot.motion, 20.0)
    still = replace(robot, motion=motion, way=respond(robot.servos, motion, robot.t_s))
    when = exposed(still, 2)
    half = robot.motion.period_s / 2
    assert when[robot.t_s < 20.0].all()
    assert not when[robot.t_s > 20.0 + half + 0.1].any()
    weak = replace(robot, noise=Noise(0.07))  # three times three deviations are twice the motion
    assert not exposed(weak, 2).any()
    assert judged_joints(weak, change=False) == []


def test_a_change_has_three_cycles_and_two_seconds_on_both_sides():
    robot = robot_with(Noise(0.1 * DEGREE))
    needed = needed_s(robot)
    assert needed == max(3 * robot.motion.period_s, 2.0)
    when = robot.t_s[change_times(robot, 1)]
    assert when[0] == pytest.approx(max(needed, 0.1 * DURATION), abs=0.1)
    assert when[-1] == pytest.approx(min(DURATION - needed, 0.9 * DURATION), abs=0.1)
