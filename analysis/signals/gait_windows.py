"""Find the time windows in which the commands repeat themselves: each holds one constant gait.

A gait of period T is constant where every command q is that of a period before::

    q(t + T) = q(t)

whatever its shape. A change of pace, direction, amplitude or offset breaks this for the period
before it and for no other time, so that the windows on both sides end and begin at the change. What
changes slowly from cycle to cycle, as a warm motor's pace, doesn't break it.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from scipy.special import gammainccinv, gammaincinv

from undulog.capture.common.arrays import BoolArray, FloatArray, IntArray

from ..estimators.series import Series, moves
from ..response.rhythm import (
    DRIVEN_SHARE,
    MIN_CYCLES,
    MIN_EXPLAINED,
    MIN_SAMPLES,
    find_rhythm,
    liveliest,
)

CHANGED = 0.05
"""A joint whose command differs by this share of its own size from that of a period before has
changed: so do controllers that step their amplitude (``cycles.STEP_SHARE``)."""

MOST_SAMPLES = 1 << 14
"""Samples of the grid at most."""

LEAST_SAMPLES = 12
"""Samples of a cycle on the grid at least; a linear interpolation then errs by a thirtieth."""

FINEST = 32
"""Time windows of the same length in which a period is looked for, at most."""

_SAME_PERIOD = 0.05
"""Periods up to this share apart are one that moves slowly."""

_SMOOTH = 0.125
"""Share of a period over which a difference is averaged."""

_QUIET = 0.25
"""Share of the record in which commands repeat themselves at least: its noise is read there."""

_CHANCE = 1e-6
"""Chance that white noise exceeds its limit at one sample."""

_NOISE = 4.0
"""Mean squared difference over a period or more, in those of noise, up to which it is noise."""

_MOST_NOISE = 4 * CHANGED
"""Share of a command's size that its noise may be."""

_STANDING = 0.1
"""A cycle with less than this share of the largest cycle's size is no gait, but a pause."""

_SLACK = 0.25
"""Periods that a window may be short of, as its ends are known to a part of one."""

_SWEPT = 0.02
"""A period that moves by this share from the first to the last third of a window is swept."""

_MAIN_LOBE = 2
"""Bins of a Hann window's main lobe on each side of a line."""


@dataclass(frozen=True)
class Repeats:
    """A window in which the commands repeat themselves.

    Attributes:
        start_s: Start [s].
        stop_s: End [s].
        period_s: Their period [s].
    """

    start_s: float
    stop_s: float
    period_s: float

    @property
    def cycles(self) -> float:
        """Periods in it."""
        return (self.stop_s - self.start_s) / self.period_s

    def settled(self) -> Repeats:
        """The window without its first period, where enough are left."""
        if self.cycles < MIN_CYCLES + 1 - _SLACK:
            return self
        return replace(self, start_s=self.start_s + self.period_s)


def several_gaits(commands: Sequence[Series], start_s: float, stop_s: float) -> list[Repeats]:
    """Find the windows of the gaits of a motion whose gait changes.

    Args:
        commands: Commands, m of them.
        start_s: Start of the motion [s].
        stop_s: Its end [s].

    Returns:
        Windows of at least ``MIN_CYCLES`` periods in order of time, without the first period after
        a change, in which the joints settle, where so many are left. None where there is one gait,
        or where what repeats itself is less than ``MIN_EXPLAINED`` of the time in motion.
    """
    grid = _Grid.of(commands, start_s, stop_s)
    windows = [] if grid is None else _constant(grid)
    if grid is None or len(windows) < 2:
        return []
    longest_s = max(window.period_s for window in windows)
    if _covered(windows) < MIN_EXPLAINED * grid.moving_s(longest_s):
        return []
    return [windows[0], *(window.settled() for window in windows[1:])]


def _constant(grid: _Grid) -> list[Repeats]:
    windows: list[Repeats] = []
    for block in _blocks(grid):
        periods = [grid.period_in(*limits) for limits in block]
        new = [period for period in periods if period is not None]
        if not new:
            continue
        candidates = [window for family in _families(new) for window in grid.repeats(family)]
        windows = _apart([*windows, *candidates])
        if _covered(windows) >= (1 - _STANDING) * (grid.t_s[-1] - grid.t_s[0]):
            break
    windows = _joined(grid, sorted(windows, key=lambda window: window.start_s))
    if len(windows) > 1:  # one gait may have a pace that moves; of a sweep each window has
        windows = [window for window in windows if not grid.sweeps(window)]
    return windows


