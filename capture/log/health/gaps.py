"""The cause of the gaps in a regular series: samples that were lost, or a sender that was late.

A controller on a busy computer issues a cycle late now and then. That is a fact about the
controller; no sample is missing. Stamps alone separate it from a loss by two properties of a loss:

- **A loss keeps the sender's grid.** The samples around a lost one are where they would have been,
  so the gap is a whole number of periods, within the noise of the intervals. A late sample ends its
  gap anywhere. Of late gaps a share of twice the tolerance is on the grid by chance: if no more are
  than that, all are late.
- **A loss breaks the count.** A sender with fixed deadlines that was held up catches up: the
  samples of a gap come after it, at short intervals, and the count over the session is that of an
  undisturbed sender. Only the samples by which it falls short can be lost.

What neither property excludes counts as lost: a sender that leaves out whole cycles of a fixed grid
looks like a loss. Of that only the log's other evidence decides, see :mod:`.skipped_cycles`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...common.arrays import BoolArray, FloatArray

GRID_TOLERANCE = 0.1
"""Distance of a gap from a whole number of periods that is on the grid [periods]. A smaller one
would take the clock steps of a computer (1 ms of 10) for lateness, a larger one more late gaps for
losses."""

NO_GRID = 0.25
"""With a tolerance of so many periods half of all gaps are on the grid: it shows nothing."""

NOISE = 3.0
"""Standard deviations within which noise is expected."""

QUARTILES = 1.349
"""Distance of the quartiles of a normal distribution [standard deviations]."""

LEAST_NOISE = 0.004
"""Least noise of the intervals that is assumed, relative to the period: that of a bin of
:class:`.TimingTally`, a 64th of an octave, in which they can't be separated."""

CENTRAL = 0.25
"""Intervals within so much of the median [medians] give the period: no gap is among them, and what
jitter there is lies evenly on either side."""

MEAN_ERROR = 1.7
"""Standard error of the period times sqrt(n) [standard deviations of an interval]: 1 for noise
that is independent from interval to interval, and more where it is cut off at :data:`CENTRAL`."""

CHANCE = 1.645
"""Standard deviations above the mean that one binomial number in twenty exceeds."""

RESOLVED = 2.0
"""A count shows whether a series caught up if its error is less than half of what its gaps lack."""

COUNT_NOISE = 2.0
"""Standard errors within which a count agrees with another. With normal noise of stamps of 1 to
25 % of the period the error is 1.3 to 13 times as large as needed (500 to 60,000 samples)."""

COUNT_ROUNDING = 0.3
"""Least error of a count over the session [samples]: first and last stamp are off the grid, too."""


@dataclass(frozen=True)
class Intervals:
    """Intervals of a series in groups of about equal size.

    Attributes:
        number: Intervals in each group, shape (n,).
        mean: Their mean [ns], ascending, shape (n,).
        spread: Largest distance of one from the mean, relative to it, shape (n,).
    """

    number: FloatArray
    mean: FloatArray
    spread: FloatArray


@dataclass(frozen=True)
class GapCauses:
    """Causes of the gaps of a series.

    Attributes:
        late: Gaps that the sender made: no sample is missing in them.
        missing: Samples that would fill the others.
        scattered: Those of them that are not in pauses.
    """

    late: int
    missing: int
    scattered: int


@dataclass(frozen=True)
class _Grid:
    """The sender's grid: its period [ns], the intervals' noise and the period's error, relative."""

    period: float
    noise: float
    error: float


def causes_of(
    intervals: Intervals, is_gap: BoolArray, is_pause: BoolArray, *, span_ns: int, count: int
) -> GapCauses:
    """Separate lost samples from late ones.

    Args:
        intervals: All intervals forward of a regular series.
        is_gap: Whether the intervals of a group are gaps, bool, shape (n,).
        is_pause: Whether they are so long that they can be cut out, bool, shape (n,).
        span_ns: Time from the earliest stamp to the latest [ns].
        count: All samples, also those with the stamp of the one before, as a burst may have them.
    """
    grid = _grid(intervals)
    number = intervals.number
    periods = intervals.mean / grid.period
    lacking = number * np.maximum(np.rint(periods - 1), 1.0) * is_gap
    is_lost = is_gap & ~_is_late(periods, intervals, is_gap, grid)
    most = _shortfall(float(lacking.sum()), span_ns / grid.period + 1.0 - count, count, grid)
    missing = min(float((lacking * is_lost).sum()), most)
    scattered = min(float((lacking * is_lost * ~is_pause).sum()), missing)
    lost_gaps = min(float((number * is_lost).sum()), missing)
    return GapCauses(
        late=round(float((number * is_gap).sum()) - lost_gaps),
        missing=round(missing),
        scattered=round(scattered),
    )


def _grid(intervals: Intervals) -> _Grid:
    """Estimate the grid from the intervals about the median."""
    count = float(intervals.number.sum())
    places = np.searchsorted(np.cumsum(intervals.number), np.array([0.25, 0.5, 0.75]) * count)
    low, median, high = intervals.mean[places]
    weight = intervals.number * (np.abs(intervals.mean - median) <= CENTRAL * median)
    period = float((weight * intervals.mean).sum() / weight.sum())
    noise = max(float(high - low) / QUARTILES / period, LEAST_NOISE)
    return _Grid(period, noise, MEAN_ERROR * noise / np.sqrt(count))


def _is_late(
    periods: FloatArray, intervals: Intervals, is_gap: BoolArray, grid: _Grid
) -> BoolArray:
    """Whether each group of gaps is off the grid, or on it by chance."""
    tolerance = np.maximum(GRID_TOLERANCE, NOISE * grid.noise) + periods * (
        NOISE * grid.error + intervals.spread
    )
    shows = is_gap & (tolerance < NO_GRID)
    off = shows & (np.abs(periods - np.rint(periods)) > tolerance)
    gaps = float(intervals.number[shows].sum())
    if not off.any():
        return off
    chance = float((intervals.number * 2.0 * tolerance)[shows].sum())
    bound = chance + CHANCE * np.sqrt(chance * (1.0 - chance / gaps)) + 0.5
    on_grid = gaps - float(intervals.number[off].sum())
    return shows if on_grid <= bound else off


def _shortfall(lacking: float, short: float, count: int, grid: _Grid) -> float:
    """Return the most samples that can be lost, by the count of all samples.

    A count that is too uncertain to separate a series that caught up from one with losses excludes
    nothing: then it is all that the gaps lack.

    Args:
        lacking: Samples that would fill all gaps.
        short: Samples by which the count falls short of the periods.
        count: Number of samples.
    """
    error = COUNT_NOISE * grid.error * count + COUNT_ROUNDING
    if lacking < RESOLVED * error:
        return lacking
    return 0.0 if short <= error else min(lacking, short)
