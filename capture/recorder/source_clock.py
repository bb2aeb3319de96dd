"""Mapping of a device's clock to the session's, which gives the sampling times.

The delays of frames are positive, come in bursts and are extended by polling. So a line through the
middle of the points (device time, host minus device time) is late by the mean delay and changes
with the load. The nearest line below all points does neither; for exponential delays it is the most
likely one. It is the edge of the lower convex hull at the mean device time.

Sources: Zhang, Liu, Xia, "Clock synchronization algorithms for network measurements", INFOCOM
2002; Moon, Skelly, Towsley, "Estimation and removal of clock skew from network delay
measurements", INFOCOM 1999; Harrison, Newman, "TICSync: knowing when things happened", ICRA 2011.

Method: the line below all delays (:class:`Envelope`). Arrival times don't
determine the least delay itself: mapped times are late by it, the same for all samples of a source.
"""

from __future__ import annotations

import itertools
from collections import deque
from dataclasses import dataclass

import numpy as np

from ..common.arrays import NS, BoolArray, IntArray
from ..sources.contract import DEVICE_TIMES_END_NS

BUCKETS = 120
"""Number of points: each is the least delayed sample of half a second, so a minute. Over a minute a
quartz keeps its rate to far better than 1 ppm, over an hour in the sun it does not."""

BUCKET_NS = 500_000_000

MIN_BUCKETS = 4
"""Least number of points for a rate."""

PRIOR = 1e-4
"""Standard deviation of the rate before the first points: 100 ppm, a plain quartz. The rate is
drawn towards 0 as far as the points are less certain than this."""

SAME_DEVICE = 2e-5
"""The same after the clock was set or restarted: most likely it is the same quartz."""

MAX_RATE = 0.02
"""Largest rate; a cheap RC oscillator is within 2 %."""

STEP_NS = 3_000_000.0
"""A line that has to move by more than this [ns], and by more than :data:`STEP_SPREADS`, is
outdated: the points before are dropped."""

STEP_SPREADS = 10.0
"""Mean distances of the points from the line."""

STEP_BUCKETS = 10
"""Number of consecutive points above the line for a step: a loaded host is late for a while."""

JUMP_NS = 100_000_000
"""A device clock whose time decreases by more than this, or is this much too early, was set or
restarted [ns]: no bus reorders its frames so far."""

_START_JUMP_NS = 1_000_000_000.0
"""The same before the rate is known, while a backlog may be processed."""

SILENCE_NS = 120_000_000_000
"""After a longer silence the offset is measured anew and only the rate is kept [ns]: a quartz
drifts by more meanwhile than the line's uncertainty."""

_WANDER = 2e-6  # of a rate over a silence

_BINS_PER_OCTAVE = 8
_BINS = 64 * _BINS_PER_OCTAVE
_DELAYS = 4096


@dataclass(frozen=True)
class ClockLine:
    """Difference between host and device time: ``offset_ns + rate * (device - origin)``.

    Attributes:
        offset_ns: At the origin [ns].
        rate: Host seconds a device second, minus one.
        uncertainty: Of the rate, one standard deviation.
        spread_ns: Mean distance of the points from the line [ns].
    """

    offset_ns: float
    rate: float
    uncertainty: float
    spread_ns: float


