"""Tables and arrays of other tools, as blocks of named columns.

A column that holds vectors, be it an array of two dimensions, a list in a cell or ``[0.1, 0.2]`` in
a text, stands for one column an element: ``positions[0]``, ``positions[1]``. A long table, a row a
joint, stands for the wide one: ``angle[joint01]``. A table without a header has ``column1`` on.
"""

from __future__ import annotations

import csv
import json
import math
import re
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from functools import partial
from pathlib import Path
from typing import Any, TextIO, cast

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from ..common.errors import ImportFormatError, raised_as
from ..common.files import check_regular
from ..common.strict_table import listed
from .array_files import read_arrays
from .column_blocks import WIDEST, Block, check_rows, refuse, rows_of_block, spread
from .parquet_blocks import ParquetReader, flat

TABLE_SUFFIXES = (".csv", ".tsv", ".txt", ".npz", ".mat", ".parquet", ".pt", ".pth")
ARRAY_SUFFIXES = TABLE_SUFFIXES[3:]

_NARROW = 64  # rows that show how wide a table is
_SPARSE_CELLS, _SPARSEST = 1 << 24, 128
_JOINT_COLUMNS = ("joint", "joint_name", "jointname", "motor", "servo", "name", "motor_id", "id")
_SNIFFED = 1 << 16
_TRACKS = "scorer"
"""First cell of a file of DeepLabCut."""

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
    """

    path: Path
    columns: tuple[str, ...]
    read: Callable[[Sequence[str], str], Iterator[Block]]
    delimiter: str = ","
    form: str = "wide"
    left_out: tuple[str, ...] = ()

    def sample(self) -> Block:
        """Return the first block of all columns."""
        first = next(iter(self.read(self.columns, "")), None)
        if first is None or not len(next(iter(first.values()), ())):
            raise ImportFormatError(self.path, "has no rows")
        return first


def open_table(path: Path) -> TableFile:
    """Open a table by its suffix.

    Raises:
        ImportFormatError: If it is none, or damaged.
        MissingExtraError: If pyarrow is needed and not installed.
    """
    suffix = path.suffix.lower()
    if suffix == ".parquet":
        return _open_parquet(path)
    if suffix not in ARRAY_SUFFIXES:
        return _open_text(path)
    return _of_arrays(path, read_arrays(path), suffix.removeprefix("."))


def open_csv(path: Path, time: str, columns: Sequence[str], delimiter: str) -> TableFile:
    """Open a CSV file with a header whose columns are known; a fault names row and column.

    Args:
        time: Column of the times, which stay exact and don't go back.
        columns: The columns of numbers; an empty cell has none.

    Raises:
        ImportFormatError: If it can't be read, or a column is not there once.
    """
    with _rows(path, delimiter) as rows:
        header = [name.strip() for name in next(rows, list[str]())]
    for name in (time, *columns):
        if header.count(name) != 1:
            actual = f"{header.count(name)} columns" if name in header else "no column"
            raise ImportFormatError(path, f"has {actual} {name!r}; it has {listed(header, name)}")
    return TableFile(path, (time, *columns), partial(_read_csv, path, header, delimiter), delimiter)


@contextmanager
def _rows(path: Path, delimiter: str) -> Generator[Iterator[list[str]]]:
    with _text(path) as stream:
        yield csv.reader(stream, delimiter=delimiter, skipinitialspace=True)


@contextmanager
def _text(path: Path) -> Generator[TextIO]:
    caught = (OSError, UnicodeDecodeError, csv.Error)
    with raised_as(ImportFormatError, path, "can't be read", *caught):
        check_regular(path)
        with path.open(encoding="utf-8-sig", newline="") as stream:
            yield stream


def _read_csv(
    path: Path, header: Sequence[str], delimiter: str, names: Sequence[str], time: str
) -> Iterator[Block]:
    before: Decimal | None = None
    places = [header.index(name) for name in names]
    step = rows_of_block(len(names))
    cells: dict[str, list[Any]] = {name: [] for name in names}
    with _rows(path, delimiter) as rows:
        for line, row in enumerate(rows, 1):
            if line == 1 or not row:
                continue
            if len(row) != len(header):
                refuse(path, f"row {line} has {len(row)} cells, the header {len(header)}")
            for name, place in zip(names, places, strict=True):
                try:
                    number = _exact(row[place], before) if name == time else _number(row[place])
                except ValueError as error:
                    raise ImportFormatError(
                        path, f"row {line}, column {name!r}: {error}"
                    ) from error
                cells[name].append(number)
            before = cells[time][-1]
            if len(cells[time]) == step:
                yield _block(cells, time)
                cells = {name: [] for name in names}
    if before is None:
        refuse(path, "has no rows below its header")
    if cells[time]:
        yield _block(cells, time)


def _block(cells: Mapping[str, list[Any]], time: str) -> Block:
    return {
        name: np.array(column, dtype=object if name == time else float)
        for name, column in cells.items()
    }


def _exact(cell: str, before: Decimal | None) -> Decimal:
    """Parse a time: a double can't hold Unix times to the ns."""
    try:
        decimal = Decimal(cell.strip())
    except InvalidOperation:
        decimal = Decimal("nan")
    if not decimal.is_finite():
        raise ValueError(f"{cell!r} is not a time")
    if before is not None and decimal < before:
        raise ValueError(f"time goes back, from {before:g}")
    return decimal


