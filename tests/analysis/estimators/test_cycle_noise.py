"""The response in each cycle of several runs, some of them short, against plain loops."""

import itertools
import math

import numpy as np
import pytest

from undulog.analysis.estimators.demodulation import (
    CycleResponses,
    LoggedPhase,
    _amplitudes,
    _difference_dof,
    _holes,
    cycles_of,
    demodulate,
    weigh,
)
from undulog.analysis.estimators.series import Series, sample_weights


def by_loops(edges, asked, given, settled_s):
    """Ratio, variance and degrees of freedom, cycle by cycle."""
    largest = max((abs(c) for run in asked for c in run if not math.isnan(abs(c))), default=0.0)
    ratios, early, late = [], [], []
    for times, commands, responses in zip(edges, asked, given, strict=True):
        ratio = [
            r / c if abs(c) > 0.05 * largest else math.nan
            for c, r in zip(commands, responses, strict=True)
        ]
        ratios += ratio
        for k in range(len(ratio) - 2):
            second = abs(ratio[k] - 2 * ratio[k + 1] + ratio[k + 2]) ** 2
            weights = zip((1, 4, 1), commands[k : k + 3], strict=True)
            share = sum(w / abs(c) ** 2 if abs(c) else math.nan for w, c in weights)
            if math.isfinite(second / share):
                (late if times[k] >= settled_s else early).append(second / share)
    used = late if len(late) >= 3 else early + late
    noise = np.mean(used) / 2 if len(used) >= 3 else math.nan
    answers = [abs(r) ** 2 for run in given for r in run]
    variance = [noise / a if a > 0 else math.nan for a in answers]
    return ratios, variance, _difference_dof(len(used)) if len(used) >= 3 else 0.0


def test_ratios_and_noise_of_runs_of_any_length_are_those_of_a_loop():
    rng = np.random.default_rng(3)
    seen = set()
    for number in range(120):
        sizes = rng.integers(0, 7, 4)
        sizes[0] = max(sizes[0], 1)
        edges = [100.0 * k + np.arange(size + 1.0) for k, size in enumerate(sizes)]
        asked, given = [], []
        for size in sizes:
            command = rng.choice(
                [1.0, 0.7, 0.06, 0.04, 0.0, np.nan], size, p=[0.5, 0.3, *[0.05] * 4]
            )
            asked.append(command * np.exp(1j * rng.normal(size=size)))
            answer = asked[-1] * (0.9 + 0.01 * rng.normal(size=size))
            given.append(np.where(rng.random(size) < 0.05, 0.0, answer))
        settled = [-np.inf, 1.0, 2.0, 101.0, 202.0, 303.0][number % 6]
        responses = cycles_of(edges, asked, given, settled_s=settled)
        ratio, variance, dof = by_loops(edges, asked, given, settled)
        np.testing.assert_allclose(responses.ratio, ratio, rtol=1e-9)
        np.testing.assert_allclose(responses.variance, variance, rtol=1e-9)
        assert responses.dof == pytest.approx(dof)
        np.testing.assert_array_equal(
            responses.start_s, np.concatenate([edge[:-1] for edge in edges])
        )
        np.testing.assert_array_equal(
            responses.stop_s, np.concatenate([edge[1:] for edge in edges])
        )
        seen.add(dof > 0)
    assert seen == {True, False}


def test_runs_whose_command_is_unknown_have_no_response():
    nothing = np.full(3, np.nan + 0j)
    responses = cycles_of([np.arange(4.0)], [nothing], [np.ones(3) + 0j])
    assert isinstance(responses, CycleResponses)
    assert np.isnan(responses.ratio).all()
    still = cycles_of([np.arange(4.0)], [np.zeros(3) + 0j], [np.ones(3) + 0j])
    assert np.isnan(still.ratio).all()
    assert still.dof == 0.0


# -- one cycle of a run ---------------------------------------------------------------------------


def wave(rate=50.0, seconds=8.0):
    t = np.arange(round(rate * seconds)) / rate
    return t, LoggedPhase(t, 2 * np.pi * t + 0.2)


def test_a_command_that_stands_has_no_amplitude():
    t, phase = wave()
    edges = phase.edges_s()
    for values in (np.zeros(t.size), np.full(t.size, 2.0)):
        amplitude, explained = _amplitudes(Series("q", t, values), phase, edges)
        assert (np.isnan(amplitude) | (np.abs(amplitude) < 1e-12)).all()
        assert explained.shape == (edges.size - 1,)
    zero, none = _amplitudes(Series("q", t, np.zeros(t.size)), phase, edges)
    assert np.isnan(zero).all()
    assert not none.any()


