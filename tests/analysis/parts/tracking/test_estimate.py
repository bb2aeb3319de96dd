"""Gain, lag and offset of a joint in any motion, against closed forms and SciPy's simulation."""

import numpy as np
import pytest
from scipy import signal

from undulog.analysis.estimators.series import Series
from undulog.analysis.parts.tracking.command import Command
from undulog.analysis.parts.tracking.errors import errors_of
from undulog.analysis.parts.tracking.estimate import track

GAIN, OFFSET = 0.8, 0.1


def moves(t_s, seed=0):
    """Minimum-jerk moves between random postures (Flash & Hogan, J. Neurosci. 5, 1985)."""
    rng = np.random.default_rng(seed)
    level, start, command = 0.0, 0.5, np.zeros(t_s.size)
    while start < t_s[-1]:
        length, target = rng.uniform(0.5, 1.5), rng.uniform(-0.6, 0.6)
        s = np.clip((t_s - start) / length, 0.0, 1.0)
        command += (target - level) * (10 * s**3 - 15 * s**4 + 6 * s**5)
        level, start = target, start + length + rng.uniform(0.1, 0.6)
    return command


def late(delay_s, *, held=False, rate_hz=50.0, position_hz=73.0, noise=0.0, seed=0, length_s=20.0):
    """Return a command and the positions of a joint that answers it after a pure delay."""
    rng = np.random.default_rng(seed)
    asked_s = np.arange(0.0, length_s, 1 / rate_hz)
    command = moves(asked_s, seed)
    t_s = np.arange(0.0, length_s, 1 / position_hz) + 0.001
    if held:
        index = np.searchsorted(asked_s, t_s - delay_s, side="right") - 1
        answer = command[np.maximum(index, 0)]
    else:
        answer = np.interp(t_s - delay_s, asked_s, command)
    position = OFFSET + GAIN * answer + noise * rng.standard_normal(t_s.size)
    return Series("j", asked_s, command), Series("j", t_s, position)


@pytest.mark.parametrize("delay_s", [0.02, 0.0713, 0.2])
def test_a_pure_delay_without_noise_is_exact(delay_s):
    tracked = track(*late(delay_s))
    assert tracked.order == 0
    assert not tracked.held
    assert tracked.lag_s.value == pytest.approx(delay_s, abs=1e-6)
    assert tracked.gain.value == pytest.approx(GAIN, abs=1e-6)
    assert tracked.explained == pytest.approx(1.0)


def test_offset_is_that_of_the_position_from_the_delayed_command():
    command, position = late(0.1)
    tracked = track(command, position)
    answer = (position.values - OFFSET) / GAIN
    assert tracked.offset_rad.value == pytest.approx(np.mean(position.values - answer), abs=1e-6)


@pytest.mark.parametrize("delay_s", [0.033, 0.12])
def test_a_command_that_is_held_is_told_from_lines(delay_s):
    tracked = track(*late(delay_s, held=True, noise=1e-4))
    assert tracked.held
    low, high = tracked.lag_s.ci95
    assert low <= delay_s <= high
    assert high - low < 0.02 / 4  # a quarter of the command's interval


def test_where_samples_coincide_the_interval_holds_lines_and_steps():
    """Positions at the commands' own times: k steps late, or any time up to one step less."""
    command, _ = late(0.0)
    shifted = np.concatenate([np.full(5, command.values[0]), command.values[:-5]])
    tracked = track(command, Series("j", command.t_s, GAIN * shifted))
    low, high = tracked.lag_s.ci95
    assert low == pytest.approx(0.08, abs=1e-3)
    assert high == pytest.approx(0.10, abs=1e-3)


@pytest.mark.parametrize(("a", "q", "order"), [(0.08, 0.0, 1), (0.1, 0.0025, 2), (0.05, 0.0025, 2)])
def test_the_lag_of_servos_is_that_of_slow_motion(a, q, order):
    """SciPy's simulation of the poles, with a delay besides."""
    delay_s, fine_s = 0.03, np.arange(0.0, 60.0, 0.001)
    asked_s = fine_s[::20]
    command = 0.3 * np.sin(2 * np.pi * (0.1 * asked_s + 1.2 * asked_s**2 / 60))
    inner = np.interp(fine_s, asked_s, command)
    system = ([1.0], [q, a, 1.0] if q else [a, 1.0])
    _, output, _ = signal.lsim(system, inner, fine_s)
    t_s = np.arange(0.5, 59.0, 0.013)
    held = []
    for seed in range(8):
        noise = 1e-3 * np.random.default_rng(seed).standard_normal(t_s.size)
        position = GAIN * np.interp(t_s - delay_s, fine_s, output) + noise
        tracked = track(Series("j", asked_s, command), Series("j", t_s, position))
        assert tracked.order == order
        assert tracked.lag_s.value == pytest.approx(delay_s + a, abs=1e-4)
        held.append(tracked.lag_s.ci95[0] <= delay_s + a <= tracked.lag_s.ci95[1])
        held.append(tracked.gain.ci95[0] <= GAIN <= tracked.gain.ci95[1])
    assert sum(held) >= 13  # of sixteen at 95 %, with a probability of 99 %


