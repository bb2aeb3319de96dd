"""Gain, lag and their intervals by their definitions; the rhythm of channels at its limits."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from undulog.analysis.estimators.harmonic import HarmonicModel, fit_at
from undulog.analysis.estimators.intervals import ResponseErrors
from undulog.analysis.estimators.series import Series
from undulog.analysis.estimators.spectrum import FundamentalNoise, ResidualBins
from undulog.analysis.response.response import Response, gain_estimate, lag_estimate, respond
from undulog.analysis.response.rhythm import (
    Rhythm,
    _periodogram_peak,
    allowed_model,
    driven,
    find_rhythm,
    liveliest,
    phase_step,
    refine,
    wave_name,
)


def noise_of(covariance, dof):
    covariance = np.array(covariance, dtype=float)
    return FundamentalNoise(np.ones(len(covariance)), np.array(dof, dtype=float), covariance)


def test_a_response_has_the_variances_of_a_ratio():
    command, response = np.array([2.0, 1j, 0.0]), np.array([1j, 0.5, 1.0])
    asked = noise_of([np.diag([0.04, 0.01])] * 3, [10, 10, 10])
    given = noise_of([np.diag([0.02, 0.09])] * 3, [20, 20, 20])
    result = respond(
        command, asked, response, given, omega_variance=0.25, delay_between_s=np.array([0, 2.0, 0])
    )
    np.testing.assert_allclose(result.ratio[:2], [0.5j, -0.5j])
    np.testing.assert_allclose(result.gain[:2], [0.5, 0.5])
    # Along and across the direction of each amplitude, over its square.
    gains = [0.04 / 4 + 0.09, 0.01 + 0.02 / 0.25]
    lags = [0.01 / 4 + 0.02, 0.04 + 0.09 / 0.25]
    np.testing.assert_allclose(result.log_gain_variance[:2], gains)
    np.testing.assert_allclose(result.lag_variance[:2], [lags[0], lags[1] + 0.25 * 4])
    welch = lags[0] ** 2 / ((0.01 / 4) ** 2 / 10 + 0.02**2 / 20)
    assert result.dof[0] == pytest.approx(welch)
    assert np.isnan(result.ratio[2])
    assert np.isnan(result.log_gain_variance[2])
    assert result.errors is None
    for estimated in (gain_estimate(result, 2), lag_estimate(result, 2)):
        assert (estimated.value, estimated.ci95) == (None, None)


def test_contrasts_are_judged_by_the_bins():
    values = np.array([[0.1, 0.2j]])
    bins = ResidualBins(values, np.array([1.0, -1.0]), np.ones(1), np.zeros((1, 2, 2)))
    more = replace(bins, values=3 * values)
    quiet = noise_of([np.eye(2)], [4])
    result = respond(
        np.array([2.0 + 0j]),
        quiet,
        np.array([1.0 + 0j]),
        quiet,
        omega_variance=0.25,
        delay_between_s=np.array([3.0]),
        bins=(bins, more),
    )
    np.testing.assert_allclose(result.errors.bins, 3 * values / 1.0 - values / 2.0)
    np.testing.assert_allclose(result.errors.turn, [1.5])


def plain(ratio, variance=0.01, dof=9.0):
    count = len(ratio)
    spread = np.full(count, variance)
    errors = ResponseErrors(np.zeros((count, 2)), np.zeros((count, 2, 2)), np.zeros(count))
    return Response(np.array(ratio), spread, 2 * spread, np.full(count, dof), errors)


def test_lags_are_positive_where_the_response_is_late():
    result = plain([np.exp(-0.3j), np.exp(0.3j), -1.0 + 0j, complex(-1.0, -0.0)])
    np.testing.assert_allclose(result.lag_rad, [0.3, -0.3, np.pi, np.pi])
    turned = plain(np.exp(-1j * np.array([3.0, 3.3, 3.4])))
    np.testing.assert_allclose(
        turned.lag_near_mean_rad - turned.lag_near_mean_rad[0], [0, 0.3, 0.4]
    )
    some = result.select([1, 0])
    np.testing.assert_array_equal(some.ratio, result.ratio[[1, 0]])
    assert some.errors.bins.shape == (2, 2)
    assert some.dof.tolist() == [9.0, 9.0]
    np.testing.assert_array_equal(some.lag_variance, 2 * some.log_gain_variance)
    assert replace(result, errors=None).select([0]).errors is None


def test_intervals_are_those_of_student():
    result = plain([0.8 * np.exp(-0.3j)])
    factor = stats.t.ppf(0.975, 9)
    gain, lag = gain_estimate(result, 0), lag_estimate(result, 0)
    assert gain.value == pytest.approx(0.8)
    assert gain.ci95 == pytest.approx((0.8 * np.exp(-factor / 10), 0.8 * np.exp(factor / 10)))
    half = np.arcsin(factor * np.sqrt(0.02))
    assert lag.value == pytest.approx(0.3)
    assert lag.ci95 == pytest.approx((0.3 - half, 0.3 + half))
    assert lag_estimate(plain([0.8 + 0j], variance=0.51 / factor**2), 0).value is None
    assert lag_estimate(plain([0.8 + 0j], variance=0.49 / factor**2), 0).value == 0.0
    assert gain_estimate(plain([0.8 + 0j], variance=np.inf), 0).value is None


# -- the rhythm -----------------------------------------------------------------------------------

T = np.arange(1000) / 100


def sine(omega, t=T, size=1.0, name="q"):
    return Series(name, t, size * np.sin(omega * t))


def test_harmonics_stay_below_the_limit_of_the_slowest_channel():
    slow = Series("s", T[::10], np.zeros(100))  # 0.45 of its rate are 4.5 Hz
    for hz, harmonics in ((0.5, 3), (1.49, 3), (1.51, 2), (2.24, 2), (2.26, 1), (9.0, 1)):
        model = allowed_model([sine(1.0), slow], 2 * np.pi * hz)
        assert model == HarmonicModel(harmonics=harmonics)
    assert allowed_model([slow], 1.0, 2).trend == 2


def test_three_cycles_are_a_rhythm():
    for cycles, there in ((2.9, False), (3.05, True)):
        result = find_rhythm([sine(2 * np.pi * cycles / 10.0)], 10.0)
        assert (result is not None) is there


def test_what_is_too_short_or_still_has_no_rhythm():
    assert find_rhythm([], 10.0) is None
    assert find_rhythm([sine(3.0)], 0.0) is None
    assert find_rhythm([Series("q", T, np.ones(T.size))], 10.0) is None
    fast = np.arange(16) / 10
    assert find_rhythm([sine(12.0, fast)], 1.6) is None
    more = np.arange(17) / 10
    assert find_rhythm([sine(12.0, more)], 1.7).omega == pytest.approx(12.0)


def test_channels_that_move_have_the_rhythm_in_their_order():
    still = Series("still", T, np.zeros(T.size))
    result = find_rhythm([sine(3.0, name="b"), still, sine(3.0, size=2.0, name="a")], 10.0)
    assert result.names == ("b", "a")
    assert result.omega == pytest.approx(3.0)
    rest = replace(result.fit, rss=np.array([1.0, 2.0]), total=np.array([8.0, 4.0]))
    assert Rhythm(result.names, rest).explained == pytest.approx(0.75)


def test_the_livelier_channels_are_looked_at_first():
    series = [sine(3.0, size=size, name=str(size)) for size in (0.1, 0.5, 0.3, 0.2, 0.4, 0.0)]
    assert [channel.name for channel in liveliest(series)] == ["0.5", "0.4", "0.3", "0.2"]


@pytest.mark.parametrize("hz", [0.3, 1.7, 20.0, 44.0])
def test_the_peak_of_the_periodogram_is_near_the_frequency(hz):
    peak = _periodogram_peak([sine(2 * np.pi * hz)], 10.0)
    assert abs(peak / (2 * np.pi) - hz) < 0.03  # grid: at most a quarter of 0.1 Hz
    # Summed over channels: the stronger rhythm counts.
    both = [sine(2 * np.pi * hz, size=2.0), sine(2 * np.pi * 7.0)]
    assert _periodogram_peak(both, 10.0) == pytest.approx(peak, abs=0.05)


def test_the_periodogram_has_limits():
    assert _periodogram_peak([sine(1.0)], 0.05) is None  # no frequency has cycles enough
    assert _periodogram_peak([sine(2 * np.pi * 3.0, T[:15])], 0.15) is None
    apart = [sine(3.0), sine(3.0, T + 20.0)]
    assert _periodogram_peak(apart, 10.0) is None
    gap = np.concatenate([T[:50], T[:50] + 0.01 * 1700])
    assert _periodogram_peak([sine(3.0, gap)], 18.0) is None
    gap = np.concatenate([T[:50], T[:50] + 0.01 * 1500])
    assert _periodogram_peak([sine(3.0, gap)], 16.0) is not None
    # The coarser of two channels sets the grid.
    coarse = _periodogram_peak([sine(2 * np.pi * 3.0), sine(2 * np.pi * 3.0, T[::10])], 10.0)
    assert coarse == pytest.approx(2 * np.pi * 3.0, abs=0.2)


def test_joints_are_driven_from_a_share_of_theliveliest_on():
    series = [sine(3.0), sine(3.0, size=0.011), sine(3.0, size=0.009), Series("n", T, 0 * T)]
    follows, astray = driven(fit_at(series, 3.0))
    assert follows.tolist() == [True, True, False, False]
    assert not astray.any()
    rng = np.random.default_rng(1)
    for noise, follow in ((0.33, True), (0.38, False)):  # explained to 0.82 and to 0.78
        noisy = Series("q", T, np.sin(3.0 * T) + noise * rng.normal(size=T.size))
        follows, astray = driven(fit_at([noisy], 3.0))
        assert (follows[0], astray[0]) == (follow, not follow)


def test_steps_and_names_of_waves():
    assert phase_step(np.exp(1j * np.array([0.0, 0.4, 0.8]))) == pytest.approx(0.4)
    assert phase_step(np.array([1.0, 1j])) == pytest.approx(np.pi / 2)
    names = [wave_name(step) for step in (0.0011, 0.0009, -0.0011, np.pi - 0.0009)]
    assert names == ["tail-to-head", "standing", "head-to-tail", "standing"]


def test_a_rhythm_is_refined_where_there_are_samples_enough():
    result = refine([sine(3.0), sine(3.0, size=0.5)], 3.05)
    assert result.omega == pytest.approx(3.0)
    assert result.fit.count.tolist() == [1000.0, 1000.0]
    assert refine([sine(3.0), sine(3.0, T[:8])], 3.0) is None
    assert refine([Series("q", T, np.ones(T.size))], 3.0) is None
