"""Parquet, by pyarrow (the extra ``parquet``)."""

from __future__ import annotations

import re
from collections.abc import Generator, Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from ..column_blocks import WIDEST, Block, WriteCells, arrow, refuse, rows_of_block
from ..parquet_blocks import ParquetReader, flat
from ..table_file import TableFile
from ..table_format import TableReader, TableWriter
from .format import Format

_NARROW = 64
"""Rows that show how wide a table is."""


def _sniff(head: bytes, path: Path) -> float:  # noqa: ARG001 - as all formats have it
    return float(head.startswith(b"PAR1"))


def _read(path: Path) -> TableFile:
    reader = ParquetReader()
    first = next(iter(list(reader.blocks(path, None, _NARROW, most=1))), None)
    if first is None:
        refuse(path, "has no rows")
    columns = tuple(flat(first))
    if len(columns) > WIDEST:
        refuse(path, f"has {len(columns)} columns; {WIDEST} at most")

    def read(names: Sequence[str], time: str) -> Iterator[Block]:  # noqa: ARG001
        chosen = [n if n in first else re.sub(r"\[\d+\]$", "", n) for n in names]
        rows = rows_of_block(len(columns))
        for vectors in reader.blocks(path, list(dict.fromkeys(chosen)), rows):
            block = flat(vectors)
            if absent := [name for name in names if name not in block]:
                refuse(path, f"has rows without {absent[0]}")
            yield {name: block[name] for name in names}

    return TableFile(path, columns, read, form="parquet")


@contextmanager
def _write(path: Path, columns: Mapping[str, str]) -> Generator[WriteCells]:
    """Create a file: texts are dictionaries of strings, a masked number is null."""
    parquet = arrow("a .parquet table")
    pa: Any = import_module("pyarrow")  # its types are incomplete
    kinds = {"int64": pa.int64(), "float64": pa.float64()}
    kinds["text"] = pa.dictionary(pa.int32(), pa.string())
    schema = pa.schema([(name, kinds[kind]) for name, kind in columns.items()])

    def array(cells: Any, kind: str) -> Any:
        if kind == "text":
            return pa.array(cells, pa.string()).dictionary_encode()
        mask = np.ma.getmaskarray(cells) if np.ma.isMaskedArray(cells) else None
        return pa.array(np.ma.getdata(cells), mask=mask, from_pandas=False)

    with parquet.ParquetWriter(path, schema) as writer:

        def write(cells: Sequence[Any]) -> None:
            arrays = list(map(array, cells, columns.values()))
            writer.write_table(pa.Table.from_arrays(arrays, schema=schema))

        yield write


FORMAT = Format(
    "parquet", "Parquet", (".parquet",), _sniff, TableReader(_read), TableWriter(_write),
)  # fmt: skip
