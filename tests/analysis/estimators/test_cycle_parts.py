"""Steps of gain and lag cycle by cycle, by plain sums: weights, combs, holes, normal equations."""

import numpy as np
import pytest

from undulog.analysis.estimators import demodulation
from undulog.analysis.estimators.demodulation import (
    LoggedPhase,
    _amplitudes,
    _comb,
    _difference_dof,
    _holes,
    _moments,
    _normal,
    amplitudes,
    cycles_of,
    demodulate,
    starts_of,
    weigh,
)
from undulog.analysis.estimators.series import Series

RNG = np.random.default_rng(9)


def test_weights_tell_what_each_cycle_has():
    t = np.concatenate([np.arange(0.0, 4.0, 0.1), np.arange(6.0, 10.0, 0.1)])
    weighed = weigh(t, 0.0, 10.0, 5)
    np.testing.assert_allclose(weighed.covered, [1.0, 1.0, 0.025, 1.0, 1.0], atol=0.026)
    assert weighed.starts.tolist() == [0, 20, 40, 40, 60, 80]
    assert weighed.coverage == pytest.approx(weighed.weights.sum() / 10.0)
    assert weighed.coverage == pytest.approx(0.8, abs=0.011)
    np.testing.assert_allclose(weighed.weights[5:10], 0.1)
    assert weighed.t_s is t
    full = weigh(np.arange(100) / 10, 0.0, 10.0, 2)
    assert (full.coverage, full.covered.tolist()) == (1.0, [1.0, 1.0])
    # A sample at an edge but for rounding begins the cycle there; all count somewhere.
    for early, second in ((0.9e-6, 2), (1.1e-6, 1)):
        edge = np.array([0.5, 1.5, 5.0 - 5.0 * early, 7.0])
        assert np.diff(weigh(edge, 0.0, 10.0, 2).starts).tolist() == [4 - second, second]


def test_a_cycle_needs_six_samples():
    t = np.arange(11) / 10
    result = amplitudes(t, np.cos(3 * t), np.array([0, 5, 11]), 3.0)
    assert np.isnan(result[0])
    assert result[1] == pytest.approx(1.0)


def test_a_phase_is_interpolated_and_ends_with_its_samples():
    phase = LoggedPhase(np.array([0.0, 1.0, 3.0]), np.array([1.0, 3.0, 4.0]))
    np.testing.assert_allclose(phase.at(np.array([0.5, 2.0, 0.0, 3.0])), [2.0, 3.5, 1.0, 4.0])
    assert np.isnan(phase.at(np.array([-0.01, 3.01]))).all()


def test_whole_cycles_but_for_rounding_count():
    t = np.arange(101.0)
    for turns, count in ((3.0 - 1e-7, 3), (3.0 - 1e-5, 2), (3.99, 3), (2.0, 2), (1.99, 0)):
        edges = LoggedPhase(t, 2 * np.pi * turns * t / 100).edges_s()
        assert edges.size == count
    # Faster than a hundred cycles a sample it is no phase.
    assert LoggedPhase(t[:3], 2 * np.pi * np.array([0.0, 150.0, 300.5])).edges_s().size == 300
    assert LoggedPhase(t[:3], 2 * np.pi * np.array([0.0, 151.0, 302.5])).edges_s().size == 0


def test_the_comb_is_the_mean_over_a_cycle_around():
    phase = np.arange(400) * 0.05
    values = 0.3 + 0.1 * phase + np.cos(phase + 1) + 0.5 * np.sin(2 * phase)
    mean = _comb(phase, values)
    inside = (phase >= np.pi - 0.051) & (phase <= phase[-1] - np.pi + 0.051)
    np.testing.assert_array_equal(np.isfinite(mean), inside)
    sure = (phase > np.pi) & (phase < phase[-1] - np.pi)
    np.testing.assert_allclose(mean[sure], (0.3 + 0.1 * phase)[sure], atol=1e-3)
    uneven = np.sort(RNG.uniform(0, 20, 300))
    rough = RNG.normal(size=300)
    k = 150
    fine = np.linspace(uneven[k] - np.pi, uneven[k] + np.pi, 200_001)
    expected = np.interp(fine, uneven, rough).mean()
    # Between samples the area is taken as straight.
    assert _comb(uneven, rough)[k] == pytest.approx(expected, abs=0.02)


