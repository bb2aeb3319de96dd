"""Parquet files as blocks of named columns; a column of vectors stands for one an element."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from ..common.errors import ImportFormatError, LogError, MissingExtraError
from .packing import WIDEST, Block, check_rows, refuse, spread


def arrow(what: str) -> Any:
    """Return pyarrow.parquet; its types are incomplete.

    Raises:
        MissingExtraError: If it is not installed.
    """
    try:
        from pyarrow import parquet
    except ImportError as error:
        raise MissingExtraError(what, "parquet", "pyarrow") from error
    return parquet


def _datasets() -> Any:
    """Return pyarrow.dataset; its types are incomplete."""
    from pyarrow import dataset

    return dataset


def read_parquet(
    path: Path, columns: Sequence[str] | None, rows: int, where: tuple[str, int] | None = None
) -> Iterator[Any]:
    """Yield the rows of some columns, so many at a time, as record batches.

    The metadata of columns is left to pyarrow: read from Python, what a damaged file says there
    ends the process.

    Args:
        columns: Their names; all of them if None.
        where: A column and the number that rows have in it; other row groups aren't read.

    Raises:
        ImportFormatError: If the file is damaged, has no such column, has one twice, or packs far
            more rows than a recording has.
        MissingExtraError: If pyarrow is not installed.
    """
    parquet = arrow("a .parquet table")
    try:
        with parquet.ParquetFile(path) as file:
            names = Counter(cast("list[str]", file.schema_arrow.names))
            for name in names if columns is None else columns:
                if names[name] != 1:
                    refuse(path, f"has {names[name] or 'no'} columns {name!r}")
            check_rows(path, file.metadata.num_rows)
            if where is None:
                yield from file.iter_batches(batch_size=rows, columns=columns)
                return
        dataset = _datasets()
        yield from dataset.dataset(path, format="parquet").to_batches(
            columns=columns, filter=dataset.field(where[0]) == where[1],
            batch_size=rows, batch_readahead=1, fragment_readahead=1,
        )  # fmt: skip
    except LogError:
        raise
    except Exception as error:  # pyarrow has errors of many bases
        raise ImportFormatError(path, f"can't be read as Parquet: {error}") from error


def block_of(batch: Any) -> Block:
    """Return the columns of a record batch."""
    block: Block = {}
    for name, column in zip(batch.schema.names, batch.columns, strict=True):
        kind = str(column.type)
        if kind.startswith(_LISTS):
            block |= spread(name, vectors_of(column))
        elif kind.startswith("timestamp"):
            block[name] = column.cast("timestamp[ns]").cast("int64").to_numpy(zero_copy_only=False)
        else:
            block[name] = column.to_numpy(zero_copy_only=False)
    return block


_LISTS = ("list", "fixed_size_list", "large_list")


def vectors_of(column: Any) -> NDArray[Any]:
    """Return a column of lists as (n, m), of numbers as (n, 1), of anything else as (n, 0)."""
    rows, lengths = len(column), np.ones(len(column))
    if str(column.type).startswith(_LISTS):
        lengths = column.value_lengths().to_numpy(zero_copy_only=False)  # NaN for a null
        column = column.flatten()
    flat = column.to_numpy(zero_copy_only=False)
    if flat.dtype.kind not in "fiub" or not rows or not 1 <= lengths[0] <= WIDEST:
        return np.zeros((rows, 0))
    if not np.all(lengths == lengths[0]):
        return np.zeros((rows, 0))
    return flat.reshape(rows, -1)