def _joined(grid: _Grid, windows: Iterable[Repeats]) -> list[Repeats]:
    """Join windows of one gait that noise, or a lost command, has divided."""
    joined: list[Repeats] = []
    for window in windows:
        if joined and grid.continues(joined[-1], window):
            joined[-1] = replace(joined[-1], stop_s=window.stop_s)
        else:
            joined.append(window)
    return joined


def _blocks(grid: _Grid) -> Iterator[list[tuple[int, int]]]:
    """Yield the whole record, then parts of it that overlap by half and are ever shorter."""
    yield [(0, grid.t_s.size)]
    count = 2
    while count <= FINEST:
        length = grid.t_s.size // count
        if length < MIN_CYCLES * LEAST_SAMPLES:
            return
        starts = range(0, grid.t_s.size - length + 1, max(length // 2, 1))
        yield [(first, first + length) for first in starts]
        count *= 2


def _families(periods: Iterable[float]) -> list[list[float]]:
    """Periods that follow each other closely belong together."""
    ordered = sorted(periods)
    families = [ordered[:1]]
    for before, after in pairwise(ordered):
        if after > (1 + _SAME_PERIOD) * before:
            families.append([])
        families[-1].append(after)
    return families


def _apart(windows: Sequence[Repeats]) -> list[Repeats]:
    """Windows that don't overlap: the longest first, of equal ones that of the shortest period."""
    kept: list[Repeats] = []
    for window in sorted(
        windows, key=lambda repeats: repeats.start_s - repeats.stop_s + repeats.period_s
    ):
        start_s, stop_s = window.start_s, window.stop_s
        for other in kept:
            if other.start_s <= start_s < other.stop_s:
                start_s = other.stop_s
            if other.start_s < stop_s <= other.stop_s:
                stop_s = other.start_s
        inside = any(start_s < other.start_s and other.stop_s < stop_s for other in kept)
        if not inside and stop_s - start_s >= MIN_CYCLES * window.period_s:
            kept.append(Repeats(start_s, stop_s, window.period_s))
    return kept


def _covered(windows: Iterable[Repeats]) -> float:
    return sum(window.stop_s - window.start_s for window in windows)


def _in_lines(values: FloatArray) -> bool:
    """Return whether the power of channels (m, n) is in one line and its harmonics, roughly.

    It takes a hundredth of the time of a fit, which decides.
    """
    centred = values - values.mean(axis=1, keepdims=True)
    power = np.sum(np.abs(np.fft.rfft(centred * np.hanning(values.shape[1]), axis=1)) ** 2, axis=0)
    peak = int(np.argmax(power))
    if peak < MIN_CYCLES - 0.5:  # its line would be as wide as the band
        return False
    bins: IntArray = np.arange(power.size, dtype=np.int64)
    lines = np.zeros(power.size, dtype=np.bool_)
    for order in (0.5, 1, 1.5, 2, 3):
        lines |= np.abs(bins - order * peak) <= _MAIN_LOBE
    return float(power[lines].sum()) >= MIN_EXPLAINED * float(power.sum())


def _recorded(commands: Iterable[Series], t_s: FloatArray) -> BoolArray:
    """Return which times lie in no gap of any command, shape (n,)."""
    recorded: BoolArray = np.ones(t_s.size, dtype=np.bool_)
    for command in commands:
        for gap in command.gaps.tolist():
            recorded &= (t_s <= command.t_s[gap]) | (t_s >= command.t_s[gap + 1])
    return recorded


@dataclass(frozen=True)
class _Grid:
    """Commands on common even times.

    Attributes:
        t_s: Times [s], shape (n,).
        values: Commands, shape (m, n).
        recorded: Where no command has a gap, shape (n,).
        running: Sums of the values and of their squares from the start, shape (2, m, n + 1).
    """

    t_s: FloatArray
    values: FloatArray
    recorded: BoolArray
    running: FloatArray

    @classmethod
    def of(cls, commands: Sequence[Series], start_s: float, stop_s: float) -> _Grid | None:
        """Interpolate the commands between two times; joints that hardly move are left out."""
        inside = [command.between(start_s, stop_s) for command in commands]
        moving = [
            command for command in inside if command.count > MIN_SAMPLES and moves(command.values)
        ]
        if not moving:
            return None
        start = max(float(command.t_s[0]) for command in moving)
        stop = min(float(command.t_s[-1]) for command in moving)
        step = max(*(command.period_s for command in moving), (stop - start) / MOST_SAMPLES, 0.0)
        if step <= 0 or stop - start < MIN_CYCLES * LEAST_SAMPLES * step:
            return None
        t_s: FloatArray = np.arange(start, stop, step, dtype=np.float64)
        values = np.stack([command.at(t_s) for command in moving])
        size = values.std(axis=1)
        values = values[size > DRIVEN_SHARE * size.max()]
        values = values - values.mean(axis=1, keepdims=True)
        running = np.zeros((2, len(values), t_s.size + 1))
        np.cumsum([values, values**2], axis=2, out=running[:, :, 1:])
        return cls(t_s, values, _recorded(moving, t_s), running)

    @property
    def step_s(self) -> float:
        """Between two samples [s]."""
        return float(self.t_s[1] - self.t_s[0])

    def continues(self, before: Repeats, after: Repeats) -> bool:
        """Return whether the commands between two windows repeat themselves but for noise.

        They do at single samples where noise is large, for the mean of the time between; and
        what comes then is that of whole periods before.
        """
        period_s = before.period_s
        periods = np.ceil((after.start_s - before.stop_s) / period_s - _SLACK) + 1
        noise = self._change(before.start_s, before.stop_s - period_s, period_s)
        between = self._change(before.stop_s - period_s, after.start_s, period_s)
        over = self._change(before.stop_s - period_s, before.stop_s, periods * period_s)
        first, stop = np.searchsorted(self.t_s, (before.stop_s - period_s, before.stop_s)).tolist()
        limit = _limit(self.values[:, first:stop].var(axis=1), _NOISE * noise)
        return bool(np.all(between <= limit) and np.all(over <= limit))

    def _change(self, start_s: float, stop_s: float, lag_s: float) -> FloatArray:
        """Return the mean squared difference to a time later, shape (m,)."""
        t_s = self.t_s[slice(*np.searchsorted(self.t_s, (start_s, stop_s)).tolist())]
        later_s = t_s + lag_s
        recorded = np.interp(t_s, self.t_s, self.recorded) == 1
        recorded &= np.interp(later_s, self.t_s, self.recorded) == 1
        difference = self._at(later_s[recorded]) - self._at(t_s[recorded])
        squares: FloatArray = np.sum(difference**2, axis=1)
        return squares / max(np.count_nonzero(recorded), 1)

    def _at(self, t_s: FloatArray) -> FloatArray:
        """Return the commands at other times, shape (m, k)."""
        place: FloatArray = (t_s - self.t_s[0]) / self.step_s
        before: IntArray = np.clip(place.astype(np.int64), 0, self.t_s.size - 2)
        part: FloatArray = np.clip(place - before, 0.0, 1.0)
        return (1 - part) * self.values[:, before] + part * self.values[:, before + 1]

    def moving_s(self, period_s: float) -> float:
        """Return how long the commands move [s], by the size of each period."""
        period = max(round(period_s / self.step_s), 1)
        size: FloatArray = self._size(period, max(self.t_s.size - period, 0)).max(axis=0)
        moving: BoolArray = size > _STANDING**2 * size.max(initial=0.0)
        share = np.count_nonzero(moving) / max(moving.size, 1)
        return share * float(self.t_s[-1] - self.t_s[0])

    def sweeps(self, window: Repeats) -> bool:
        """Return whether the period moves within a window."""
        first, last = np.searchsorted(self.t_s, (window.start_s, window.stop_s)).tolist()
        enough = round((MIN_CYCLES + 1) * window.period_s / self.step_s)
        third = min(max((last - first) // 3, enough), last - first)
        ends = [self.period_in(first, first + third), self.period_in(last - third, last)]
        if ends[0] is None or ends[1] is None:
            return True
        return abs(float(np.log(ends[1] / ends[0]))) > _SWEPT

    def period_in(self, first: int, last: int) -> float | None:
        """Return the period of the rhythm that explains the commands in a part of the record."""
        t_s = self.t_s[first:last]
        channels = [Series(str(k), t_s, row[first:last]) for k, row in enumerate(self.values)]
        few = liveliest([channel for channel in channels if moves(channel.values)])
        if not few or not _in_lines(np.stack([channel.values for channel in few])):
            return None
        rhythm = find_rhythm(few, float(t_s[-1] - t_s[0]))
        if rhythm is None or rhythm.explained < MIN_EXPLAINED:
            return None
        period_s = 2 * np.pi / rhythm.omega
        return period_s if period_s >= LEAST_SAMPLES * self.step_s else None

    def repeats(self, periods: Sequence[float]) -> list[Repeats]:
        """Return the windows in which the commands repeat themselves with one of some periods."""
        period_s = float(np.median(periods))
        width = max(round(_SMOOTH * period_s / self.step_s), 1)
        lags = {round(period / self.step_s / _SMOOTH) * _SMOOTH for period in periods}
        longest = int(np.ceil(max(lags))) + 1
        count = self.t_s.size - longest - width
        if count < 1:
            return []
        size = self._size(round(period_s / self.step_s), count)
        same: BoolArray = np.zeros(count, dtype=np.bool_)
        for lag in sorted(lags):
            same |= self._same(lag, width, count, size)
        edges = np.flatnonzero(np.diff(np.concatenate([[0], same.view(np.int8), [0]])))
        spans = zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True)
        half = width // 2
        repeats = [
            Repeats(
                float(self.t_s[first if first == 0 else first + half]),
                float(self.t_s[min(last - 1 + half + longest - 1, self.t_s.size - 1)]),
                period_s,
            )
            for first, last in spans
        ]
        return [window for window in repeats if window.cycles >= MIN_CYCLES]

    def _size(self, period: int, count: int) -> FloatArray:
        """Return the variance of each joint over the period from each sample on, shape (m, c)."""
        period = min(period, self.t_s.size - count)
        total = self.running[:, :, period : period + count] - self.running[:, :, :count]
        mean, square = total / period
        return np.maximum(square - mean**2, 0.0)

    def _same(self, lag: float, width: int, count: int, size: FloatArray) -> BoolArray:
        """Return from which samples on all joints move as a period later, shape (c,)."""
        whole = int(lag)
        part = lag - whole
        n = count + width
        later = (1 - part) * self.values[:, whole : whole + n]
        later += part * self.values[:, whole + 1 : whole + 1 + n]
        recorded = self.recorded[:n] & self.recorded[whole : whole + n]
        recorded &= self.recorded[whole + 1 : whole + 1 + n]
        running = np.zeros((len(self.values), n + 1))
        # What wasn't recorded shows no change.
        np.cumsum(recorded * (later - self.values[:, :n]) ** 2, axis=1, out=running[:, 1:])
        change = (running[:, width : width + count] - running[:, :count]) / width
        noise = np.quantile(change, _QUIET, axis=1, keepdims=True)
        # A mean of w squares has the distribution of chi-squared over w; noise of few samples'
        # memory has half as many that are independent.
        noise = noise * gammainccinv(width / 4, _CHANCE) / gammaincinv(width / 4, _QUIET)
        lively = size.max(axis=0) > _STANDING**2 * size.max()
        return lively & np.all(change <= _limit(size, noise), axis=0)


def _limit(size: FloatArray, noise: FloatArray) -> FloatArray:
    """Return the mean squared difference of each joint up to which its command is the same.

    Args:
        size: Variance of the command over a period, joints first.
        noise: Mean squared difference that noise makes at most.
    """
    least = np.maximum(size, _STANDING**2 * size.max(axis=0))
    return np.maximum(CHANGED**2 * least, np.minimum(noise, _MOST_NOISE**2 * least))
