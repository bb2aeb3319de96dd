"""A table of another tool, as blocks of named columns.

A column that holds vectors, be it an array of two dimensions, a list in a cell or ``[0.1, 0.2]`` in
a text, stands for one column an element: ``positions[0]``, ``positions[1]``. A long table, a row a
joint, stands for the wide one: ``angle[joint01]``. A table without a header has ``column1`` on.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..common.errors import ImportFormatError
from .column_blocks import WIDEST, Block, refuse, rows_of_block

_SPARSE_CELLS, _SPARSEST = 1 << 24, 128
_JOINT_COLUMNS = ("joint", "joint_name", "jointname", "motor", "servo", "name", "motor_id", "id")

_LONG_FORMS = ("wide", "parquet")
"""Kinds of tables that may be long ones; arrays have no texts."""

_TIMES = ("time", "timestamp", "stamp", "t", "secs", "seconds", "epoch", "ts", "datetime")


@dataclass(frozen=True)
class TableFile:
    """One table.

    Attributes:
        columns: Its columns, vectors taken apart.
        read: Yields the blocks of the columns named; times, named second, keep their text where
            the file has one.
        delimiter: What stands between the cells of a text.
        form: ``wide``, ``long`` or ``headerless``, or the kind of file.
        left_out: Arrays of the file that are no columns.
        row: Returns the number of a row in the file, counted from 1, by its place in the table,
            counted from 0; None where a row of the table is none of the file.
    """

    path: Path
    columns: tuple[str, ...]
    read: Callable[[Sequence[str], str], Iterator[Block]]
    delimiter: str = ","
    form: str = "wide"
    left_out: tuple[str, ...] = ()
    row: Callable[[int], int] | None = None

    def sample(self) -> Block:
        """Return the first block of all columns."""
        first = next(iter(self.read(self.columns, "")), None)
        if first is None or not len(next(iter(first.values()), ())):
            raise ImportFormatError(self.path, "has no rows")
        return first


def as_wide(table: TableFile) -> TableFile | None:
    """Return a long table, whose rows each name their joint, as a wide one; None if it is none."""
    if table.form not in _LONG_FORMS:
        return None
    by_name = {name.lower(): name for name in table.columns}
    joint = next((by_name[name] for name in _JOINT_COLUMNS if name in by_name), None)
    if joint is None or len(table.columns) < 3:
        return None
    sample = table.sample()
    names = list(dict.fromkeys(map(str, sample[joint].tolist())))
    if not 1 <= len(names) < min(WIDEST, max(2, len(sample[joint]) // 2 + 1)):
        return None
    values = [name for name in table.columns if name != joint and sample[name].dtype.kind in "fiub"]
    time = next((n for n in values if is_time(n)), None)
    values = [name for name in values if name != time]
    if time is None or not values:
        return None

    def read(requested: Sequence[str], exact: str) -> Iterator[Block]:  # noqa: ARG001
        present = [value for value in values if any(n.startswith(f"{value}[") for n in requested)]
        blocks = list(table.read([time, joint, *present], ""))
        yield from _wide(table.path, blocks, (time, joint, *present), requested)

    seen: dict[str, None] = {}
    for block in table.read([joint], ""):
        seen |= dict.fromkeys(map(str, block[joint].tolist()))
        if len(seen) * len(values) > WIDEST:
            return None
    order = sorted(seen, key=lambda n: (names.index(n) if n in names else len(names), n))
    columns = (time, *(f"{value}[{name}]" for value in values for name in order))
    return TableFile(table.path, columns, read, table.delimiter, "long")


def _wide(
    path: Path, blocks: list[Block], columns: Sequence[str], requested: Sequence[str]
) -> Iterator[Block]:
    """Put the rows of one time side by side; the table is held whole, in order of time.

    Args:
        columns: Of the times, of the joints, and of the values.
        requested: The columns to yield.
    """
    import pandas as pd

    t, who, *cells = (np.concatenate([block[name] for block in blocks]) for name in columns)
    stamps, row = np.unique(t, return_inverse=True)
    codes, names = pd.factorize(np.array(list(map(str, who.tolist())), dtype=object))
    if len(stamps) * len(names) > max(_SPARSE_CELLS, _SPARSEST * len(t)):
        refuse(path, f"names {len(names)} joints that seldom share a time; is {columns[1]!r} one?")
    order = np.argsort(row, kind="stable")
    step = rows_of_block(len(cells) * len(names))
    ends = np.searchsorted(row[order], np.arange(0, len(stamps) + step, step))
    for k, at in enumerate(range(0, len(stamps), step)):
        mine = order[ends[k] : ends[k + 1]]
        block: Block = {columns[0]: stamps[at : at + step]}
        for value, numbers in zip(columns[2:], cells, strict=True):
            dense = np.full((len(block[columns[0]]), len(names)), np.nan)
            present = mine[~np.isnan(numbers[mine].astype(float))]
            dense[row[present] - at, codes[present]] = numbers[present]
            block |= {f"{value}[{name}]": dense[:, i] for i, name in enumerate(names)}
        yield {name: block[name] for name in requested}


def words(name: str) -> list[str]:
    """Return the words of a column's name in lower case: ``des_dofPos`` is des, dof, pos."""
    apart = re.sub(r"([a-z])([A-Z])", r"\1 \2", name)
    return re.findall(r"[a-z]+", apart.lower())


def is_time(name: str) -> bool:
    """Return whether a column is named as times are."""
    parts = words(re.sub(r"[\[(].*", "", name))
    return bool(parts) and parts[0] in _TIMES
