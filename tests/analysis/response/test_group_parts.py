"""Groups of joints, part by part: which tones are apart, and which lines a model has."""

from dataclasses import replace

import numpy as np
import pytest

from undulog.analysis.estimators.harmonic import HarmonicModel, fit_at
from undulog.analysis.estimators.series import Series
from undulog.analysis.response.groups import (
    _candidates,
    _clusters,
    _combinations,
    _fundamental_share,
    _highest,
    _most_lines,
    _one_rhythm,
    _periodogram,
    _shared,
    _Tone,
    find_groups,
    further_lines,
    group_model,
    mixed_tones,
    with_mixed_lines,
)
from undulog.analysis.response.rhythm import Rhythm

T = np.arange(2000) / 100  # bins of 0.05 Hz
BIN = 2 * np.pi / 20.0
RNG = np.random.default_rng(4)


def wave(omega, name="q", size=1.0, noise=0.0):
    return Series(name, T, size * np.sin(omega * T) + noise * RNG.normal(size=T.size))


def tone(omega, name="q", noise=0.01, size=1.0):
    series = wave(omega, name, size, noise)
    return _Tone(series, Rhythm((name,), fit_at([series], omega)))


def test_the_error_of_a_tone_is_the_bound_of_its_frequency():
    # Rife and Boorstyn: var omega >= 12 s^2 / (A^2 / 2 T^2 n), s^2 the variance of a sample.
    expected = np.sqrt(24 * 0.01**2 / (20.0**2 * 2000))
    assert tone(3.0).error == pytest.approx(expected, rel=0.1)
    still = tone(3.0)
    fit = replace(still.rhythm.fit, weight=np.zeros(1))
    assert replace(still, rhythm=replace(still.rhythm, fit=fit)).error == np.inf


def test_tones_with_no_wide_gap_between_them_are_a_cluster():
    tones = [tone(omega, str(omega)) for omega in (3.0, 2.0, 3.4, 5.0, 3.8)]
    names = [[part.series.name for part in cluster] for cluster in _clusters(tones, 0.45)]
    assert names == [["2.0"], ["3.0", "3.4", "3.8"], ["5.0"]]
    assert _clusters([], 0.5) == []
    assert len(_clusters(tones[:1], 0.5)) == 1


def test_a_cluster_of_a_single_frequency_is_a_rhythm():
    rhythm, close = _one_rhythm([tone(3.0, "a"), tone(3.0 + 0.05 * BIN, "b")], 0.1 * BIN)
    assert (rhythm.names, close) == (("a", "b"), None)
    # Noise leaves it open: five standard errors of the difference.
    noisy = [tone(3.0, "a", 1.0), tone(3.0, "b", 1.0)]
    doubt = 5 * np.hypot(noisy[0].error, noisy[1].error)
    for factor, parts in ((0.9, 1), (1.1, 2)):
        fit = replace(noisy[1].rhythm.fit, omega=3.0 + factor * doubt)
        second = replace(noisy[1], rhythm=replace(noisy[1].rhythm, fit=fit))
        close = _one_rhythm([noisy[0], second], 1e-6)[1]
        assert (close is not None) is (parts == 2)


def test_frequencies_that_differ_are_reported():
    near = [tone(3.0, "a"), tone(3.0 + 0.2 * BIN, "b")]
    rhythm, close = _one_rhythm(near, 0.1 * BIN)
    assert (close.kept, close.left, rhythm.names) == (("a", "b"), (), ("a", "b"))
    assert (close.low_hz, close.high_hz) == pytest.approx(
        (3.0 / 2 / np.pi, (3.0 + 0.2 * BIN) / 2 / np.pi)
    )
    apart = [tone(3.0, "a"), tone(3.0, "b"), tone(3.0 + 1.2 * BIN, "c")]
    rhythm, close = _one_rhythm(apart, 0.1 * BIN)
    assert (rhythm.names, close.kept, close.left) == (("a", "b"), ("a", "b"), ("c",))
    # Of as many joints those that move most stay.
    pair = [tone(3.0, "a"), tone(3.0 + 1.2 * BIN, "b", size=2.0)]
    assert _one_rhythm(pair, 0.1 * BIN)[1].kept == ("b",)


