"""Sampling times of joints that a bus asks in turn: message stamps plus logged offsets."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ...common.arrays import FloatArray, IntArray

_NS = 1_000_000_000
_FAR_NS = 2.0**60


@dataclass(frozen=True)
class Series:
    """Samples of some joints.

    Attributes:
        names: The joints.
        t_ns: Message stamps [Unix ns], not decreasing, one array a joint; joints that were
            sampled together share one array.
        values: One array of shape (n_j,) a joint.
    """

    names: tuple[str, ...]
    t_ns: Sequence[IntArray]
    values: Sequence[FloatArray]


def own_times(stamped: Sequence[Series], offsets: Series) -> list[list[IntArray]]:
    """Sampling times of several series whose joints have the same offsets.

    Args:
        stamped: The series.
        offsets: Sample time minus stamp [s]. Its memory may be used for the times: don't look at
            it afterwards.

    Returns:
        For each series one array a joint [Unix ns]: its stamps plus the offset that was logged
        with each stamp, or last before it (the first offset for stamps before that). Series that
        were stamped alike share them, and so do joints without offsets. Joints that ``offsets``
        doesn't have keep their stamps.
    """
    if all(_stamped_alike(series, offsets) for series in stamped):  # the usual case
        own = [
            np.add(t_ns, _steps(values), out=values.view(np.int64))
            for t_ns, values in zip(offsets.t_ns, offsets.values, strict=True)
        ]
        return [own for _ in stamped]
    found: list[list[IntArray]] = []
    for i, series in enumerate(stamped):
        for earlier, known in zip(stamped[:i], found, strict=True):
            if _stamped_alike(series, earlier):
                found.append(known)
                break
        else:
            found.append(_each_own(series, offsets))
    return found


def _each_own(series: Series, offsets: Series) -> list[IntArray]:
    place = {name: j for j, name in enumerate(offsets.names)}
    own: list[IntArray] = []
    for name, t_ns in zip(series.names, series.t_ns, strict=True):
        j = place.get(name)
        if j is None or not len(offsets.t_ns[j]):
            own.append(t_ns)
            continue
        last = np.searchsorted(offsets.t_ns[j], t_ns, side="right") - 1
        own.append(t_ns + _steps(offsets.values[j][np.maximum(last, 0)]))
    return own


def _steps(offset_s: FloatArray) -> IntArray:
    """Offsets [ns]; those that are not finite, or beyond all reason, count as zero."""
    with np.errstate(over="ignore", invalid="ignore"):
        steps = offset_s * _NS
        np.rint(steps, out=steps)
        usable = np.abs(steps) < _FAR_NS
    if not usable.all():
        steps[~usable] = 0.0
    return steps.astype(np.int64)


def _stamped_alike(one: Series, other: Series) -> bool:
    if one.names != other.names or len({id(t_ns) for t_ns in (*one.t_ns, *other.t_ns)}) > 2:
        return False
    return all(
        a is b or np.array_equal(a, b) for a, b in zip(one.t_ns[:1], other.t_ns[:1], strict=True)
    )
