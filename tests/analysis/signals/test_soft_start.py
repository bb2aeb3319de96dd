"""A soft start or stop of the commands is left out by its amplitude, and nothing else is."""

import numpy as np
import pytest

from support.analysed import analysed
from undulog.analysis.estimators.series import Series
from undulog.analysis.signals.stretch import Options
from undulog.analysis.signals.windows import steady_part

OMEGA = 2 * np.pi * 0.83
SECONDS = 20.0


def joints(envelope, *, omega=OMEGA, noise=0.0, phase=None, count=9, rate=50):
    rng = np.random.default_rng(0)
    t = np.arange(round(SECONDS * rate)) / rate
    turn = omega * t if phase is None else phase(t)
    waves = [0.5 * envelope(t) * np.sin(turn - k) + 0.1 * (k % 3) for k in range(count)]
    return [Series(f"j{k}", t, q + noise * rng.normal(size=t.size)) for k, q in enumerate(waves)]


def part(series):
    return steady_part(series, float(series[0].t_s[0]), float(series[0].t_s[-1]))


@pytest.mark.parametrize("seconds", [1.0, 3.0, 5.0, 8.0, 12.0, 16.0])
def test_a_linear_start_ends_within_half_a_cycle_of_where_it_does(seconds):
    start, stop = part(joints(lambda t: np.clip(t / seconds, 0, 1)))
    assert seconds - 0.15 <= start <= seconds + 0.6
    assert stop == pytest.approx(19.98)


@pytest.mark.parametrize(
    ("envelope", "expected"),
    [
        (lambda t: 0.5 - 0.5 * np.cos(np.pi * np.clip(t / 4, 0, 1)), (3.7, 19.98)),
        (lambda t: np.clip(0.5 + t / 8, 0, 1), (4.0, 19.98)),
        (lambda t: 1 - np.exp(-t), (5.3, 19.98)),  # 0.5 % are lacking after 5.3 time constants
        (lambda t: np.clip((20 - t) / 3, 0, 1), (0.0, 17.0)),
        (lambda t: np.clip(t / 4, 0, 1) * np.clip((20 - t) / 3, 0, 1), (4.0, 17.0)),
    ],
)
def test_other_soft_starts_and_stops(envelope, expected):
    assert part(joints(envelope)) == pytest.approx(expected, abs=0.5)
    assert part(joints(envelope, noise=0.005)) == pytest.approx(expected, abs=1.0)


@pytest.mark.parametrize(
    "envelope",
    [
        np.ones_like,
        lambda t: 1 + 0.2 * np.sin(0.9 * t - 1.5),
        lambda t: 1 + 0.05 * np.sin(0.9 * t - 1.5),
        lambda t: 0.5 + 0.5 * np.sin(0.9 * t - 1.5),
        lambda t: 1.0 * (t % 6 < 4),
        lambda t: np.clip(t % 7 / 1.5, 0, 1) * (t % 7 < 5),
        lambda t: np.where(t < 10, 0.5, 1.0),
        lambda t: np.where(t < 10, 1.0, 0.5),
        lambda t: np.where(t < 5, 0.5, 1.0),
        lambda t: 1 + np.exp(-t / 2),
        lambda t: 1 + np.exp(-t) * np.sin(3 * t),
        lambda t: np.clip(t / 20, 0, 1),
    ],
    ids=[
        "steady",
        "modulated by 20 %",
        "modulated by 5 %",
        "modulated to zero",
        "bursts",
        "soft bursts",
        "larger half-way",
        "smaller half-way",
        "larger after a quarter",
        "decays to its amplitude",
        "overshoots",
        "grows all along",
    ],
)
def test_what_is_no_soft_start_is_kept(envelope):
    for noise in (0.0, 0.01):
        assert part(joints(envelope, noise=noise)) == (0.0, 19.98)


def test_another_frequency_half_way_is_no_soft_stop():
    def phase(t):
        return 2 * np.pi * np.where(t < 10, 0.8 * t, 8 + 1.1 * (t - 10))

    start, stop = part(joints(lambda t: np.clip(t / 3, 0, 1), phase=phase))
    assert (start, stop) == (0.0, 19.98)


def test_groups_that_start_apart():
    ramp = joints(lambda t: np.clip(t / 2, 0, 1), count=5)
    late = joints(lambda t: np.clip((t - 1) / 3, 0, 1), omega=0.6 * OMEGA, count=4)
    late = [Series(f"v{k}", channel.t_s, channel.values) for k, channel in enumerate(late)]
    start, stop = part([*ramp, *late])
    assert 3.9 <= start <= 4.8
    assert stop == pytest.approx(19.98)


@pytest.mark.nightly
def test_a_soft_start_in_a_bag_leaves_the_interval_of_a_steady_one(bag, wave):
    """5 s of growth; the response follows at once, so the truth is that of the steady gait."""
    widths = []
    for ramp_s in (0.0, 5.0):
        truth = wave(np.random.default_rng(3), joints=6, duration=15.0)
        noise = np.random.default_rng(4).normal(0, 0.004, (truth.ticks_ns.size, 6))
        log = bag(f"{ramp_s}.mcap")
        for tick, t_ns in enumerate(truth.ticks_ns):
            grown = 1.0 if ramp_s == 0 else min(tick / 100 / ramp_s, 1.0)
            command = 0.05 + grown * (truth.command(t_ns) - 0.05)
            response = 0.04 + grown * (truth.response(t_ns) - 0.04)
            log.write("/joint_commands", t_ns, truth.names, command)
            log.write("/joint_states", t_ns, truth.names, response + noise[tick])
        log.close()
        result = analysed(log.path)
        (text,) = [w for w in result.warnings if "soft start" in w] or [""]
        assert bool(text) == (ramp_s > 0)
        assert result.gait.fitted.start_s == pytest.approx(ramp_s, abs=0.6)
        lag = [joint.lag_rad for joint in result.joints]
        error = [abs(e.value - true) for e, true in zip(lag, truth.lag, strict=True)]
        assert max(error) < np.radians(0.2)
        widths.append(np.median([e.ci95[1] - e.ci95[0] for e in lag]))
    assert widths[1] < 2 * widths[0]  # of two thirds of the samples: 1.2 times
    # A start of the user's own is taken as it is.
    assert analysed(log.path, Options(start_s=1.0)).gait.fitted.start_s == pytest.approx(1.0)
