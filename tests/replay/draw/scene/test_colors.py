"""Colours of power: symmetric, saturating, honest about what isn't known."""

import numpy as np

from undulog.replay.draw.scene.body import power_colors
from undulog.replay.samples.quantities import power_limit


def test_sign_and_size_of_power_can_be_read_from_the_colour():
    driven, idle, drives = power_colors(np.array([-2.0, 0.0, 2.0]), 2.0)
    assert driven[2] > driven[0]  # cyan
    assert drives[0] > drives[2]  # vermilion
    assert np.ptp(idle[:3].astype(int)) < 12  # grey
    half = power_colors(np.array([1.0]), 2.0)[0].astype(int)
    np.testing.assert_allclose(half, (idle.astype(int) + drives) / 2, atol=1)


def test_colours_saturate_at_the_limit():
    np.testing.assert_array_equal(*power_colors(np.array([5.0, 2.0]), 2.0))


def test_unknown_power_is_no_power_and_not_zero():
    unknown, idle = power_colors(np.array([np.nan, 0.0]), 1.0)
    assert unknown.tolist() != idle.tolist()


def test_the_limit_is_a_percentile_with_two_digits():
    power = np.linspace(-0.1234, 0.1234, 10001)
    assert power_limit(power) == 0.13
    assert power_limit(1000 * power) == 130.0
    assert power_limit(np.append(power, [np.nan, 1e6])) == 0.13
    assert power_limit(np.zeros(4)) == 1.0
    assert power_limit(np.full(4, np.nan)) == 1.0
