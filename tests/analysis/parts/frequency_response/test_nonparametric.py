"""The steps of estimates without a model, by plain sums and dense least squares."""

import numpy as np
import pytest
from scipy import signal, stats

from undulog.analysis.estimators.series import Series
from undulog.analysis.parts.frequency_response.nonparametric import (
    LineResponse,
    LocalResponse,
    _bins_beside,
    _blackman_harris,
    _level,
    even_times,
    excited_lines,
    find_tones,
    indirect_response,
    line_power,
    local_response,
    noise_power,
    resampled,
    tone_response,
    window,
)

RNG = np.random.default_rng(8)


def circular(*shape):
    return (RNG.normal(size=shape) + 1j * RNG.normal(size=shape)) / np.sqrt(2)


def test_a_disc_holds_what_an_f_variable_tells():
    lines = LineResponse(np.ones(2), np.ones(2), np.array([4.0, 9.0]), np.array([3.0, 12.0]))
    expected = np.sqrt([4.0 * stats.f.ppf(0.95, 2, 6), 9.0 * stats.f.ppf(0.95, 2, 24)])
    np.testing.assert_allclose(lines.radius(), expected)
    covariance = np.array([[[4.0, 1.0], [1.0, 9.0]]])
    local = LocalResponse(np.ones(1), np.ones((1, 2)), covariance, np.ones(1), 5)
    np.testing.assert_allclose(local.radius(0.5) ** 2, [np.array([4, 9]) * stats.f.ppf(0.5, 2, 10)])
    np.testing.assert_allclose(local.radius() ** 2, [np.array([4, 9]) * stats.f.ppf(0.95, 2, 10)])


def test_even_times_are_many_enough_and_have_small_factors():
    for stop, step in ((9.97, 0.01), (1.0, 0.25), (3.0, 0.7)):
        times, distance = even_times(2.0, 2.0 + stop, step)
        assert times[0] == 2.0
        assert times.size % 2 == 0
        assert times.size >= stop / step - 1e-9
        assert times.size < 1.2 * stop / step + 4
        assert distance == pytest.approx(stop / times.size)
        np.testing.assert_allclose(np.diff(times), distance)
    # 997 is a prime number: 1000 = 2^3 5^3 is next.
    assert even_times(0.0, 9.97, 0.01)[0].size == 1000
    assert even_times(0.0, 1.0, 0.25)[0].size == 4


def test_splines_follow_a_cubic_exactly():
    t = np.sort(RNG.uniform(0, 3, 20))
    cubic = np.polynomial.Polynomial([1.0, -2.0, 0.5, 0.3])
    at = np.linspace(t[0], t[-1], 50)
    np.testing.assert_allclose(resampled(Series("q", t, cubic(t)), at), cubic(at), rtol=1e-9)


def test_the_window_is_scipys():
    np.testing.assert_allclose(_blackman_harris(101), signal.windows.blackmanharris(101), atol=1e-9)


# -- tones ----------------------------------------------------------------------------------------

STEP, COUNT = 0.02, 4000
T = np.arange(COUNT) * STEP  # bins of 1/80 Hz


def tones_of(values):
    return find_tones(Series("u", T, values), values)


def wave(*pairs):
    return sum(size * np.cos(2 * np.pi * hz * T + 0.3 + hz) for hz, size in pairs)


def test_tones_are_those_above_a_share_of_the_largest():
    np.testing.assert_allclose(tones_of(wave((0.7, 1.0), (1.9, 0.011))), [0.7, 1.9], atol=1e-9)
    assert tones_of(wave((0.7, 1.0), (1.9, 0.009))).size == 1
    # A straight line is none, nor what is below four bins of the record.
    np.testing.assert_allclose(tones_of(wave((0.7, 1.0)) + 0.3 * T), [0.7], atol=1e-9)
    assert tones_of(wave((2.6 / 80, 1.0))) is None


def test_tones_have_to_be_apart_and_few():
    near = [0.7 + k / 80 for k in (0.0, 5.0)]
    np.testing.assert_allclose(tones_of(wave((near[0], 1.0), (near[1], 0.8))), near, atol=1e-6)
    assert tones_of(wave((0.7, 1.0), (0.7 + 3.0 / 80, 0.8))) is None
    t = np.arange(1000) * STEP  # bins of 1/20 Hz
    many = 0.5 + 0.3 * np.arange(65)
    for count, there in ((64, True), (65, False)):
        values = np.cos(2 * np.pi * np.outer(t, many[:count]) + many[:count] ** 2).sum(axis=1)
        assert (find_tones(Series("u", t, values), values) is not None) is there


