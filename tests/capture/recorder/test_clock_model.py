"""A source's clock against a plain model of its rules, sample by sample, on random sources."""

import math

import numpy as np
import pytest

from undulog.capture.recorder.source_clock import Envelope, SourceClock

EPOCH_NS = 1_700_000_000_000_000_000
NS, MS = 1_000_000_000, 1_000_000
END_NS = 2**62  # of device times that are possible


class Model:
    """Maps one sample after the other; the line below the delays is the product's own."""

    def __init__(self):
        self.envelope, self.own_clock, self.resets, self.odd = Envelope(), False, 0, 0
        self.last = self.floor = -(10**19)
        self.device = self.host = self.front = self.came = self.bucket_ends = 0
        self.pair, self.events, self.delays = None, [], []

    def add(self, device, host):
        times = self.possible(device, host)
        mapped, start = [], 0
        while start < len(host):
            without = times[start] == host[start]
            stop = start
            while stop < len(host) and (times[stop] == host[stop]) == without:
                stop += 1
            run = list(zip(times[start:stop], host[start:stop], strict=True))
            mapped += [self.in_order(came) for _, came in run] if without else self.map(run)
            start = stop
        if times == host:
            self.pair = (times[-1], host[-1])
        self.delays += [came - t for came, t in zip(host, mapped, strict=True)]
        return mapped

    def possible(self, device, host):
        """Device times; an impossible one is that of the last possible sample within 100 ms."""
        good = [0 <= t < END_NS for t in device]
        self.odd += good.count(False)
        nearest = (self.device, self.came) if self.own_clock else None
        if nearest is None and True in good:
            nearest = (device[good.index(True)], host[good.index(True)])
        times = []
        for t, came, is_good in zip(device, host, good, strict=True):
            if is_good:
                nearest = (t, came)
            near = nearest is not None and came - nearest[1] <= 100 * MS
            times.append(t if is_good else nearest[0] if near else came)
        self.came = nearest[1] if nearest else self.came
        return times

    def in_order(self, came):
        self.last = max(came, self.last)
        return self.last

    def map(self, run):
        if not self.own_clock:
            self.own_clock = True
            self.restart(*run[0], Envelope())
        elif run[0][1] - self.host > 120 * NS and self.envelope.settled:
            self.after_silence(*run[0])
        mapped = []
        while run:
            if run[0][1] >= self.bucket_ends:
                self.envelope.close_bucket()
                self.bucket_ends = run[0][1] + NS // 2
            late = [k for k, (_, came) in enumerate(run) if came >= self.bucket_ends]
            count = self.take(run[: max(late[0], 1)] if late else run)
            for t, came in run[:count]:
                mapped.append(self.place(t, came))
                self.device, self.host = self.pair = (t, came)
            self.floor = self.last - self.front // 2
            run = run[count:]
        return mapped

    def take(self, run):
        """Give the least delayed sample before a jump to the envelope; return their number."""
        front, back = self.front, None
        for k, (t, _) in enumerate(run):
            front = max(front, t)
            if t - front < -100 * MS:
                back = k
                break
        if back == 0:
            return self.jump(run, "went back")
        run = run if back is None else run[:back]
        heights, line = [], self.envelope.line
        for t, came in run:
            x, y = float(t - self.zero), float(came - t - self.offset)
            heights.append((y - line.offset_ns - line.rate * x, x, y))
        limit = -100 * MS if self.envelope.settled else -1000 * MS
        early = [k for k, (height, _, _) in enumerate(heights) if height < limit]
        if early and not self.envelope.empty:
            if early[0] == 0:
                return self.jump(run, "jumped ahead")
            heights = heights[: early[0]]
        _, x, y = min(heights, key=lambda height: height[0])
        self.envelope.take(x, y)
        return len(heights)

    def jump(self, run, what):
        (t, came), line = run[0], self.envelope.line
        size_s = abs(t - self.device - (came - self.host)) / NS
        self.events.append(f"the device's clock {what} by {size_s:.3f} s and is measured anew")
        self.resets += 1
        prior = (line.rate, 2e-5) if self.envelope.settled else (0.0, 1e-4)
        self.restart(t, came, Envelope(*prior))
        return self.take(run)

    def after_silence(self, t, came):
        line, silent_ns = self.envelope.line, came - self.host
        lag_ns = silent_ns - (t - self.device) * (1 + line.rate)
        if abs(lag_ns) <= 100 * MS + 5 * max(line.uncertainty, 2e-6) * silent_ns:
            self.restart(t, came, Envelope(line.rate, max(3 * line.uncertainty, 2e-6)))

    def restart(self, t, came, envelope):
        self.envelope, self.zero, self.offset = envelope, t, came - t
        self.device, self.front, self.host = t, t, came
        self.bucket_ends, self.floor = came + NS // 2, self.last - t // 2

    def place(self, t, came):
        """By the line; at half speed where that decreases; not after the arrival, never back."""
        line = self.envelope.line
        self.front = max(self.front, t)
        lag = math.floor(line.offset_ns + line.rate * (self.front - self.zero))
        half = self.front // 2
        self.floor = max(self.front + self.offset + lag - half, self.floor)
        self.last = max(min(self.floor + half, came), self.last)
        return self.last - (self.front - t)