class Envelope:
    """The least delayed points of the last minute and the line below them.

    Coordinates are relative to an origin of the caller's; x is the device time, y is host minus
    device time, both in ns.
    """

    def __init__(self, rate: float = 0.0, sigma: float = PRIOR) -> None:
        """Start without points.

        Args:
            rate: Expected rate.
            sigma: Its standard deviation.
        """
        self.line = ClockLine(0.0, rate, sigma, 0.0)
        self._prior = (rate, sigma)
        self._points: deque[tuple[float, float]] = deque(maxlen=BUCKETS)
        self._least: tuple[float, float] | None = None  # of the bucket that is open

    @property
    def empty(self) -> bool:
        """Whether it has no point yet."""
        return self._least is None and not self._points

    @property
    def settled(self) -> bool:
        """Whether a rate is known."""
        return len(self._points) >= MIN_BUCKETS

    def take(self, x: float, y: float) -> None:
        """Add the point that is lowest above the line among the latest samples."""
        line = self.line
        height = y - line.offset_ns - line.rate * x
        if self.empty:
            self.line = ClockLine(line.offset_ns + height, *_rest(line))
        elif height < 0.0:
            step = max(STEP_NS, STEP_SPREADS * line.spread_ns)
            if -height > step and len(self._points) >= STEP_BUCKETS:
                self._drop_before(0)
            self.line = ClockLine(line.offset_ns + height, *_rest(self.line))
        least = self._least
        if least is None or y - line.rate * x < least[1] - line.rate * least[0]:
            self._least = (x, y)

    def close_bucket(self) -> None:
        """Make the least delayed sample of half a second a point of the envelope."""
        if self._least is None:
            return
        self._points.append(self._least)
        self._least = None
        self._fit()
        recent = list(self._points)[-STEP_BUCKETS:]
        before = len(self._points) - len(recent)
        if before < STEP_BUCKETS:
            return
        line = self.line
        heights = [y - line.offset_ns - line.rate * x for x, y in self._points]
        spread = sum(heights[:before]) / before
        if min(heights[before:]) > max(STEP_NS, STEP_SPREADS * spread):
            self._drop_before(STEP_BUCKETS)
            self._fit()

    def _drop_before(self, kept: int) -> None:
        """Drop all but the last points; the rate becomes the expected one."""
        line = self.line
        sigma = max(3.0 * line.uncertainty, 1e-6)
        self._prior = (line.rate, min(sigma, PRIOR))
        while len(self._points) > kept:
            self._points.popleft()
        self._least = self._least if kept else None
        self.line = ClockLine(line.offset_ns, line.rate, self._prior[1], line.spread_ns)

    def _fit(self) -> None:
        points = sorted(self._points)
        count, span = len(points), points[-1][0] - points[0][0]
        rate, sigma = self._prior
        if count >= MIN_BUCKETS and span > 0.0:
            steepness = min(max(_edge_rate(points), -MAX_RATE), MAX_RATE)
            offset = min(y - steepness * x for x, y in points)
            spread = sum(y - offset - steepness * x for x, y in points) / (count - 2)
            unsure = spread * (12.0 / count) ** 0.5 / span
            weight = sigma**2 / (sigma**2 + unsure**2)
            rate += (steepness - rate) * weight
            sigma *= (1.0 - weight) ** 0.5
        offset = min(y - rate * x for x, y in points)
        spread = sum(y - offset - rate * x for x, y in points) / count
        self.line = ClockLine(offset, rate, sigma, spread)


def _rest(line: ClockLine) -> tuple[float, float, float]:
    return line.rate, line.uncertainty, line.spread_ns


def _edge_rate(points: list[tuple[float, float]]) -> float:
    """Return the slope of the lower hull's edge at the mean x, the nearest line below."""
    hull: list[tuple[float, float]] = []
    for x, y in points:
        if hull and hull[-1][0] == x:
            continue  # sorted: the present one is lower
        while len(hull) >= 2 and _turns_down(hull[-2], hull[-1], (x, y)):
            hull.pop()
        hull.append((x, y))
    mean = sum(x for x, _ in points) / len(points)
    for (x0, y0), (x1, y1) in itertools.pairwise(hull):
        if x1 >= mean:
            return (y1 - y0) / (x1 - x0)
    return 0.0  # one point only


def _turns_down(a: tuple[float, float], b: tuple[float, float], c: tuple[float, float]) -> bool:
    return (b[1] - a[1]) * (c[0] - a[0]) >= (c[1] - a[1]) * (b[0] - a[0])


