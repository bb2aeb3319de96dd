"""Samples on other samples' times, without inventing any.

Each servo has its own sampling times; a picture of the whole body needs all of them at one
instant. Between two samples we draw the straight line, across a gap nothing: there the result
is NaN, and so is everything computed from it.

Rounding of what is drawn: finer than can be seen, coarse enough to be packed.

Rerun packs its files with LZ4, which finds what repeats. Noise below what a screen shows never
does: values rounded to a power of two take half the space of those that were logged.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from undulog.capture.common.arrays import BoolArray, FloatArray, IntArray

LEVELS = 500
"""Steps that the range of a plotted line is cut into, at least."""
_TAIL = 0.01


def plot_step(values: FloatArray) -> float:
    """The step that a plotted line is rounded to.

    Args:
        values: Samples of the line, any unit, shape (n,); NaN where there is none.

    Returns:
        A power of two, at most 1/500 of the range that holds all but the lowest and highest
        hundredth of the samples, so that rounding moves none by more than a thousandth of that
        range; 0, for none, where the line is flat.
    """
    known = values[np.isfinite(values)]
    if not known.size:
        return 0.0
    low, high = np.quantile(known, [_TAIL, 1.0 - _TAIL])
    span = float(high - low) or float(known.max() - known.min())
    return float(2.0 ** np.floor(np.log2(span / LEVELS))) if span > 0.0 else 0.0


def rounded(values: FloatArray, steps: Sequence[float] | FloatArray) -> FloatArray:
    """Round to multiples of a step.

    Args:
        values: Shape (n, k).
        steps: One a column, shape (k,); 0 leaves a column as it is.

    Returns:
        Shape (n, k); at most half a step from the values.
    """
    step = np.asarray(steps, dtype=np.float64)
    if not step.any():
        return values
    safe = np.where(step > 0.0, step, 1.0)
    return np.where(step > 0.0, np.round(values / safe) * safe, values)


GAP_STEPS = 5.0
"""Two samples further apart than this many typical steps have a gap between them."""


def typical_step_ns(t_ns: IntArray) -> int:
    """Median distance of successive samples.

    Args:
        t_ns: Sampling times [ns], ascending, shape (n,).

    Returns:
        The step [ns]; 0 where there are fewer than two distinct times.
    """
    steps = np.diff(t_ns)
    steps = steps[steps > 0]
    return int(np.median(steps)) if steps.size else 0


def gaps(t_ns: IntArray) -> BoolArray:
    """Which samples are followed by a gap.

    Args:
        t_ns: Sampling times [ns], ascending, shape (n,).

    Returns:
        Shape (n - 1,), or (0,) for fewer than two samples.
    """
    return np.asarray(np.diff(t_ns) > GAP_STEPS * typical_step_ns(t_ns), dtype=np.bool_)


def mark_gaps(
    t_ns: IntArray, values: FloatArray, end_ns: int | None = None
) -> tuple[IntArray, FloatArray]:
    """Put one row of NaN into every gap, a step after its last sample.

    A plot joins neighbouring rows by a line and a body keeps its last pose until the next one;
    the row of NaN ends both where the data end.

    Args:
        t_ns: Sampling times [ns], ascending, shape (n,).
        values: Shape (n, k).
        end_ns: Where the session ends [ns]; a silence before it counts as a gap.

    Returns:
        Times and values with the rows put in; the arguments themselves where there is no gap.
    """
    step = typical_step_ns(t_ns)
    before = np.flatnonzero(gaps(t_ns))
    if end_ns is not None and t_ns.size and end_ns - t_ns[-1] > GAP_STEPS * step:
        before = np.append(before, t_ns.size - 1)
    if not before.size:
        return t_ns, values
    return (
        np.insert(t_ns, before + 1, t_ns[before] + step),
        np.insert(values, before + 1, np.nan, axis=0),
    )


def decimate(t_ns: IntArray, rate_hz: float) -> IntArray:
    """Choose samples so that no more than ``rate_hz`` a second remain.

    Every slot of 1 / ``rate_hz`` that holds samples keeps its first one; slots are centred on
    multiples of that period after the first sample, so that jitter about a multiple is harmless.

    Args:
        t_ns: Sampling times [ns], ascending, shape (n,).
        rate_hz: At most this many samples a second.

    Returns:
        Indices into ``t_ns``, ascending.
    """
    if not t_ns.size:
        return np.zeros(0, dtype=np.int64)
    period = round(1e9 / rate_hz)
    slot = (t_ns - t_ns[0] + period // 4) // period
    first = np.flatnonzero(np.diff(slot, prepend=slot[0] - 1))
    return first.astype(np.int64)


def interpolate(t_ns: IntArray, values: FloatArray, at_ns: IntArray) -> FloatArray:
    """Straight line between the samples about each wanted time.

    Args:
        t_ns: Sampling times [ns], ascending, shape (n,).
        values: Shape (n,) or (n, k).
        at_ns: Wanted times [ns], shape (m,).

    Returns:
        Shape (m,) or (m, k). A wanted time that is a sampling time gets that sample. NaN before
        the first sample, after the last, across a gap and beside a NaN sample.
    """
    if np.array_equal(t_ns, at_ns):
        return values
    found = np.full((at_ns.size, *values.shape[1:]), np.nan)
    if not t_ns.size:
        return found
    left = np.searchsorted(t_ns, at_ns, side="right") - 1
    inside = left >= 0
    exact = inside & (t_ns[np.maximum(left, 0)] == at_ns)
    found[exact] = values[left[exact]]
    if t_ns.size > 1:
        joined = np.append(~gaps(t_ns), False)
        between = inside & ~exact & joined[np.maximum(left, 0)]
        i = left[between]
        share = (at_ns[between] - t_ns[i]) / (t_ns[i + 1] - t_ns[i])
        share = share.reshape(-1, *[1] * (values.ndim - 1))
        found[between] = (1.0 - share) * values[i] + share * values[i + 1]
    return found


def hold(t_ns: IntArray, values: FloatArray, at_ns: IntArray) -> FloatArray:
    """The last sample at or before each wanted time: a servo keeps its command till the next.

    Args:
        t_ns: Sampling times [ns], ascending, shape (n,).
        values: Shape (n,) or (n, k).
        at_ns: Wanted times [ns], shape (m,).

    Returns:
        Shape (m,) or (m, k); NaN before the first sample and later than a gap's length after
        the last one, where a lost command cannot be told from a held one.
    """
    found = np.full((at_ns.size, *values.shape[1:]), np.nan)
    if not t_ns.size:
        return found
    left = np.searchsorted(t_ns, at_ns, side="right") - 1
    age = at_ns - t_ns[np.maximum(left, 0)]
    limit = GAP_STEPS * typical_step_ns(t_ns) if t_ns.size > 1 else 0.0
    known = (left >= 0) & (age <= limit)
    found[known] = values[left[known]]
    return found


def ordered(t_ns: IntArray, values: FloatArray) -> tuple[IntArray, FloatArray]:
    """Samples in the order of their times.

    Args:
        t_ns: Sampling times [ns], shape (n,).
        values: Shape (n,) or (n, k).

    Returns:
        Both sorted by time, equal times in their given order; unchanged where sorted already.
    """
    if np.all(t_ns[1:] >= t_ns[:-1]):
        return t_ns, values
    order = np.argsort(t_ns, kind="stable")
    return t_ns[order], values[order]
