"""Gain, lag and offset of a joint in any motion, with intervals that hold the model's order.

A joint follows its command by a gain, a delay and up to two poles (equation (1) of :mod:`.fit`).
The *lag* is that of slow motion, d + a: of a pure delay the delay, of a servo delay and time
constants together. All orders agree on it where they can't agree on d and a. An effect isn't before
its cause: what the fit finds to be early is given as 0.

What a servo does between two commands isn't in the log: it may hold the last one, or go to the next
in a line. Both are tried. A command that is held is later by half of its sampling interval; where
the data don't tell the two, the intervals hold both.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from undulog.capture.common.arrays import BoolArray, FloatArray, IntArray
from undulog.capture.judgement.levels import FEWEST

from ...common.estimate import Estimate
from ...estimators.intervals import t_factor
from ...estimators.series import Series
from .fit import (
    GAIN,
    OFFSET,
    PLACES,
    D,
    Data,
    Fit,
    first_fit,
    slopes,
    with_errors,
    with_poles,
    with_steps,
)

DECIDED = 2 * float(np.log(100.0))
"""Difference of two sums of squares over the residual's variance by which one of two models
explains the data a hundred times better (the ratio of two likelihoods)."""

POSSIBLE = 3.84
"""The same from which a further pole is possible at all: the 95th percentile of chi-squared."""

MOST_SAMPLES = 1 << 16
"""Samples that are fitted, evenly thinned out: those of an hour at 18 Hz."""

MOST_POLES = 2


@dataclass(frozen=True)
class Value:
    """A value, its 95 % interval, and the degrees of freedom of its error.

    Attributes:
        ci95: None where the error isn't known.
    """

    value: float
    ci95: tuple[float, float] | None = None
    freedom: float = 0.0

    @property
    def error(self) -> float:
        """Standard error; infinite where it isn't known."""
        if self.ci95 is None:
            return float("inf")
        return (self.ci95[1] - self.ci95[0]) / 2 / t_factor(self.freedom)

    @property
    def estimate(self) -> Estimate:
        """The value with its interval alone."""
        return Estimate(self.value, self.ci95)


@dataclass(frozen=True)
class Tracking:
    """How a joint follows its command.

    Attributes:
        gain: g of equation (1).
        lag_s: d + a [s]; one before its cause is 0.
        offset_rad: Mean of the position less that of the delayed command [rad].
        command_rad: Mean of the delayed command [rad].
        speed_rad_s: Root mean square of the rate of the delayed command [rad/s].
        order: Poles, 0 to 2.
        held: Whether a command that is held until the next explains more than lines.
        explained: Share of the position's variance, at most 1.
        rms_rad: Root mean square of what is left [rad].
    """

    gain: Value
    lag_s: Value
    offset_rad: Value
    command_rad: float
    speed_rad_s: float
    order: int
    held: bool
    explained: float
    rms_rad: float


