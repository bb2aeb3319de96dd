"""Steps of frequency responses: bands, periods, stretches, what joints share, bandwidths."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import signal, stats
from scipy.interpolate import CubicSpline

from undulog.analysis.estimators.series import Series
from undulog.analysis.parts.frequency_response.delay_model import DelayModel
from undulog.analysis.parts.frequency_response.excitation import (
    Excitation,
    ExcitationKind,
    _exact_lag,
    _is_chirp,
    _minima,
    _period,
    excited_bins,
    find_excitation,
    swept_band,
)
from undulog.analysis.parts.frequency_response.measure import (
    _agreement,
    _bandwidth,
    _distortion,
    _estimates,
    _of_band,
    _resonance,
    _same_commands,
    _unbroken,
    estimate,
    frequency_responses,
    joint_response,
    sound_lines,
)
from undulog.analysis.parts.frequency_response.nonparametric import (
    LineResponse,
    local_response,
    window,
)

RNG = np.random.default_rng(11)
STEP = 0.02
T = np.arange(2000) * STEP


def series(values, t=T, name="q"):
    return Series(name, t, np.asarray(values, dtype=float))


def lines_of(gain, variance=1e-6, freedom=9.0, frequency=None):
    gain = np.asarray(gain)
    frequency = np.geomspace(0.5, 8.0, gain.size) if frequency is None else frequency
    return LineResponse(frequency, gain, np.full(gain.size, variance), np.full(gain.size, freedom))


# -- what is excited ------------------------------------------------------------------------------


def test_the_bins_of_a_command_hold_all_but_a_hundredth_of_its_energy():
    rng = np.random.default_rng(3)
    spectrum = 1e-5 * rng.random(400)
    spectrum[100:200] = 1.0 + rng.random(100)
    bins = excited_bins(spectrum)
    assert 100 <= bins[0] < 104
    assert 195 <= bins[-1] < 202
    assert 0.985 <= spectrum[bins].sum() / spectrum.sum() <= 1.0
    assert (np.diff(bins) > 0).all()
    assert excited_bins(np.zeros(40)).size == 0
    spectrum[0] = 1e9
    assert excited_bins(spectrum)[0] in (1, 2)  # without the constant, but for what it leaks


@pytest.mark.parametrize("rising", [True, False])
def test_nothing_is_given_outside_of_a_sweep(rising):
    """From 0.10 to 2.77 Hz in 120 s, as an arm was commanded."""
    t = np.arange(0.0, 120.0, STEP)
    swept = np.sin(2 * np.pi * (0.1 * t + 2.67 * t**2 / 240))
    u = swept if rising else swept[::-1]
    low, high = swept_band(u - u.mean(), STEP)
    assert 0.1 <= low < 0.2
    assert 2.6 < high <= 2.77
    y = signal.lfilter([0.2], [1, -0.8], u) + 1e-3 * RNG.normal(size=t.size)
    (response,) = frequency_responses({"a": series(u, t)}, {"a": series(y, t)}, pytest.fail)
    assert response.excitation == "chirp"
    assert response.frequency_hz[0] >= 0.1
    assert response.frequency_hz[-1] <= 2.77
    assert response.frequency_hz[-1] > 2.5


def test_a_move_of_a_few_bins_has_no_line():
    """Ten seconds of an industrial robot: four lines of its command, beside which all is noise."""
    t = np.arange(0.0, 10.0, 0.004)
    s = np.clip(t / 5.0, 0.0, 1.0)
    u = 10 * s**3 - 15 * s**4 + 6 * s**5 - np.clip((t - 5.0) / 5.0, 0, 1) ** 2
    assert frequency_responses({"a": series(u, t)}, {"a": series(0.9 * u, t)}, pytest.fail) == ()


def test_a_command_has_to_move_often_and_without_long_gaps():
    assert find_excitation(series(np.sin(T[:127]), T[:127])) is None
    assert find_excitation(series(RNG.normal(size=128), T[:128])) is not None
    assert find_excitation(series(np.ones(2000))) is None
    for length, there in ((15.5, True), (16.5, False)):
        t = T[:200].copy()
        t[100:] += (length * 200 - 199) * STEP
        assert (find_excitation(series(RNG.normal(size=200), t)) is not None) is there


def test_steps_have_at_most_eight_values():
    for count, kind in ((8, ExcitationKind.STEPS), (9, ExcitationKind.NOISE)):
        steps = RNG.permutation(np.repeat(np.arange(count), 20))[:100].repeat(20)
        assert find_excitation(series(steps)).kind is kind


def test_one_sine_is_no_periodic_multisine():
    result = find_excitation(series(np.sin(2 * np.pi * T)))
    assert (result.kind, result.tones_hz.size) == (ExcitationKind.TONES, 1)
    assert np.isnan(result.period_s)


# -- periods --------------------------------------------------------------------------------------


def test_local_minima_behind_an_index():
    values = np.array([1.0, 0.0, 2.0, 1.0, 1.0, 3.0, 0.5, 4.0, 0.0])
    assert _minima(values, 0).tolist() == [1, 3, 4, 6]
    assert _minima(values, 3).tolist() == [4, 6]


def test_the_period_of_what_repeats_twice():
    shape = RNG.normal(size=100)
    shape -= shape.mean()
    assert _period(np.tile(shape, 2)) == pytest.approx(100, abs=1e-3)
    assert _period(np.tile(shape, 3)[:201]) == pytest.approx(100, abs=1e-3)
    assert _period(np.tile(shape, 2)[:196]) is None
    assert _period(RNG.normal(size=400)) is None
    assert _period(np.linspace(-0.1, 0.1, 300) + 1.0) is None
    k = np.arange(900)
    smooth = np.cos(2 * np.pi * k / 97.3) + 0.7 * np.cos(6 * np.pi * k / 97.3 + 1)
    assert _period(smooth) == pytest.approx(97.3, abs=1e-3)


def test_repetitions_differ_by_less_than_a_thousandth_of_the_variance():
    shape = signal.lfilter([0.2], [1, -0.8], RNG.normal(size=300))[100:]
    shape -= shape.mean()
    repeated = np.tile(shape, 3)
    for share, there in ((0.7e-3, True), (1.4e-3, False)):
        noise = RNG.normal(size=600) * np.sqrt(share * np.var(repeated))
        assert (_period(repeated + noise) is not None) is there


def test_the_exact_lag_is_one_of_least_squares():
    k = np.arange(1000.0)
    wave = np.cos(2 * np.pi * k / 61.7) + 0.5 * np.sin(4 * np.pi * k / 61.7)
    curve = CubicSpline(k, wave)
    lag, left = _exact_lag(curve, 61.4)
    assert lag == pytest.approx(61.7, abs=0.01)
    place = np.arange(0.0, 999 - 61.4 - 1)
    now, later = curve(place), curve(place + lag)
    assert left == pytest.approx(np.sum((later - now) ** 2) / np.sum(later**2 + now**2), rel=1e-9)
    # A step is half a sample at most.
    assert _exact_lag(curve, 59.7)[0] == pytest.approx(60.2)
    assert _exact_lag(curve, 63.7)[0] == pytest.approx(63.2)
    still = CubicSpline(k, np.ones(1000))
    assert _exact_lag(still, 30.0) == (30.0, 0.0)


def test_a_sweep_has_half_waves_in_order():
    t = np.arange(0, 40, 0.02)
    assert _is_chirp(signal.chirp(t, 0.1, 40, 3.0))
    assert _is_chirp(signal.chirp(t, 3.0, 40, 0.1))
    assert not _is_chirp(RNG.normal(size=t.size))

    def of_halves(lengths):
        signs = np.repeat((-1.0) ** np.arange(len(lengths) + 1), [5, *lengths])
        return np.concatenate([signs, [-signs[-1]]])

    assert _is_chirp(of_halves(range(10, 17)))  # eight crossings
    assert not _is_chirp(of_halves(range(10, 16)))
    for apart, sweep in ((8, True), (9, False)):  # two of thirty change places
        mixed = np.arange(10, 40)
        mixed[[5, 5 + apart]] = mixed[[5 + apart, 5]]
        rank = stats.spearmanr(np.arange(30), mixed).statistic
        assert (abs(rank) > 0.97) == sweep
        assert _is_chirp(of_halves(mixed)) is sweep


# -- estimates ------------------------------------------------------------------------------------


def test_a_band_has_forty_lines_of_the_local_polynomial_method():
    u = signal.lfilter([0.3], [1, -0.7], RNG.normal(size=4000))
    y = signal.lfilter([0.5], [1, -0.5], u) + 0.01 * RNG.normal(size=4000)
    result = _of_band([u + 3.0, y - 2.0], STEP)
    spectra = [np.fft.rfft(row - row.mean()) for row in (u, y)]
    half = window(1, freedom=12)
    assert result.frequency_hz[0] == pytest.approx((half // 2 + 1) / 80.0, abs=2 / 80.0)
    assert result.frequency_hz[-1] <= 0.25 / STEP
    assert result.frequency_hz[-1] == pytest.approx(0.25 / STEP, rel=0.01)
    bins = np.rint(result.frequency_hz * 80.0).astype(int)
    first, last = bins[0], bins[-1]
    nearest = sorted({round(k) for k in np.geomspace(first, last, 40)})
    np.testing.assert_allclose(bins, nearest, atol=1)
    local = local_response(spectra[1], spectra[0][None], bins, half)
    np.testing.assert_allclose(result.value, local.value[:, 0])
    np.testing.assert_allclose(result.variance, local.variance[:, 0])
    assert set(result.freedom) == {float(local.freedom)}
    assert _of_band([u[:70], y[:70]], STEP) is None  # four windows need more bins
    assert _of_band([u[:90], y[:90]], STEP) is not None


def test_halves_are_those_of_the_record():
    tones = np.array([0.7, 1.9])
    u = np.cos(2 * np.pi * np.outer(T, tones)).sum(axis=1)
    gain = np.where(T < 20.0, 0.8, 0.5)
    pair = [series(u), series(gain * u + 1e-3 * RNG.normal(size=2000))]
    excitation = Excitation(ExcitationKind.TONES, tones, float("nan"))
    whole, first, second = _estimates(pair, excitation)
    np.testing.assert_allclose(np.abs(first.value), 0.8, atol=0.01)
    np.testing.assert_allclose(np.abs(second.value), 0.5, atol=0.01)
    np.testing.assert_allclose(np.abs(whole.value), 0.65, atol=0.02)
    # More samples than twice the tones and sixteen.
    few = [row.between(0.0, 20 * STEP - 1e-6) for row in pair]
    assert few[0].count == 20
    assert next(_estimates(few, excitation)) is None
    few = [row.between(0.0, 21 * STEP + 1e-6) for row in pair]
    assert (few[0].count, len(next(_estimates(few, excitation)).value)) == (22, 2)


def test_a_band_needs_samples_of_all():
    u = RNG.normal(size=2000)
    short = series(RNG.normal(size=16), T[:16])
    excitation = Excitation(ExcitationKind.NOISE, np.zeros(0), float("nan"))
    assert list(_estimates([series(u), short], excitation)) == [None, None, None]
    halves = list(_estimates([series(u), series(2 * u)], excitation))
    assert [row is not None for row in halves] == [True] * 3
    there = np.isfinite(halves[1].value)
    assert np.mean(there) > 0.8
    np.testing.assert_allclose(halves[1].value[there], 2.0, atol=1e-6)
    # At the sampling interval of the slower channel.
    slow = list(_estimates([series(u), series(2 * u[::2], T[::2])], excitation))
    assert slow[0].frequency_hz[-1] == pytest.approx(0.25 / (2 * STEP), rel=0.01)
    assert estimate(series(u), series(2 * u), excitation).value[0] == pytest.approx(2.0)


def test_lines_without_noise_have_that_of_rounding():
    lines = LineResponse(
        np.arange(5.0),
        np.array([2.0, np.nan, 1.0, 0.0, 3.0]) + 0j,
        np.array([0.0, 1.0, 0.5, 0.0, np.nan]),
        np.array([4.0, 4.0, 0.0, 4.0, 4.0]),
    )
    result = sound_lines(lines)
    assert result.frequency_hz.tolist() == [0.0]
    assert result.variance[0] == pytest.approx((2e-9) ** 2)
    loud = sound_lines(lines_of([1.0, 2.0], 0.3))
    assert loud.variance.tolist() == [0.3, 0.3]


def test_the_longest_stretch_without_a_long_gap():
    t = np.concatenate([np.arange(100), np.arange(110, 400), np.arange(405, 500)]) * 0.1
    command = series(np.sin(t), t)
    late = np.arange(480) * 0.1 + 0.05
    response = series(np.cos(late), late)
    limit = 0.01 * (48.0 - 0.05)  # 0.48 s: a step of 0.6 s is a gap, too
    assert limit < 0.6
    first, second = _unbroken([command, response])
    assert (first.t_s[0], first.t_s[-1]) == pytest.approx((11.0, 39.9))
    assert second.t_s[0] >= 11.0
    assert second.t_s[-1] <= 39.9 + 1e-9
    whole = _unbroken([series(T), series(T, T + 0.5)])
    assert whole[0].t_s[0] == 0.5
    assert whole[1].t_s[-1] <= T[-1] + 1e-9
    assert whole[0].t_s[-1] == T[-1]
    apart = _unbroken([series(T[:50], T[:50]), series(T[:50], T[:50] + 100.0)])
    assert min(row.count for row in apart) == 0


def test_commands_are_the_same_but_for_sign_and_scale():
    base, rest = RNG.normal(size=2000), RNG.normal(size=2000)
    commands = {
        "a": series(base),
        "b": series(-3 * base + 1),
        "c": series(base + 0.03 * rest),  # 0.99955
        "d": series(base + 0.06 * rest),  # 0.9982
        "e": series(np.zeros(2000)),
    }
    sharing = _same_commands(commands)
    assert sharing["a"] == ("b", "c")
    assert sharing["b"] == ("a", "c")
    assert sharing["e"] == ()
    assert _same_commands({}) == {}
    assert _same_commands({"a": series(base)}) == {"a": ()}


# -- results --------------------------------------------------------------------------------------


def test_a_joint_has_students_intervals():
    gain = np.array([1.0, 0.9, 0.5, 0.02])
    lines = lines_of(gain * np.exp(-0.2j), 1e-3, 9.0)
    result = joint_response("j", "chirp", ("k",), lines)
    reach = stats.t.ppf(0.975, 18) * np.sqrt(1e-3 / 2)
    np.testing.assert_allclose(np.array(result.gain_ci95), [[g - reach, g + reach] for g in gain])
    np.testing.assert_allclose(result.lag_rad, 0.2)
    assert result.lag_ci95[3] is None  # within the disc of zero
    expected = [0.2 - reach / 0.5, 0.2 + reach / 0.5]
    np.testing.assert_allclose(result.lag_ci95[2], expected)
    np.testing.assert_allclose(result.coherence, gain**2 / (gain**2 + 1e-3))
    assert (result.joint, result.excitation, result.shares_command) == ("j", "chirp", ("k",))
    assert 0 <= result.delay_s.ci95[0] <= result.delay_s.value <= result.delay_s.ci95[1]


def no_model():
    return DelayModel(0.0, (0.0, 0.0), None, np.zeros(0), np.ones(1), 1.0, 0.0)


def test_the_bandwidth_is_where_the_gain_has_fallen_by_three_decibels():
    frequency = np.array([1.0, 2.0, 4.0, 8.0])
    lines = lines_of([1.0, 0.9, 0.5, 0.1], frequency=frequency)
    share = (0.9 - 0.5**0.5) / 0.4
    expected = 2.0 * 2.0**share
    assert _bandwidth(lines, np.abs(lines.value), no_model()) == pytest.approx(expected)
    flat = lines_of([1.0, 0.9, 0.8, 0.75], frequency=frequency)
    assert _bandwidth(flat, np.abs(flat.value), no_model()) is None
    # By a model of first order: exactly at its corner, but for the gain of the lowest line.
    corner = DelayModel(0.0, (0.0, 0.0), (0, 1), np.ones(1), np.array([1.0, 0.5]), 2 * np.pi, 1.0)
    hz = np.sqrt(2 * (4 + 1.0) - 4)  # |1 / (1 + j f / 2)|^2 is half of that at 1 Hz
    assert _bandwidth(lines, np.abs(lines.value), corner) == pytest.approx(hz, rel=1e-3)


def test_a_resonance_stands_out_of_the_intervals():
    lines = lines_of([1.0, 1.3, 0.5], frequency=np.array([1.0, 2.0, 4.0]))
    gain = np.abs(lines.value)
    for reach, hz in ((0.14, 2.0), (0.16, None)):
        assert _resonance(lines, gain, np.full(3, reach)) == hz


def test_halves_agree_within_their_noise():
    first, second = lines_of(np.ones(6), 0.01, 6.0), lines_of(np.ones(6), 0.02, 9.0)
    reach = np.sqrt(0.01 * stats.f.ppf(0.95, 2, 12) + 0.02 * stats.f.ppf(0.95, 2, 18))
    value = 1 + reach * np.array([0.0, 0.99, 0.99j, -0.99, 1.01, 1.01j])
    assert _agreement(first, replace(second, value=value)) == (4, 6)
    value[[0, 5]] = np.nan  # not excited in this half
    assert _agreement(first, replace(second, value=value)) == (3, 4)
    assert _agreement(first, replace(second, value=np.full(6, np.nan))) is None
    assert _agreement(None, second) is None
    assert _agreement(first, None) is None
    assert _agreement(first, lines_of(np.ones(5))) is None


def test_distortion_is_power_where_the_command_has_none():
    period_s, count = 4.0, 200
    t = np.arange(5 * count) * STEP
    excited, free = np.array([1, 3, 5, 9]), np.array([2, 4, 6, 7, 8])
    u = np.cos(2 * np.pi * np.outer(t, excited) / period_s + excited**2).sum(axis=1)
    y = 0.5 * u + 0.03 * np.cos(2 * np.pi * 4 * t / period_s) + 0.04 * np.cos(2 * np.pi * 7 * t / 4)
    excitation = Excitation(ExcitationKind.PERIODIC, np.zeros(0), period_s)
    pair = series(u, t), series(y, t)
    expected = np.sqrt((0.03**2 + 0.04**2) / free.size / 0.25)
    assert _distortion(*pair, excitation) == pytest.approx(expected, rel=1e-3)
    assert _distortion(*pair, Excitation(ExcitationKind.NOISE, np.zeros(0), float("nan"))) is None
    two = tuple(row.between(0.0, 8.01) for row in pair)
    assert _distortion(*two, excitation) == pytest.approx(expected, rel=0.01)
    less = tuple(row.between(0.0, 7.9) for row in pair)
    assert _distortion(*less, excitation) is None
    sine = series(np.cos(np.pi * t / 2), t)
    assert _distortion(sine, sine, excitation) is None  # there is no line beside it


def test_joints_beyond_the_first_are_not_estimated(monkeypatch):
    module = "undulog.analysis.parts.frequency_response.measure.MOST_JOINTS"
    monkeypatch.setattr(module, 2)
    u = RNG.normal(size=400)
    commands = {name: series(u, T[:400], name) for name in "abcd"}
    commands["still"] = series(np.zeros(400), T[:400], "still")
    answers = {name: row for name, row in commands.items() if name != "a"}
    notes = []
    result = frequency_responses(commands, answers, notes.append)
    assert [row.joint for row in result] == ["b", "c"]
    assert result[0].shares_command == ("c",)
    assert notes == ["frequency responses are those of the first 2 joints that are driven"]
    notes.clear()
    del commands["d"]
    assert len(frequency_responses(commands, answers, notes.append)) == 2
    assert notes == []
