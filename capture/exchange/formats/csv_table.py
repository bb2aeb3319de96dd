"""CSV and other delimited text: any delimiter, with or without a header, decimal commas, vectors.

A column without a name is ``index`` if it is the first, as pandas writes one, else ``column3``.
"""

from __future__ import annotations

import csv
import json
import re
from collections.abc import Generator, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any, TextIO, cast

import numpy as np
from numpy.typing import NDArray

from ...common.errors import ImportFormatError, raised_as
from ...common.files import as_text, check_regular, csv_writer
from ..column_blocks import WIDEST, Block, WriteCells, refuse, rows_of_block, spread
from ..table_file import TableFile
from ..table_format import TableReader, TableWriter
from .format import Format

_SNIFFED, _FIRST_LINES = 1 << 16, 50
"""Characters, and lines of them, that show how a text is cut."""

_DELIMITERS = (";", "\t", ",", " ")

_TRACKS = "scorer"
"""First cell of a file of DeepLabCut."""

_LEAST_ROWS, _LEAST_NUMBERS = 2, 0.5
"""Of a text of another suffix: rows, and part of the columns that are numbers (by spaces: all)."""


@dataclass(frozen=True)
class _Layout:
    """How a text is cut into columns.

    Attributes:
        names: Of the columns, those of vectors once.
        vectors: Index of each column of vectors, and the length of these.
        skipped: Lines before the data.
    """

    names: tuple[str, ...]
    vectors: Mapping[int, int]
    delimiter: str
    decimal: str
    skipped: int

    def columns(self) -> tuple[str, ...]:
        """Return the columns, those of vectors an element each."""
        return tuple(
            column
            for i, name in enumerate(self.names)
            for column in (
                [f"{name}[{k}]" for k in range(self.vectors[i])] if i in self.vectors else [name]
            )
        )


def _sniff(head: bytes, path: Path) -> float:
    """Recognise lines that one delimiter cuts alike, with numbers below the first of them."""
    try:
        lines = head[: head.rfind(b"\n") + 1].decode("utf-8-sig").splitlines()
        delimiter, rows = _cut(path, _data_lines(lines)[:_FIRST_LINES])
    except (UnicodeDecodeError, ImportFormatError):
        return 0.0
    columns = zip(*rows[1:], strict=True)
    numeric = [all(_is_number(cell) for cell in column if cell) for column in columns]
    least = 1.0 if delimiter == " " else _LEAST_NUMBERS
    return 0.6 if len(rows) > _LEAST_ROWS and sum(numeric) >= least * len(rows[0]) else 0.0


@contextmanager
def _text(path: Path) -> Generator[TextIO]:
    caught = (OSError, UnicodeDecodeError, csv.Error)
    with raised_as(ImportFormatError, path, "can't be read", *caught):
        check_regular(path)
        with path.open(encoding="utf-8-sig", newline="") as stream:
            yield stream


def _read(path: Path) -> TableFile:
    with _text(path) as stream:
        head = stream.read(_SNIFFED)
    lines = head.splitlines()
    lines = lines[:-1] if len(head) == _SNIFFED and len(lines) > 1 else lines
    data = _data_lines(lines)
    skipped = len(lines) - len(data)
    delimiter, rows = _cut(path, [line for line in data[:_FIRST_LINES] if line])
    first = [cell.strip(" #%\t") for cell in rows[0]]
    if first[0].lower() == _TRACKS and len(rows) > 2:
        first, lines_of_header = _track_names(rows), 3 + (rows[1][0].lower() == "individuals")
        skipped, rows = skipped + lines_of_header - 1, rows[lines_of_header - 1 :]
    headerless = all(_is_number(cell) for cell in first if cell)
    names = [f"column{i + 1}" for i in range(len(first))]
    if not headerless:
        names = [name or (names[i] if i else "index") for i, name in enumerate(first)]
    rows = rows if headerless else rows[1:]
    decimals = delimiter != "," and any("," in c and _decimal(c) for c in (rows or [[]])[-1])
    vectors = {
        i: _width(path, cell)
        for i, cell in enumerate((rows or [[]])[0])
        if cell.strip().startswith(("[", "("))
    }
    layout = _Layout(
        tuple(names), vectors, delimiter, "," if decimals else ".", skipped + (not headerless)
    )
    columns = layout.columns()
    if len(columns) > WIDEST:
        refuse(path, f"has {len(columns)} columns; {WIDEST} at most")
    _check_rows(path, layout)
    read = partial(_blocks, path, layout if rows else None)
    form = "headerless" if headerless else "wide"
    return TableFile(path, columns, read, delimiter, form, row=partial(_row, path, layout))


def _data_lines(lines: list[str]) -> list[str]:
    """Return the lines from the first one that isn't empty, or a comment sign alone."""
    begin = next((i for i, line in enumerate(lines) if line.strip(" \t#%")), len(lines))
    return lines[begin:]


def _check_rows(path: Path, layout: _Layout) -> None:
    """Refuse a row that has more cells than the header; one with fewer lacks the last values."""
    if layout.delimiter == " ":
        return
    most = len(layout.names)
    with _text(path) as stream:
        for number, line in enumerate(stream, start=1):
            if line.count(layout.delimiter) >= most and '"' not in line and number > layout.skipped:
                cells = line.count(layout.delimiter) + 1
                refuse(path, f"row {number} has {cells} cells, the header {most}")