def test_a_shared_rhythm_begins_at_the_mean_frequency():
    rhythm = _shared([tone(2.95, "b"), tone(2.95, "a")])
    assert rhythm.omega == pytest.approx(2.95, abs=1e-3)
    assert rhythm.names == ("b", "a")


def test_the_share_of_the_fundamental():
    fit = fit_at([wave(3.0), Series("z", T, np.zeros(T.size))], 3.0)
    fit = replace(fit, amplitudes=np.array([[1.0, 2j, 0.0], [0.0, 0.0, 0.0]]))
    np.testing.assert_allclose(_fundamental_share(fit), [0.2, 0.0])


def test_subharmonics_are_no_common_rhythm():
    """Two and three times a frequency that no channel has."""
    result = find_groups([wave(4.0, "a"), wave(4.0, "b"), wave(6.0, "c")], 20.0)
    assert [rhythm.names for rhythm in result.rhythms] == [("a", "b"), ("c",)]
    assert [rhythm.omega for rhythm in result.rhythms] == pytest.approx([4.0, 6.0])
    assert result.explained == pytest.approx(1.0)
    assert (result.unresolved, result.astray) == ((), ())


def test_a_channel_that_follows_no_rhythm_is_astray():
    odd = Series("n", T, 0.5 * RNG.normal(size=T.size))
    small = Series("s", T, 0.005 * RNG.normal(size=T.size))
    result = find_groups([wave(4.0, "a"), wave(4.0, "b"), odd, small], 20.0)
    assert (len(result.rhythms), find_groups([small.between(0, 0.1)], 0.1)) == (1, None)
    two = find_groups([wave(4.0, "a"), wave(4.0, "b"), wave(6.47, "c"), odd, small], 20.0)
    assert [rhythm.names for rhythm in two.rhythms] == [("a", "b"), ("c",)]
    assert two.astray == ("n",)
    total = 3 * 0.5 + np.var(odd.values) + np.var(small.values)
    assert two.explained == pytest.approx(1.5 / total, abs=0.01)


def test_compound_channels_go_where_their_largest_tone_is():
    both = Series("d", T, 0.5 * np.sin(4.0 * T) + 0.8 * np.sin(6.47 * T))
    result = find_groups([wave(4.0, "a"), wave(4.0, "b"), wave(6.47, "c"), both], 20.0)
    groups = {name: k for k, rhythm in enumerate(result.rhythms) for name in rhythm.names}
    assert groups["d"] == groups["c"]
    assert result.explained == pytest.approx(1.0)
    # The larger group first, and of as many joints that which moves more.
    assert result.rhythms[0].fit.total.sum() > result.rhythms[1].fit.total.sum()


# -- lines ----------------------------------------------------------------------------------------


def test_combinations_are_all_of_rising_order():
    for count, highest in ((1, 3), (2, 3), (3, 4)):
        listed = [tuple(sorted(pair.items())) for pair in _combinations(count, highest)]
        orders = [sum(abs(factor) for _, factor in pair) for pair in listed]
        assert orders == sorted(orders)
        expected = {((k, order),) for k in range(count) for order in range(1, highest + 1)}
        for a in range(count):
            for b in range(a + 1, count):
                for m in range(1, highest):
                    for n in range(1, highest + 1 - m):
                        expected |= {((a, m), (b, n)), ((a, m), (b, -n))}
        assert set(listed) == expected
        assert len(listed) == len(expected)


def test_mixed_tones_reach_to_the_sixth_order_and_the_resolution():
    duration_s = 2 * np.pi * 100  # a bin of 0.01
    assert mixed_tones([5.0, 1.0], duration_s)[0].factors == {1: 5}
    assert mixed_tones([7.0, 1.0], duration_s) == []
    for off, count in ((0.0149, 2), (0.0151, 0)):
        assert len(mixed_tones([1.0, 6.0 + off], duration_s)) == count
    assert mixed_tones([6.0, 1.0], duration_s)[0].group == 0
    # The same below 1 rad/s, and with the sign turned where the sum is below zero.
    slow = [(tone.group, dict(tone.factors)) for tone in mixed_tones([0.75, 0.5], duration_s)]
    assert slow == [(0, {0: -1, 1: 3}), (1, {0: 2, 1: -2})]
    turned = [(tone.group, dict(tone.factors)) for tone in mixed_tones([0.5, 0.75], duration_s)]
    assert turned == [(0, {0: -2, 1: 2}), (1, {0: 3, 1: -1})]


