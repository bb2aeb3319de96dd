"""The lower envelope of the lag of a device's clock behind the host's: a line below all delays.

The delays of frames are positive, come in bursts and are extended by polling. So a line through the
middle of the points (device time, host minus device time) is late by the mean delay and changes
with the load. The nearest line below all points does neither; for exponential delays it is the most
likely one. It is the edge of the lower convex hull at the mean device time.

Sources: Zhang, Liu, Xia, "Clock synchronization algorithms for network measurements", INFOCOM
2002; Moon, Skelly, Towsley, "Estimation and removal of clock skew from network delay
measurements", INFOCOM 1999; Harrison, Newman, "TICSync: knowing when things happened", ICRA 2011.
"""

from __future__ import annotations

import itertools
from collections import deque
from dataclasses import dataclass

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


@dataclass(frozen=True)
class Line:
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
        self.line = Line(0.0, rate, sigma, 0.0)
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
            self.line = Line(line.offset_ns + height, *_rest(line))
        elif height < 0.0:
            step = max(STEP_NS, STEP_SPREADS * line.spread_ns)
            if -height > step and len(self._points) >= STEP_BUCKETS:
                self._drop_before(0)
            self.line = Line(line.offset_ns + height, *_rest(self.line))
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
        heights = [self._height(x, y) for x, y in self._points]
        spread = sum(heights[:before]) / before
        if min(heights[before:]) > max(STEP_NS, STEP_SPREADS * spread):
            self._drop_before(STEP_BUCKETS)
            self._fit()

    def _height(self, x: float, y: float) -> float:
        return y - self.line.offset_ns - self.line.rate * x

    def _drop_before(self, kept: int) -> None:
        """Drop all but the last points; the rate becomes the expected one."""
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
