"""Parquet files of other tools as blocks of columns, read by pyarrow in a child process.

A column of lists of numbers of one length is an array of two dimensions, (n, m); texts and whatever
else is no number are objects: text, number or None.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from ..common.confined import Confined
from ..common.confined_child import Send
from ..common.errors import ImportFormatError, raised_as
from ..common.packets import Packet, is_plain
from .column_blocks import WIDEST, Block, arrow, check_rows, refuse, spread

_TEXT_A_ROW, _LEAST_TEXT = 1024, 1 << 16
"""Characters of a column of texts on average and of a short one; a name or a time has fewer."""

_MOST_TEXT = 1 << 24
"""Characters of the texts of a block."""

_LONGEST_OTHER = 100
"""Characters kept of a cell that is neither number nor text: it is only reported."""

_LISTS = ("list", "fixed_size_list", "large_list")


class ParquetReader:
    """Reads Parquet files, one after the other, in one child process."""

    def __init__(self) -> None:
        """Start nothing yet."""
        self._confined = Confined(ImportFormatError)

    def blocks(
        self,
        path: Path,
        columns: Sequence[str] | None,
        rows: int,
        *,
        where: tuple[str, int] | None = None,
        most: int | None = None,
    ) -> Iterator[Block]:
        """Yield the rows of some columns, so many at a time; none without rows.

        Args:
            columns: Their names; all of them if None, but those of long texts.
            where: A column and the number that rows have in it; other row groups aren't read.
            most: Number of blocks; all of them if None.

        Raises:
            ImportFormatError: If the file is damaged, has no such column, has one twice, packs far
                more rows than a recording has, or takes too much memory or time to read.
            MissingExtraError: If pyarrow is not installed.
        """
        asked = None if columns is None else list(columns)
        parser = f"{__name__}:parse"
        for packet in self._confined.stream(
            parser, path, columns=asked, rows=rows, where=where, most=most
        ):
            texts = packet.facts["texts"]
            yield {
                name: packet.arrays[name] if name in packet.arrays else _objects(texts[name])
                for name in packet.facts["names"]
            }


def _objects(cells: Sequence[object]) -> NDArray[Any]:
    column = np.empty(len(cells), dtype=object)
    column[:] = cells
    return column


def flat(block: Block) -> Block:
    """Return a block whose vectors stand for one column an element."""
    columns: Block = {}
    for name, cells in block.items():
        columns |= spread(name, cells) if cells.ndim == 2 else {name: cells}
    return columns


def vectors_of(cells: NDArray[Any]) -> NDArray[Any]:
    """Return a column of vectors as (n, m), of numbers as (n, 1), of anything else as (n, 0)."""
    if cells.ndim == 2:
        return cells
    return cells[:, None] if cells.dtype.kind in "fiub" else np.zeros((len(cells), 0))


def parse(
    path: Path,
    send: Send,
    *,
    columns: list[str] | None,
    rows: int,
    where: tuple[str, int] | None,
    most: int | None,
) -> None:
    """Send the blocks of a file; runs in the child process.

    The metadata of columns is left to pyarrow: read from Python, what a damaged file says there
    ends the process.
    """
    sent = 0
    # pyarrow has errors of many bases
    with raised_as(ImportFormatError, path, "can't be read as Parquet", Exception):
        for batch in _batches(path, columns, rows, where):
            if len(batch):
                send(_packet(path, batch, some=columns is None))
                sent += 1
            if sent == most:
                break


def _batches(
    path: Path, columns: list[str] | None, rows: int, where: tuple[str, int] | None
) -> Iterator[Any]:
    parquet = arrow("a .parquet table")
    with parquet.ParquetFile(path, pre_buffer=False) as file:
        names = Counter(cast("list[str]", file.schema_arrow.names))
        if columns is None and len(names) > WIDEST:
            refuse(path, f"has {len(names)} columns; {WIDEST} at most")
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


def _packet(path: Path, batch: Any, *, some: bool) -> Packet:
    """Return a record batch; ``some``: leave out columns of long texts."""
    arrays: Block = {}
    texts: dict[str, list[object]] = {}
    left = _MOST_TEXT
    for name, column in zip(batch.schema.names, batch.columns, strict=True):
        size = _text_size(column)
        if size > min(left, max(_LEAST_TEXT, _TEXT_A_ROW * len(column))):
            if some:
                continue
            refuse(path, f"has {size} characters in {len(column)} cells of column {name!r}")
        cells = _cells(column)
        if is_plain(cells):
            arrays[name] = cells
        else:
            texts[name] = [_value(cell) for cell in cells]
            left -= size
    names = [name for name in batch.schema.names if name in arrays or name in texts]
    return Packet({"names": names, "texts": texts}, arrays)


def _text_size(column: Any) -> int:
    """Return the bytes of the texts of a column, each where it stands; 0 for other columns."""
    lib: Any = import_module("pyarrow")
    compute: Any = import_module("pyarrow.compute")
    texts = column.dictionary if lib.types.is_dictionary(column.type) else column
    kind = texts.type
    if not (
        lib.types.is_string(kind) or lib.types.is_large_string(kind)
        or lib.types.is_binary(kind) or lib.types.is_large_binary(kind)
    ):  # fmt: skip
        return 0
    sizes = compute.binary_length(texts)
    if texts is not column:
        sizes = sizes.take(column.indices)
    return compute.sum(sizes).as_py() or 0


def _cells(column: Any) -> NDArray[Any]:
    kind = str(column.type)
    if kind.startswith(_LISTS):
        return _vectors(column)
    if kind.startswith("timestamp"):
        column = column.cast("timestamp[ns]").cast("int64")
    return column.to_numpy(zero_copy_only=False)


def _vectors(column: Any) -> NDArray[Any]:
    """Return a column of lists as (n, m); as (n, 0) if they are no numbers or of other lengths."""
    types: Any = import_module("pyarrow").types
    none = np.zeros((len(column), 0))
    kind = column.type.value_type
    if not (types.is_integer(kind) or types.is_floating(kind) or types.is_boolean(kind)):
        return none
    lengths = column.value_lengths().to_numpy(zero_copy_only=False)  # NaN for a null
    if not len(lengths) or not 1 <= lengths[0] <= WIDEST or not np.all(lengths == lengths[0]):
        return none
    numbers = column.flatten().to_numpy(zero_copy_only=False)
    return numbers.reshape(len(column), -1) if numbers.dtype.kind in "fiub" else none


def _value(cell: Any) -> object:
    """Return a cell as a value of JSON, which converts to the same number and text."""
    if cell is None or isinstance(cell, str | bool | int | float):
        return cell
    return str(cell)[:_LONGEST_OTHER]
