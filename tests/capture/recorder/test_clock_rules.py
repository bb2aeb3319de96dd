"""The rules of a source's clock at their limits, with delays and jumps of known size."""

import numpy as np
import pytest

from undulog.capture.recorder.source_clock import SourceClock

EPOCH_NS = 1_700_000_000_000_000_000
NS, MS = 1_000_000_000, 1_000_000
LEAST_NS = 300_000


def fed(clock, device, delays):
    """Map samples one after the other; host times are device times and delays after the start."""
    device, host = np.asarray(device), EPOCH_NS + np.asarray(device) + delays
    pairs = zip(device, host, strict=True)
    return np.concatenate([clock.add(np.array([t]), np.array([came])) for t, came in pairs])


def steady(count, step_ns=100 * MS, delay_ns=LEAST_NS):
    """A clock that a number of samples of one delay have reached, and the next device time."""
    clock = SourceClock()
    device = 7 * NS + np.arange(count) * step_ns
    mapped = fed(clock, device, delay_ns)
    assert (mapped == EPOCH_NS + device + delay_ns).all()
    return clock, int(device[-1]) + step_ns


def test_a_rate_is_known_after_two_seconds():
    assert steady(20)[0].result().drift_ppm is None
    assert steady(21)[0].result().drift_ppm == 0.0


# -- what is reported of the delays ----------------------------------------------------------------


@pytest.mark.parametrize("count", [700, 9000])
def test_jitter_and_99_per_cent_point_are_those_of_arrival_minus_mapped_time(count):
    rng = np.random.default_rng(count)
    device = np.cumsum(rng.integers(1 * MS, 4 * MS, count))
    host = EPOCH_NS + device + rng.exponential(2 * MS, count).astype(np.int64)
    host = np.maximum.accumulate(host)
    clock = SourceClock()
    pieces = zip(np.array_split(device, 60), np.array_split(host, 60), strict=True)
    mapped = np.concatenate([clock.add(*piece) for piece in pieces])
    delays_ns = (host - mapped).astype(float)
    for _ in range(2):  # asking changes nothing
        estimate = clock.result()
        assert estimate.jitter_s == pytest.approx(delays_ns.std() / NS, rel=1e-6)
        true_s = np.percentile(delays_ns, 99, method="inverted_cdf") / NS
        assert true_s / 2 ** (1 / 16) <= estimate.delay_p99_s * (1 + 1e-9)
        assert estimate.delay_p99_s <= true_s * 2 ** (1 / 16) * (1 + 1e-9)
    assert estimate.offset_ns == pytest.approx(int(mapped[-1] - device[-1]), abs=1)
    assert (estimate.samples, estimate.resets, estimate.out_of_range) == (count, 0, 0)


def test_without_samples_nothing_is_known():
    estimate = SourceClock().result()
    assert (estimate.samples, estimate.own_clock, estimate.offset_ns) == (0, False, None)
    assert (estimate.jitter_s, estimate.delay_p99_s, estimate.drift_ppm) == (0.0, 0.0, None)
    clock = SourceClock()
    assert clock.pair() is None
    assert len(clock.add(np.array([], np.int64), np.array([], np.int64))) == 0
    assert clock.pair() is None


def test_a_new_start_forgets_the_delays_that_were_not_counted_yet():
    clock = SourceClock()
    fed(clock, np.arange(50) * MS + 1, 5 * MS + np.arange(50) % 2 * MS)
    clock.restart()
    estimate = clock.result()
    assert (estimate.jitter_s, estimate.delay_p99_s) == (0.0, 0.0)
    assert (estimate.own_clock, estimate.resets, estimate.samples) == (False, 1, 50)


def test_the_drift_is_of_the_device_relative_to_the_host():
    device = np.arange(0, 30 * NS, 50 * MS)
    clock = SourceClock()
    host = np.rint(device * 1.01).astype(np.int64)
    fed(clock, device, host - device)
    for _ in range(3):  # an RC oscillator, 1 % off: far from the expected rate, but without noise
        assert clock.result().drift_ppm == pytest.approx((1 / 1.01 - 1) * 1e6, abs=0.5)


