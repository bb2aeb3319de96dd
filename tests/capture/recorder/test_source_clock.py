"""The mapping of device clocks against clocks and delays that were made, so the truth is known."""

import socket
import struct
import subprocess
import sys
import time
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from undulog.capture.common.arrays import IntArray
from undulog.capture.recorder.source_clock import JUMP_NS, ClockEstimate, Envelope, SourceClock
from undulog.capture.sources.contract import DEVICE_TIMES_END_NS

EPOCH_NS = 1_700_000_000_000_000_000
NS = 1_000_000_000
TICK_NS = 5_000_000


@dataclass(frozen=True)
class Made:
    """Samples whose true times are known, all in ns, shape (n,)."""

    true: IntArray
    device: IntArray
    host: IntArray

    @property
    def after_s(self):
        return (self.true - EPOCH_NS) / NS


def make(*, rate_hz=500.0, duration_s=60.0, drift_ppm=0.0, polled=True, seed=0, **delay_s):
    """A quartz that is off by ``drift_ppm``, exponential delays in order, seen every 5 ms.

    ``delay_s``: the least delay, and the mean of what comes on top.
    """
    least_s, mean_s = delay_s.get("least", 0.0003), delay_s.get("mean", 0.002)
    rng = np.random.default_rng(seed)
    count = int(rate_hz * duration_s)
    true = EPOCH_NS + (np.arange(count) / rate_hz * NS).astype(np.int64)
    true += rng.integers(0, int(0.02 * NS / rate_hz), count)
    device = 12_345 + np.rint((true - EPOCH_NS) * (1 + drift_ppm * 1e-6)).astype(np.int64)
    delay = least_s * NS + rng.exponential(mean_s * NS, count)
    host = np.maximum.accumulate(true + delay.astype(np.int64))
    if polled:  # a tick is never quite on time
        tick = -(-host // TICK_NS)
        late = rng.integers(0, 200_000, int(tick[-1] - tick[0]) + 1)
        host = tick * TICK_NS + late[tick - tick[0]]
    return Made(true, device, host)


def batches(made):
    cuts = np.flatnonzero(np.diff(made.host // TICK_NS)) + 1
    return list(zip(np.split(made.device, cuts), np.split(made.host, cuts), strict=True))


def mapped(clock, made):
    return np.concatenate([clock.add(device, host) for device, host in batches(made)])


def late_of(made, after_s=-1):
    """How late a new clock maps each sample [s], in order and before the arrival; the clock.

    Samples before ``after_s`` are left out.
    """
    clock = SourceClock()
    t_ns = mapped(clock, made)
    holds(t_ns, made.host)
    return (t_ns - made.true)[made.after_s > after_s] / NS, clock


def holds(t_ns, host):
    assert (np.diff(t_ns) >= 0).all()
    assert (t_ns <= host).all()


# -- convergence -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("drift_ppm", "rate_hz"),
    [(-100.0, 100.0), (-100.0, 1000.0), (-20.0, 1000.0), (0.0, 100.0), (100.0, 1000.0)],
)
def test_after_half_a_minute_only_the_least_delay_is_left(drift_ppm, rate_hz):
    made = make(drift_ppm=drift_ppm, rate_hz=rate_hz, polled=False)
    late_s, clock = late_of(made, after_s=30)
    assert 0.0003 - 50e-6 < late_s.min() <= late_s.max() < 0.0003 + 50e-6
    estimate = clock.result()
    assert estimate.drift_ppm == pytest.approx(drift_ppm, abs=1.0)
    assert abs(estimate.drift_ppm - drift_ppm) < 4 * estimate.drift_uncertainty_ppm + 0.05
    # Exponential delays: the standard deviation is their mean, 1 % are over ln(100) means. In
    # order, so frames behind a late one are late with it, which at 100 Hz hardly ever happens.
    if rate_hz == 100.0:
        assert estimate.jitter_s == pytest.approx(0.002, rel=0.1)
        assert estimate.delay_p99_s == pytest.approx(0.002 * np.log(100), rel=0.15)
    assert (estimate.own_clock, estimate.samples, estimate.resets) == (True, len(made.true), 0)


@pytest.mark.parametrize("drift_ppm", [-100.0, 0.0, 100.0])
def test_polling_costs_no_more_than_the_newest_frame_waits(drift_ppm):
    made = make(drift_ppm=drift_ppm, rate_hz=1000.0)
    late_s, clock = late_of(made, after_s=30)
    assert late_s.max() < 0.0003 + 0.001  # frames come every ms, one is just before the tick
    assert late_s.min() > 0.0
    assert late_s.max() - late_s.min() < 100e-6  # what is left is the same for all
    assert clock.result().drift_ppm == pytest.approx(drift_ppm, abs=1.0)


def test_the_intervals_are_the_device_s_and_no_stamp_is_repeated():
    made = make(drift_ppm=30.0, rate_hz=1000.0)
    steps = np.diff(mapped(SourceClock(), made))
    settled = made.after_s[1:] > 10
    assert (steps > 0).all()
    assert np.abs(steps - np.diff(made.true))[settled].max() < 50_000
    assert np.diff(made.host).std() > 20 * (steps - np.diff(made.true))[settled].std()


@pytest.mark.nightly
def test_an_hour_of_a_quartz_in_the_sun_is_followed():
    """The rate wanders by 20 ppm within the hour; memory holds one minute of it."""
    rng = np.random.default_rng(5)
    true = EPOCH_NS + np.arange(36_000) * 100_000_000
    t_s = (true - EPOCH_NS) / NS
    wandered_s = 20e-6 * 3600 / (2 * np.pi) * np.sin(2 * np.pi * t_s / 3600)
    device = np.rint(t_s * NS + wandered_s * NS).astype(np.int64)
    host = true + 500_000 + rng.exponential(1e6, len(true)).astype(np.int64)
    late_s, clock = late_of(Made(true, device, np.maximum.accumulate(host)), after_s=30)
    assert 0.0002 < late_s.min() <= late_s.max() < 0.0009
    assert clock.result().resets == 0


# -- clocks that are none, and clocks that are set ---------------------------------------------


def test_a_source_without_a_clock_keeps_the_host_s_times():
    made = make(duration_s=2.0)
    clock = SourceClock()
    t_ns = np.concatenate([clock.add(host, host) for _, host in batches(made)])
    assert np.array_equal(t_ns, made.host)
    assert clock.result() == ClockEstimate(False, None, None, None, 0.0, 0.0, len(t_ns), 0)
    assert clock.pair() == (made.host[-1], made.host[-1])


def test_samples_without_a_device_time_among_others_are_stamped_by_their_arrival():
    made = make(duration_s=20.0, drift_ppm=40.0)
    echoed = np.arange(len(made.true)) % 7 == 3
    device = np.where(echoed, made.host, made.device)
    clock = SourceClock()
    t_ns = mapped(clock, Made(made.true, device, made.host))
    holds(t_ns, made.host)
    assert np.array_equal(t_ns[echoed], made.host[echoed])
    assert clock.result().drift_ppm == pytest.approx(40.0, abs=5.0)


def test_a_new_estimate_after_a_failure_is_one_reset():
    made = make()
    clock = SourceClock()
    mapped(clock, made)
    clock.restart()
    estimate = clock.result()
    assert (estimate.resets, estimate.own_clock, estimate.drift_ppm) == (1, False, None)


@pytest.mark.parametrize("first", ["restarts at zero", "is set an hour ahead", "is set back"])
def test_a_clock_that_is_set_is_measured_anew(first):
    made = make(duration_s=80.0, drift_ppm=80.0)
    change = {"restarts at zero": 0, "is set an hour ahead": 3600 * NS, "is set back": -2 * NS}
    device = made.device.copy()
    after = made.after_s >= 40
    shift = change[first] or -int(device[after][0])
    device[after] += shift
    late_s, clock = late_of(Made(made.true, device, made.host))
    settled = (made.after_s > 30) & ((made.after_s < 40) | (made.after_s > 70))
    assert late_s[settled].max() < 0.0025
    assert late_s.max() < 0.02  # also just after the change: the arrival bounds it
    estimate = clock.result()
    assert estimate.resets == 1
    assert estimate.drift_ppm == pytest.approx(80.0, abs=1.0)
    (event,) = clock.take_events()
    assert ("jumped ahead by" if shift > 0 else "went back by") in event
    assert float(event.split("by ")[1].split(" s")[0]) == pytest.approx(abs(shift) / NS, abs=0.1)
    assert clock.take_events() == []


@pytest.mark.parametrize(
    ("odd_ns", "first"),
    [
        (1 << 62, 0),
        (1 << 62, 137),
        (1 << 63, 137),
        ((1 << 63) + 18 * 10**17 - 1, 0),
        (2**64 - 1, 137),
    ],
)
def test_impossible_times_are_near_their_neighbours_and_change_nothing(odd_ns, first):
    made = make(duration_s=40.0, drift_ppm=50.0)
    odd = np.arange(len(made.true)) % 200 == first
    device = np.where(odd, np.uint64(odd_ns), made.device.astype(np.uint64))
    late_s, clock = late_of(Made(made.true, device, made.host))
    estimate = clock.result()
    assert (estimate.resets, estimate.out_of_range) == (0, odd.sum())
    assert estimate.drift_ppm == pytest.approx(50.0, abs=2.0)
    late_s = late_s[made.after_s > 20]
    assert late_s[~odd[made.after_s > 20]].max() < 0.0025
    assert np.abs(late_s).max() < 0.0045  # an impossible time: that of the sample before, 2 ms


def test_a_device_with_impossible_times_only_is_mapped_by_the_arrivals():
    made = make(duration_s=2.0)
    clock = SourceClock()
    first = made.after_s < 1.0
    t_ns = mapped(clock, Made(made.true, np.where(first, made.device, 1 << 62), made.host))
    holds(t_ns, made.host)
    late = made.host > made.host[first][-1] + JUMP_NS
    assert np.array_equal(t_ns[late], made.host[late])
    assert clock.result().out_of_range == (~first).sum()


def test_a_backlog_at_the_start_is_no_reset_and_does_not_stay():
    made = make(duration_s=20.0)
    host = np.maximum(made.host, EPOCH_NS + 500_000_000)
    late_s, clock = late_of(Made(made.true, made.device, host))
    assert clock.result().resets == 0
    assert late_s[made.after_s > 3].max() < 0.003


def test_a_stalled_host_does_not_move_the_line():
    made = make(duration_s=60.0, drift_ppm=10.0)
    stalled = (made.after_s > 30) & (made.after_s < 33)
    host = np.where(stalled, np.maximum(made.host, EPOCH_NS + 33 * NS), made.host)
    late_s, clock = late_of(Made(made.true, made.device, np.maximum.accumulate(host)))
    assert late_s[made.after_s > 29].max() < 0.0025
    assert clock.result().resets == 0


@pytest.mark.slow
@pytest.mark.parametrize("step_ms", [pytest.param(-20, marks=pytest.mark.nightly), 20])
def test_a_small_step_of_the_least_delay_is_followed_within_seconds(step_ms):
    made = make(duration_s=90.0, polled=False)
    host = made.host + np.where(made.after_s > 45, step_ms * 1_000_000, 0) + 30_000_000
    late_s, clock = late_of(Made(made.true, made.device, np.maximum.accumulate(host)))
    assert np.median(late_s[made.after_s < 45]) == pytest.approx(0.0303, abs=2e-4)
    assert late_s[made.after_s > 55] == pytest.approx(0.0303 + step_ms / 1000, abs=3e-4)
    assert clock.result().resets == 0


@pytest.mark.slow
@pytest.mark.parametrize(
    "silence_s", [40_000, *(pytest.param(s, marks=pytest.mark.nightly) for s in (30, 900))]
)
def test_a_long_silence_is_no_reset_and_the_offset_is_found_at_once(silence_s):
    """The rate moves by 1 ppm meanwhile, as a quartz's does from one room to the next."""
    made = make(duration_s=80.0, polled=False)
    late = made.after_s >= 40
    silence_ns = silence_s * NS
    true = made.true + late * silence_ns
    x = true - EPOCH_NS
    end = 40 * NS + silence_ns
    device = np.rint(x * (1 + 60e-6) + np.maximum(x - 40 * NS, 0) * 1e-6).astype(np.int64)
    late_s, clock = late_of(Made(true, device, made.host + late * silence_ns))
    assert np.abs(late_s[x > end + 2 * NS] - 0.0003).max() < 2e-4
    assert clock.result().resets == 0
    assert clock.take_events() == []


def test_a_clock_that_stood_during_a_silence_is_followed():
    made = make(duration_s=60.0)
    late = made.after_s >= 30
    host = made.host + late * 600 * NS
    device = made.device + late * 500 * NS
    clock = SourceClock()
    holds(mapped(clock, Made(made.true, device, host)), host)
    # Too little time has gone by on the device, which a late arrival could explain as well: what
    # is told is that the delay grew, and the line follows.
    assert clock.result().offset_ns == pytest.approx(int(host[-1] - device[-1]), abs=10_000_000)


def test_a_device_that_counts_milliseconds_is_mapped_to_a_millisecond():
    made = make(duration_s=60.0, drift_ppm=70.0, polled=False)
    late_s, clock = late_of(
        Made(made.true, (made.device // 1_000_000 * 1_000_000), made.host), after_s=30
    )
    assert 0.0003 - 0.00105 < late_s.min() <= late_s.max() < 0.0003 + 0.00105
    assert clock.result().drift_ppm == pytest.approx(70.0, abs=3.0)


# -- properties --------------------------------------------------------------------------------

stamps = st.one_of(st.integers(-(2**60), 2**60), st.integers(-(2**63), 2**63 - 1))
pairs = st.lists(st.tuples(stamps, st.integers(0, 10**10)), min_size=1, max_size=60)


@given(pairs, st.lists(st.integers(0, 60), max_size=5))
@settings(max_examples=300, deadline=None)
def test_whatever_a_device_reports_times_stay_in_its_order_and_before_their_arrival(made, cuts):
    device = np.array([t for t, _ in made])
    host = EPOCH_NS + np.cumsum([step for _, step in made])
    clock = SourceClock()
    parts = zip(np.split(device, sorted(cuts)), np.split(host, sorted(cuts)), strict=True)
    t_ns = np.concatenate([clock.add(device_ns, host_ns) for device_ns, host_ns in parts])
    usable = (device >= 0) & (device < DEVICE_TIMES_END_NS)
    steps = np.diff(device[usable])
    assert (np.diff(t_ns[usable]) >= np.where((steps < 0) & (steps >= -JUMP_NS), steps, 0)).all()
    assert (t_ns <= host).all()
    assert clock.result().samples == len(made)


@pytest.mark.parametrize("drift_ppm", [-100.0, 0.0, 100.0])
def test_samples_of_longer_ways_keep_their_times_among_the_others(drift_ppm):
    """Every other sample comes 20 ms after it was taken, behind fresh ones."""
    made = make(drift_ppm=drift_ppm, rate_hz=1000.0, polled=False)
    late = np.arange(len(made.true)) % 2 == 1
    host = np.where(late, made.host + 20_000_000, made.host)
    order = np.argsort(host, kind="stable")
    shuffled = Made(made.true[order], made.device[order], host[order])
    clock = SourceClock()
    t_ns = mapped(clock, shuffled)
    assert (t_ns <= shuffled.host).all()
    late_s = (t_ns - shuffled.true)[shuffled.after_s > 30] / NS
    assert 0.0003 - 50e-6 < late_s.min() <= late_s.max() < 0.0003 + 50e-6
    assert clock.result().resets == 0


@pytest.mark.slow
@given(
    *(st.floats(-150, 150), st.floats(1e-4, 5e-3), st.floats(0, 2e-3)),
    *(st.integers(0, 2**62 - 10**12), st.integers(0, 99)),
)
@settings(max_examples=8, deadline=None)
def test_any_quartz_and_any_load_converge(drift_ppm, mean_s, least_s, device_zero, seed):
    delays = {"mean": mean_s, "least": least_s, "polled": False, "seed": seed}
    made = make(rate_hz=200.0, duration_s=40.0, drift_ppm=drift_ppm, **delays)
    late_s, _ = late_of(Made(made.true, made.device + device_zero, made.host))
    assert np.abs(late_s[made.after_s > 30] - least_s).max() < 0.1 * mean_s + 5e-6


@given(st.lists(st.tuples(st.integers(0, 10**9), st.integers(0, 10**8)), min_size=4, max_size=40))
@example([(70_000_000, 0), (0, 2), (0, 3), (1, 6)])
@settings(deadline=None)
def test_the_line_lies_under_all_points_and_nearest(points):
    """Against linear programming on the same points (Moon, Skelly, Towsley 1999)."""
    from scipy.optimize import linprog

    x = np.cumsum([step + 1 for step, _ in points]) + 0.0
    y = 1e-4 * np.array([height for _, height in points])
    envelope = Envelope(sigma=1e9)  # nothing is expected of the rate
    for instant, delay in zip(x, y, strict=True):
        envelope.take(float(instant), float(delay))
        envelope.close_bucket()
    line = envelope.line
    heights = y - line.offset_ns - line.rate * x
    assert heights.min() > -1e-6
    span = x[-1] - x[0]
    scaled = (x - x.mean()) / span  # the points may lie far from zero and close together
    below = {"A_ub": np.column_stack([np.ones(len(x)), scaled]), "b_ub": y}
    best = linprog([-len(x), -float(scaled.sum())], **below, bounds=[(None, None)] * 2)
    assert best.status == 0
    if abs(best.x[1] / span) < 0.02:  # rates further off are no clock's
        assert heights.sum() == pytest.approx(y.sum() + best.fun, abs=1e-3 * (1 + y.max()))


def test_metadata_is_text_and_leaves_out_what_is_unknown():
    clock = SourceClock()
    clock.add(np.array([100, 200]), np.array([EPOCH_NS, EPOCH_NS + 100]))
    facts = clock.result().facts()
    assert facts["offset_ns"] == str(EPOCH_NS - 100)
    assert facts["samples"] == "2"
    assert "drift_ppm" not in facts
    assert clock.pair() == (200, EPOCH_NS + 100)


# -- two real clocks ---------------------------------------------------------------------------

SENDER = """
import socket, struct, sys, time
out = socket.socket(fileno=int(sys.argv[1]))
for k in range(3000):
    time.sleep(0.001)
    true_ns, raw_ns = time.monotonic_ns(), time.clock_gettime_ns(time.CLOCK_MONOTONIC_RAW)
    out.send(struct.pack("<QQ", true_ns, raw_ns + raw_ns // 12500))
"""


@pytest.mark.slow
@pytest.mark.clock(0.02, "the kernel steers one of the two clocks")
def test_another_process_with_another_clock_over_a_real_socket():
    """The kernel's raw clock, 80 ppm faster, against its steered one; the sender has both."""
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    clock = SourceClock()
    true = []
    host = []
    mapped_ns = []
    command = [sys.executable, "-c", SENDER, str(theirs.fileno())]
    # Our end is closed first, whatever happens: a sender that waits for room ends then.
    with subprocess.Popen(command, pass_fds=(theirs.fileno(),)) as sender, ours:
        theirs.close()
        ended = False
        while not ended:
            time.sleep(0.005)
            ours.settimeout(60)
            batch = [ours.recv(16)]
            ours.setblocking(False)
            with suppress(BlockingIOError):
                while batch[-1]:
                    batch.append(ours.recv(16))
            ended = not batch[-1]
            pairs = [struct.unpack("<QQ", data) for data in batch if data]
            now = np.full(len(pairs), time.monotonic_ns())
            true += [pair[0] for pair in pairs]
            host += now.tolist()
            mapped_ns += clock.add(np.array([pair[1] for pair in pairs]), now).tolist()
    assert sender.returncode == 0
    assert len(true) == 3000
    t_ns, host_ns = np.array(mapped_ns), np.array(host)
    holds(t_ns, host_ns)
    late_s = (t_ns - np.array(true))[1000:] / NS
    waited_s = (host_ns - np.array(true))[1000:] / NS
    assert late_s.min() > -0.001
    assert np.median(late_s) < np.median(waited_s)
    assert late_s.std() < waited_s.std()
    assert clock.result().resets == 0
