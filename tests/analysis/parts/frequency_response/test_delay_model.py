"""Delays and transfer functions that are known."""

import numpy as np
import pytest
from scipy import stats

from undulog.analysis.parts.frequency_response.delay_model import ORDERS, fit_delay, group_delay

F_HZ = np.geomspace(0.2, 8.0, 40)


def noisy(value, rng, relative):
    sd = relative * np.abs(value)
    noise = (rng.normal(size=value.size) + 1j * rng.normal(size=value.size)) / np.sqrt(2)
    return value + sd * noise, sd**2


def servo(f_hz, delay_s, natural_hz=3.0, damping=0.4):
    s = 2j * np.pi * f_hz
    w = 2 * np.pi * natural_hz
    return np.exp(-s * delay_s) * w**2 / (s**2 + 2 * damping * w * s + w**2)


@pytest.mark.nightly
def test_delay_and_response_of_a_second_order_system_lie_within_their_intervals():
    rng, inside = np.random.default_rng(0), []
    for _ in range(60):
        value, variance = noisy(servo(F_HZ, 0.023), rng, 0.02)
        model = fit_delay(F_HZ, value, variance, freedom=12)
        inside.append(model.interval_s[0] <= 0.023 <= model.interval_s[1])
        assert model.orders is not None
        assert np.abs(model.response(F_HZ) / servo(F_HZ, 0.023) - 1).max() < 0.1
    assert 0.88 <= np.mean(inside) <= 1.0


def test_the_lowest_sufficient_order_is_taken():
    rng = np.random.default_rng(1)
    value, variance = noisy(0.9 * np.exp(-2j * np.pi * F_HZ * 0.01), rng, 0.01)
    model = fit_delay(F_HZ, value, variance, freedom=12)
    assert model.orders == (0, 0)
    assert model.numerator == pytest.approx([0.9], rel=0.01)
    assert model.interval_s[0] <= 0.01 <= model.interval_s[1]
    assert model.delay_s == pytest.approx(0.01, abs=1e-4)


def test_without_a_model_it_is_the_group_delay():
    rng = np.random.default_rng(2)
    ripple = np.exp(-2j * np.pi * F_HZ * 0.05) * (1 + 0.5 * np.sin(40 * np.log(F_HZ)))
    value, variance = noisy(ripple, rng, 0.002)
    model = fit_delay(F_HZ, value, variance, freedom=12)
    assert (model.orders, model.p < 0.01) == (None, True)
    assert model.delay_s == pytest.approx(0.05, abs=0.002)


# -- parts ----------------------------------------------------------------------------------------


def test_the_group_delay_is_a_weighted_regression_of_the_phase():
    rng = np.random.default_rng(3)
    omega = 2 * np.pi * F_HZ
    value, variance = noisy(np.exp(-0.02j * omega) / (1 + F_HZ), rng, 0.05)
    value[5], variance[7] = 0.1 * np.sqrt(variance[5]), 9.0
    delay_s, sd_s = group_delay(omega, value, variance)
    clear = np.abs(value) ** 2 > 4 * variance
    assert (clear[5], clear[7], clear.sum()) == (False, False, 38)
    phase = np.unwrap(np.angle(value[clear]))
    sd = np.sqrt(variance[clear] / 2) / np.abs(value[clear])
    line, covariance = np.polyfit(omega[clear], phase, 1, w=1 / sd, cov="unscaled")
    rest = (phase - np.polyval(line, omega[clear])) / sd
    spread = max(1.0, rest @ rest / 36)
    assert delay_s == pytest.approx(-line[0])
    assert sd_s == pytest.approx(np.sqrt(covariance[0, 0] * spread))
    bent = np.exp(-0.02j * omega + 0.5j * np.sin(omega))
    wide = group_delay(omega, bent, np.full(40, 1e-4))
    line, covariance = np.polyfit(omega, np.unwrap(np.angle(bent)), 1, cov=True)
    assert wide == pytest.approx((-line[0], np.sqrt(covariance[0, 0])))
    assert np.isnan(group_delay(omega[:2], bent[:2], np.full(2, 1e-4))).all()
    three = group_delay(omega[:3], np.exp(-0.1j * omega[:3]), np.full(3, 1e-4))
    assert three[0] == pytest.approx(0.1)