def batches(rng, count=30):
    """Samples of a clock with noise, jumps, silences, impossible times, echoes and late arrivals.

    The first ones are close together, so that the rate is known soon.
    """
    rate = 1 + rng.choice([0.0, 3e-5, -1e-4, 0.015])
    odd = [END_NS, END_NS - 1 + 2**60, -1, -(2**63), 2**63 - 1]
    now_ns, zero = EPOCH_NS, int(rng.integers(0, 2**45))
    for _ in range(count):
        pause = rng.choice([0, MS, 60 * MS, 490 * MS, 500 * MS, 2 * NS, 130 * NS, 2000 * NS],
                           p=[0.2, 0.2, 0.2, 0.1, 0.1, 0.16, 0.02, 0.02])  # fmt: skip
        now_ns += int(pause)
        if rng.random() < 0.08:
            zero += int(rng.choice([-3600, -3, -0.2, -0.1, 0.1, 0.2, 1, 1.2, 3600]) * NS)
        size = int(rng.integers(1, 12))
        true = now_ns + np.cumsum(rng.choice([0, 1, MS, 70 * MS, 200 * MS], size))
        device = np.maximum(zero, 0) + np.rint((true - EPOCH_NS) * rate).astype(np.int64)
        late = rng.random(size) < 0.1
        device -= late * rng.integers(0, 101 * MS, size)  # by a longer way, behind fresh ones
        device = np.maximum(device, 0)
        host = true + rng.exponential(rng.choice([1e5, 3e6]), size).astype(np.int64)
        if rng.random() < 0.9:
            host = np.maximum.accumulate(host)
        echoes = rng.random(size) < rng.choice([0, 0, 0.3, 1], p=[0.5, 0.3, 0.1, 0.1])
        device = np.where(echoes, host, device)
        wrong = rng.random(size) < rng.choice([0, 0.2, 1], p=[0.8, 0.15, 0.05])
        device = np.where(wrong, rng.choice(odd, size), device)
        now_ns = int(host.max())
        yield device, host


@pytest.mark.parametrize("seed", range(16))
def test_each_sample_is_mapped_as_by_the_model(seed):
    rng = np.random.default_rng(seed)
    clock, model = SourceClock(), Model()
    for device, host in batches(rng):
        expected = model.add(device.tolist(), host.tolist())
        assert clock.add(device, host).tolist() == expected
        assert clock.pair() == model.pair
        estimate = clock.result()
        line, delays = model.envelope.line, np.array(model.delays) / NS
        counts = (estimate.own_clock, estimate.samples, estimate.resets, estimate.out_of_range)
        assert counts == (model.own_clock, len(delays), model.resets, model.odd)
        settled = model.own_clock and model.envelope.settled
        assert estimate.drift_uncertainty_ppm == (line.uncertainty * 1e6 if settled else None)
        if settled:
            assert estimate.drift_ppm == pytest.approx((1 / (1 + line.rate) - 1) * 1e6, abs=1e-9)
        if model.own_clock:
            x = model.device - model.zero
            assert estimate.offset_ns == model.offset + round(line.offset_ns + line.rate * x)
        assert estimate.jitter_s == pytest.approx(delays.std(), rel=1e-5, abs=1e-6)
    assert clock.take_events() == model.events
