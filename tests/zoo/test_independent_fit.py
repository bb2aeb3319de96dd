"""The check from outside, on closed cases."""

import numpy as np
import pytest

from zoo.independent_fit import independent_fit, period_of

T_S = np.arange(0, 30, 0.02)
COMMAND = 0.3 * np.sin(2 * np.pi * 0.5 * T_S)


def answer(gain=1.0, delay_s=0.0, offset=0.0):
    return gain * 0.3 * np.sin(2 * np.pi * 0.5 * (T_S - delay_s)) + offset


@pytest.mark.parametrize(
    ("gain", "delay_s", "offset"), [(1, 0, 0), (0.8, 0.12, 0.2), (1.3, 0.3, -1)]
)
def test_a_joint_that_follows_is_fitted_and_refutes(gain, delay_s, offset):
    fit = independent_fit(T_S, COMMAND, answer(gain, delay_s, offset), (10.0, 14.0))
    assert fit.gain == pytest.approx(gain, rel=1e-3)
    assert fit.delay_s == pytest.approx(delay_s, abs=5e-3)
    assert fit.offset == pytest.approx(offset, abs=1e-3)
    assert fit.explained > 0.9999
    assert fit.refutes


@pytest.mark.parametrize("gain", [0.55, 1.45, -1.0])
def test_another_gain_does_not_refute(gain):
    assert not independent_fit(T_S, COMMAND, answer(gain), (None, None)).refutes


def test_a_joint_that_stands_still_does_not_refute():
    fit = independent_fit(T_S, COMMAND, np.full(T_S.size, 0.1), (None, None))
    assert fit.explained == 0
    assert not fit.refutes
    noise = 1e-3 * np.random.default_rng(1).normal(size=T_S.size)
    assert not independent_fit(T_S, COMMAND, noise, (5.0, 20.0)).refutes


def test_half_of_a_fault_inside_the_span_does_not_refute():
    position = np.where((T_S > 10) & (T_S < 14), answer()[500], answer())
    assert not independent_fit(T_S, COMMAND, position, (10.0, 14.0)).refutes
    assert independent_fit(T_S, COMMAND, position, (20.0, 24.0)).refutes


def test_a_command_of_less_than_3_degrees_has_nothing_to_follow():
    small = np.radians(2.9) / 0.6
    assert independent_fit(T_S, small * COMMAND, np.zeros(T_S.size), (None, None)).refutes
    more = np.radians(3.1) / 0.6
    assert not independent_fit(T_S, more * COMMAND, np.zeros(T_S.size), (None, None)).refutes


def test_a_delay_stays_below_a_quarter_of_the_period():
    fast = 0.3 * np.sin(2 * np.pi * 2.0 * T_S)
    late = 0.3 * np.sin(2 * np.pi * 2.0 * (T_S - 0.2))  # 144 degrees
    assert not independent_fit(T_S, fast, late, (None, None)).refutes
    assert independent_fit(T_S, fast, late, (None, None)).delay_s < 0.125
    assert independent_fit(T_S, COMMAND, answer(1, 0.2), (None, None)).refutes


def test_a_short_span_is_judged_by_its_residual():
    """0.3 s of a small departure leave r^2 of the widened time above 95 %."""
    noise = 2e-3 * np.random.default_rng(2).normal(size=T_S.size)
    inside = (T_S > 10.0) & (T_S < 10.3)
    span = 10.0, 10.3
    departed = independent_fit(T_S, COMMAND, answer() + noise + 0.03 * inside, span)
    assert departed.explained > 0.95
    assert not departed.refutes
    assert independent_fit(T_S, COMMAND, answer() + noise, span).refutes


def test_the_period_of_a_command():
    assert period_of(T_S, COMMAND + 0.05 * np.sin(2 * np.pi * 3 * T_S)) == pytest.approx(
        2, rel=0.01
    )
    assert period_of(T_S, np.ones(T_S.size)) == np.inf