@dataclass(frozen=True)
class ClockEstimate:
    """Estimate of a source's clock.

    Attributes:
        own_clock: Whether the source has a clock of its own; without one the times are the host's.
        offset_ns: Host minus device time at the last sample [ns]; None without an own clock.
        drift_ppm: Rate of the device's clock relative to the host's, minus one [ppm], over the last
            minute; None if it isn't known yet.
        drift_uncertainty_ppm: Its standard deviation [ppm].
        jitter_s: Standard deviation of arrival minus mapped time [s].
        delay_p99_s: 99 % point of arrival minus mapped time [s], within 9 %.
        resets: Number of times that the device's clock was set or restarted.
        out_of_range: Samples whose device time is impossible.
    """

    own_clock: bool
    offset_ns: int | None
    drift_ppm: float | None
    drift_uncertainty_ppm: float | None
    jitter_s: float
    delay_p99_s: float
    samples: int
    resets: int
    out_of_range: int = 0

    def facts(self) -> dict[str, str]:
        """Return the known values as text, as in the metadata record ``undulog.clock``."""
        facts: dict[str, str] = {
            "samples": str(self.samples),
            "resets": str(self.resets),
            "jitter_s": f"{self.jitter_s:.3g}",
            "delay_p99_s": f"{self.delay_p99_s:.3g}",
        }
        if self.out_of_range:
            facts["out_of_range"] = str(self.out_of_range)
        if self.offset_ns is not None:
            facts["offset_ns"] = str(self.offset_ns)
        if self.drift_ppm is not None and self.drift_uncertainty_ppm is not None:
            facts["drift_ppm"] = f"{self.drift_ppm:.3f}"
            facts["drift_uncertainty_ppm"] = f"{self.drift_uncertainty_ppm:.2g}"
        return facts


