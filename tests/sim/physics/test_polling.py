"""Polled joints against motions known in closed form."""

import math

import numpy as np
import pytest

from undulog.sim.physics.sensors import JointPolling
from undulog.sim.physics.steps import Steps
from undulog.sim.scenario.sensors import Noise, ServoPolling

DT, N, JOINTS = 1e-3, 10, 4


def periods(count, angle, rate, drive):
    """Control periods of steps; ``drive`` is what acts from the step's start to its end."""

    def period(p):
        steps = range(N * p, N * p + N + 1)
        motion = [np.array([value(k * DT) for k in steps]) for value in (angle, rate)]
        torque, current, voltage = np.array([drive(k) for k in steps]).transpose(1, 0, 2)
        whole = Steps.empty(N + 1, JOINTS + 1, JOINTS)
        body, held = whole.stacked.body, whole.stacked.drive
        body.angle[:], body.rate[:] = motion
        held.torque[:], held.current[:], held.voltage[:] = torque, current, voltage
        return whole

    return [period(p) for p in range(count)]


def polling(servos=None, noise=None, seed=1):
    return JointPolling(
        servos or ServoPolling(), noise or Noise(), JOINTS, period_steps=N, dt=DT, seed=seed
    )


def cycles(poll, run):
    return [sample for period in run for sample in poll.observe(period)] + poll.flush()


def moving(count, angle=lambda t: np.zeros(JOINTS)):
    """Angles alone; rates and drives are zero."""
    return periods(count, angle, lambda t: np.zeros(JOINTS), lambda k: np.zeros((3, JOINTS)))


SLOPE = np.arange(1.0, JOINTS + 1)


def ramps(count):
    """Angles and rates that grow linearly in time, and drives that grow from step to step."""
    return periods(
        count,
        angle=lambda t: SLOPE * t,
        rate=lambda t: -SLOPE * t,
        drive=lambda k: (SLOPE * k, 2 * SLOPE * k, np.full(JOINTS, (-1.0) ** k)),
    )


def test_a_cycle_comes_two_ticks_after_its_start_and_each_tick_has_one():
    poll = polling(ServoPolling(slot_s=1.3e-3))
    released = [[sample.cycle for sample in poll.observe(period)] for period in ramps(5)]
    # The period that is handed over p-th ends with tick p + 1.
    assert released == [[], [0], [1], [2], [3]]
    assert ([sample.cycle for sample in poll.flush()], poll.flush()) == ([4, 5], [])


def test_a_run_without_a_control_period_has_no_cycle_and_a_short_one_has_all():
    assert polling().flush() == []
    assert [sample.cycle for sample in cycles(polling(), ramps(1))] == [0, 1]


def test_at_once_the_samples_are_those_of_the_tick():
    for sample in cycles(polling(), ramps(6)):
        t = sample.cycle * N * DT
        np.testing.assert_array_equal(sample.offset_s, 0.0)
        np.testing.assert_allclose(sample.position, SLOPE * t, rtol=1e-15)
        np.testing.assert_allclose(sample.velocity, -SLOPE * t, rtol=1e-15)


@pytest.mark.parametrize("slot_s", [0.0, 1e-3, 1.3e-3, 2.4999e-3])
def test_each_joint_has_its_own_time_and_a_mean_around_it(slot_s):
    count = 6
    for sample in cycles(polling(ServoPolling(slot_s=slot_s)), ramps(count)):
        start, end = sample.cycle * N * DT, count * N * DT
        # After the run's end no joint can be sampled: the last cycle is that of the end.
        expected = slot_s * np.arange(JOINTS) if sample.cycle < count else np.zeros(JOINTS)
        np.testing.assert_allclose(sample.offset_s, expected, atol=1e-17)
        t = start + sample.offset_s
        np.testing.assert_allclose(sample.position, SLOPE * t, rtol=1e-12)
        np.testing.assert_allclose(sample.velocity, -SLOPE * t, rtol=1e-12)
        lower, upper = np.maximum(t - 0.005, 0.0) / DT, np.minimum(t + 0.005, end) / DT

        def integral(x):
            # Of floor(x'), what a value k held from step k to step k + 1 has up to x.
            whole = np.floor(x + 1e-9)
            return whole * (whole - 1) / 2 + whole * (x - whole)

        mean = (integral(upper) - integral(lower)) / (upper - lower)
        np.testing.assert_allclose(sample.effort, SLOPE * mean, rtol=1e-9)
        np.testing.assert_allclose(sample.current, 2 * SLOPE * mean, rtol=1e-9)


def test_a_ripple_with_the_control_period_cancels_wherever_a_joint_is_sampled():
    def drive(k):
        ripple = np.full(JOINTS, math.cos(2 * math.pi * (k % N) / N))
        return ripple, ripple, ripple + 3.0

    run = periods(6, lambda t: SLOPE * t, lambda t: SLOPE, drive)
    poll = polling(ServoPolling(slot_s=2.1e-3))
    for sample in [s for period in run for s in poll.observe(period)][1:]:
        np.testing.assert_allclose(sample.effort, 0.0, atol=1e-12)
        np.testing.assert_allclose(sample.voltage, 3.0, atol=1e-12)


def test_the_encoder_sends_whole_steps():
    step = 0.0015
    for sample in cycles(polling(ServoPolling(resolution=step)), ramps(5)):
        true = SLOPE * sample.cycle * N * DT
        assert np.abs(sample.position - true).max() <= step / 2 + 1e-15
        np.testing.assert_allclose(sample.position / step, np.rint(sample.position / step))
        np.testing.assert_allclose(sample.velocity, -true, rtol=1e-12)


def test_within_its_dead_band_the_encoder_stands_still():
    swing, band = 0.02, 0.015
    run = moving(40, lambda t: np.full(JOINTS, swing * math.sin(2 * math.pi * 5 * t)))
    readings = np.array([s.position[0] for s in cycles(polling(ServoPolling(dead_band=band)), run)])
    true = swing * np.sin(2 * np.pi * 5 * 0.01 * np.arange(41))
    assert np.abs(readings - true).max() <= band
    changes = np.diff(readings)
    assert (np.abs(changes[changes != 0.0]) > band).all()
    still = moving(5, lambda t: np.full(JOINTS, 0.9 * band * math.sin(100 * t)))
    for sample in cycles(polling(ServoPolling(dead_band=band)), still):
        np.testing.assert_array_equal(sample.position, 0.0)


def test_noise_is_white_and_has_the_asked_deviation():
    noise = Noise(position=1e-3, velocity=1e-2, effort=0.1)
    run = moving(2000)
    samples = cycles(polling(noise=noise), run)
    for name, sigma in (("position", 1e-3), ("velocity", 1e-2), ("effort", 0.1)):
        values = np.array([getattr(sample, name) for sample in samples])
        # Standard error of a deviation from 8,004 values: 0.8 %.
        assert values.std() == pytest.approx(sigma, rel=0.03)
        assert abs(values.mean()) < 4 * sigma / math.sqrt(values.size)
        assert abs(np.corrcoef(values[1:, 0], values[:-1, 0])[0, 1]) < 0.1
    again = cycles(polling(noise=noise), run)
    assert all(np.array_equal(a.position, b.position) for a, b in zip(samples, again, strict=True))
    other = cycles(polling(noise=noise, seed=2), run)
    assert not np.array_equal(samples[0].position, other[0].position)
