"""Energies on the samples' own times against closed forms."""

import numpy as np
import pytest
from scipy import stats

from undulog.analysis.estimators.series import Series, clean, coverage, sample_weights
from undulog.analysis.parts.energy.measure import _distance, _ratio, add_up, integrate, power_of
from undulog.capture.log.read.sample_times import Signal

SECOND = 10**9


def test_periodic_power_over_whole_cycles_is_integrated_to_rounding():
    t = np.arange(400) / 100
    power = 0.2 + np.sin(2 * np.pi * t) + 0.5 * np.cos(6 * np.pi * t - 1)
    (energy,) = integrate([Series("q", t, power)], 0.0, 4.0, 4)
    np.testing.assert_allclose(energy.net_j, 0.2, atol=0.02)
    assert energy.net_j.sum() == pytest.approx(0.8, abs=1e-12)
    assert energy.coverage == pytest.approx(1.0)


def test_positive_and_absolute_parts():
    t = np.arange(4000) / 1000
    (energy,) = integrate([Series("q", t, np.sin(2 * np.pi * t))], 0.0, 4.0, 2)
    np.testing.assert_allclose(energy.plus_j, 2 / np.pi, rtol=1e-5)
    np.testing.assert_allclose(energy.abs_j, 4 / np.pi, rtol=1e-5)


def test_uneven_sampling_is_weighted_by_time():
    t = np.arange(3000) / 1000 + np.random.default_rng(1).uniform(0, 0.9e-3, 3000)
    (energy,) = integrate([Series("q", t, t**2)], 0.0, 3.0)
    assert energy.net_j[0] == pytest.approx(9.0, rel=1e-3)


def test_gaps_are_not_bridged():
    t = np.arange(1000) / 100
    t = t[(t < 3) | (t >= 5)]
    (energy,) = integrate([Series("q", t, np.ones(t.size))], 0.0, 10.0)
    assert energy.net_j[0] == pytest.approx(8.0, abs=0.02)
    assert energy.coverage == pytest.approx(0.8, abs=0.002)
    # Also not at the window's ends.
    assert coverage(t[t >= 5], 0.0, 10.0) == pytest.approx(0.5, abs=0.002)
    assert integrate([Series("q", t[:1], np.ones(1))], 0.0, 10.0) == [None]


def test_weights_are_the_trapezoidal_rule_inside():
    t = np.array([0.5, 1.0, 2.0, 2.5, 3.5])
    np.testing.assert_allclose(sample_weights(t, 0.0, 4.0), [0.75, 0.75, 0.75, 0.75, 1.0])


def test_power_of_signals_sampled_at_other_times():
    t = np.arange(1000) * 10_000_000
    current = Signal("q", "A", t, np.full(1000, 2.0))
    shifted = t + 3_000_000
    kept = (shifted < 3 * SECOND) | (shifted > 4 * SECOND)
    power = power_of(current, Signal("q", "V", shifted[kept], shifted[kept] * 1e-9), 0)
    np.testing.assert_allclose(power.values, 2 * power.t_s, atol=1e-9)
    # The first current has no voltage yet, and those in the voltage's gap have none.
    assert power.count == 1000 - 1 - np.count_nonzero((t > 2.993e9) & (t < 4.003e9))
    assert power.dropped_nan == 1000 - power.count


def test_a_factor_reaches_from_its_first_sample_to_its_last():
    t = np.arange(10) * 10_000_000
    current = Signal("q", "A", t, np.full(10, 2.0))
    volt_ns = np.array([2, 3, 4, 6, 7]) * 10_000_000  # no gap: one of 20 ms
    power = power_of(current, Signal("q", "V", volt_ns, volt_ns * 1e-6), 0)
    np.testing.assert_allclose(power.t_s, np.arange(2, 8) * 0.01)
    np.testing.assert_allclose(power.values, 2 * np.arange(20.0, 80.0, 10.0))
    alone = power_of(current, Signal("q", "V", volt_ns[:1], volt_ns[:1] * 1e-6), 0)
    assert (alone.count, alone.dropped_nan) == (0, 10)
    two = power_of(current, Signal("q", "V", volt_ns[:2], volt_ns[:2] * 1e-6), 0)
    np.testing.assert_allclose(two.values, [40.0, 60.0])


