"""Comparison of a joint's effort with the usual one: whether its motor pushes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..common.arrays import ComplexArray, FloatArray
from .fault import Symptom
from .motion import (
    BLOCKS,
    FEW_SAMPLES,
    MIN_SHARE,
    MIN_WINDOWS,
    JointMotion,
    Judged,
    Response,
    complex_median,
    marked_spans,
    median_of,
    neighbours,
    record_span,
    whole_or,
    windowed_response,
    within,
)

# Effort, as a share of a neighbour's, below which a motor does not drive its joint: friction.
POWERLESS = 0.2
# Control error, in those of the neighbours, from which a motor with power would push.
PUSHING_ERROR_RATIO = 2.5
ENDS = 2  # joints at either end of a free chain, which little load may keep from any effort
SAME = 0.35  # change of an effort, as a share of the usual one, up to which it is the usual one
PUSHING = 1.3  # share of the usual effort above which a motor pushes against something


@dataclass(frozen=True)
class UsualEffort:
    """Effort of the joints that follow.

    Attributes:
        size: Median absolute effort of each, shape (k,).
        ratio: Response of the effort to the command of each, shape (k,).
    """

    size: FloatArray
    ratio: ComplexArray

    def size_of(self, motion: JointMotion, main: Symptom) -> float:
        """Usual absolute effort of a joint: its own where it does not stand, else the others'."""
        if motion.effort is not None and main.spans_s:
            outside = motion.effort.values[~within(motion.effort.t_s, main.spans_s)]
            if outside.size >= FEW_SAMPLES:
                return float(np.median(np.abs(outside)))
        return median_of(self.size, 0.0)


def usual_effort(judged: Sequence[Judged]) -> UsualEffort:
    """Return effort of each joint that follows.

    Args:
        judged: The joints; those without a usual response are left out.
    """
    size: list[float] = []
    ratio: list[complex] = []
    for each in judged:
        effort = each.motion.effort
        if effort is None or not effort.values.size or not each.has_usual:
            continue
        r = windowed_response(each.motion.command, effort, each.response.period_s)
        size.append(float(np.median(np.abs(effort.values))))
        if r.valid.any():
            ratio.append(complex_median(r.ratio[r.valid]))
    return UsualEffort(np.array(size, dtype=np.float64), np.array(ratio, dtype=np.complex128))


def effort_there(
    motion: JointMotion, judged: Judged, main: Symptom, usual: UsualEffort
) -> tuple[float, float] | None:
    """Return size and change of the effort while a joint stands, relative to the usual effort.

    The effort's response to the command in windows of one cycle: a joint that is blocked pushes
    in step with its command, one that moves in step with its own lag behind it.

    Returns:
        Both; None without an effort to compare with.
    """
    if motion.effort is None:
        return None
    spans = main.spans_s or (record_span(motion),)
    r = windowed_response(motion.command, motion.effort, judged.response.period_s)
    during, beside = np.zeros_like(r.valid), np.ones_like(r.valid)
    for start, stop in spans:
        during |= (r.start_s >= start) & (r.stop_s <= stop)
        beside &= (r.start_s >= stop) | (r.stop_s <= start)
    ratio = r.ratio[during & r.valid]
    own = r.ratio[beside & r.valid]
    reference = own if main.spans_s and own.size >= BLOCKS else usual.ratio
    if ratio.size >= BLOCKS and reference.size:  # fewer windows hold parts of the usual motion
        here, there = complex_median(ratio), complex_median(reference)
        scattered = float(np.median(np.abs(reference - there))) > SAME * abs(there)
        if abs(there) > 0 and not scattered:
            return abs(here / there), abs(here / there - 1)
    # Too short for a window, or no usual response: by its size alone.
    inside = within(motion.effort.t_s, spans)
    values, level = motion.effort.values[inside], usual.size_of(motion, main)
    if values.size < FEW_SAMPLES or not level > 0:
        return None
    size = float(np.median(np.abs(values))) / level  # of a sine as large as its root mean square
    return size, size - 1 if size > PUSHING else 0.0


def powerless(judged: Sequence[Judged], k: int) -> list[Symptom]:
    """Find whether neighbours swing a joint: far from its command, without effort against it."""
    each, near = judged[k], neighbours(judged, k)
    r = each.response
    if each.motion.effort is None or min(k, len(judged) - 1 - k) < ENDS:
        return []
    errors = np.array([_usual(one, _control_error(one.response)) for one in near])
    usual = median_of(errors[np.isfinite(errors)])
    far = _control_error(r) > np.fmax(PUSHING_ERROR_RATIO * usual, r.asked / 2)
    off = r.valid & ~each.still & far
    if not off.any():
        return []
    known = [size for one in near if np.isfinite(size := _usual(one, _effort_spread(one)))]
    if not known:
        return []
    effort, pushes = _effort_spread(each), max(known)
    light = off & (effort < POWERLESS * pushes)
    if np.count_nonzero(light) < max(MIN_WINDOWS, MIN_SHARE * np.count_nonzero(off)):
        return []
    share = 100 * float(np.median(effort[light])) / pushes
    text = f"moves with its neighbours, at {share:.0f} % of their largest effort"
    return [Symptom("powerless", whole_or(marked_spans(r, light), r), text)]


def _control_error(response: Response) -> FloatArray:
    """Standard deviation of the position less the command in each window [rad], shape (w,)."""
    covariance = response.ratio.real * response.asked**2
    return np.sqrt(np.maximum(response.asked**2 + response.spread**2 - 2 * covariance, 0.0))


def _effort_spread(each: Judged) -> FloatArray:
    """Standard deviation of the effort in each window, shape (w,); NaN where it has no sample."""
    r, effort = each.response, each.motion.effort
    if effort is None:
        return np.full(r.start_s.size, np.nan)
    i, j = (np.searchsorted(effort.t_s, edges) for edges in (r.start_s, r.stop_s))
    level = effort.values - median_of(effort.values, 0.0)
    first, second = (np.concatenate(([0.0], np.cumsum(level**power))) for power in (1, 2))
    count = np.where(j > i, j - i, np.nan)
    mean, square = (first[j] - first[i]) / count, (second[j] - second[i]) / count
    return np.sqrt(np.maximum(square - mean**2, 0.0))


def _usual(each: Judged, values: FloatArray) -> float:
    """Return the median over the judged windows; NaN without any."""
    return median_of(values[each.response.valid & np.isfinite(values)])
