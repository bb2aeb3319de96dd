"""Delays and transfer functions that are known."""

import numpy as np
import pytest

from undulog.analysis.response.delay_model import fit_delay

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
        inside.append(abs(model.delay_s - 0.023) <= 1.96 * model.delay_sd_s)
        assert model.orders is not None
        assert np.abs(model.response(F_HZ) / servo(F_HZ, 0.023) - 1).max() < 0.1
    assert 0.88 <= np.mean(inside) <= 1.0


def test_the_lowest_sufficient_order_is_taken():
    rng = np.random.default_rng(1)
    value, variance = noisy(0.9 * np.exp(-2j * np.pi * F_HZ * 0.01), rng, 0.01)
    model = fit_delay(F_HZ, value, variance, freedom=12)
    assert model.orders == (0, 0)
    assert model.numerator == pytest.approx([0.9], rel=0.01)
    assert model.delay_s == pytest.approx(0.01, abs=4 * model.delay_sd_s)


def test_without_a_model_it_is_the_group_delay():
    rng = np.random.default_rng(2)
    ripple = np.exp(-2j * np.pi * F_HZ * 0.05) * (1 + 0.5 * np.sin(40 * np.log(F_HZ)))
    value, variance = noisy(ripple, rng, 0.002)
    model = fit_delay(F_HZ, value, variance, freedom=12)
    assert (model.orders, model.p < 0.01) == (None, True)
    assert model.delay_s == pytest.approx(0.05, abs=0.002)