# -- jumps -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("beyond_ns", [0, 1])
@pytest.mark.parametrize(("samples", "limit_ns"), [(60, 100 * MS), (10, 1000 * MS)])
def test_a_clock_that_is_more_ahead_than_the_limit_was_set(samples, limit_ns, beyond_ns):
    clock, device = steady(samples)
    fed(clock, [device + limit_ns + beyond_ns], LEAST_NS - limit_ns - beyond_ns)
    estimate, events = clock.result(), clock.take_events()
    assert estimate.resets == len(events) == beyond_ns
    if events:
        text = f"the device's clock jumped ahead by {limit_ns / NS:.3f} s and is measured anew"
        assert events == [text]
        sigma = 2e-5 if samples == 60 else 1e-4  # most likely it is the same quartz
        assert clock._envelope.line.uncertainty == sigma


@pytest.mark.parametrize("beyond_ns", [0, 1])
@pytest.mark.parametrize("samples", [60, 10])
def test_a_clock_that_is_more_behind_than_100_ms_was_set(samples, beyond_ns):
    clock, device = steady(samples)
    back_ns = 100 * MS + beyond_ns
    last = device - 100 * MS
    fed(clock, [last - back_ns], LEAST_NS + 100 * MS + back_ns)
    estimate, events = clock.result(), clock.take_events()
    assert estimate.resets == len(events) == beyond_ns
    if events:
        assert events == ["the device's clock went back by 0.200 s and is measured anew"]


@pytest.mark.parametrize("ahead", [False, True])
def test_a_jump_within_a_batch_divides_it(ahead):
    clock, device = steady(60)
    shift = (5 if ahead else -5) * NS
    times = device + np.arange(6) * MS
    times[2:] += shift
    host = EPOCH_NS + device + LEAST_NS + np.arange(6) * MS
    assert (clock.add(times, host) == host).all()
    (event,) = clock.take_events()
    assert event.startswith("the device's clock jumped ahead by 5" if ahead else
                            "the device's clock went back by 5")  # fmt: skip
    assert clock.pair() == (times[-1], host[-1])
    assert clock.result().offset_ns == host[-1] - times[-1]


def test_a_jump_keeps_the_rate_that_is_known():
    clock = SourceClock()
    device = np.arange(0, 40 * NS, 50 * MS)
    fed(clock, device, np.rint(device * 5e-5).astype(np.int64))
    assert clock._envelope.line.rate == pytest.approx(5e-5, rel=1e-3)
    fed(clock, [int(device[-1]) + 9 * NS], 3 * MS - 9 * NS)
    assert clock.result().resets == 1
    assert clock._envelope.line.rate == pytest.approx(5e-5, rel=1e-3)


# -- silences --------------------------------------------------------------------------------------


@pytest.mark.parametrize("beyond_ns", [0, 1])
def test_after_more_than_two_minutes_the_offset_is_measured_anew(beyond_ns):
    clock, device = steady(60)
    silent_ns = 120 * NS + beyond_ns
    fed(clock, [device - 100 * MS + silent_ns], LEAST_NS)
    estimate = clock.result()
    assert (estimate.resets, estimate.drift_ppm is None) == (0, beyond_ns == 1)
    if beyond_ns:
        assert clock._envelope.line.uncertainty == 2e-6


def test_a_silence_before_the_rate_is_known_is_none():
    clock, device = steady(10)
    fed(clock, [device + 300 * NS, device + 301 * NS, device + 302 * NS, device + 303 * NS],
        LEAST_NS)  # fmt: skip
    assert clock.result().drift_ppm is not None  # with the points from before


@pytest.mark.parametrize("beyond_ns", [-MS, MS])
def test_a_clock_that_is_ahead_after_a_silence_was_set_or_drifted(beyond_ns):
    """It may be off by 100 ms, and five times what its rate may have wandered."""
    clock, device = steady(60)
    limit_ns = 100 * MS + round(5 * 2e-6 * 1000 * NS) + beyond_ns
    fed(clock, [device - 100 * MS + 1000 * NS + limit_ns], LEAST_NS - limit_ns)
    estimate, events = clock.result(), clock.take_events()
    assert estimate.resets == len(events) == (beyond_ns > 0)
    assert estimate.drift_ppm is None
    assert clock._envelope.line.uncertainty == (2e-5 if beyond_ns > 0 else 2e-6)