def test_tones_explain_all_but_a_thousandth():
    rest = RNG.normal(size=COUNT)
    loud = wave((0.7, 1.0), (1.9, 0.5))
    for share, there in ((0.0007, True), (0.0014, False)):
        noise = rest * np.sqrt(share * np.var(loud)) / rest.std()
        assert (tones_of(loud + noise) is not None) is there


def test_the_noise_of_a_tone_is_that_of_the_bins_beside_it():
    """By the periodogram of what a dense fit leaves."""
    tones = np.array([0.7, 1.9])
    y = wave((0.7, 0.9), (1.9, 0.4)) + 0.1 * RNG.normal(size=COUNT) + 0.2 - 0.01 * T
    u = wave((0.7, 1.0), (1.9, 0.5))
    command, response = Series("u", T, u), Series("y", T, y)
    result = tone_response(command, response, tones)
    drift = np.stack([T**d for d in range(3)], axis=1)
    angle = 2 * np.pi * np.outer(T, tones)
    design = np.hstack([drift, np.cos(angle), np.sin(angle)])
    theta = np.linalg.lstsq(design, y, rcond=None)[0]
    amplitude = theta[3:5] - 1j * theta[5:]
    inputs = np.array([1.0, 0.5]) * np.exp(1j * (0.3 + tones))
    np.testing.assert_allclose(result.value, amplitude / inputs, rtol=1e-6)
    rest = y - design @ theta
    for k, tone in enumerate(tones):
        bins = _bins_beside(tone, tones, T[-1], 25.0)
        assert bins.size == 12
        power = np.abs(2 / COUNT * np.exp(-2j * np.pi * np.outer(bins, T)) @ rest) ** 2
        noise = np.median(power) / stats.expon.ppf(0.5)
        assert result.variance[k] == pytest.approx(noise / np.abs(inputs[k]) ** 2, rel=0.1)
        assert result.freedom[k] == pytest.approx(12 * np.log(2) ** 2)
    # Of a loop: of y - G u.
    mixed = Series("u", T, u + 0.1 * RNG.normal(size=COUNT))
    fed = Series("y", T, 0.5 * mixed.values)
    looped = tone_response(mixed, fed, tones, looped=True)
    np.testing.assert_allclose(looped.value, 0.5, rtol=1e-9)
    assert looped.variance.max() < 1e-20
    assert tone_response(mixed, fed, tones).variance.min() > 1e-7


def test_levels_are_medians_over_those_of_exponential_variables():
    for count in (4, 5, 12):
        power = RNG.exponential(size=(count,))
        ordered = np.cumsum(1 / np.arange(count, 0, -1.0))
        assert _level(power) == pytest.approx(np.median(power) / np.median(ordered))
    draws = RNG.exponential(size=(1000, 12))
    assert np.mean([_level(row) for row in draws]) == pytest.approx(1.0, abs=0.06)


def test_bins_of_noise_are_a_bin_and_a_half_from_any_tone():
    bins = np.sort(_bins_beside(1.0, np.array([1.0, 1.05]), 100.0, 25.0)) * 100 - 100
    below, above = [-7.5, -6.5, -5.5, -4.5, -3.5, -2.5, -1.5], [1.5, 2.5, 3.5, 6.5, 7.5]
    np.testing.assert_allclose(bins, below + above)
    # Neither the drift nor half of the sampling rate is reached.
    for tone, least in ((0.0505, 1.55), (0.0495, 2.45)):
        low = np.sort(_bins_beside(tone, np.array([tone]), 100.0, 0.12)) * 100
        expected = np.r_[np.arange(least, 4.0), np.arange(100 * tone + 1.5, 12.0)]
        np.testing.assert_allclose(low, expected)


# -- lines ----------------------------------------------------------------------------------------


def test_excited_lines_have_a_share_of_the_strongest():
    power = np.array([[9e9, 1.0, 0.0011, 0.0009, 0.5], [9e9, 1.0, 0.0011, 0.0009, 0.5]])
    assert excited_lines(np.sqrt(power) + 0j).tolist() == [1, 2, 4]
    either = np.array([[0, 1.0, 0.0], [0, 1.0, 2.0]])
    assert excited_lines(either + 0j).tolist() == [1, 2]


