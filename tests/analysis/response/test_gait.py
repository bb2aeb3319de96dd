"""Is there a gait, where is it steady, and when has it settled?"""

from itertools import pairwise

import numpy as np
import pytest

from undulog.analysis.estimators.harmonic import fit_at, fit_shared
from undulog.analysis.estimators.series import Series
from undulog.analysis.response.fitting import fit_gait
from undulog.analysis.response.rhythm import driven, find_rhythm, phase_step, wave_name
from undulog.analysis.signals.windows import Stretch, covered, settled, steady_runs, whole_cycles


def channels(make, count=4, duration=10.0, rate=100.0):
    t = np.arange(round(duration * rate)) / rate
    return [Series(f"j{i}", t, make(t, i)) for i in range(count)]


@pytest.mark.parametrize("frequency", [0.31, 0.5, 1.7, 9.3])
def test_a_rhythm_is_found_wherever_it_is(frequency):
    omega = 2 * np.pi * frequency
    rhythm = find_rhythm(channels(lambda t, i: np.sin(omega * t - i)), 10.0)
    assert rhythm.omega == pytest.approx(omega, rel=1e-9)
    assert rhythm.explained > 1 - 1e-9


def test_what_the_thresholds_stand_for():
    rng = np.random.default_rng(1)
    noisy = channels(lambda t, i: np.sin(4 * t - i) + rng.normal(0, 0.35, t.size))
    assert 0.78 < find_rhythm(noisy, 10.0).explained < 0.84
    square = channels(lambda t, i: np.sign(np.sin(6 * t - i)))
    assert find_rhythm(square, 10.0).explained == pytest.approx(0.90, abs=0.01)
    # Three cycles and harmonics fitted to a ramp: (6 / pi^2)(1/9 + 1/36 + 1/81).
    t = np.arange(3000) / 300
    ramp = fit_shared([Series("ramp", t, t)], 2 * np.pi * 0.3)
    assert find_rhythm([Series("ramp", t, t)], 10.0) is None or ramp.explained[0] < 0.2


def test_what_is_no_gait():
    rng = np.random.default_rng(2)
    for make in (
        lambda t, i: 0.1 * t,
        lambda t, i: 0.1 * t**2,
        lambda t, i: np.cumsum(rng.normal(0, 0.01, t.size)),
        lambda t, i: rng.normal(0, 0.3, t.size),
        lambda t, i: np.sin(0.8 * t**2),
        lambda t, i: np.where(t > 4, 0.3, 0.0),
        lambda t, i: np.zeros_like(t),
        lambda t, i: np.sin(2 * np.pi * 0.2 * t),
    ):
        notes = []
        named = {channel.name: channel for channel in channels(make)}
        assert fit_gait(named, named, 10.0, notes.append) is None
        assert notes[0].startswith("no gait")


def test_a_strong_second_harmonic_is_not_taken_for_the_gait():
    waves = channels(lambda t, i: 0.6 * np.sin(5 * t - i) + np.sin(2 * (5 * t - i)))
    rhythm = find_rhythm(waves, 10.0)
    assert rhythm.omega == pytest.approx(5.0, rel=1e-9)


def test_driven_joints():
    rng = np.random.default_rng(1)
    sizes = [0.4, 0.35, 0.001, 0.0, 0.2]
    makes = channels(lambda t, i: sizes[i] * np.sin(3 * t - i), count=4)
    makes += channels(lambda t, i: 0.2 * rng.normal(size=t.size), count=1)
    follows, astray = driven(fit_at(makes, 3.0))
    assert follows.tolist() == [True, True, False, False, False]
    assert astray.tolist() == [False, False, False, False, True]


def test_direction_of_the_wave():
    # Eq. 2 with a negative lag: crests move towards the high indices, the tail.
    step = phase_step(0.4 * np.exp(-1j * np.pi / 3 * np.arange(12)))
    assert step == pytest.approx(-np.pi / 3)
    assert (wave_name(step), wave_name(-step)) == ("head-to-tail", "tail-to-head")
    assert wave_name(0.0) == wave_name(np.pi) == "standing"


def test_planes_with_different_frequencies_are_not_averaged():
    t = np.arange(1000) / 100
    named = {f"h{i}": Series(f"h{i}", t, 0.4 * np.sin(3 * t - i)) for i in range(5)}
    named |= {f"v{i}": Series(f"v{i}", t, 0.1 * np.sin(4.3 * t - i)) for i in range(2)}
    notes = []
    fit = fit_gait(named, named, 10.0, notes.append)
    driven_joints = [group.driven for group in fit.groups]
    assert driven_joints == [tuple(f"h{i}" for i in range(5)), ("v0", "v1")]
    assert [group.fit.omega for group in fit.groups] == pytest.approx([3.0, 4.3], rel=1e-9)
    assert not any("commanded something else" in text for text in notes)


def test_steady_runs_of_the_logged_gait():
    names = ("horizontal.A", "horizontal.omega", "horizontal.phase", "horizontal.offset")
    t_ns = np.arange(100) * 10_000_000
    values = np.tile([0.4, 3.0, 0.0, 0.0], (100, 1))
    values[:, 2] = np.arange(100)  # the phase runs on
    values[:20, 0] = np.linspace(0, 0.4, 20)  # amplitude ramp
    values[60:, 1] = 4.0
    values[80:, 3] = 0.1
    runs = steady_runs(t_ns, names, values)
    edges_ns = np.array([190, 600, 800, 1000]) * 1_000_000
    assert runs[-3:] == [Stretch(*pair) for pair in pairwise(edges_ns.tolist())]
    assert steady_runs(t_ns, names, values, ("offset",))[-1] == Stretch(600_000_000, 10**9)
    assert steady_runs(t_ns[:0], names, values[:0]) == []
    long = [run for run in runs if run.duration_s >= 0.2]
    assert steady_runs(t_ns, names, values, least_s=0.2) == long
    assert len(long) == 3 < len(runs)


def test_settling_time_counts_from_the_start_or_from_the_change():
    second = 10**9
    assert settled(Stretch(2 * second, 16 * second), 0, 8.0) == Stretch(8 * second, 16 * second)
    assert settled(Stretch(20 * second, 40 * second), 0, 8.0) == Stretch(28 * second, 40 * second)
    assert settled(Stretch(0, 5 * second), 0, 8.0).duration_s == 0


def test_covered_counts_the_last_samples_own_interval():
    assert covered([np.arange(5) * 10, np.arange(3) * 10 + 2]) == Stretch(0, 50)
    assert covered([np.empty(0, dtype=np.int64)]) is None


def test_whole_cycles_are_those_at_the_end():
    assert whole_cycles(0.0, 9.0, 0.5) == (1.0, 9.0, 4)
    assert whole_cycles(0.0, 7.99999, 0.5) == (0.0, 7.99999, 4)
    assert whole_cycles(8.0, 20.01, 0.5) == (8.0, 20.0, 6)  # a sample more than whole cycles
    assert whole_cycles(0.0, 1.0, 0.5)[2] == 0