def test_cycles_with_gaps_or_without_samples_have_holes():
    t = np.concatenate([0.55 + np.arange(35) / 10, 5.05 + np.arange(40) / 10])
    series = Series("q", t, t)
    holes = _holes(series, np.arange(0.0, 11.0))
    assert np.flatnonzero(holes).tolist() == [0, 3, 4, 5, 9]
    # By no more than a sampling interval the ends may be missed.
    assert not _holes(series, np.array([0.46, 1.0, 2.0])).any()
    assert _holes(series, np.array([0.44, 1.0, 2.0])).tolist() == [True, False]
    assert not _holes(series, np.array([8.0, 9.04])).any()
    assert _holes(series, np.array([8.0, 9.06])).all()


@pytest.mark.parametrize("together", [8192, 100, 1])
def test_moments_give_the_normal_equations(together, monkeypatch):
    """However many samples are summed in one go."""
    monkeypatch.setattr(demodulation, "_TOGETHER", together)
    phase, values = np.sort(RNG.uniform(0, 30, 240)), RNG.normal(size=240)
    starts = np.array([10, 60, 61, 130, 240])
    waves, cross, power = _moments(phase, values, starts)
    normal = _normal(np.diff(starts).astype(float), waves)
    for k in range(4):
        part = slice(starts[k], starts[k + 1])
        angle = phase[part]
        rows = np.stack(
            [angle**0, np.cos(angle), np.sin(angle), np.cos(2 * angle), np.sin(2 * angle)]
        )
        np.testing.assert_allclose(normal[k], rows @ rows.T, atol=1e-9)
        np.testing.assert_allclose(cross[:, k], rows @ values[part], atol=1e-9)
        assert power[k] == pytest.approx(values[part] @ values[part])


def test_cycles_are_summed_few_at_a_time(monkeypatch):
    sizes = []
    plain = demodulation.cos_sin

    def counted(angle):
        sizes.append(angle.size)
        return plain(angle)

    monkeypatch.setattr(demodulation, "cos_sin", counted)
    monkeypatch.setattr(demodulation, "_TOGETHER", 100)
    _moments(np.linspace(0, 60, 400), np.ones(400), np.arange(0, 401, 40))
    assert sizes == [80] * 5
    sizes.clear()
    _moments(np.linspace(0, 60, 400), np.ones(400), np.arange(0, 401, 200))
    assert sizes == [200, 200]
    monkeypatch.undo()
    monkeypatch.setattr(demodulation, "cos_sin", counted)
    sizes.clear()
    _moments(np.linspace(0, 60, 9000), np.ones(9000), np.arange(9001))
    assert sizes == [8192, 808]


def test_an_amplitude_is_least_squares_of_two_harmonics():
    t = np.arange(600) / 100
    phi = 2 * np.pi * t + 0.05 * np.sin(t)
    values = 0.5 * np.cos(phi + 0.4) + 0.2 * np.sin(2 * phi) + 0.05 * RNG.normal(size=600)
    phase, series = LoggedPhase(t, phi), Series("q", t, values + 2.0)
    edges = phase.edges_s()
    amplitude, explained = _amplitudes(series, phase, edges)
    swing = series.values[:-1] - _comb(phi[:-1], series.values[:-1])  # the last is the end
    starts = starts_of(t[:-1], edges)
    for k in range(edges.size - 1):
        part = slice(starts[k], starts[k + 1])
        angle, y = phi[part], swing[part]
        design = np.stack(
            [angle**0, np.cos(angle), np.sin(angle), np.cos(2 * angle), np.sin(2 * angle)], axis=1
        )
        if not np.isfinite(y).all():
            assert np.isnan(amplitude[k])
            continue
        best = np.linalg.lstsq(design, y, rcond=None)[0]
        assert amplitude[k] == pytest.approx(best[1] - 1j * best[2], rel=1e-6)
        share = y.size * abs(amplitude[k]) ** 2 / 2 / (y @ y)
        assert explained[k] == pytest.approx(share)
    assert np.isfinite(amplitude).sum() >= 4


