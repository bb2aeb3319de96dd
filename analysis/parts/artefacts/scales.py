"""Wrong sign and wrong unit: what one channel says against another, cycle by cycle.

A position that follows its command upside down at full size has the wrong sign; one that is
180/pi times as large is in degrees. A velocity must be the derivative of the position, whatever
the mechanics: where the two disagree in scale, a sensor is wrong.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from undulog.capture.common.arrays import BoolArray, FloatArray, IntArray

from ...estimators.series import GAP_FACTOR, Series
from .result import Span

DEGREE = float(np.degrees(1.0))
UNIT_SLACK = 1.6
"""Factor within which a ratio is taken for 180/pi: a weak servo's gain is in it, too."""

OPPOSITE = -0.7
"""Correlation of a response with its command at full size, below which its sign is wrong: 45
degrees from opposite phase."""

EARLY = -0.26
"""Correlation of a response with the rate of its command, below which its sign is right: beyond a
resonance of the body a sound joint lags by nearly half a cycle, and one of the wrong sign by half a
cycle or more. This is 15 degrees less, for clocks that differ."""

EITHER_WAY = 0.75
"""Share of the cycles that must follow the command, upright or not, for a sign to be decided:
of a multisine near a resonance every cycle has another phase."""

FULL_SIZE = (0.5, 2.0)
MIN_CORRELATION = 0.98
"""Correlation of a position with the integral of its velocity that lets scales be compared."""

SAME_SCALE = 1.05
"""Two sensors of one angle whose scales differ by less than this agree."""

SAME_RATE = 1.25
"""A velocity and its position that differ by less than this agree: sampled in step with a ripple of
the control period, a sound velocity may be off by 14 % (twin)."""

SURE = 4.0
"""Standard errors by which a scale is off beyond what counts as agreement."""

HOLE_SHARE = 0.02
"""More of a cycle without samples says nothing."""

_FEW = 3
"""A cycle with so few samples says nothing."""


def runs(marked: BoolArray) -> tuple[IntArray, IntArray]:
    """Runs of marked samples.

    Args:
        marked: Shape (n,).

    Returns:
        Index of the first sample of each run, and one past its last, each of shape (k,).
    """
    edge = np.diff(np.concatenate(([0], marked.astype(np.int8), [0])))
    return np.flatnonzero(edge == 1), np.flatnonzero(edge == -1)


def resolution_of(values: FloatArray) -> float:
    """Return the smallest step along the last axis that a sensor shows; 0 if it shows none."""
    step = np.abs(np.diff(values))
    moved = step[step > 0]
    return float(moved.min()) if moved.size else 0.0


def spans_of(t_s: FloatArray, marked: BoolArray, *, join: int = 1) -> tuple[Span, ...]:
    """Return the stretches over which samples are marked.

    Args:
        t_s: Times, strictly increasing [s], shape (n,).
        marked: Shape (n,).
        join: Runs with fewer samples than this between them are one.

    Returns:
        From a run's first sample to the sample after it, or to its own last one where a gap or the
        end follows.
    """
    first, stop = runs(marked)
    if first.size == 0:
        return ()
    apart = np.concatenate(([True], first[1:] - stop[:-1] >= join))
    starts, ends = first[apart], stop[np.concatenate((apart[1:], [True]))]
    usual = float(np.median(np.diff(t_s))) if t_s.size > 1 else 0.0
    after = np.minimum(ends, t_s.size - 1)
    bridged = t_s[after] - t_s[ends - 1] <= GAP_FACTOR * usual
    stops = np.where(bridged, t_s[after], t_s[ends - 1])
    return tuple(zip(t_s[starts].tolist(), stops.tolist(), strict=True))


def inside(t_s: FloatArray, spans: Iterable[Span]) -> BoolArray:
    """Which times lie in any of some stretches.

    Args:
        t_s: Times, increasing [s], shape (n,).

    Returns:
        Shape (n,).
    """
    marked = np.zeros(t_s.size, dtype=np.bool_)
    for start, stop in spans:
        marked[np.searchsorted(t_s, start, "left") : np.searchsorted(t_s, stop, "right")] = True
    return marked