def test_limits_of_lines():
    slow = Series("s", T[::10], T[::10])
    assert _highest([wave(1.0), slow]) == pytest.approx(0.45 * 2 * np.pi * 10)
    assert _most_lines([wave(1.0), slow]) == 200 // 8
    few = Series("f", T[:15], T[:15])
    assert _most_lines([few]) == 1
    assert group_model([few], [3.0, 4.7], 0, 20.0).lines == (4.7,)
    assert group_model([wave(1.0)], [3.0, 4.7], 0, 20.0).lines == pytest.approx((4.7, 9.4, 14.1))


def test_lines_within_half_a_cycle_coincide():
    duration_s = 2 * np.pi * 100
    assert further_lines([1.0, 2.0049], 0, 3, 9.0, duration_s) == pytest.approx((4.0098, 6.0147))
    assert len(further_lines([1.0, 2.0051], 0, 3, 9.0, duration_s)) == 3
    assert further_lines([1.0, 0.0049], 0, 1, 9.0, duration_s) == pytest.approx((0.0098,))
    assert further_lines([1.0, 3.0], 0, 1, 9.0, duration_s) == (3.0, 6.0, 9.0)
    assert further_lines([1.0, 3.0], 0, 1, 8.99, duration_s) == (3.0, 6.0)


def test_candidates_are_mixed_tones_apart_from_all_that_is_there():
    omegas, model = [2 * np.pi, 2 * np.pi * 1.618], HarmonicModel(harmonics=2, lines=(10.0,))
    listed = _candidates(omegas, 0, model, 40.0, BIN)
    expected = []
    for m in range(-11, 12):
        for n in range(-11, 12):
            line = m * omegas[0] + n * omegas[1]
            if not 1 <= abs(m) + abs(n) <= 11 or line <= 0 or line > 40.0:
                continue
            far = abs(line - omegas[0]) > 30 * BIN
            near = min(abs(line - k * omegas[0]) for k in range(3)) <= BIN
            if not far and not near and abs(line - 10.0) > 0.75 * BIN:
                expected.append(line)
    np.testing.assert_allclose(sorted(listed), sorted(expected))
    low = _candidates(omegas, 0, model, 8.0, BIN)
    np.testing.assert_allclose(sorted(low), [line for line in sorted(expected) if line <= 8.0])
    plain = _candidates(omegas, 0, HarmonicModel(harmonics=2), 40.0, BIN)
    assert set(listed) < set(plain)


def test_the_periodogram_of_what_a_fit_leaves():
    other = Series("r", T[::2] + 0.003, np.cos(4.0 * T[::2]) + RNG.normal(size=1000))
    series = [wave(3.0, noise=0.3), other]
    fit = fit_at(series, 3.0)
    omegas = np.array([4.0, 5.5])
    power = _periodogram(series, fit, omegas)
    for k, channel in enumerate(series):
        rest = channel.values - fit.predict(k, channel.t_s)
        turned = np.exp(-1j * np.outer(omegas, channel.t_s)) @ rest
        np.testing.assert_allclose(power[k], np.abs(turned) ** 2 / channel.count)


def test_the_strongest_mixed_tones_become_lines():
    omegas = [2 * np.pi, 2 * np.pi * 1.618]
    tones = {2 * omegas[1] - omegas[0]: 0.02, 3 * omegas[0] - omegas[1]: 0.05}
    series = []
    for k in range(4):
        values = np.sin(omegas[0] * T - k) + 0.01 * RNG.normal(size=T.size)
        values = values + sum(size * np.sin(line * T + k) for line, size in tones.items())
        series.append(Series(f"j{k}", T, values))
    model = group_model(series, omegas, 0, 20.0)
    wider = with_mixed_lines(series, omegas, 0, model, 20.0)
    assert wider.lines[: len(model.lines)] == model.lines
    added = wider.lines[len(model.lines) :]
    assert added == pytest.approx(sorted(tones, key=tones.get, reverse=True))
    short = [channel.between(0.0, 0.39) for channel in series]  # 39 samples: four lines
    assert with_mixed_lines(short, omegas, 0, replace(model, lines=model.lines[:1] * 4), 0.39) == (
        replace(model, lines=model.lines[:1] * 4)
    )