def _row(path: Path, layout: _Layout, place: int) -> int:
    """Return the number of the line that holds a row of the table."""
    with _text(path) as stream:
        filled = (
            number
            for number, line in enumerate(stream, start=1)
            if number > layout.skipped and line.strip()
        )
        return next(islice(filled, place, None), 0)


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


def _cut(path: Path, lines: list[str]) -> tuple[str, list[list[str]]]:
    """Return the delimiter that cuts all lines alike, and their cells.

    Raises:
        ImportFormatError: If none does; names the first row that differs where all are numbers.
    """
    if not lines:
        refuse(path, "is no table: it is empty")
    uneven: list[list[str]] = []
    for delimiter in _DELIMITERS:
        try:
            if delimiter == " ":
                rows = [line.strip("# ").split() for line in lines]
            else:
                rows = list(csv.reader(lines, delimiter=delimiter, skipinitialspace=True))
        except csv.Error as error:
            raise ImportFormatError(path, f"is no table: {error}") from error
        if len(rows[0]) < 2:
            continue
        if len({len(row) for row in rows}) == 1:
            if len(rows[0]) > WIDEST:
                raise ImportFormatError(path, f"has {len(rows[0])} columns; {WIDEST} at most")
            return delimiter, rows
        if delimiter != " " and all(_is_number(cell) for row in rows[1:] for cell in row if cell):
            uneven = uneven or rows
    for number, row in enumerate(uneven, start=1):
        if len(row) != len(uneven[0]):
            refuse(path, f"row {number} has {len(row)} cells, the header {len(uneven[0])}")
    raise ImportFormatError(
        path, "is no table: no comma, semicolon, tab or space cuts its first lines alike"
    )


def _blocks(path: Path, layout: _Layout | None, names: Sequence[str], time: str) -> Iterator[Block]:
    """Yield the rows of some columns; none if the text has a header alone."""
    if layout is None:
        return
    import pandas as pd

    order = {name: i for i, name in reversed(list(enumerate(layout.names)))}
    selected = sorted(i for name, i in order.items() if name in names or f"{name}[0]" in names)
    texts = {i: str for i in selected if i in layout.vectors or layout.names[i] == time}
    step = rows_of_block(len(layout.names) + sum(layout.vectors.values()))
    sep = r"\s+" if layout.delimiter == " " else layout.delimiter
    try:
        with pd.read_csv(  # pyright: ignore[reportCallIssue, reportUnknownMemberType]
            path, sep=sep, decimal=layout.decimal, names=list(range(len(layout.names))),
            header=None, skiprows=layout.skipped, usecols=selected, dtype=cast("Any", texts),
            chunksize=step, skipinitialspace=True, encoding="utf-8-sig", index_col=False,
            low_memory=False, on_bad_lines="error",
        ) as chunks:  # fmt: skip
            for chunk in cast("Iterator[pd.DataFrame]", chunks):
                cells = {int(i): chunk[i] for i in chunk.columns}
                block: Block = {}
                for i in selected:
                    if i in layout.vectors:
                        block |= _spread(path, layout, i, cells[i].tolist(), int(chunk.index[0]))
                    else:
                        block[layout.names[i]] = cells[i].to_numpy()
                yield {name: block[name] for name in names}
    except ImportFormatError:
        raise
    except (OSError, ValueError, pd.errors.ParserError, OverflowError) as error:
        raise ImportFormatError(path, f"can't be read: {str(error).strip()}") from error


def _spread(path: Path, layout: _Layout, index: int, cells: list[Any], begin: int) -> Block:
    """Return a column of vectors as a column an element."""
    name = layout.names[index]
    try:
        return spread(name, _vectors(cells, layout.vectors[index]))
    except (ValueError, TypeError) as error:
        row = begin + layout.skipped + 1
        raise ImportFormatError(
            path, f"column {name!r}, from row {row}: vectors of other lengths or no numbers"
        ) from error


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


@contextmanager
def _write(path: Path, columns: Mapping[str, str]) -> Generator[WriteCells]:
    """Create a file in UTF-8: all digits that a number needs, a masked one is an empty cell."""
    names = list(map(as_text, columns))
    with path.open("w", encoding="utf-8", newline="") as stream:
        csv_writer(stream, names).writerow(names)

        def write(cells: Sequence[NDArray[Any]]) -> None:
            lists: list[list[Any]] = [column.tolist() for column in cells]
            texts: dict[str, str] = {}
            for i, kind in enumerate(columns.values()):
                if kind == "text":
                    texts |= {text: as_text(text) for text in dict.fromkeys(lists[i])}
                    lists[i] = [texts[text] for text in lists[i]]
            csv_writer(stream, list(texts)).writerows(zip(*lists, strict=True))

        yield write


FORMAT = Format(
    "csv", "CSV and other delimited text", (".csv", ".tsv", ".txt"), _sniff,
    TableReader(_read), TableWriter(_write),
)  # fmt: skip
