"""The control laws and what stands between them and the joints, against closed forms."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from undulog.sim.twin import filters
from undulog.sim.twin.reactions import amplitude, bend, frequency

DISTANCES = np.linspace(0.0, 3.0, 31)


def test_bend_halves_every_ln2_over_k_and_keeps_its_sign():
    assert bend(0.0, 1.0, 0.22, 2.0) == 0.22
    for d in DISTANCES:
        half = bend(d + math.log(2) / 2.0, -1.0, 0.22, 2.0)
        assert half == pytest.approx(bend(d, -1.0, 0.22, 2.0) / 2, rel=1e-12)
        assert half < 0
    assert bend(math.inf, 1.0, 0.22, 2.0) == 0.0


def test_amplitude_falls_smoothly_from_far_to_contact():
    a = amplitude(DISTANCES, 0.4, 0.1, 3.0)
    assert a[0] == pytest.approx(0.1)
    assert amplitude(np.array([math.inf]), 0.4, 0.1, 3.0)[0] == 0.4
    assert (np.diff(a) > 0).all()
    # The law solves A~' = k (A_max - A~): checked by differences to second order in the step.
    h = DISTANCES[1]
    slope = np.gradient(a, h)[1:-1]
    np.testing.assert_allclose(slope, 3.0 * (0.4 - a[1:-1]), rtol=(3.0 * h) ** 2 / 5)


def test_frequency_is_bounded():
    assert (frequency(0.0, 0.5, 2.0), frequency(math.inf, 0.5, 2.0)) == (1.5, 1.0)
    assert frequency(0.5, 0.5, 2.0) == pytest.approx(1.0 + 0.5 / math.e)


@given(st.floats(0.0, 3.0), st.floats(-5, 5), st.floats(0.01, 2.0))
def test_low_pass_is_the_exact_step_response_however_it_is_cut(time_s, height, time_constant_s):
    cut = filters.LowPass(time_constant_s, 0.0)
    for _ in range(7):
        cut.step(time_s / 7, height)
    whole = height * (1.0 - math.exp(-time_s / time_constant_s))
    assert cut.step(0.0, height) == pytest.approx(whole, abs=1e-9)


def test_low_pass_without_time_constant_passes_arrays():
    np.testing.assert_array_equal(filters.LowPass(0.0, np.zeros(2)).step(0.01, np.ones(2)), [1, 1])


def test_the_freer_side_is_latched():
    latch = filters.SideLatch(margin_m=0.05, hold_s=1.0)
    inf = math.inf
    assert latch.step(0.0, inf, inf) == 1  # a tie: at first to the right
    assert latch.step(0.1, inf, 0.5) == -1  # the left is free
    assert latch.step(0.5, 0.3, inf) == -1  # held for a second
    assert (latch.step(1.09, 0.3, inf), latch.step(1.1, 0.3, inf)) == (-1, 1)
    assert latch.step(9.0, 0.52, 0.5) == 1  # within the margin
    assert latch.step(9.1, inf, inf) == 1  # a tie: the last one
    assert latch.step(9.2, 0.56, 0.5) == -1


def test_a_head_between_two_walls_changes_sides_at_most_once_a_second():
    random = np.random.default_rng(3)
    latch = filters.SideLatch(0.02, 1.0)
    sides = [latch.step(t / 100, *random.uniform(0.2, 1.0, 2)) for t in range(2000)]
    changes = np.flatnonzero(np.diff(sides))
    assert len(changes) > 15
    assert np.diff(changes).min() >= 100


def sharp(distance_m):
    """A GP2Y0A02's branch in use, folded back below 0.15 m: voltage falls linearly to nothing."""
    voltage = 90.05 / (100 * np.maximum(distance_m, 0.15) + 13.46) - 0.137
    voltage = np.where(distance_m < 0.15, voltage * distance_m / 0.15, voltage)
    return (90.05 / (voltage + 0.137) - 13.46) / 100


def test_a_wall_that_comes_nearer_than_the_sensor_can_tell_stays_near():
    times = np.arange(0.0, 4.0, 0.01)
    true = 0.10 + 0.4 * np.abs(times - 2.0) / 2.0  # 0.5 m, in to 0.10 m, out again
    memory = filters.NearMemory(np.array([0.2]), 1.0)
    believed = np.array([memory.step(t, sharp(d)[None])[0] for t, d in zip(times, true, strict=1)])
    near = true < 0.15
    assert sharp(true)[near].max() > 0.2  # read farther than it is
    assert believed[near].max() <= 0.2
    assert believed[times < 1.0] == pytest.approx(true[times < 1.0])
    assert believed[-1] == pytest.approx(true[-1])  # forgotten in time