def track(command: Series, position: Series, used: BoolArray | None = None) -> Tracking | None:
    """Fit how a joint follows its command.

    Args:
        command: [rad].
        position: [rad].
        used: Samples of the position that are used, shape (n,); without it all that fall within
            the time of the command.

    Returns:
        None where either doesn't move, or where there are fewer than two samples for each block.
    """
    if command.count < 2 or position.count < 2 or not np.ptp(command.values) > 0:
        return None
    stop_s = command.t_s[-1] + command.period_s
    within: BoolArray = (position.t_s >= command.t_s[0]) & (position.t_s <= stop_s)
    within = within if used is None else within & used
    if np.count_nonzero(within) < 2 * FEWEST or not np.ptp(position.values[within]) > 0:
        return None
    chosen: IntArray = np.flatnonzero(within).astype(np.int64)
    data = Data(command, position, chosen[:: -(-chosen.size // MOST_SAMPLES)])
    return _combined(data, _fits(data))


def _fits(data: Data) -> list[Fit]:
    """Return the best fit first, then those that the data leave open beside it.

    A simpler model stands unless another is a hundred times better, and lines stand unless a
    command that is held is.
    """
    line = with_errors(data, first_fit(data))
    best, left_open = _decided(data, line, with_steps(data, line))
    if not _bends(data, best):
        return [best, *left_open]
    for order in range(1, MOST_POLES + 1):
        line = with_errors(data, with_poles(data, best, order))
        if (best.squares - line.squares) / data.unit(line) < POSSIBLE:
            continue
        further, beside = _decided(data, line, with_steps(data, line))
        if (best.squares - further.squares) / data.unit(further) < DECIDED:
            left_open += [further, *beside]
        else:
            best, left_open = further, beside
    return [best, *left_open]


def _decided(data: Data, line: Fit, steps: Fit) -> tuple[Fit, list[Fit]]:
    """Return the fit that stands of lines and steps, and the other one where it is open."""
    steps = with_errors(data, steps)
    better = min(line, steps, key=lambda fit: fit.squares)
    if abs(line.squares - steps.squares) > DECIDED * data.unit(better):
        return better, []
    return line, [steps]


def _bends(data: Data, fit: Fit) -> bool:
    """Return whether the residual holds a part of the command's curvature, as poles leave it."""
    d = float(fit.theta[D])
    wide = max(data.period_s, d / 2)
    middle, early, late = (data.x(fit.held, d + way * wide, 0.0, 0.0) for way in (0, -1, 1))
    design, left = slopes(data, fit)
    bent = early + late - 2 * middle
    bent = bent - design @ np.linalg.lstsq(design, bent, rcond=None)[0]
    power = float(bent @ bent)
    along = float(bent @ left)
    return power > 0 and along**2 / power > POSSIBLE * data.unit(fit)


def _combined(data: Data, fits: Sequence[Fit]) -> Tracking:
    """Combine the fits that the data leave open; the best is the first."""
    best, count = fits[0], data.y.size
    intervals = [_intervals(data, fit) for fit in fits if fit.errors is not None]
    lag_s = best.lag_s
    if best.held and not best.order and intervals:
        lag_s = sum(intervals[0][D]) / 2  # any place of a step explains as much
    freedom = [fit.errors.freedom for fit in fits if fit.errors is not None]

    def value(k: int, value: float, least: float = -np.inf) -> Value:
        if not intervals:
            return Value(value)
        low, high = min(ends[k][0] for ends in intervals), max(ends[k][1] for ends in intervals)
        ci95 = max(low, least), max(high, least)
        return Value(value, ci95, min(float(numbers[k]) for numbers in freedom))

    x = data.x(best.held, *best.theta[D:].tolist())
    length_s = float(data.t_s[-1] - data.t_s[0])
    power = float(np.sum((data.y - data.y.mean()) ** 2))
    return Tracking(
        gain=value(GAIN, float(best.theta[GAIN])),
        lag_s=value(D, max(lag_s, 0.0), 0.0),
        offset_rad=value(OFFSET, float(best.theta[OFFSET])),
        command_rad=float(x.mean()),
        speed_rad_s=float(np.sqrt(np.sum(np.diff(x) ** 2 / np.diff(data.t_s)) / length_s)),
        order=best.order,
        held=best.held,
        explained=1 - best.squares / power,
        rms_rad=float(np.sqrt(best.squares / count)),
    )


def _intervals(data: Data, fit: Fit) -> list[tuple[float, float]]:
    """Return the 95 % intervals of offset, gain and lag."""
    if fit.errors is None:
        return []
    middle = (float(fit.theta[OFFSET]), float(fit.theta[GAIN]), fit.lag_s)
    half = [fit.errors.half(k) for k in range(len(middle))]
    intervals = [(m - h, m + h) for m, h in zip(middle, half, strict=True)]
    if fit.held and not fit.order:
        quantile = t_factor(float(fit.errors.freedom[D]))
        limit = fit.squares + quantile**2 * data.unit(fit)
        intervals[D] = _places(
            lambda d: data.solved(True, d, 0.0, 0.0)[1] <= limit,
            fit.lag_s,
            data.period_s,
        )
    return intervals


def _places(explains: Callable[[float], bool], middle: float, width: float) -> tuple[float, float]:
    """Return the ends of the delays near one that explain as much; a staircase has many."""
    near: FloatArray = middle + width * np.arange(-PLACES, PLACES + 1) / PLACES
    inside = [middle, *(d for d in near.tolist() if explains(d))]
    step = width / PLACES
    ends = min(inside), max(inside)
    return _edge(explains, ends[0], -step), _edge(explains, ends[1], step)


def _edge(explains: Callable[[float], bool], inside: float, step: float) -> float:
    """Return where delays cease to explain as much, beyond one that does, by bisection."""
    outside = inside + step
    while abs(outside - inside) > abs(step) / PLACES:
        middle = (outside + inside) / 2
        inside, outside = (middle, outside) if explains(middle) else (inside, middle)
    return outside