class SourceClock:
    """Maps one source's device times to the session's clock, as the samples arrive.

    Mapped times never lie after the arrival, and decrease only where the device's own do, by as
    much: a sample with a longer delay than its neighbours keeps its time. Where the estimate
    decreases, times run at half speed until they meet it, so that samples stay apart.
    """

    def __init__(self) -> None:
        """Start without samples."""
        self._envelope = Envelope()
        self._has_clock = False
        self._device = self._host = 0  # of the last sample
        self._possible_ns = 0  # arrival of the last sample whose device time is possible
        self._front = 0  # the latest device time so far
        self._pair: tuple[int, int] | None = None
        self._last = -(2**62)  # the last mapped time
        self._floor = -(2**62)  # what the next may not fall below, at half speed
        self._origin = (0, 0)  # device time, host minus device time
        self._bucket_ends = self._samples = self._resets = self._out_of_range = 0
        self._events: list[str] = []
        self._delays: list[IntArray] = []
        self._waiting = 0
        self._moments = (0.0, 0.0)
        self._bins = np.zeros(_BINS, np.int64)

    def add(self, t_device_ns: IntArray, t_host_ns: IntArray) -> IntArray:
        """Map samples to the session's clock.

        Args:
            t_device_ns: Times on the device's own clock, in the order of arrival, shape (n,); equal
                to ``t_host_ns`` where a sample has none. Times that are not in
                [0, :data:`~.capture.sources.contract.DEVICE_TIMES_END_NS`) are impossible: such
                samples get the time of the one before, or of their arrival if none came within
                100 ms, and don't change the estimate.
            t_host_ns: Arrival on the session's clock [Unix ns], not decreasing, shape (n,).

        Returns:
            Sampling times on the session's clock [Unix ns], shape (n,).
        """
        device = np.asarray(t_device_ns).astype(np.int64)
        host = np.asarray(t_host_ns).astype(np.int64)
        if not len(host):
            return host
        self._samples += len(host)
        odd = device.view(np.uint64) >= DEVICE_TIMES_END_NS
        if odd.any():
            self._replace(device, host, odd)
        else:
            self._possible_ns = int(host[-1])
        without = device == host
        if without.all():
            self._pair = int(device[-1]), int(host[-1])
            mapped = self._in_order(host)
        elif without.any():
            mapped = self._mixed(device, host, without)
        else:
            mapped = self._map(device, host)
        self._delays.append(host - mapped)
        self._waiting += len(host)
        if self._waiting >= _DELAYS:
            self._count_delays()
        return mapped

    def pair(self) -> tuple[int, int] | None:
        """Return device and host time of the latest sample [ns]; None before the first."""
        return self._pair

    def take_events(self) -> list[str]:
        """Return the events of the clock since the last call, one sentence each."""
        events, self._events = self._events, []
        return events

    def restart(self) -> None:
        """Begin a new estimate with the next sample, after a failure."""
        self._has_clock, self._delays, self._waiting = False, [], 0
        self._resets += 1

    def result(self) -> ClockEstimate:
        """Return the present estimate."""
        self._count_delays()
        line, settled = self._envelope.line, self._has_clock and self._envelope.settled
        offset = drift = unsure = None
        if self._has_clock:
            x = self._device - self._origin[0]
            offset = self._origin[1] + round(line.offset_ns + line.rate * x)
        if settled:
            drift, unsure = (1.0 / (1.0 + line.rate) - 1.0) * 1e6, line.uncertainty * 1e6
        count = max(self._samples, 1)
        mean = self._moments[0] / count
        reached = np.cumsum(self._bins)
        most = int(reached[-1])
        place = int(np.searchsorted(reached, 0.99 * most)) if most else 0
        return ClockEstimate(
            own_clock=self._has_clock,
            offset_ns=offset,
            drift_ppm=drift,
            drift_uncertainty_ppm=unsure,
            jitter_s=max(self._moments[1] / count - mean**2, 0.0) ** 0.5 / NS,
            delay_p99_s=2.0 ** (place / _BINS_PER_OCTAVE) / NS if place else 0.0,
            samples=self._samples,
            resets=self._resets,
            out_of_range=self._out_of_range,
        )

    # -- mapping ---------------------------------------------------------------------------

    def _replace(self, device: IntArray, host: IntArray, odd: BoolArray) -> None:
        """Replace each impossible device time by the last possible one, or by the arrival's."""
        self._out_of_range += int(odd.sum())
        last = np.maximum.accumulate(np.where(odd, -1, np.arange(len(device))))
        if not self._has_clock and not odd.all():
            last = np.maximum(last, int(odd.argmin()))  # before the first, the one that follows
        t_ns = np.where(last < 0, self._device, device[last])
        came_ns = np.where(last < 0, self._possible_ns, host[last])
        near = ((last >= 0) | self._has_clock) & (host - came_ns <= JUMP_NS)
        device[odd] = np.where(near, t_ns, host)[odd]
        self._possible_ns = int(came_ns[-1])

    def _in_order(self, t_ns: IntArray) -> IntArray:
        """Map times of the host's clock."""
        mapped = np.maximum(np.maximum.accumulate(t_ns), self._last)
        self._last = int(mapped[-1])
        return mapped

    def _mixed(self, device: IntArray, host: IntArray, without: BoolArray) -> IntArray:
        """Map samples of which some have no device time, e.g. echoes of sent frames."""
        cuts = np.flatnonzero(np.diff(without)) + 1
        parts: list[IntArray] = []
        starts: list[int] = [0, *cuts.tolist()]
        for start, stop in itertools.pairwise([*starts, len(host)]):
            stamped, other = device[start:stop], host[start:stop]
            parts.append(self._in_order(other) if without[start] else self._map(stamped, other))
        return np.concatenate(parts)

    def _map(self, device: IntArray, host: IntArray) -> IntArray:
        """Map samples with device times, split at half seconds and at jumps of the clock."""
        if not self._has_clock:
            self._has_clock = True
            self._restart(int(device[0]), int(host[0]), Envelope())
        elif host[0] - self._host > SILENCE_NS and self._envelope.settled:
            self._after_silence(device, host)
        parts: list[IntArray] = []
        while len(host):
            if host[0] >= self._bucket_ends:
                self._envelope.close_bucket()
                self._bucket_ends = int(host[0]) + BUCKET_NS
            stop = len(host)
            if host[-1] >= self._bucket_ends:
                stop = int(np.searchsorted(host, self._bucket_ends))
                stop = max(stop, 1)  # arrivals may decrease
            stop = self._take(device[:stop], host[:stop])
            if stop:
                parts.append(self._place(device[:stop], host[:stop]))
                self._device, self._host = int(device[stop - 1]), int(host[stop - 1])
                self._pair = self._device, self._host
            device, host = device[stop:], host[stop:]
        return parts[0] if len(parts) == 1 else np.concatenate(parts)

    def _take(self, device: IntArray, host: IntArray) -> int:
        """Add the samples before a jump to the envelope; return their number."""
        stop = len(device)
        back = device - np.maximum(np.maximum.accumulate(device), self._front) < -JUMP_NS
        if back.any():
            stop = int(back.argmax())
            if stop == 0:
                self._jump(int(device[0]), int(host[0]), "went back")
                return self._take(device, host)
        envelope, line = self._envelope, self._envelope.line
        x = (device[:stop] - self._origin[0]).astype(np.float64)
        y = ((host[:stop] - device[:stop]) - self._origin[1]).astype(np.float64)
        height = y - line.offset_ns - line.rate * x
        lowest = int(height.argmin())
        if not envelope.empty:
            jump = JUMP_NS if envelope.settled else _START_JUMP_NS
            if height[lowest] < -jump:
                stop = int((height < -jump).argmax())
                if stop == 0:
                    self._jump(int(device[0]), int(host[0]), "jumped ahead")
                    return self._take(device, host)
                lowest = int(height[:stop].argmin())
        envelope.take(float(x[lowest]), float(y[lowest]))
        return stop

    def _after_silence(self, device: IntArray, host: IntArray) -> None:
        """Begin a new envelope with the old rate, unless the clock was set meanwhile."""
        line = self._envelope.line
        elapsed_ns = int(host[0]) - self._host
        lag_ns = elapsed_ns - (int(device[0]) - self._device) * (1.0 + line.rate)
        if abs(lag_ns) > JUMP_NS + 5.0 * max(line.uncertainty, _WANDER) * elapsed_ns:
            return  # it was set: found when the samples are taken
        sigma = max(3.0 * line.uncertainty, _WANDER)
        self._restart(int(device[0]), int(host[0]), Envelope(line.rate, sigma))

    def _jump(self, device: int, host: int, what: str) -> None:
        self._resets += 1
        size_ns = abs((device - self._device) - (host - self._host))
        self._events.append(
            f"the device's clock {what} by {size_ns / NS:.3f} s and is measured anew"
        )
        rate = self._envelope.line.rate if self._envelope.settled else 0.0
        sigma = SAME_DEVICE if self._envelope.settled else PRIOR
        self._restart(device, host, Envelope(rate, sigma))

    def _restart(self, device: int, host: int, envelope: Envelope) -> None:
        self._envelope = envelope
        self._origin = device, host - device
        self._device, self._front, self._host = device, device, host
        self._bucket_ends = host + BUCKET_NS
        self._floor = self._last - device // 2

    def _place(self, device: IntArray, host: IntArray) -> IntArray:
        """Map samples by the line, in the device's order and not after their arrival."""
        line, sampled = self._envelope.line, device
        device = np.maximum(np.maximum.accumulate(device), self._front)
        x = device - self._origin[0]
        lag = np.floor(line.offset_ns + line.rate * x).astype(np.int64)
        mapped = device + (self._origin[1] + lag)
        half = device >> 1
        floor = np.maximum(mapped - half, self._floor)
        mapped = np.minimum(np.maximum.accumulate(floor) + half, host)
        mapped = np.maximum(np.maximum.accumulate(mapped), self._last)
        self._last, self._front = int(mapped[-1]), int(device[-1])
        self._floor = self._last - int(half[-1])
        return mapped - (device - sampled)

    def _count_delays(self) -> None:
        if not self._delays:
            return
        delays = np.concatenate(self._delays).astype(np.float64)
        self._delays, self._waiting = [], 0
        total, squares = self._moments
        self._moments = total + float(delays.sum()), squares + float(delays @ delays)
        places = np.rint(np.log2(np.maximum(delays, 1.0)) * _BINS_PER_OCTAVE).astype(np.int64)
        self._bins += np.bincount(places, minlength=_BINS)[:_BINS]
