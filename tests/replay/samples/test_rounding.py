"""Rounding of plotted lines: how much, and that it packs."""

import numpy as np
import pytest

from undulog.replay.samples.sampling import LEVELS, plot_step, rounded


@pytest.mark.parametrize("size", [1e-6, 0.3, 45.0, 1e5])
def test_a_step_is_a_power_of_two_below_a_five_hundredth_of_the_range(size):
    values = size * np.sin(np.linspace(0.0, 20.0, 5000))
    step = plot_step(values)
    assert np.log2(step) == np.round(np.log2(step))
    room = np.ptp(np.quantile(values, [0.01, 0.99]))
    assert room / LEVELS / 2 < step <= room / LEVELS
    apart = np.abs(rounded(values[:, None], [step])[:, 0] - values)
    assert apart.max() <= room / 1000


def test_spikes_do_not_make_a_line_coarse():
    values = np.sin(np.linspace(0.0, 20.0, 5000))
    spiky = values.copy()
    spiky[::500] = 1e6
    assert plot_step(spiky) == plot_step(values)


def test_a_line_that_is_still_nearly_always_is_rounded_by_its_whole_range():
    values = np.zeros(5000)
    values[100:110] = 1.0
    assert plot_step(values) == 2.0**-9


def test_a_flat_line_and_no_line_are_left_alone():
    assert (
        plot_step(np.full(10, 3.3)) == plot_step(np.zeros(0)) == plot_step(np.full(3, np.nan)) == 0
    )
    values = np.array([[0.1, 0.1], [np.nan, 0.3]])
    np.testing.assert_array_equal(rounded(values, [0.0, 0.0]), values)
    np.testing.assert_array_equal(rounded(values, [0.25, 0.0]), [[0.0, 0.1], [np.nan, 0.3]])