@pytest.mark.parametrize("count", [0, 1, 2, 11, 12, 13])
def test_a_few_samples_within_the_phase_are_no_cycle(count):
    t, phase = wave()
    early = np.concatenate([t[:count] + 1.0, 100.0 + t[:40]])
    amplitude, explained = _amplitudes(Series("q", early, early), phase, phase.edges_s())
    assert np.isnan(amplitude).all()
    assert not explained.any()


@pytest.mark.parametrize(("count", "there"), [(11, False), (12, True)])
def test_each_cycle_needs_twelve_samples_of_its_own(count, there):
    _, phase = wave()
    phase = LoggedPhase(phase.t_s, phase.value - 0.2)  # cycles begin at half seconds
    t = (np.arange(8 * count) + 0.5) / count
    amplitude, explained = _amplitudes(
        Series("q", t, np.cos(2 * np.pi * t)), phase, phase.edges_s()
    )
    assert np.isfinite(amplitude[1:-1]).tolist() == [there] * (amplitude.size - 2)
    np.testing.assert_allclose(explained[1:-1], float(there), atol=1e-3)


def test_a_command_at_the_least_share_counts():
    """A power of an amplitude a is a^2 / 2; its mean over a cycle is taken off before."""
    t, phase = wave(100.0)
    edges = phase.edges_s()
    angle = phase.value
    for third, there in ((0.49, True), (0.51, False)):
        # 1 / (1 + third^2) is explained: 0.806 and 0.794.
        command = Series("q", t, np.cos(angle) + third * np.cos(3 * angle) + 5.0)
        asked, given = demodulate(command, Series("q", t, 0.5 * np.sin(angle)), phase, edges)
        inner = slice(1, -1)
        assert np.isfinite(asked[inner]).all() == there
        assert np.isnan(asked[inner]).all() != there
        np.testing.assert_allclose(given[inner], -0.5j, atol=2e-3)
        if there:
            np.testing.assert_allclose(asked[inner], 1.0, atol=2e-3)


def test_a_second_harmonic_is_fitted_beside_the_first():
    """At uneven times they are not orthogonal."""
    rng = np.random.default_rng(6)
    t = np.cumsum(rng.uniform(0.02, 0.06, 300))
    phase = LoggedPhase(np.array([0.0, 12.0]), np.array([0.0, 24 * np.pi]))
    angle = 2 * np.pi * t
    plain = Series("q", t, 0.4 * np.cos(angle + 1.0))
    edges = phase.edges_s()
    both = Series("q", t, plain.values + 0.3 * np.sin(2 * angle))
    amplitude, share = _amplitudes(plain, phase, edges)
    other, less = _amplitudes(both, phase, edges)
    finite = np.isfinite(amplitude) & np.isfinite(other)
    assert finite.sum() >= 6
    np.testing.assert_allclose(amplitude[finite], 0.4 * np.exp(1j), atol=0.08)
    np.testing.assert_allclose(other[finite], amplitude[finite], atol=0.08)
    assert (share[finite] > less[finite] + 0.1).all()


def test_holes_are_those_of_a_loop():
    rng = np.random.default_rng(7)
    for _ in range(60):
        step = rng.choice([1.0, 1.0, 1.0, 2.0, 4.0, 9.0], 30)
        series = Series("q", np.cumsum(step), np.zeros(30))
        t, usual = series.t_s, np.median(np.diff(series.t_s))
        edges = np.sort(rng.uniform(t[0] - 3.0, t[-1] + 3.0, 8))
        expected = []
        for low, high in itertools.pairwise(edges):
            missing = [a < high and b > low for a, b in itertools.pairwise(t) if b - a > 3 * usual]
            expected.append(any(missing) or t[0] - low > usual or high - t[-1] > usual)
        assert _holes(series, edges).tolist() == expected


def test_weights_of_cycles_are_those_of_a_loop():
    rng = np.random.default_rng(8)
    for cycles in (1, 2, 5):
        t = np.sort(rng.uniform(2.0, 7.0, 40))
        t = t[(t < 4.1) | (t > 5.9)]
        result = weigh(t, 2.0, 7.0, cycles)
        weights, period = sample_weights(t, 2.0, 7.0), 5.0 / cycles
        place = np.minimum(np.floor((t - 2.0) / period), cycles - 1)
        sums = np.array([weights[place == k].sum() for k in range(cycles)])
        np.testing.assert_allclose(result.weights, weights)
        np.testing.assert_allclose(result.covered, np.minimum(sums / period, 1.0))
        assert result.starts.tolist() == [0, *(np.sum(place <= k) for k in range(cycles))]
        assert result.coverage == pytest.approx(min(1.0, weights.sum() / 5.0))
