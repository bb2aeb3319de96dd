"""Blocks of named columns, read from files with bounds on what these may expand to.

Also those of Parquet files, where a column of vectors stands for one an element.
"""

from __future__ import annotations

import zipfile
import zlib
from collections import Counter
from collections.abc import Iterator, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any, NoReturn, TypeAlias, cast

import numpy as np
from numpy.typing import NDArray

from ..common.errors import ImportFormatError, MissingExtraError, raised_as

Block: TypeAlias = dict[str, NDArray[Any]]
"""Column to its cells, (n,): numbers, or texts where they are none."""

WIDEST = 4096
"""Most columns of a table."""

MOST_BYTES = 1 << 29
"""More bytes of numbers than this in a file of arrays are refused [B]: they are read at once."""

UNZIPPING = (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError)
"""Errors of a damaged zip, the last of a kind of compression that its header invents."""

_ROWS, _CELLS = 16384, 1 << 20  # most of a block
_MANY_ROWS = 1 << 22
_ROWS_A_BYTE = 4
_MANY_CELLS, _CELLS_A_BYTE = 1 << 25, 16
_PIECE = 1 << 20


def spread(name: str, vectors: NDArray[Any]) -> Block:
    """Return vectors, (n, m), as the columns ``name[0]`` to ``name[m - 1]``."""
    return {f"{name}[{i}]": vectors[:, i] for i in range(vectors.shape[1])}


def joined(columns: Sequence[NDArray[Any]]) -> NDArray[Any]:
    """Return columns of numbers, (n,) each, as one array, (n, m), of single or double precision.

    Columns that :func:`spread` made of one array are not copied; the result is not to be written.
    """
    first, many = columns[0], len(columns)
    step, begin = first.itemsize, _address(first)
    if str(first.dtype) in {"float32", "float64"} and all(
        each.base is first.base is not None
        and (each.dtype, each.strides) == (first.dtype, (many * step,))
        and _address(each) == begin + k * step
        for k, each in enumerate(columns)
    ):
        return np.lib.stride_tricks.as_strided(
            first, (len(first), many), (many * step, step), writeable=False
        )
    single = all(each.dtype == np.float32 for each in columns)
    return np.stack(columns, axis=1, dtype=np.float32 if single else np.float64)


def _address(array: NDArray[Any]) -> int:
    return array.__array_interface__["data"][0]


def refuse(path: Path, why: str) -> NoReturn:
    """Raise ImportFormatError."""
    raise ImportFormatError(path, why)


def rows_of_block(columns: int) -> int:
    """Return how many rows a block of so many columns has."""
    return max(1, min(_ROWS, _CELLS // max(1, columns)))


def check_rows(path: Path, rows: int) -> None:
    """Refuse a file that packs far more rows than a recording has.

    Raises:
        ImportFormatError: If it has millions of rows and hardly a bit for each.
    """
    size = path.stat().st_size
    if rows > max(_MANY_ROWS, _ROWS_A_BYTE * size):
        refuse(path, f"has {rows} rows in {size} bytes: so many equal rows are no recording")


def check_cells(path: Path, cells: int) -> None:
    """Refuse a file that packs far more numbers than a recording has into what is read at once.

    Raises:
        ImportFormatError: If there are millions, and hardly a bit for each.
    """
    size = path.stat().st_size
    if cells > max(_MANY_CELLS, _CELLS_A_BYTE * size):
        refuse(path, f"has {cells} numbers in {size} bytes: so many equal ones are no recording")


def read_entry(archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> bytearray:
    """Return the bytes of an entry, never more than its directory declares.

    Raises:
        ValueError: If it is packed by a method that has no bound on what it expands to.
    """
    if info.compress_type not in {zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED}:
        raise ValueError(f"{info.filename} is neither stored nor deflated")
    data, at = bytearray(info.file_size), 0
    with archive.open(info) as stream:  # without a size, a stream is expanded whole
        while piece := stream.read(min(_PIECE, len(data) - at)):
            data[at : at + len(piece)] = piece
            at += len(piece)
    if at < len(data):
        raise ValueError(f"{info.filename} has {at} bytes of {len(data)}")
    return data


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
    # pyarrow has errors of many bases
    with raised_as(ImportFormatError, path, "can't be read as Parquet", Exception):
        with parquet.ParquetFile(path) as file:
            names = Counter(cast("list[str]", file.schema_arrow.names))
            for name in names if columns is None else columns:
                if names[name] != 1:
                    refuse(path, f"has {names[name] or 'no'} columns {name!r}")
            check_rows(path, file.metadata.num_rows)
            if where is None:
                yield from file.iter_batches(batch_size=rows, columns=columns)
                return
        dataset: Any = import_module("pyarrow.dataset")  # its types are incomplete
        yield from dataset.dataset(path, format="parquet").to_batches(
            columns=columns, filter=dataset.field(where[0]) == where[1],
            batch_size=rows, batch_readahead=1, fragment_readahead=1,
        )  # fmt: skip


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