def test_a_cycle_of_a_command_needs_twelve_samples():
    for rate, there in ((12.0, True), (11.0, False)):
        t = np.arange(round(8 * rate) + 1) / rate + 1e-4
        phase = LoggedPhase(t, 2 * np.pi * t)
        amplitude, explained = _amplitudes(
            Series("q", t, np.cos(2 * np.pi * t)), phase, phase.edges_s()
        )
        assert np.isfinite(amplitude).any() == there
        assert (explained > 0.5).any() == there
    few = np.arange(12) / 10
    amplitude, explained = _amplitudes(
        Series("q", few, few), LoggedPhase(few, 9 * few), np.array([0.4, 0.8])
    )
    assert np.isnan(amplitude).all()
    assert explained.tolist() == [0.0]


def test_a_command_counts_where_the_phase_explains_four_fifths():
    t = np.arange(2000) / 100 + 0.003
    phase = LoggedPhase(t, 2 * np.pi * t)
    edges = phase.edges_s()
    for share, there in ((0.81, True), (0.79, False)):
        # Of power 1 - share: a wave over which the mean of each cycle is zero.
        rest = np.sqrt(1 / share - 1) * np.cos(6 * np.pi * t)
        command = Series("q", t, np.cos(2 * np.pi * t) + rest)
        asked, given = demodulate(command, Series("q", t, 0.5 * command.values), phase, edges)
        assert np.isfinite(asked[2:-2]).all() == there
        assert np.isnan(asked[2:-2]).all() != there
        np.testing.assert_allclose(given[2:-2], 0.5, atol=1e-3)


def test_small_commands_are_not_driven():
    asked = np.array([1.0, 0.051, 0.049, 1.0, 1.0, 0.0]) + 0j
    result = cycles_of([np.arange(7.0)], [asked], [0.5 * asked])
    assert np.isfinite(result.ratio).tolist() == [True, True, False, True, True, False]
    none = cycles_of([np.arange(4.0)], [np.full(3, np.nan + 0j)], [np.ones(3) + 0j])
    assert np.isnan(none.ratio).all()
    assert (none.dof, np.isnan(none.variance).all()) == (0.0, True)


def test_three_second_differences_show_the_noise():
    for count, dof in ((4, 0.0), (5, _difference_dof(3))):
        asked = np.ones(count) + 0j
        given = asked + 0.01 * RNG.normal(size=count)
        result = cycles_of([np.arange(count + 1.0)], [asked], [given])
        assert result.dof == dof
        assert np.isfinite(result.variance).all() == (count == 5)
    silent = np.array([0.5, 0.5, 0.0, 0.5, 0.5, 0.5, 0.5]) + 0j
    result = cycles_of([np.arange(8.0)], [np.ones(7) + 0j], [silent])
    assert np.isnan(result.variance).tolist() == [False] * 2 + [True] + [False] * 4


def test_scatter_counts_from_when_it_has_settled():
    asked = np.ones(12) + 0j
    given = asked + np.r_[0.3 * RNG.normal(size=4), 0.01 * RNG.normal(size=8)]
    edges = np.arange(13.0)
    second = np.abs(given[:-2] - 2 * given[1:-1] + given[2:]) ** 2 / 6
    for settled, first in ((4.0, 4), (4.1, 5), (7.0, 7), (7.1, 0)):
        result = cycles_of([edges], [asked], [given], settled_s=settled)
        expected = second[first:].mean() / 2 / np.abs(given) ** 2
        np.testing.assert_allclose(result.variance, expected)
        assert result.dof == _difference_dof(10 - first)