@dataclass(frozen=True)
class Compared:
    """Two channels side by side in each cycle.

    Attributes:
        start_s: Start of each cycle [s], shape (c,).
        stop_s: Its end [s], shape (c,).
        ratio: Standard deviation of the first over that of the second, shape (c,); NaN where
            either stands still or has a gap.
        correlation: Shape (c,).
        error: Standard error that noise makes of the logarithm of the ratio, shape (c,).
    """

    start_s: FloatArray
    stop_s: FloatArray
    ratio: FloatArray
    correlation: FloatArray
    error: FloatArray

    def spans(self, marked: BoolArray) -> tuple[Span, ...]:
        """Return the marked cycles as stretches.

        Args:
            marked: Shape (c,).
        """
        spans: list[Span] = []
        starts, stops = self.start_s[marked].tolist(), self.stop_s[marked].tolist()
        for start, stop in zip(starts, stops, strict=True):
            if spans and spans[-1][1] == start:
                spans[-1] = (spans[-1][0], stop)
            else:
                spans.append((start, stop))
        return tuple(spans)


def turns(series: Series) -> FloatArray:
    """Return the times at which a signal swings up through its middle.

    Returns:
        Between them lies a cycle each [s]; with hysteresis, so that noise makes none.
    """
    middle, spread = float(np.median(series.values)), float(np.std(series.values))
    far = np.abs(series.values - middle) > 0.25 * spread
    if spread == 0 or not np.any(far):
        return np.zeros(0)
    at = np.flatnonzero(far)
    high = series.values[at] > middle
    return series.t_s[at[1:][high[1:] & ~high[:-1]]]


def compare(first: Series, second: Series, edges_s: FloatArray, *, noisy: bool = False) -> Compared:
    """Compare two channels over each cycle.

    Args:
        edges_s: Edges of the cycles [s], shape (c + 1,); the first and the last cycle reach to the
            ends of ``first``; with fewer than two edges all of it is one.
        noisy: Whether the error counts with the autocorrelation of what differs.
    """
    inner = edges_s[1:-1] if edges_s.size > 2 else np.zeros(0)
    starts: IntArray = np.concatenate(([0], np.searchsorted(first.t_s, inner)))
    starts = np.unique(starts[starts < first.count])
    stops = np.append(first.t_s[starts[1:]], first.t_s[-1])
    x, y = first.values, second.at(first.t_s)
    count = np.diff(np.append(starts, first.count))
    x, y = (v - np.repeat(np.add.reduceat(v, starts) / count, count) for v in (x, y))
    xx, yy, xy = (np.add.reduceat(v, starts) for v in (x * x, y * y, x * y))
    usable = (xx > 0) & (yy > 0) & (count > _FEW)
    for channel in (first, second):
        usable &= _hole(channel, first.t_s[starts], stops) <= HOLE_SHARE * (
            stops - first.t_s[starts]
        )
    nothing = np.full(starts.size, np.nan)
    ratio = np.sqrt(np.divide(xx, yy, out=nothing.copy(), where=usable))
    correlation = np.divide(xy, np.sqrt(xx * yy), out=nothing, where=usable)
    # Of two noisy copies of one signal (delta method): var(ln ratio) = (1 - r^2) / n, with as many
    # independent samples as noise of that autocorrelation leaves.
    error = np.sqrt(np.maximum(1 - correlation**2, 0.0) / np.maximum(count, 1))
    if noisy:
        power = float(yy.sum())
        error *= _correlated(x - y * (float(xy.sum()) / power if power > 0 else 0.0))
    return Compared(first.t_s[starts], stops, ratio, correlation, error)