def test_clean_sorts_drops_and_counts():
    t_ns = np.array([10, 30, 20, 20, 40]) * SECOND
    series = clean("q", t_ns, np.array([1.0, 3.0, 2.0, 9.0, np.inf]), 10 * SECOND)
    np.testing.assert_array_equal(series.t_s, [0.0, 10.0, 20.0])
    np.testing.assert_array_equal(series.values, [1.0, 2.0, 3.0])
    assert (series.dropped_nan, series.dropped_duplicates) == (1, 1)


def test_each_cycle_has_its_own_energy_and_coverage():
    t = np.arange(800) / 100 - 3.0
    power = 0.2 + np.sin(2 * np.pi * t) ** 2
    kept = (t < 0.2) | (t >= 0.7)
    (energy,) = integrate([Series("q", t[kept], power[kept])], -3.0, 5.0, 8)
    whole = np.delete(np.arange(8), 3)
    np.testing.assert_allclose(energy.net_j[whole], 0.7, atol=1e-9)
    np.testing.assert_allclose(energy.covered[whole], 1.0, atol=1e-9)
    assert energy.covered[3] == pytest.approx(0.5, abs=0.011)


def test_powers_of_other_times_are_weighed_by_their_own():
    t = np.arange(400) / 100
    late = t[t >= 2.0]
    powers = [Series(name, times, np.ones(times.size)) for name, times in (("a", t), ("b", late))]
    powers += [powers[1], Series("c", t + 0.001, t), powers[0]]
    together = integrate(powers, 0.0, 4.0, 2)
    for power, energy in zip(powers, together, strict=True):
        (alone,) = integrate([power], 0.0, 4.0, 2)
        np.testing.assert_array_equal(energy.net_j, alone.net_j)
        np.testing.assert_array_equal(energy.covered, alone.covered)
        assert energy.coverage == alone.coverage
    np.testing.assert_allclose(together[1].net_j, [0.005, 1.995], atol=0.006)
    same = integrate([powers[0], Series("d", t, 3.0 * np.ones(400))], 0.0, 4.0, 2)
    np.testing.assert_allclose(same[1].plus_j, 3.0 * same[0].plus_j)


def test_a_window_takes_two_samples_and_a_length():
    power = Series("q", np.array([1.0, 2.0, 3.0]), np.array([1.0, 1.0, -1.0]))
    (energy,) = integrate([power], 0.5, 2.5)
    np.testing.assert_allclose((energy.net_j, energy.plus_j), [[2.0], [2.0]])
    assert integrate([power], 1.5, 2.5) == integrate([power], 2.0, 2.0) == [None]
    assert integrate([power], 3.0, 0.0) == [None]
    assert integrate([], 0.0, 1.0) == []
    before = Series("none", np.array([0.1, 0.2]), np.ones(2))
    nothing, same = integrate([before, power], 0.5, 2.5)
    assert (nothing, same.net_j.tolist()) == (None, energy.net_j.tolist())
    assert add_up(power, power, 2.0, 2.0, 1) is add_up(power, power, 3.0, 1.0, 1) is None
    short = Series("q", power.t_s[:1], power.values[:1])
    assert add_up(short, short, 0.0, 4.0, 1) is None
    two = Series("q", power.t_s[:2], np.array([4.0, 6.0]))
    np.testing.assert_allclose(add_up(two, two, 0.5, 2.5, 2).net_j, [4.0, 6.0])


def test_a_product_of_nothing_is_nothing():
    none = Signal("q", "A", np.zeros(0, dtype=np.int64), np.zeros(0))
    t = np.arange(3) * 10_000_000
    some = Signal("q", "V", t, np.ones(3))
    assert power_of(none, some, 0).count == power_of(none, none, 0).count == 0
    assert power_of(some, none, 0).count == 0