def test_noise_of_lines_is_the_variance_of_their_mean():
    spectra = circular(3, 5, 4)
    expected = np.var(spectra, axis=1, ddof=1) / 5
    np.testing.assert_allclose(noise_power(spectra), expected)
    mean = np.abs(spectra.mean(axis=1)) ** 2
    np.testing.assert_allclose(line_power(spectra), mean - expected)
    alone = noise_power(spectra[:, :1])
    assert alone.shape == (3, 4)
    assert np.isnan(alone).all()
    assert np.isfinite(noise_power(spectra[:, :2])).all()


# -- the local polynomial method ------------------------------------------------------------------


@pytest.mark.parametrize(("inputs", "order"), [(1, 2), (2, 1)])
def test_a_local_response_is_least_squares_in_its_window(inputs, order):
    spectra, output = circular(inputs, 60), circular(60)
    half = window(inputs, order)
    bins = np.array([2, 30, 58])
    result = local_response(output, spectra, bins, half, order=order)
    for row, k in enumerate(bins):
        first = min(max(k - half, 1), 60 - (2 * half + 1))
        index = np.arange(first, first + 2 * half + 1)
        powers = (index - k)[:, None] ** np.arange(order + 1.0)
        design = np.hstack([*(u[index, None] * powers for u in spectra), powers])
        theta = np.linalg.lstsq(design, output[index], rcond=None)[0]
        rest = output[index] - design @ theta
        freedom = index.size - design.shape[1]
        noise = np.sum(np.abs(rest) ** 2) / freedom
        at = np.arange(inputs) * (order + 1)
        covariance = noise * np.linalg.inv(design.conj().T @ design)[np.ix_(at, at)]
        np.testing.assert_allclose(result.value[row], theta[at], rtol=1e-6)
        np.testing.assert_allclose(result.covariance[row], covariance, rtol=1e-6)
        np.testing.assert_allclose(result.variance[row], np.diag(covariance).real, rtol=1e-6)
        assert result.noise[row] == pytest.approx(noise)
        assert result.freedom == freedom >= 6


def test_the_least_window_leaves_its_degrees_of_freedom():
    for inputs, order, freedom in ((1, 2, 6), (2, 2, 6), (1, 1, 5), (3, 2, 12)):
        left = 2 * window(inputs, order, freedom) + 1 - (order + 1) * (inputs + 1)
        assert freedom <= left <= freedom + 1
    assert window(1) == window(1, 2, 6) == 6


def test_windows_as_long_as_the_spectrum_or_the_unknowns_are_refused():
    spectrum = circular(12)
    for half, length in ((2, 12), (4, 9), (3, 7)):
        with pytest.raises(ValueError, match=f"a window of {2 * half + 1} bins of {length} for 6"):
            local_response(spectrum[:length], spectrum[None, :length], np.array([4]), half)
    assert (
        local_response(spectrum[:10], spectrum[None, ::-1][:, :10], np.array([4]), 4).freedom == 3
    )
    three = local_response(spectrum, spectrum[None, ::-1], np.array([4]), 3)
    assert (three.freedom, np.isfinite(three.value).all()) == (1, True)


def test_the_indirect_response_has_the_variance_of_a_ratio():
    """From the joint covariance of both outputs' errors, which share the noise of one window."""
    reference = circular(80)
    both = np.stack([reference * (0.6 - 0.2j), reference * (1.5 + 0.5j)])
    both = both + 0.05 * (circular(2, 80) + circular(80) * np.array([[1.0], [0.5j]]))
    bins, half = np.array([20, 40]), window(1, freedom=12)
    value, variance, freedom = indirect_response(both[0], both[1], reference, bins, half)
    for row, k in enumerate(bins):
        index = np.arange(k - half, k + half + 1)
        powers = (index - k)[:, None] ** np.arange(3.0)
        design = np.hstack([reference[index, None] * powers, powers])
        theta = np.linalg.lstsq(design, both[:, index].T, rcond=None)[0]
        rest = both[:, index].T - design @ theta
        share = np.linalg.inv(design.conj().T @ design)[0, 0].real
        covariance = share * rest.T @ rest.conj() / freedom
        ratio = theta[0, 0] / theta[0, 1]
        turn = np.array([1.0, -ratio]) / theta[0, 1]
        assert value[row] == pytest.approx(ratio)
        assert variance[row] == pytest.approx((turn @ covariance @ turn.conj()).real, rel=1e-6)
    weak = indirect_response(both[0], circular(80), reference, bins, half)
    assert np.isnan(weak[1]).any()
