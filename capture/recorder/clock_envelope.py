"""The lower envelope of what a device's clock lags behind the host's: a line under all delays.

A frame arrives after it was sampled, never before, and mostly by more than it must: the delays are
positive, come in bursts and are stretched by polling. So a line through the middle of the points
(device time, host minus device time) is late by the mean delay and leans with the load. The line
that lies under all points and as near to them as can be is neither; where delays are exponential
it is the likeliest one. It is the edge of the lower convex hull above or below the mean device
time.

Sources: Zhang, Liu, Xia, "Clock synchronization algorithms for network measurements", INFOCOM
2002; Moon, Skelly, Towsley, "Estimation and removal of clock skew from network delay
measurements", INFOCOM 1999; Harrison, Newman, "TICSync: knowing when things happened", ICRA 2011.
"""

from __future__ import annotations

import itertools
from collections import deque
from dataclasses import dataclass

BUCKETS = 120
"""Points that are kept: each is the least delayed sample of half a second, so a minute. Over a
minute a quartz keeps its rate to far better than 1 ppm, over an hour in the sun it does not."""

BUCKET_NS = 500_000_000

MIN_BUCKETS = 4
"""Fewer points give no rate."""

PRIOR = 1e-4
"""Rates that are expected before anything is known: 100 ppm, a plain quartz. The rate is drawn
towards nothing as far as the points are less certain than this."""

SAME_DEVICE = 2e-5
"""The same after the clock was set or restarted: it is most likely the same quartz."""

MAX_RATE = 0.02
"""Further off than this is no clock; a cheap RC oscillator is within 2 %."""

STEP_NS = 3_000_000.0
"""A line that has to move by more than this, and by more than :data:`STEP_SPREADS`, was true of
another time: the points before are forgotten."""

STEP_SPREADS = 10.0
"""Mean distances of the points from the line."""

STEP_BUCKETS = 10
"""Points in a row that lie above before they are believed: a loaded host is late for a while."""


@dataclass(frozen=True)
class Line:
    """What to add to a device time: ``offset_ns + rate * (device - origin)``.

    Attributes:
        offset_ns: At the origin [ns].
        rate: Host seconds a device second, less one.
        uncertainty: Of the rate, one standard deviation.
        spread_ns: Mean distance of the points from the line [ns].
    """

    offset_ns: float
    rate: float
    uncertainty: float
    spread_ns: float


class Envelope:
    """The least delayed points of the last minute and the line below them.

    Coordinates are relative to an origin that the owner chooses; x is the device time, y is host
    minus device time, both in ns.
    """

    def __init__(self, rate: float = 0.0, sigma: float = PRIOR) -> None:
        """Start without points.

        Args:
            rate: What the rate is expected to be.
            sigma: How well that is known.
        """
        self.line = Line(0.0, rate, sigma, 0.0)
        self._prior = (rate, sigma)
        self._points: deque[tuple[float, float]] = deque(maxlen=BUCKETS)
        self._least: tuple[float, float] | None = None  # of the bucket that is open

    @property
    def empty(self) -> bool:
        """Whether there is no point yet."""
        return self._least is None and not self._points

    @property
    def settled(self) -> bool:
        """Whether a rate is known."""
        return len(self._points) >= MIN_BUCKETS

    def take(self, x: float, y: float) -> None:
        """Take the point that lies lowest above the line among the latest samples.

        Args:
            x: Device time [ns].
            y: Host minus device time [ns].
        """
        line = self.line
        height = y - line.offset_ns - line.rate * x
        if self.empty:
            self.line = Line(line.offset_ns + height, *_rest(line))
        elif height < 0.0:
            step = max(STEP_NS, STEP_SPREADS * line.spread_ns)
            if -height > step and len(self._points) >= STEP_BUCKETS:
                self._forget(0)
            self.line = Line(line.offset_ns + height, *_rest(self.line))
        least = self._least
        if least is None or y - line.rate * x < least[1] - line.rate * least[0]:
            self._least = (x, y)

    def close_bucket(self) -> None:
        """Half a second is over: its least delayed sample becomes a point of the envelope."""
        if self._least is None:
            return
        self._points.append(self._least)
        self._least = None
        self._fit()
        recent = list(self._points)[-STEP_BUCKETS:]
        before = len(self._points) - len(recent)
        if before < STEP_BUCKETS:
            return
        heights = [self._height(x, y) for x, y in self._points]
        spread = sum(heights[:before]) / before
        if min(heights[before:]) > max(STEP_NS, STEP_SPREADS * spread):
            self._forget(STEP_BUCKETS)
            self._fit()

    def _height(self, x: float, y: float) -> float:
        return y - self.line.offset_ns - self.line.rate * x

    def _forget(self, kept: int) -> None:
        """Drop all but the last points; what is known of the rate stays as an expectation."""
        line = self.line
        sigma = max(3.0 * line.uncertainty, 1e-6) if self.settled else self._prior[1]
        self._prior = (line.rate, min(sigma, PRIOR))
        while len(self._points) > kept:
            self._points.popleft()
        self._least = self._least if kept else None
        self.line = Line(line.offset_ns, line.rate, self._prior[1], line.spread_ns)

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
        self.line = Line(offset, rate, sigma, spread)


def _rest(line: Line) -> tuple[float, float, float]:
    return line.rate, line.uncertainty, line.spread_ns


def _edge_rate(points: list[tuple[float, float]]) -> float:
    """Slope of the lower hull's edge at the mean x: the line under all points and nearest."""
    hull: list[tuple[float, float]] = []
    for x, y in points:
        if hull and hull[-1][0] == x:
            continue  # sorted: the one that is there is lower
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
