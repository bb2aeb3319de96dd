"""Blocks of named columns, read from files with bounds on what these may expand to."""

from __future__ import annotations

import zipfile
import zlib
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any, NoReturn, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ..common.errors import ImportFormatError, MissingExtraError

Block: TypeAlias = dict[str, NDArray[Any]]
"""Column to its cells, (n,): numbers, or texts where they are none."""

WriteCells: TypeAlias = Callable[[Sequence[NDArray[Any]]], None]
"""Writes rows: an array a column, all of one length. A masked number has no value, NaN is one."""

OpenTable: TypeAlias = Callable[[Path, Mapping[str, str]], AbstractContextManager[WriteCells]]
"""Creates a file with columns of some names and kinds: ``int64``, ``float64`` or ``text``."""

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
        column.base is first.base is not None
        and (column.dtype, column.strides) == (first.dtype, (many * step,))
        and _address(column) == begin + k * step
        for k, column in enumerate(columns)
    ):
        return np.lib.stride_tricks.as_strided(
            first, (len(first), many), (many * step, step), writeable=False
        )
    single = all(column.dtype == np.float32 for column in columns)
    return np.stack(columns, axis=1, dtype=np.float32 if single else np.float64)


def with_gaps(values: NDArray[Any], missing: NDArray[Any]) -> NDArray[Any]:
    """Return numbers of which some are masked: there is no value, not even NaN."""
    return np.ma.array(values, mask=missing)  # pyright: ignore[reportUnknownMemberType]


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
