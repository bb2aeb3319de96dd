"""Frozen values as rows of a pandas table, units in the names of the columns."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import fields, is_dataclass
from typing import Any, cast

import pandas as pd

from ...results.estimate import Estimate

_UNITS = ("_rad", "_hz", "_m_s", "_m", "_j", "_s", "_deg")


def table(kind: type[Any], rows: Iterable[Any], **more: Iterable[Any]) -> pd.DataFrame:
    """Dataclasses of one kind as a table.

    An :class:`~.analysis.results.estimate.Estimate` named ``lag_rad`` becomes ``lag_rad``,
    ``lag_low_rad`` and ``lag_high_rad``; a field ``ci95`` becomes ``low`` and ``high``; tuples of
    words are joined by spaces. Fields that hold other structures are left out.

    Args:
        kind: The kind.
        rows: The dataclasses.
        **more: Columns to put first, one value a row.

    Returns:
        One row each; without rows, the columns that every row would have.
    """
    every = [row_of(one) for one in rows]
    frame = pd.DataFrame(every) if every else pd.DataFrame(columns=_columns(kind), dtype="str")
    for place, (name, values) in enumerate(more.items()):
        frame.insert(place, name, list(values))
    return frame


def row_of(one: Any) -> dict[str, Any]:
    """One dataclass as a row.

    Args:
        one: The dataclass.

    Returns:
        Column to value.
    """
    row: dict[str, Any] = {}
    for field in fields(one):
        value = getattr(one, field.name)
        if value is None and "float" in str(field.type):
            value = float("nan")
        row |= _cells(field.name, value)
    return row


def ends(name: str) -> tuple[str, str]:
    """Columns of the two ends of an interval.

    Args:
        name: Of the value's column, e.g. ``lag_rad``.

    Returns:
        For example ``lag_low_rad`` and ``lag_high_rad``.
    """
    unit = next((unit for unit in _UNITS if name.endswith(unit)), "")
    stem = name.removesuffix(unit)
    return f"{stem}_low{unit}", f"{stem}_high{unit}"


def named(kind: type[Any], indices: Mapping[str, Any]) -> pd.DataFrame:
    """A mapping of dataclasses as a table, the keys first.

    Args:
        kind: Their kind.
        indices: Name to dataclass.

    Returns:
        One row each.
    """
    return table(kind, indices.values(), name=list(indices))


def _cells(name: str, value: Any) -> dict[str, Any]:
    if isinstance(value, Estimate):
        low, high = ends(name)
        interval = value.ci95 or (None, None)
        return {name: _number(value.value), low: _number(interval[0]), high: _number(interval[1])}
    if name == "ci95":
        interval = value or (None, None)
        return {"low": _number(interval[0]), "high": _number(interval[1])}
    if isinstance(value, tuple):
        words = cast("tuple[Any, ...]", value)
        return {name: " ".join(words)} if all(isinstance(one, str) for one in words) else {}
    if is_dataclass(value) or isinstance(value, dict):
        return {}
    return {name: value}


def _columns(kind: type[Any]) -> list[str]:
    plain = [
        field.name
        for field in fields(kind)
        if not str(field.type).startswith(("tuple", "dict", "Estimate"))
    ]
    estimates = [field.name for field in fields(kind) if field.type == "Estimate"]
    return [*plain, *(column for name in estimates for column in (name, *ends(name)))]


def _number(value: float | None) -> float:
    return float("nan") if value is None else value
