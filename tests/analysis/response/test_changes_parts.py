"""What changes from cycle to cycle, part by part, against closed forms."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from undulog.analysis.estimators.harmonic import HarmonicModel, fit_at
from undulog.analysis.estimators.intervals import t_factor
from undulog.analysis.estimators.series import Series
from undulog.analysis.estimators.slow_changes import Coefficients, SlowChanges
from undulog.analysis.estimators.trends import Trend
from undulog.analysis.response.changes import (
    _BESIDE,
    _KEPT,
    _POWER,
    _SPREAD,
    CycleRatios,
    ResponseChanges,
    _amplitude_drift,
    _blocks,
    _cycles,
    _fitted,
    _noise_within,
    _polynomial,
    _stands_out,
    _without_image,
    moving_pace,
    response_changes,
    with_changes,
)
from undulog.analysis.response.response import Response

HZ, RATE = 0.5, 100
OMEGA = 2 * np.pi * HZ
T = np.arange(4000) / RATE  # twenty cycles
RNG = np.random.default_rng(7)


def slow(trend=Trend.STEADY, **fields):
    """Two joints: gains 1 and 0.8, minus lags 0 and 0.6."""
    given = {
        "trend": trend,
        "level": Coefficients(np.array([1.0, 0.8, 0.0, 0.6]), np.array([0.01, 0.02, 0.03, 0.04])),
        "change": Coefficients(np.array([0.1, 0.0, 0.0, 0.2]), np.array([0.01, 0.02, 0.03, 0.04])),
        "tau": (4.0, 3.0, 5.0),
        "turn": 0.0,
        "correlation": (0.0, 0.0),
        "alike": False,
        "dof": 10,
        "excess": 0.0,
        "residuals": RNG.normal(size=(4, 10)),
        "share": (0.1, 0.2),
        "effective": 10.0,
    }
    return SlowChanges(**given | fields)


def changes_of(result, **fields):
    given = {
        "slow": result,
        "reference": np.array([0.9 + 0j, 0.5j]),
        "excess": 0.5,
        "period_s": 2.0,
        "cycles": 16,
        "scatter": np.array([[0.01, 0.0], [0.0, 0.02]]),
        "amplitude_drift": None,
    }
    return ResponseChanges(**given | fields)


def test_changes_are_relative_to_the_level():
    changes = changes_of(slow(Trend.SETTLING))
    level = np.array([1.0, 0.8 + 0.6j])
    np.testing.assert_allclose(changes.per_joint, np.array([0.1, 0.2j]) / level)
    gain, lag = changes.of_joint(1)
    expected = 0.2j / level[1]
    assert gain.value == pytest.approx(expected.real)
    assert gain.ci95 == pytest.approx((expected.real - 0.02, expected.real + 0.02))
    assert lag.value == pytest.approx(-expected.imag)
    assert lag.ci95 == pytest.approx((-expected.imag - 0.04, -expected.imag + 0.04))
    # A transient of four cycles in sixteen: a quarter of it a cycle, in the mean.
    assert changes.largest == pytest.approx(0.2 * 4 / 16)
    assert replace(changes, cycles=2).largest == pytest.approx(0.2)
    assert changes.time_constant_s.value == 8.0
    assert changes.time_constant_s.ci95 == (6.0, 10.0)
    drifting = changes_of(slow(Trend.DRIFTING))
    assert drifting.largest == pytest.approx(0.2)
    assert drifting.time_constant_s.value is None


def test_a_small_change_counts_as_none():
    zero = np.zeros(4)
    for size, trend in ((1.01e-4, Trend.DRIFTING), (0.99e-4, Trend.STEADY)):
        change = Coefficients(np.array([size, 0.0, 0.0, 0.0]), zero)
        assert changes_of(slow(Trend.DRIFTING, change=change)).trend is trend


def test_variation_counts_where_it_is_clear_and_large():
    for excess, scatter, varies in (
        (0.9e-3, 1.1e-4, True),
        (1.1e-3, 1.1e-4, False),
        (0.9e-3, 0.9e-4, False),
    ):
        table = np.array([[0.0, scatter], [0.0, 0.0]])
        assert changes_of(slow(), excess=excess, scatter=table).varies is varies
    for cycles, effective, uncertain in (
        (8, 4.0, False),
        (7, 4.0, True),
        (8, 3.9, True),
        (16, 9.0, False),
    ):
        changes = changes_of(slow(effective=effective), excess=0.0, cycles=cycles)
        assert changes.uncertain is uncertain
    assert not changes_of(slow(effective=1.0), excess=0.5).uncertain


def response_of(dof=20.0):
    return Response(
        np.array([0.9 + 0.1j, 0.6j]), np.array([1e-6, 1.0]), np.array([1e-6, 1.0]), np.full(2, dof)
    )


def test_a_response_that_is_steady_stays_as_it_is():
    response = response_of()
    assert with_changes(response, changes_of(slow(), excess=1.1e-3)) is response


@pytest.mark.parametrize("alike", [True, False])
def test_variation_raises_the_variances_of_a_steady_response(alike):
    result, response = slow(alike=alike), response_of()
    raised = with_changes(response, changes_of(result, excess=0.9e-3))
    np.testing.assert_allclose(raised.ratio, response.ratio)
    half = np.array([[0.01, 0.02], [0.03, 0.04]]) / [1.0, 1.0]
    spread = (half / t_factor(10)) ** 2
    if alike:
        before = np.array([1e-6, 1.0]) * (t_factor(20.0) / t_factor(10)) ** 2
        spread = np.maximum(spread, before)
    np.testing.assert_allclose(raised.log_gain_variance, spread[0])
    np.testing.assert_allclose(raised.lag_variance, spread[1])
    np.testing.assert_array_equal(raised.dof, [10, 10])


def test_a_response_that_settles_is_its_level():
    result = slow(Trend.SETTLING)
    settled = with_changes(response_of(), changes_of(result))
    np.testing.assert_allclose(settled.ratio, np.array([0.9, 0.5j]) * [1.0, 0.8 + 0.6j])
    bins = 0.1**0.5 * result.residuals[:2] + 1j * 0.2**0.5 * result.residuals[2:]
    np.testing.assert_allclose(settled.errors.bins, bins)
    circular = np.mean(np.abs(bins) ** 2, axis=1) / 2
    spread = (np.array([[0.01, 0.02], [0.03, 0.04]]) / t_factor(10)) ** 2
    diagonal = np.einsum("mii->im", settled.errors.rounding)
    np.testing.assert_allclose(diagonal, np.maximum(spread - circular, 0.0))
    assert settled.errors.turn.tolist() == [0.0, 0.0]
    np.testing.assert_array_equal(settled.errors.rounding[:, 0, 1], 0.0)
    wide = Coefficients(result.level.value, np.full(4, 50.0))
    wider = with_changes(response_of(), changes_of(replace(result, level=wide)))
    expected = (50.0 / t_factor(10)) ** 2 - circular
    np.testing.assert_allclose(wider.errors.rounding[:, 1, 1], expected)
    growing = changes_of(slow(), amplitude_drift=settled)  # that there is one is all that counts
    np.testing.assert_allclose(with_changes(response_of(), growing).ratio, settled.ratio)


# -- cycles ---------------------------------------------------------------------------------------


def group(noise=0.0, late=0.0, count=4000):
    t = T[:count]
    commands = [Series("q", t, size * np.cos(OMEGA * t - k)) for k, size in enumerate((0.4, 0.2))]
    growth = 1 + late * (t - t.mean())
    answers = [
        Series(
            "q",
            t,
            (0.9 - 0.1 * k) * growth * np.roll(channel.values, 0) + noise * RNG.normal(size=t.size),
        )
        for k, channel in enumerate(commands)
    ]
    fit = fit_at([*commands, *answers], OMEGA, HarmonicModel(harmonics=1))
    return commands, answers, fit, np.arange(4).reshape(2, 2)


def test_each_cycle_has_its_ratio():
    commands, answers, fit, channels = group(late=0.01)
    result = _cycles(commands, answers, fit, channels)
    assert result.number.tolist() == list(range(20))
    middle = (np.arange(20) + 0.5) / HZ - T.mean()
    expected = np.array([[0.9], [0.8]]) * (1 + 0.01 * middle)
    np.testing.assert_allclose(result.ratio, expected, atol=2e-4)
    np.testing.assert_allclose(result.command, 1.0, atol=1e-9)


def test_fewer_than_five_cycles_are_too_few():
    assert _cycles(*group(count=4 * 200 + 190)) is None
    assert _cycles(*group(count=1000)).number.size == 5
    commands, answers, fit, channels = group()
    still = replace(fit, amplitudes=fit.amplitudes * np.array([[1.0], [1.0], [0.0], [1.0]]))
    assert _cycles(commands, answers, still, channels) is None
    assert response_changes(commands, answers, fit, channels) is None  # no noise at all


def test_cycles_beyond_a_hundred_and_sixty_are_taken_together():
    t = np.arange(32_300) / 100
    command, answer = (Series("q", t, size * np.cos(OMEGA * t)) for size in (0.4, 0.3))
    fit = fit_at([command, answer], OMEGA, HarmonicModel(harmonics=1))
    result = _cycles([command], [answer], fit, np.array([[0], [1]]))
    np.testing.assert_array_equal(result.number, 2.0 * np.arange(80))


def test_a_gap_takes_its_cycles_out():
    commands, answers, _, channels = group(noise=1e-3)
    kept = (T < 6.0) | (T >= 8.0)
    answers = [Series("q", T[kept], channel.values[kept]) for channel in answers]
    fit = fit_at([*commands, *answers], OMEGA, HarmonicModel(harmonics=1))
    result = _cycles(commands, answers, fit, channels)
    # The change of a cycle is that to its neighbours, which are lost with it.
    assert 3 not in result.number
    assert result.number[0] == 0
    assert 17 <= result.number.size <= 19


def test_noise_within_a_cycle_is_that_of_its_ratio():
    spread, levels = [], []
    for _ in range(6):
        commands, answers, fit, channels = group(noise=0.02)
        result = _cycles(commands, answers, fit, channels)
        spread.append(np.var(result.ratio / result.ratio.mean(axis=1, keepdims=True), axis=1))
        levels.append(result.noise)
    # Of white noise s^2 in n samples each part of a cycle's amplitude has 2 s^2 / n.
    expected = 2 * 0.02**2 / 200 / (np.array([0.9, 0.8]) * [0.4, 0.2]) ** 2
    np.testing.assert_allclose(np.mean(levels, axis=0), expected, rtol=0.45)
    np.testing.assert_allclose(np.mean(spread, axis=0) / 2, expected, rtol=0.3)


def test_constants_of_the_noise_within_cycles():
    turn = 2 * np.pi * np.arange(512) / 512
    basis = np.linalg.qr(np.stack([turn**0, np.cos(turn), np.sin(turn)], axis=1))[0]
    for beside, kept in zip(_BESIDE, _KEPT, strict=True):
        wave = np.exp(1j * beside * turn)
        rest = wave - basis @ (basis.T @ wave)
        assert kept == pytest.approx(np.sum(np.abs(rest) ** 2) / 512)
    assert pytest.approx((1.5, 2.5)) == _BESIDE
    assert pytest.approx(1.5 ** (1 / _POWER)) == 2.5 / 1.5  # a power of the frequency
    assert pytest.approx((1 + _POWER) ** 2 + _POWER**2) == _SPREAD


def test_noise_is_read_at_one_and_a_half_and_two_and_a_half_times_the_frequency():
    values = (
        0.1 * RNG.normal(size=(1, 2000)) + 0.2 * np.cumsum(RNG.normal(size=(1, 2000)), axis=1) / 9
    )
    t = np.arange(2000) / 100
    sampled, starts = Series("q", t, values[0]), np.arange(0, 2001, 200)
    amplitude = np.zeros((1, 10), dtype=complex)
    result = _noise_within(sampled, values, starts, OMEGA, amplitude)
    parts = values.reshape(10, 200) - values.reshape(10, 200).mean(axis=1, keepdims=True)
    levels = []
    for beside, kept in zip(_BESIDE, _KEPT, strict=True):
        waves = np.exp(1j * beside * OMEGA * t).reshape(10, 200)
        levels.append(np.mean(np.abs((waves * parts).sum(axis=1)) ** 2 / 200) / kept)
    rise = max(levels[0] / levels[1], 1.0) ** _POWER
    assert result[0] == pytest.approx(2 * rise * levels[0] / 200)
    # Too slow for 2.5 times, and for both.
    wide = _noise_within(sampled, values, starts, 2 * np.pi * 100 * 0.45 / 2.0, amplitude)
    assert wide[0] > 0
    fast = _noise_within(sampled, values, starts, 2 * np.pi * 100 * 0.45 / 1.4, amplitude)
    assert fast.tolist() == [0.0]
    # A cycle's own amplitude is no noise.
    turned = (0.5j * np.exp(1j * OMEGA * t)).real
    same = _noise_within(sampled, values + turned, starts, OMEGA, amplitude + 0.5j)
    np.testing.assert_allclose(same, result)
    assert _noise_within(sampled, 0 * values, starts, OMEGA, amplitude).tolist() == [0.0]


def test_a_change_within_cycles_leaves_no_image():
    """Least squares over each cycle, of an amplitude that grows and turns linearly."""
    edges = np.arange(8.0) * 2.0 + 0.7
    t = np.arange(0.7, 14.7, 0.002)
    amplitude, rate = 0.5 * np.exp(0.9j), 0.01 - 0.02j
    y = (amplitude * (1 + rate * (t - 7.7)) * np.exp(1j * OMEGA * t)).real
    fitted = []
    for low, high in itertools.pairwise(edges):
        inside = (t >= low - 1e-9) & (t < high - 1e-9)
        angle = OMEGA * t[inside]
        design = np.stack([angle**0, np.cos(angle), -np.sin(angle)], axis=1)
        best = np.linalg.lstsq(design, y[inside], rcond=None)[0]
        fitted.append(best[1] + 1j * best[2])
    relative = np.array([fitted]) / amplitude
    result = _without_image(relative, np.array([[amplitude]]), edges, OMEGA)
    truth = 1 + rate * ((edges[:-1] + edges[1:]) / 2 - 7.7)
    assert np.abs(relative[0] - truth).max() > 2e-3
    np.testing.assert_allclose(result[0], truth, atol=2e-4)
    single = relative[:, :1]
    assert _without_image(single, np.array([[amplitude]]), edges[:2], OMEGA) is single


def test_long_channels_are_taken_one_by_one():
    short = [Series("q", T, T) for _ in range(3)]
    assert list(_blocks(short)) == [[0, 1, 2]]
    t = np.arange(400_000.0)
    long = [Series("q", t, t) for _ in range(5)]
    assert list(_blocks(long)) == [[0, 1], [2, 3], [4]]
    assert list(_blocks([*short[:2], *long[:1]])) == [[0, 1], [2]]


# -- amplitudes and pace --------------------------------------------------------------------------


def test_what_stands_out_has_an_f_variable_of_one_in_a_thousand():
    rest = RNG.normal(size=(3, 20))
    dof = 60 - 6
    scatter = np.sum(rest**2) / dof
    limit = stats.f.isf(1e-3, 2, dof)
    assert _stands_out(1.001 * limit * 2 * scatter, 2, rest, 2)
    assert not _stands_out(0.999 * limit * 2 * scatter, 2, rest, 2)
    assert _stands_out(0.0, 1, np.zeros((1, 5)), 2)
    assert not _stands_out(9.0, 1, np.zeros((1, 2)), 2)
    assert not _stands_out(9.0, 1, np.ones((1, 2)), 2)


def test_commands_that_grow_have_a_regression_line():
    number = np.r_[np.arange(6.0), np.arange(8.0, 15.0)]
    scatter = 1e-4 * RNG.normal(size=(2, 13))
    size = np.exp(0.002 * (number - 7) + scatter)
    cycles = CycleRatios(number, size * np.exp(0.3j), size, np.zeros(2))
    result = _amplitude_drift(cycles)
    lines = [stats.linregress(number, np.log(row)) for row in size]
    assert result.value == pytest.approx(np.mean([line.slope for line in lines]))
    common = stats.linregress(number, np.log(size).mean(axis=0))
    half = stats.t.ppf(0.975, 11) * common.stderr
    assert result.ci95 == pytest.approx((common.slope - half, common.slope + half))
    for drift, moving in ((1.1e-3 / 14, True), (0.9e-3 / 14, False)):
        size = np.exp(drift * (number - number.mean())) * np.ones((2, 1))
        assert (
            _amplitude_drift(CycleRatios(number, size, size, np.zeros(2))) is not None
        ) is moving
    noisy = np.exp(0.1 * RNG.normal(size=(2, 13)))
    assert _amplitude_drift(CycleRatios(number, noisy, noisy, np.zeros(2))) is None


def test_a_phase_bends_by_polynomials_of_rising_degree():
    place = np.linspace(-1, 1, 15)
    straight = 0.3 - 2.0 * place
    noise = 1e-4 * RNG.normal(size=15)
    for degree in (2, 3, 4):
        result = _polynomial(place, straight + 0.05 * place**degree + noise, 1e-3)
        assert result.size == degree + 1
        assert result[degree] == pytest.approx(0.05, abs=2e-3)
    assert _polynomial(place, straight + noise, 1e-3) is None
    # The fewest numbers: two more than the degree tell nothing of the scatter.
    few = np.linspace(-1, 1, 5)
    assert _polynomial(few, few**2, 1e-3).size == 3
    assert _polynomial(few[:4], few[:4] ** 2, 1e-3) is None
    # What is bent by less than a quarter of the least phase, in the mean square, stays.
    bend = place**2 - np.mean(place**2)
    bend /= np.sqrt(np.mean(bend**2))
    for factor, there in ((1.02, True), (0.98, False)):
        assert (_polynomial(place, factor * 2.5e-4 * bend, 1e-3) is not None) is there
    coefficients, values = _fitted(place, np.exp(place), 3)
    expected = np.polynomial.polynomial.polyfit(place, np.exp(place), 3)
    np.testing.assert_allclose(coefficients, expected)
    np.testing.assert_allclose(values, np.polynomial.polynomial.polyval(place, expected))


def test_a_pace_that_moves_straightens_the_phase():
    rate = 0.004  # rad/s^2
    middle = T.mean()
    phase = OMEGA * T + rate / 2 * (T - middle) ** 2
    late = OMEGA * (T - 0.1) + rate / 2 * (T - 0.1 - middle) ** 2
    series = [
        Series("c", T, 0.4 * np.cos(phase) + 1e-4 * RNG.normal(size=T.size)),
        Series("r", T, 0.3 * np.cos(late)),
    ]
    fit = fit_at(series, OMEGA, HarmonicModel(harmonics=1))
    result = moving_pace(series, 1, fit)
    assert abs(result.drift - rate) < 0.02 * rate
    assert 0 < result.half < 0.02 * rate
    hertz = result.hz_per_s
    assert hertz.value == pytest.approx(result.drift / (2 * np.pi))
    assert hertz.ci95[1] - hertz.value == pytest.approx(result.half / (2 * np.pi))
    assert result.series[0].t_s is result.series[1].t_s
    # Over the new times the phase is a straight line.
    line = stats.linregress(result.series[0].t_s, phase)
    rest = phase - line.intercept - line.slope * result.series[0].t_s
    assert np.abs(rest).max() < 0.03 * np.ptp(rate / 2 * (T - middle) ** 2)
    assert line.slope == pytest.approx(OMEGA, rel=1e-3)
    steady = [Series("c", T, 0.4 * np.cos(OMEGA * T) + 1e-3 * RNG.normal(size=T.size))]
    assert moving_pace(steady, 1, fit_at(steady, OMEGA)) is None
    short = [series[0].between(0.0, 9.5)]
    assert moving_pace(short, 1, fit_at(short, OMEGA)) is None


def swept(t, rate, size, name="c"):
    return Series(name, t, size * np.cos(OMEGA * t + rate / 2 * (t - t.mean()) ** 2))


def test_the_pace_is_the_mean_of_the_commands_by_their_information():
    rate = 0.004
    series = [swept(T, rate, 0.4), swept(T, 0.0, 0.2)]
    fit = fit_at(series, OMEGA, HarmonicModel(harmonics=1))
    for weight, share in (((1.0, 1.0), 0.8), ((1.0, 4.0), 0.5)):
        result = moving_pace(series, 2, replace(fit, weight=np.array(weight)))
        assert result.drift == pytest.approx(share * rate, rel=0.03)
    # A command with a gap tells no phase; a response none at all.
    kept = (T < 11.0) | (T > 14.0)
    gap = [swept(T, rate, 0.4), Series("g", T[kept], series[1].values[kept]), series[1]]
    fit = fit_at(gap, OMEGA, HarmonicModel(harmonics=1))
    assert moving_pace(gap, 2, fit).drift == pytest.approx(rate, rel=0.03)
    assert moving_pace(gap[1:2], 1, fit_at(gap[1:2], OMEGA)) is None


def test_the_pace_of_many_cycles_is_that_of_several_together():
    t, rate = np.arange(8100) / 10, 2e-5
    series = [swept(t, rate, 0.4), swept(t[50:], rate, 0.3)]
    fit = fit_at(series, OMEGA, HarmonicModel(harmonics=1))
    assert moving_pace(series, 1, fit).drift == pytest.approx(rate, rel=0.02)
    assert moving_pace(series, 2, fit).drift == pytest.approx(rate, rel=0.02)


def test_a_pace_that_turns_time_back_is_none():
    far = np.arange(3) * 4000.0 - 8000.0
    series = [swept(T, 0.004, 0.4), Series("far", far, np.zeros(3))]
    fit = fit_at(series[:1], OMEGA, HarmonicModel(harmonics=1))
    assert moving_pace(series[:1], 1, fit) is not None
    assert moving_pace(series, 1, fit) is None
