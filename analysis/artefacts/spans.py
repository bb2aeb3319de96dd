"""Stretches of time over which something holds, from marks on samples."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from undulog.capture.common.arrays import BoolArray, FloatArray, IntArray

from ..estimators.series import GAP_FACTOR
from ..results.artefact import Span


def runs(marked: BoolArray) -> tuple[IntArray, IntArray]:
    """Runs of marked samples.

    Args:
        marked: Shape (n,).

    Returns:
        Index of the first sample of each run, and one past its last, each of shape (k,).
    """
    edge = np.diff(np.concatenate(([0], marked.astype(np.int8), [0])))
    return np.flatnonzero(edge == 1), np.flatnonzero(edge == -1)


def spans_of(t_s: FloatArray, marked: BoolArray, *, join: int = 1) -> tuple[Span, ...]:
    """Stretches over which samples are marked.

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
        spans: Stretches, their ends included.

    Returns:
        Shape (n,).
    """
    marked = np.zeros(t_s.size, dtype=np.bool_)
    for start, stop in spans:
        marked[np.searchsorted(t_s, start, "left") : np.searchsorted(t_s, stop, "right")] = True
    return marked