def test_a_factor_is_interpolated_to_its_last_sample_and_on_either_side_of_a_gap():
    t = np.arange(0, 300, 5) * 1_000_000 + 10**18
    ten = np.r_[0:100:10, 200:300:10] * 1_000_000 + 10**18
    first = Signal("q", "A", t, np.ones(t.size))
    power = power_of(first, Signal("q", "V", ten, (ten - 10**18) * 1e-9), 10**18)
    expected_ms = np.r_[0:91:5, 200:291:5]
    np.testing.assert_allclose(power.t_s, expected_ms * 1e-3, atol=1e-12)
    np.testing.assert_allclose(power.values, expected_ms * 1e-3, atol=1e-12)


def accumulated(power, count, start_s=-3.0, length_s=0.01, fine=200):
    """Means of a power and of its positive part over intervals, by the midpoint rule."""
    at = start_s + (np.arange(count * fine).reshape(count, fine) + 0.5) * length_s / fine
    t = start_s + (np.arange(count) + 0.5) * length_s
    values = power(at)
    return Series("q", t, values.mean(axis=1)), Series("q", t, np.maximum(values, 0).mean(axis=1))


def test_accumulated_powers_keep_what_happens_within_an_interval():
    # A ripple in step with the sampling, and one that changes the sign within an interval.
    def power(t):
        return 0.3 + 2.0 * np.sin(2 * np.pi * 100 * t) + np.sin(2 * np.pi * t)

    net, plus = accumulated(power, 800)
    energy = add_up(net, plus, -3.0, 5.0, 8)
    np.testing.assert_allclose(energy.net_j, 0.3, atol=1e-12)
    fine = power((np.arange(800_000) + 0.5) * 1e-5)
    np.testing.assert_allclose(energy.abs_j.sum(), np.abs(fine).sum() * 1e-5, rtol=1e-4)
    np.testing.assert_allclose(energy.covered, 1.0)
    (product,) = integrate([net], -3.0, 5.0, 8)
    assert product.abs_j.sum() < 0.6 * energy.abs_j.sum()  # the sign of the mean alone


def test_a_window_takes_its_part_of_the_intervals_at_its_edges():
    net, plus = accumulated(lambda t: 1.0 + t, 800)  # stamps from -2.995 on
    energy = add_up(net, plus, -1.0037, 2.0021, 1)
    exact = 3.0058 + (2.0021**2 - 1.0037**2) / 2
    assert energy.net_j[0] == pytest.approx(exact, abs=2 * 0.01**2 / 8)
    assert energy.plus_j[0] == pytest.approx(exact + 0.0037**2 / 2, abs=2 * 0.01**2 / 8)


def test_a_lost_message_is_a_gap_of_one_interval():
    net, plus = accumulated(np.ones_like, 800)
    kept = np.delete(np.arange(800), [5, 6, 400])
    lost = [Series("q", power.t_s[kept], power.values[kept]) for power in (net, plus)]
    energy = add_up(*lost, -3.0, 5.0, 8)
    np.testing.assert_allclose(energy.net_j, [0.98, 1, 1, 1, 0.99, 1, 1, 1])
    np.testing.assert_allclose(energy.covered, energy.net_j)
    assert energy.coverage == pytest.approx(7.97 / 8)
    assert (add_up(net, lost[1], -3.0, 5.0, 8), add_up(net, plus, 6.0, 7.0, 1)) == (None, None)


@pytest.mark.parametrize("cycles", [2, 5, 60])
def test_a_distance_has_the_interval_of_a_sum_of_normal_steps(cycles):
    way = np.random.default_rng(cycles).normal(0.02, 0.005, cycles)
    distance = _distance(way)
    expected = stats.t.interval(0.95, cycles - 1, way.mean(), stats.sem(way))
    assert distance.value == pytest.approx(cycles * way.mean())
    np.testing.assert_allclose(distance.ci95, cycles * np.array(expected), rtol=1e-9)


def test_the_interval_of_a_ratio_holds_the_ratio_as_often_as_it_says():
    rng, held, draws = np.random.default_rng(2), 0, 2000
    for _ in range(draws):
        below = rng.normal(1.0, 0.2, 40)
        above = 0.7 * below + rng.normal(0.0, 0.1, 40)
        low, high = _ratio(above, below).ci95
        held += low <= 0.7 <= high
    assert held / draws == pytest.approx(0.95, abs=0.016)  # three standard errors
