"""Windows of a constant gait, found in commands whose changes are known."""

import numpy as np
import pytest

from undulog.analysis.estimators.series import Series
from undulog.analysis.signals.gait_windows import several_gaits


def commands(pace_hz, *, joints=4, rate_hz=50.0, noise=0.0, amplitude=None, seed=0):
    """Serpentine commands at a pace for each sample [Hz], shape (n,)."""
    rng = np.random.default_rng(seed)
    t_s = np.arange(pace_hz.size) / rate_hz
    phase = 2 * np.pi * np.cumsum(pace_hz) / rate_hz
    size = np.ones_like(t_s) if amplitude is None else amplitude
    rows = [
        size * np.sin(phase - 0.7 * k) + noise * rng.standard_normal(t_s.size)
        for k in range(joints)
    ]
    return [Series(f"j{k}", t_s, row) for k, row in enumerate(rows)], float(t_s[-1])


def by_time(values, seconds, rate_hz=50.0):
    return np.repeat(values, np.rint(np.array(seconds) * rate_hz).astype(int))


@pytest.mark.parametrize("noise", [0.0, 0.02, 0.05])
def test_windows_lie_within_the_gaits(noise):
    paces, seconds = [0.5, 0.8, 0.5, 1.3], [24.0, 15.0, 31.0, 12.0]
    series, stop_s = commands(by_time(paces, seconds), noise=noise)
    windows = several_gaits(series, 0.0, stop_s)
    edges = np.cumsum([0.0, *seconds])
    assert len(windows) == 4
    for window, pace, start_s, end_s in zip(windows, paces, edges[:-1], edges[1:], strict=True):
        assert window.period_s == pytest.approx(1 / pace, rel=0.02)
        slack_s = 0.25 / pace
        assert start_s - slack_s <= window.start_s <= start_s + 1.5 / pace
        assert end_s - 0.5 / pace <= window.stop_s <= end_s + slack_s


def test_the_same_gait_in_other_units_and_at_another_time_has_the_same_windows():
    pace = by_time([0.5, 0.8], [30.0, 30.0])
    series, stop_s = commands(pace)
    first = several_gaits(series, 0.0, stop_s)
    moved = [
        Series(channel.name, channel.t_s + 1000.0, -57.3 * channel.values + 9.0)
        for channel in series
    ]
    second = several_gaits(moved, 1000.0, 1000.0 + stop_s)
    for a, b in zip(first, second, strict=True):
        assert b.start_s - 1000.0 == pytest.approx(a.start_s, abs=0.03)
        assert b.stop_s - 1000.0 == pytest.approx(a.stop_s, abs=0.03)


@pytest.mark.parametrize("cycles", [3.4, 3.7, 4.5, 6.0])
def test_a_short_gait_after_a_long_one_is_kept(cycles):
    series, stop_s = commands(by_time([0.5, 0.8], [30.0, cycles / 0.8]))
    windows = several_gaits(series, 0.0, stop_s)
    assert len(windows) == 2
    assert windows[1].cycles >= 2.75
    assert windows[1].stop_s == pytest.approx(stop_s, abs=0.3)


def test_a_pause_divides_one_gait():
    amplitude = by_time([1.0, 0.0, 1.0], [20.0, 10.0, 20.0])
    series, stop_s = commands(np.full(amplitude.size, 0.6), amplitude=amplitude)
    windows = several_gaits(series, 0.0, stop_s)
    assert [round(window.stop_s) for window in windows] == [20, 50]
    assert windows[1].start_s >= 30.0


@pytest.mark.parametrize("noise", [0.0, 0.01, 0.03, 0.1])
@pytest.mark.parametrize("seed", range(4))
def test_noise_divides_no_gait(noise, seed):
    series, stop_s = commands(np.full(3000, 0.7), noise=noise, seed=seed)
    assert several_gaits(series, 0.0, stop_s) == []


@pytest.mark.parametrize("seed", range(6))
def test_motion_that_is_no_gait_has_no_windows(seed):
    rng = np.random.default_rng(seed)
    t_s = np.arange(0, 60, 0.02)
    sequences = [np.repeat(rng.choice([-1.0, 1.0], 120), 25) for _ in range(4)]
    steps = [np.repeat(rng.uniform(-1, 1, 30), 100) for _ in range(4)]
    tones = 0.1 * np.array([1, 3, 5, 7, 11, 13])
    waves = [
        np.sin(2 * np.pi * np.outer(t_s, tones) + rng.uniform(0, 6.3, tones.size)).sum(axis=1)
        for _ in range(4)
    ]
    walks = [np.cumsum(rng.standard_normal(t_s.size)) for _ in range(4)]
    for motion in (sequences, steps, waves, walks):
        series = [Series(f"j{k}", t_s, row) for k, row in enumerate(motion)]
        assert several_gaits(series, 0.0, float(t_s[-1])) == []


@pytest.mark.parametrize("ends_hz", [(0.1, 4.0), (0.4, 1.2), (2.0, 0.3)])
def test_a_sweep_has_no_windows(ends_hz):
    series, stop_s = commands(np.geomspace(*ends_hz, 4000))
    assert several_gaits(series, 0.0, stop_s) == []


def test_standing_and_too_short_commands_have_none():
    t_s = np.arange(0, 10, 0.02)
    still = [Series("j0", t_s, np.zeros_like(t_s))]
    assert several_gaits(still, 0.0, 10.0) == []
    assert several_gaits([], 0.0, 10.0) == []
    series, _ = commands(np.full(20, 1.0))
    assert several_gaits(series, 0.0, 0.4) == []


@pytest.mark.parametrize("lost_s", [0.5, 3.0, 7.0])
def test_a_loss_of_samples_divides_no_gait(lost_s):
    series, stop_s = commands(np.full(3000, 0.7))
    kept = (series[0].t_s < 25.0) | (series[0].t_s > 25.0 + lost_s)
    lost = [Series(channel.name, channel.t_s[kept], channel.values[kept]) for channel in series]
    assert several_gaits(lost, 0.0, stop_s) == []