# -- times that are none, and times in between -----------------------------------------------------


def test_an_estimate_that_decreases_lets_times_run_at_half_speed_until_they_meet_it():
    clock, device = steady(3000, step_ns=MS, delay_ns=2_500_000)
    later = device + np.arange(10) * MS
    # The fifth shows that the least delay is 2 ms less, and comes with the two before it.
    arrivals = later + 2_500_000
    arrivals[2:5] = later[2] + 2_500_000
    host = EPOCH_NS + arrivals
    mapped = clock.add(later, host) - EPOCH_NS - later
    assert (np.diff(mapped) <= 0).all()
    assert mapped.tolist() == [2_000_000, 1_500_000, 1_000_000, *[500_000] * 7]


def test_an_impossible_time_is_that_of_the_sample_before_for_100_ms():
    clock, device = steady(60)
    at_ns = EPOCH_NS + device - 100 * MS + LEAST_NS
    odd = np.array([1 << 62])
    near = clock.add(odd, np.array([at_ns + 100 * MS]))
    assert near.tolist() == [at_ns]
    clock, _ = steady(60)
    far = clock.add(odd, np.array([at_ns + 100 * MS + 1]))
    assert far.tolist() == [at_ns + 100 * MS + 1]
    assert clock.result().out_of_range == 1
    clock.add(odd.repeat(3), np.full(3, at_ns + 200 * MS))
    assert clock.result().out_of_range == 4


def test_an_impossible_time_before_the_first_is_that_of_the_sample_behind_it():
    clock = SourceClock()
    host = EPOCH_NS + np.arange(4) * MS
    mapped = clock.add(np.array([1 << 62, 1 << 62, 5 * NS, 5 * NS + MS]), host)
    assert mapped.tolist() == [host[0], host[0], host[0], host[1]]
    assert clock.pair() == (5 * NS + MS, host[3])


def test_samples_with_and_without_device_times_keep_their_order():
    clock = SourceClock()
    host = EPOCH_NS + 10 * NS + np.arange(1, 7) * MS
    device = 3 * NS + np.arange(1, 7) * MS
    mixed = np.where([True, False, False, True, True, False], device, host)
    assert clock.add(mixed, host).tolist() == host.tolist()
    assert clock.pair() == (device[4], host[4])
    assert clock.result().offset_ns == host[0] - device[0]
    assert clock.add(host[-1:] - NS, host[-1:] - NS).tolist() == [host[-1]]  # never back


def test_facts_are_text_to_as_many_digits_as_there_are():
    clock = SourceClock()
    rng = np.random.default_rng(1)
    fed(clock, np.arange(0, 30 * NS, 50 * MS), LEAST_NS + rng.integers(0, MS, 600))
    clock.add(np.array([1 << 62]), np.array([EPOCH_NS + 40 * NS]))
    estimate, facts = clock.result(), clock.result().facts()
    assert set(facts) == {
        "samples", "resets", "jitter_s", "delay_p99_s", "out_of_range", "offset_ns", "drift_ppm",
        "drift_uncertainty_ppm",
    }  # fmt: skip
    assert float(facts["jitter_s"]) == pytest.approx(estimate.jitter_s, rel=5e-3)
    assert float(facts["delay_p99_s"]) == pytest.approx(estimate.delay_p99_s, rel=5e-3)
    assert float(facts["drift_ppm"]) == pytest.approx(estimate.drift_ppm, abs=5e-4)
    assert float(facts["drift_uncertainty_ppm"]) == pytest.approx(
        estimate.drift_uncertainty_ppm, rel=5e-2
    )
    assert (facts["out_of_range"], facts["samples"], facts["resets"]) == ("1", "601", "0")