@pytest.mark.parametrize("variance", [3e-4, 1e-2])
@pytest.mark.parametrize(
    ("b", "a", "orders"),
    [
        ((0.8,), (1, 0.7), (0, 1)),
        ((0.8,), (1, 0.5, 0.6), (0, 2)),
        ((0.8, 0.9), (1, 0.5, 0.9), (1, 2)),
        ((0.8, 0.1, 0.7), (1, 0.4, 1.2), (2, 2)),
    ],
)
def test_exact_models_are_recovered(b, a, orders, variance):
    omega = 2 * np.pi * F_HZ
    scale = np.exp(np.mean(np.log(omega)))
    s = 1j * omega / scale
    value = np.exp(-1j * omega * 0.015) * np.polyval(b[::-1], s) / np.polyval(a[::-1], s)
    model = fit_delay(F_HZ, value, np.full(40, variance), freedom=12)
    assert (model.orders, model.scale) == (orders, pytest.approx(scale))
    np.testing.assert_allclose(model.numerator, b, rtol=1e-5)
    np.testing.assert_allclose(model.denominator, a, rtol=1e-5)
    assert model.delay_s == pytest.approx(0.015, abs=1e-6)
    assert model.p == pytest.approx(1.0)
    between = np.array([0.7, 3.3])
    s = 2j * np.pi * between / scale
    exact = np.exp(-2j * np.pi * between * 0.015) * np.polyval(b[::-1], s) / np.polyval(a[::-1], s)
    np.testing.assert_allclose(model.response(between), exact, rtol=1e-4)


def test_orders_are_tried_from_the_lowest_on():
    sums = [sum(orders) for orders in ORDERS]
    assert sums == sorted(sums)
    assert len(set(ORDERS)) == len(ORDERS)
    assert all(0 <= top <= bottom <= 3 for top, bottom in ORDERS)


def test_the_standard_deviation_of_the_delay_is_that_of_least_squares():
    rng = np.random.default_rng(4)
    omega = 2 * np.pi * F_HZ
    value, variance = noisy(0.9 * np.exp(-0.01j * omega), rng, 0.01)
    model = fit_delay(F_HZ, value, variance, freedom=12)
    # Of a pure delay the phase is a line through zero; each part has half of the variance.
    expected = 1 / np.sqrt(np.sum(omega**2 * model.numerator[0] ** 2 * 2 / variance))
    half = 1.95996 * expected
    assert model.interval_s[0] <= (model.delay_s - half) * (1 + 1e-6)  # and what more poles say
    assert model.interval_s[1] >= (model.delay_s + half) * (1 - 1e-6)
    rest = np.abs(value - model.response(F_HZ)) ** 2 * 2 / variance
    chance = stats.f.sf(rest.sum() / 78, 78, 960)
    assert model.p == pytest.approx(chance, rel=1e-6)


def test_an_effect_before_its_cause_is_no_model():
    value = 0.9 * np.exp(2j * np.pi * F_HZ * 0.01)
    model = fit_delay(F_HZ, value, np.full(40, 1e-6), freedom=12)
    assert model.orders is None
    assert model.interval_s == (0.0, 0.0)
    assert model.delay_s == pytest.approx(-0.01, abs=1e-4)


def test_few_lines_have_models_of_two_numbers_for_each_unknown():
    for count, orders in ((1, None), (2, (0, 0))):
        value = 0.9 * np.exp(-2j * np.pi * F_HZ[:count] * 0.01)
        model = fit_delay(F_HZ[:count], value, np.full(count, 1e-3), freedom=12)
        assert model.orders == orders