def _number(cell: str) -> float:
    if not cell or cell.isspace():
        return math.nan
    try:
        number = float(cell)
    except ValueError as error:
        raise ValueError(f"{cell!r} is not a number") from error
    if math.isinf(number):
        raise ValueError(f"{cell!r} is not a finite number")
    return number


def _of_arrays(path: Path, arrays: Mapping[str, NDArray[Any]], form: str) -> TableFile:
    """Take the arrays as columns whose first axis is the longest common one."""
    plain = {
        name: np.squeeze(array) for name, array in arrays.items() if array.dtype.kind in "fiub"
    }
    plain = {
        name: array for name, array in plain.items() if array.ndim in {1, 2} and array.size > 1
    }
    if not plain:
        raise ImportFormatError(path, "holds no arrays of numbers with one or two dimensions")
    vectors = [array.shape[0] for array in plain.values() if array.ndim == 1]
    lengths = [max(array.shape) for array in plain.values()]
    rows = max(vectors or lengths, key=lambda n: (lengths.count(n), n))
    check_rows(path, rows)
    columns: Block = {}
    for name, column in plain.items():
        upright = column.T if column.ndim == 2 and column.shape[0] != rows else column
        if upright.shape[0] != rows or math.prod(upright.shape[1:]) > WIDEST:
            continue
        if upright.ndim == 1:
            columns[name] = upright
        else:
            columns |= {f"{name}[{i}]": upright[:, i] for i in range(upright.shape[1])}

    def read(names: Sequence[str], time: str) -> Iterator[Block]:  # noqa: ARG001
        step = rows_of_block(len(names))
        for at in range(0, rows, step):
            yield {name: columns[name][at : at + step] for name in names}

    kept = {name.partition("[")[0] for name in columns}
    left_out = tuple(name for name in arrays if name not in kept)
    return TableFile(path, tuple(columns), read, form=form, left_out=left_out)


def _open_parquet(path: Path) -> TableFile:
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

    table = TableFile(path, columns, read, form="parquet")
    return _pivoted(table) or table


def _open_text(path: Path) -> TableFile:
    with _text(path) as stream:
        head = stream.read(_SNIFFED)
    lines = head.splitlines()
    lines = lines[:-1] if len(head) == _SNIFFED and len(lines) > 1 else lines
    skipped = next((i for i, line in enumerate(lines) if line.strip(" \t#%")), len(lines))
    delimiter, rows = _sniffed(path, [line for line in lines[skipped : skipped + 50] if line])
    first = [cell.strip(" #%\t") for cell in rows[0]]
    if first[0].lower() == _TRACKS and len(rows) > 2:
        first, lines_of_header = _track_names(rows), 3 + (rows[1][0].lower() == "individuals")
        skipped, rows = skipped + lines_of_header - 1, rows[lines_of_header - 1 :]
    headerless = all(_is_number(cell) for cell in first if cell)
    raw = [f"column{i + 1}" for i in range(len(first))] if headerless else first
    repeated = [name for name in raw if raw.count(name) > 1]
    if repeated or not all(raw):
        raise ImportFormatError(path, f"has several columns {(repeated or [''])[0]!r}")
    skipped += not headerless
    data = rows if headerless else rows[1:]
    decimal = "," if delimiter != "," and any("," in c and _decimal(c) for c in data[-1]) else "."
    vectors = {
        name: _width(path, cell)
        for name, cell in zip(raw, (data or [[]])[0], strict=False)
        if cell.strip().startswith(("[", "("))
    }
    columns = tuple(
        column
        for name in raw
        for column in (
            [f"{name}[{i}]" for i in range(vectors[name])] if name in vectors else [name]
        )
    )
    if len(columns) > WIDEST:
        refuse(path, f"has {len(columns)} columns; {WIDEST} at most")
    read = partial(_read_text, path, raw, vectors, delimiter, decimal, skipped)
    table = TableFile(path, columns, read, delimiter, "headerless" if headerless else "wide")
    return _pivoted(table) or table


