"""Numbers and strings of a topic's messages, as one array a field."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...common.arrays import IntArray
from ..columns.layouts import Group


@dataclass(frozen=True)
class FieldArrays:
    """Fields of a topic, one value a message.

    Attributes:
        t_ns: Stamps on the log's clock, or log times where there is none [Unix ns], shape (n,).
        values: By field path, e.g. ``pose.pose.position.x`` or ``position[3]``, each of shape (n,).
    """

    t_ns: IntArray
    values: Mapping[str, NDArray[Any]]


def group_arrays(group: Group, shift_ns: int) -> FieldArrays:
    """Return the fields of all messages of one layout.

    Args:
        shift_ns: What the clock of the stamps is behind the log's [ns].
    """
    columns: dict[str, NDArray[Any]] = {
        path: np.full(len(group), text, dtype=object) for path, text in group.strings.items()
    }
    for path in group.paths:
        values = group.values(path)
        if group.layout.leaves[path].is_array:
            columns |= {f"{path}[{k}]": values[:, k] for k in range(values.shape[1])}
        else:
            columns[path] = values[:, 0]
    t_ns = group.stamps()
    if group.is_stamped and (shift_ns or not t_ns.all()):
        t_ns = np.where(t_ns == 0, group.times(), t_ns + shift_ns)
    return FieldArrays(t_ns, columns)


def joined(parts: Sequence[FieldArrays]) -> FieldArrays:
    """Return the fields of several layouts in the order of time; NaN where one has no such field.

    Messages of one time stay in the order of the log within their layout.
    """
    if not parts:
        return FieldArrays(np.empty(0, dtype=np.int64), {})
    t_ns = np.concatenate([part.t_ns for part in parts])
    order = np.arange(t_ns.size)
    if np.any(np.diff(t_ns) < 0):
        order = np.argsort(t_ns, kind="stable")
    paths = dict.fromkeys(path for part in parts for path in part.values)
    columns = {
        path: np.concatenate(
            [part.values.get(path, np.full(part.t_ns.size, np.nan)) for part in parts]
        )[order]
        for path in paths
    }
    return FieldArrays(t_ns[order], columns)
