"""Lag, gain and their intervals over the grid: noise, rate, length, skew, lost samples."""

import estimator_tables
import numpy as np
import pytest

GUESS = 2 * np.pi * 1.002  # the truth is 1 Hz


@pytest.mark.built("tables")
@pytest.mark.slow
@pytest.mark.parametrize("sigma", [0.001, 0.05])
@pytest.mark.parametrize("lost", [0.0, 0.2])
@pytest.mark.parametrize("skew_s", [0.0, 0.005])
@pytest.mark.parametrize(
    ("rate", "cycles"), [(50.0, 10.0), (100.0, 7.4), (100.0, 20.0), (200.0, 7.0)]
)
def test_lag_and_gain_reach_the_bound(rate, cycles, skew_s, lost, sigma):
    """Rife & Boorstyn 1974: at known omega var phase >= 1/(eta N), eta = A^2/(2 sigma^2)."""
    draws, rng = 3000, np.random.default_rng(7)
    case = {"cycles": cycles, "rate": rate, "sigma": sigma, "skew_s": skew_s, "lost": lost}
    data = estimator_tables.sampled(rng, draws=draws, **case)
    lag, gain, _ = estimator_tables.fitted(*data, GUESS)
    samples = round(0.8 * cycles * rate) if lost else round(cycles * rate)
    assert data[3].shape == (draws, samples)
    bound = (2 * sigma**2 / ((0.9 * 0.5) ** 2 * samples)) ** 0.5
    # 3,000 draws: the ratio's own standard error is 1.3 %; far below the bound is an error, too.
    for errors in (lag, gain):
        assert 0.96 < np.sqrt(np.mean(errors**2)) / bound < 1.05
        assert abs(np.mean(errors)) < 4 * bound / draws**0.5 + bound**2


@pytest.mark.built("tables")
@pytest.mark.slow
@pytest.mark.parametrize("lost", [0.0, 0.2])
@pytest.mark.parametrize("ar", [0.0, 0.9])
@pytest.mark.parametrize("cycles", [7.0, 7.4, 10.0, 20.0])
def test_intervals_cover(cycles, ar, lost):
    """4,000 draws: the coverage's own standard error is 0.35 %."""
    lag, gain = estimator_tables.coverage(cycles, ar, lost=lost)
    assert 0.93 < lag < 0.97
    assert 0.93 < gain < 0.97


def test_common_ways_are_worse():
    """Off a whole number of cycles; the fit alone reaches the bound."""
    ours, *others = estimator_tables.compared(draws=400).values()
    assert ours[2] < 1.1  # RMSE of the lag over its bound; 400 draws: standard error 3.5 %
    assert all(other[2] > 1.5 for other in others)