def test_a_sensor_without_fold_has_no_memory():
    memory = filters.NearMemory(np.array([0.0]), 1.0)
    read = np.array([0.1, 0.5, math.inf])
    assert [memory.step(0.01 * i, d[None])[0] for i, d in enumerate(read)] == list(read)


@given(st.lists(st.floats(0.01, 0.5), min_size=2, max_size=60), st.floats(0.0, 3.0))
def test_phase_history_gives_back_a_linear_function_exactly(steps, back):
    history = filters.PhaseHistory(3.0)
    phases = np.cumsum(steps)
    for phase in phases:
        history.add(phase, np.array([2.0 * phase - 1.0, -phase]))
    at = max(phases[-1] - back, phases[0])  # the first one where nothing is older
    got = history.back(np.array([back]))[0]
    np.testing.assert_allclose(got, [2.0 * at - 1.0, -at], rtol=1e-9, atol=1e-9)


def swing(turn_rate, periods=6, gain=1.6):
    """Headings of a head that swings by 0.6 rad while its path turns, and what is made of them."""
    path, rows = filters.PathHeading(gain), []
    for phase in np.arange(0.0, periods * math.tau, 0.03):
        bent = 0.0 if phase < 2 * math.tau else -turn_rate / gain
        way = math.pi + turn_rate * max(phase - 2 * math.tau, 0.0)
        measured = math.remainder(way + 0.6 * math.sin(phase), math.tau)
        rows.append((phase, way, path.step(phase, measured, bent)))
    return np.array(rows).T


@pytest.mark.parametrize("turn_rate", [0.0, 0.2, -0.3])
def test_path_heading_has_neither_the_swing_nor_half_a_period_of_delay(turn_rate):
    """Across the cut at pi, and while a turn begins: without the model it would be pi c Y late."""
    phase, way, measured = swing(turn_rate)
    error = np.abs([math.remainder(e, math.tau) for e in measured - way])
    # The trapezoidal rule, and a sample more or less:
    assert error[phase > math.tau].max() < 0.005
    assert error[phase < math.tau].max() > 0.1  # not yet a period


def test_path_heading_goes_on_over_a_full_turn():
    phase, way, measured = swing(0.3, periods=12)
    assert way[-1] - way[0] > 2 * math.tau
    assert np.abs(np.diff(measured[phase > math.tau])).max() < 0.05


def test_path_heading_waits_for_a_heading_and_outlasts_it():
    path = filters.PathHeading(1.6)
    assert math.isnan(path.step(0.0, math.nan, 0.0))
    assert path.step(0.1, 0.7, 0.0) == pytest.approx(0.7)
    assert path.step(0.2, math.nan, 0.0) == pytest.approx(0.7)


@given(st.lists(st.floats(0.05, 0.5), min_size=2, max_size=60), st.floats(0.5, 3.0))
def test_least_is_the_least_within_the_span(steps, span):
    history, random = filters.PhaseHistory(span), np.random.default_rng(1)
    phases = np.cumsum(steps)
    values = random.uniform(0, 1, (len(phases), 3))
    for phase, value in zip(phases, values, strict=True):
        history.add(phase, value)
    np.testing.assert_array_equal(history.least(), values[phases >= phases[-1] - span].min(axis=0))


def test_the_body_bends_where_the_head_did_also_when_omega_changes():
    """Y(t) = sin of the phase: joint i must show it (i - 1) |lag| of phase later, exactly so."""
    lag, phase = -math.pi / 6, 0.0
    wave = filters.PassedWave(13, lag)
    for tick in range(900):
        phase += 0.01 * math.pi * (1.0 if tick < 700 else 1.3)
        bent = wave.step(phase, math.sin(phase))
    expected = np.sin(phase - np.arange(13) * abs(lag))
    np.testing.assert_allclose(bent, expected, atol=(0.013 * math.pi) ** 2 / 8)


def test_the_body_is_straight_until_the_wave_comes():
    wave = filters.PassedWave(4, 1.0)
    wave.step(0.0, 0.0)
    for k in range(1, 16):
        bent = wave.step(0.1 * k, 0.2)
    np.testing.assert_allclose(bent, [0.2, 0.2, 0.0, 0.0], atol=1e-12)