def against_command(position: Compared, rate: Compared) -> dict[str, tuple[Span, ...]]:
    """Wrong sign and unit of a position, from its command.

    Args:
        position: Position against its command.
        rate: Position against the rate of its command.

    Returns:
        ``wrong_sign`` and ``wrong_unit`` to stretches, those that were found.
    """
    degrees = _near(position.ratio, DEGREE) & (np.abs(position.correlation) > -OPPOSITE)
    # A joint that hardly moves may be stuck: only one that follows closely is in another unit.
    radians = _near(position.ratio, 1 / DEGREE) & (position.correlation > MIN_CORRELATION)
    full = (position.ratio > FULL_SIZE[0]) & (position.ratio < FULL_SIZE[1])
    opposite = (position.correlation < OPPOSITE) & (full | degrees) & (rate.correlation > EARLY)
    # A sign changes no more than the sign: near a resonance the phase is anything, cycle by cycle.
    along = np.abs(position.correlation[np.isfinite(position.correlation)]) > -OPPOSITE
    opposite &= np.count_nonzero(along) >= EITHER_WAY * along.size
    return _found(position, {"wrong_sign": opposite, "wrong_unit": degrees | radians})


def against_witness(position: Compared, same: float) -> dict[str, tuple[Span, ...]]:
    """Sign, unit and scale of a position against another measure of the same angle.

    Args:
        position: Position against a second sensor, or against the integral of the velocity.
        same: Factor within which scales agree.

    Returns:
        ``wrong_sign``, ``wrong_unit`` and ``scale_mismatch`` to stretches, those that were found.
    """
    clear = np.abs(position.correlation) > MIN_CORRELATION
    ratio = np.where(clear, position.ratio, np.nan)
    if clear.any():
        near = np.pad(ratio[clear], 1, mode="edge")
        ratio[clear] = np.median(np.stack([near[:-2], near[1:-1], near[2:]]), axis=0)
    unit = _near(ratio, DEGREE) | _near(ratio, 1 / DEGREE)
    off = np.abs(np.log(ratio)) > np.log(same) + SURE * position.error
    signs = {"wrong_sign": clear & (position.correlation < 0), "wrong_unit": unit}
    return _found(position, signs | {"scale_mismatch": clear & off & ~unit})


def rate_of(series: Series) -> Series:
    """Return the time derivative of a signal with two samples or more, by central differences."""
    return Series(series.name, series.t_s, np.gradient(series.values, series.t_s))


def integral(velocity: Series) -> Series:
    """A velocity integrated over time, by the trapezoidal rule.

    Args:
        velocity: [rad/s].

    Returns:
        The way gone since its first sample [rad], on its times.
    """
    part = (velocity.values[1:] + velocity.values[:-1]) / 2 * np.diff(velocity.t_s)
    return Series(velocity.name, velocity.t_s, np.concatenate(([0.0], np.cumsum(part))))


def _hole(series: Series, start_s: FloatArray, stop_s: FloatArray) -> FloatArray:
    """Return the time in each cycle that lies in a channel's gaps [s]."""
    if not series.gaps.size:
        return np.zeros(start_s.size)
    step = np.zeros(series.count)
    step[series.gaps + 1] = series.t_s[series.gaps + 1] - series.t_s[series.gaps]
    lost = np.cumsum(step)
    return np.interp(stop_s, series.t_s, lost) - np.interp(start_s, series.t_s, lost)


def _correlated(residual: FloatArray) -> float:
    """By how much autocorrelated noise widens the error of a mean, from its first lag (AR(1))."""
    power = float(residual @ residual)
    first = float(residual[1:] @ residual[:-1]) / power if power > 0 else 0.0
    first = min(max(first, 0.0), 0.99)
    return float(((1 + first) / (1 - first)) ** 0.5)


def _near(ratio: FloatArray, factor: float) -> BoolArray:
    return np.abs(np.log(ratio / factor)) < np.log(UNIT_SLACK)


def _found(comparison: Compared, marked: dict[str, BoolArray]) -> dict[str, tuple[Span, ...]]:
    return {name: comparison.spans(mask) for name, mask in marked.items() if np.any(mask)}
