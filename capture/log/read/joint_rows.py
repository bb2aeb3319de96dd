"""Messages that carry the same joints as rows, and rows as one series per joint."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from ...common.arrays import FloatArray, IntArray
from ..columns.layouts import Group
from .joint_messages import JointSource, sampled

_EARLY_OR_LATE = 0.1
"""A joint that is missing for more than this part of the topic's span causes a warning."""


@dataclass(frozen=True)
class JointRows:
    """Messages that carry the same joints.

    Attributes:
        names: The joints, k of them.
        stamp_ns: header.stamp [ns], shape (n,).
        log_ns: Log time [Unix ns], shape (n,).
        values: Shape (n, k), or (n, 0) if these messages leave the field empty.
    """

    names: tuple[str, ...]
    stamp_ns: IntArray
    log_ns: IntArray
    values: FloatArray


def rows_of(source: JointSource, type_name: str, group: Group, field: str) -> JointRows:
    """Return the rows of messages of one layout, in log order; without stamps at log times."""
    log_ns = group.times()
    stamp_ns = group.stamps()
    names, values = sampled(source, type_name, group, field)
    if (np.diff(log_ns) < 0).any():  # a file need not be in log order, a reader must be
        logged = np.argsort(log_ns, kind="stable")
        stamp_ns, log_ns, values = stamp_ns[logged], log_ns[logged], values[logged]
    return JointRows(names, stamp_ns, log_ns, values)


def merge_rows(
    rows: Sequence[JointRows], topic: str, field: str, warn: Callable[[str], None]
) -> tuple[tuple[str, ...], list[IntArray], list[FloatArray]]:
    """Merge messages of all layouts to one series per joint.

    Args:
        rows: The messages, by layout.
        warn: Called with one sentence for each irregularity.

    Returns:
        Joint names in the order of a list that has all, else of first appearance; times [Unix ns]
        and values, one array per joint. Joints sampled together share one array of times.
    """
    filled = [row for row in rows if row.names and row.values.shape[1] == len(row.names)]
    for row in rows:
        if row.names and row.values.shape[1] not in {0, len(row.names)}:
            warn(
                f"{topic}: {len(row.stamp_ns)} messages have {len(row.names)} names but "
                f"{row.values.shape[1]} values of {field}; they are left out"
            )
    if len(filled) == 1:
        row = filled[0]
        t_ns, order = _in_time(row.stamp_ns, f"{topic}", warn)
        values = row.values if order is None else row.values[order]
        if values.strides[0] != values.itemsize:  # a joint's samples side by side
            values = np.asfortranarray(values)
        return row.names, [t_ns] * len(row.names), [values[:, j] for j in range(len(row.names))]
    # A list that has all joints gives their order; a shorter one may come first.
    longest = max((row.names for row in filled), key=len, default=())
    parts: dict[str, list[tuple[JointRows, int]]] = {}
    if len(longest) == len({name for row in filled for name in row.names}):
        parts = {name: [] for name in longest}
    for row in filled:
        for j, name in enumerate(row.names):
            parts.setdefault(name, []).append((row, j))
    times: list[IntArray] = []
    columns: list[FloatArray] = []
    for name, pieces in parts.items():
        log_ns = np.concatenate([row.log_ns for row, _ in pieces])
        logged = np.argsort(log_ns, kind="stable")
        stamps = np.concatenate([row.stamp_ns for row, _ in pieces])[logged]
        values = np.concatenate([row.values[:, j] for row, j in pieces])[logged]
        t_ns, order = _in_time(stamps, f"{topic}, {name}", warn)
        times.append(t_ns)
        columns.append(values if order is None else values[order])
    _warn_changed_set(tuple(parts), times, topic, warn)
    return tuple(parts), times, columns


def _in_time(
    t_ns: IntArray, where: str, warn: Callable[[str], None]
) -> tuple[IntArray, IntArray | None]:
    """Sort times; return also the order if they were unsorted. Duplicates cause a warning."""
    steps = np.diff(t_ns)
    backward, repeated = int((steps < 0).sum()), int((steps == 0).sum())
    order: IntArray | None = None
    if backward:
        warn(f"{where}: {backward} samples go back in time; sorted by their stamps")
        order = np.argsort(t_ns, kind="stable")
        t_ns = t_ns[order]
        repeated = int((np.diff(t_ns) == 0).sum())
    if repeated:
        warn(f"{where}: {repeated} samples repeat the stamp before them; all are kept")
    return t_ns, order


def _warn_changed_set(
    names: Sequence[str], times: Sequence[IntArray], topic: str, warn: Callable[[str], None]
) -> None:
    """Warn of joints that are missing at the start or end of the topic."""
    filled = [t for t in times if len(t)]
    if not filled:
        return
    start, stop = min(int(t[0]) for t in filled), max(int(t[-1]) for t in filled)
    slack = _EARLY_OR_LATE * (stop - start)
    partial = [
        name
        for name, t in zip(names, times, strict=True)
        if not len(t) or t[0] - start > slack or stop - t[-1] > slack
    ]
    if partial:
        warn(
            f"{topic}: the set of joints changes during the session; only part of it has "
            f"{', '.join(partial)}"
        )