@pytest.mark.parametrize("held", [False, True])
def test_poles_are_those_of_the_exact_solution_between_samples(held):
    """A step of a first-order lag is 1 - exp(-t / a); a ramp is t - a (1 - exp(-t / a))."""
    t_s = np.arange(0.0, 4.0, 0.1)
    step = Series("j", t_s, (t_s >= 1.0).astype(float))
    at_s = np.linspace(1.3, 3.5, 50)
    x = Command(step, Series("j", at_s, at_s), held=held).filtered(at_s, 0.0, 0.2, 0.0)
    exact = 1 - np.exp(-(at_s - 1.0) / 0.2)
    if not held:  # a ramp of 0.1 s before it
        ramp = [(at_s - start - 0.2 * (1 - np.exp(-(at_s - start) / 0.2))) for start in (0.9, 1.0)]
        exact = (ramp[0] - ramp[1]) / 0.1
    assert np.allclose(x, exact, atol=2e-3)


def test_intervals_hold_the_truth_as_often_as_they_say():
    """60 draws: 95 % of them or, at a probability of 1 %, 52 at least."""
    held, squares = 0, []
    for seed in range(60):
        command, position = late(0.09, noise=5e-3, seed=seed)
        tracked = track(command, position)
        held += tracked.lag_s.ci95[0] <= 0.09 <= tracked.lag_s.ci95[1]
        rate = np.gradient(command.values, command.t_s)
        power = np.sum(np.interp(position.t_s - 0.09, command.t_s, rate) ** 2)
        squares.append((tracked.lag_s.value - 0.09) ** 2 * power * (GAIN / 5e-3) ** 2)
    assert held >= 52
    assert np.mean(squares) < 1.6  # of the bound without a gain and an offset to be fitted, 1


def test_an_effect_before_its_cause_is_no_lag():
    command, _ = late(0.0)
    early = Series("j", command.t_s, np.interp(command.t_s + 0.03, command.t_s, command.values))
    tracked = track(command, early)
    assert tracked.lag_s.value == 0.0
    assert tracked.lag_s.ci95 == (0.0, 0.0)
    assert tracked.gain.value == pytest.approx(1.0, abs=1e-3)


def test_a_joint_that_stands_and_one_that_is_not_asked_have_none():
    command, position = late(0.1)
    assert track(command, Series("j", position.t_s, np.ones(position.count))) is None
    assert track(Series("j", command.t_s, np.ones(command.count)), position) is None
    assert track(command, position.between(0.0, 0.15)) is None


def test_a_long_record_is_thinned_out():
    """Half an hour at 200 Hz: every sixth sample, and the answer of a shorter one."""
    tracked = track(*late(0.09, position_hz=200.0, noise=5e-3, length_s=1800.0))
    short = track(*late(0.09, position_hz=200.0, noise=5e-3, length_s=60.0))
    assert tracked.lag_s.ci95[0] <= 0.09 <= tracked.lag_s.ci95[1]
    width, shorter = (x.lag_s.ci95[1] - x.lag_s.ci95[0] for x in (tracked, short))
    assert width < shorter / 1.5


def test_errors_of_a_mean_are_those_of_correlated_noise():
    """The mean of an AR(1) series of n samples has the variance (1 + r) / (1 - r) / n of one."""
    rng, n, r = np.random.default_rng(1), 4000, 0.9
    design, t_s = np.ones((n, 1)), np.arange(float(n))
    ratios = []
    for _ in range(40):
        white = rng.standard_normal(n) * np.sqrt(1 - r * r)
        noise = signal.lfilter([1.0], [1.0, -r], white)
        errors = errors_of(t_s, design, noise - noise.mean(), np.ones((1, 1)))
        ratios.append(float(errors.sd[0]) ** 2 / ((1 + r) / (1 - r) / n))
    assert np.mean(ratios) == pytest.approx(1.0, abs=0.15)


def test_few_blocks_that_have_all_of_the_weight_leave_a_stationary_error():
    rng, n = np.random.default_rng(2), 1000
    design = np.column_stack([np.ones(n), np.zeros(n)])
    design[480:500, 1] = 1.0  # one block of sixty-four
    noise = 0.1 * rng.standard_normal(n)
    errors = errors_of(np.arange(float(n)), design, noise, np.eye(2))
    assert errors.sd[1] == pytest.approx(0.1 / np.sqrt(20), rel=0.25)


def test_parameters_that_cannot_be_told_apart_have_no_error():
    assert errors_of(np.arange(50.0), np.ones((50, 2)), np.ones(50), np.eye(2)) is None