def _track_names(rows: Sequence[Sequence[str]]) -> list[str]:
    """Return names of columns from the header of DeepLabCut: scorer, (individuals,) body parts."""
    parts = rows[1:4] if rows[1][0].lower() == "individuals" else rows[1:3]
    names = ("_".join(part[k].strip() for part in parts) for k in range(1, len(rows[0])))
    return ["frame", *names]


def _width(path: Path, cell: str) -> int:
    try:
        return len(_vector(cell))
    except ValueError as error:
        raise ImportFormatError(path, f"{cell[:40]!r} is no vector of numbers") from error


def _decimal(cell: str) -> bool:
    return re.fullmatch(r"\s*[-+]?\d*,\d+([eE][-+]?\d+)?\s*", cell) is not None


def _is_number(cell: str) -> bool:
    if cell.startswith(("[", "(")):
        return True
    try:
        float(cell.replace(",", "."))
    except ValueError:
        return False
    return True


def _sniffed(path: Path, lines: list[str]) -> tuple[str, list[list[str]]]:
    """Return the delimiter that cuts all lines alike, and their cells."""
    for delimiter in (";", "\t", ",", " "):
        try:
            if delimiter == " ":
                rows = [line.strip("# ").split() for line in lines]
            else:
                rows = list(csv.reader(lines, delimiter=delimiter, skipinitialspace=True))
        except csv.Error as error:
            raise ImportFormatError(path, f"is no table: {error}") from error
        if rows and len({len(row) for row in rows}) == 1 and len(rows[0]) > 1:
            if len(rows[0]) > WIDEST:
                raise ImportFormatError(path, f"has {len(rows[0])} columns; {WIDEST} at most")
            return delimiter, rows
    raise ImportFormatError(
        path, "is no table: no comma, semicolon, tab or space cuts its first lines alike"
    )


def _read_text(  # noqa: PLR0917 - bound once, where the file was sniffed
    path: Path,
    raw: list[str],
    vectors: Mapping[str, int],
    delimiter: str,
    decimal: str,
    skipped: int,
    names: Sequence[str],
    time: str,
) -> Iterator[Block]:
    selected = [name for name in raw if name in names or f"{name}[0]" in names]
    texts = {name: str for name in (*vectors, time) if name in selected}
    step = rows_of_block(len(raw) + sum(vectors.values()))
    try:
        with pd.read_csv(  # pyright: ignore[reportCallIssue, reportUnknownMemberType]
            path, sep=r"\s+" if delimiter == " " else delimiter, decimal=decimal, names=raw,
            header=None, skiprows=skipped, usecols=selected, dtype=cast("Any", texts),
            chunksize=step, skipinitialspace=True, encoding="utf-8-sig", index_col=False,
            low_memory=False, on_bad_lines="error",
        ) as chunks:  # fmt: skip
            for chunk in cast("Iterator[pd.DataFrame]", chunks):
                yield _text_block(path, chunk, vectors, skipped, names)
    except ImportFormatError:
        raise
    except (OSError, ValueError, pd.errors.ParserError, OverflowError) as error:
        raise ImportFormatError(path, f"can't be read: {str(error).strip()}") from error


def _text_block(
    path: Path, chunk: pd.DataFrame, vectors: Mapping[str, int], skipped: int, names: Sequence[str]
) -> Block:
    block: Block = {}
    for name in map(str, chunk.columns):
        if name not in vectors:
            block[name] = chunk[name].to_numpy()
            continue
        cells = chunk[name].tolist()
        try:
            rows = _vectors(cells, vectors[name])
        except (ValueError, TypeError) as error:
            row = int(chunk.index[0]) + skipped + 1
            raise ImportFormatError(
                path, f"column {name!r}, from row {row}: vectors of other lengths or no numbers"
            ) from error
        block |= spread(name, rows)
    return {name: block[name] for name in names}


def _vectors(cells: list[Any], width: int) -> NDArray[Any]:
    """Parse vectors in cells, all at once where they are JSON; an empty cell has no numbers."""
    if all(isinstance(cell, str) for cell in cells):
        try:
            rows = np.array(json.loads(f"[{','.join(cells)}]"), dtype=float)
            if rows.shape == (len(cells), width):
                return rows
        except (ValueError, RecursionError):
            pass
    rows = np.full((len(cells), width), np.nan)
    for i, cell in enumerate(cells):
        if isinstance(cell, str) and (numbers := _vector(cell)):
            rows[i] = numbers
    return rows


def _vector(cell: str) -> list[float]:
    return [float(word) for word in re.split(r"[,;\s]+", cell.strip(" []()")) if word]


def _pivoted(table: TableFile) -> TableFile | None:
    """Return a long table as a wide one: one whose rows each name their joint."""
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
