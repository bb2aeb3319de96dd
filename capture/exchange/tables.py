"""Tables and arrays of other tools, as blocks of named columns.

A column that holds vectors, be it an array of two dimensions, a list in a cell or ``[0.1, 0.2]`` in
a text, stands for one column an element: ``positions[0]``, ``positions[1]``. A long table, a row a
joint, stands for the wide one: ``angle[joint01]``. A table without a header has ``column1`` on.
"""

from __future__ import annotations

import csv
import io
import json
import math
import re
import zipfile
import zlib
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias, cast

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from ..common.errors import ImportFormatError, LogError, MissingExtraError
from .torch_zip import MOST_BYTES, UNZIPPING, read_entry, read_tensors, refuse

Block: TypeAlias = dict[str, NDArray[Any]]
"""Column to its cells, (n,): numbers, or texts where they are none."""

TABLE_SUFFIXES = (".csv", ".tsv", ".txt", ".npz", ".mat", ".parquet", ".pt", ".pth")
ARRAY_SUFFIXES = TABLE_SUFFIXES[3:]

_ROWS, _CELLS = 16384, 1 << 20  # most of a block
_WIDEST = 4096
_COMPRESSED, _PIECE = 15, 1 << 16  # of .mat
_NPY_HEADER = 1 << 17  # bytes
_NARROW = 64  # rows that show how wide a table is
_MANY_ROWS = 1 << 22
_ROWS_A_BYTE = 4
_MANY_CELLS, _CELLS_A_BYTE = 1 << 25, 16
_SPARSE_CELLS, _SPARSEST = 1 << 24, 128
_JOINT_COLUMNS = ("joint", "joint_name", "jointname", "motor", "servo", "name", "motor_id", "id")
_SNIFFED = 1 << 16


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
    readers = {".npz": _npz, ".mat": _mat}
    arrays = readers.get(suffix, read_tensors)(path)
    return _of_arrays(path, arrays, suffix.removeprefix("."))


def _of_arrays(path: Path, arrays: Mapping[str, NDArray[Any]], form: str) -> TableFile:
    """Take the arrays as columns whose first axis is the longest common one."""
    plain = {name: np.squeeze(each) for name, each in arrays.items() if each.dtype.kind in "fiub"}
    plain = {name: each for name, each in plain.items() if each.ndim in {1, 2} and each.size > 1}
    if not plain:
        raise ImportFormatError(path, "holds no arrays of numbers with one or two dimensions")
    vectors = [each.shape[0] for each in plain.values() if each.ndim == 1]
    lengths = [max(each.shape) for each in plain.values()]
    rows = max(vectors or lengths, key=lambda n: (lengths.count(n), n))
    check_rows(path, rows)
    columns: Block = {}
    for name, each in plain.items():
        upright = each.T if each.ndim == 2 and each.shape[0] != rows else each
        if upright.shape[0] != rows or math.prod(upright.shape[1:]) > _WIDEST:
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


def _npz(path: Path) -> dict[str, NDArray[Any]]:
    try:
        with zipfile.ZipFile(path) as archive:
            size = sum(info.file_size for info in archive.infolist())
            if size > MOST_BYTES:
                refuse(path, f"holds {size} bytes of arrays; {MOST_BYTES} at most")
            check_cells(path, size // 8)
            return {
                info.filename.removesuffix(".npy"): array
                for info in archive.infolist()
                if (array := _npy(read_entry(archive, info), info.filename)) is not None
            }
    except ImportFormatError:
        raise
    except (OSError, ValueError, RuntimeError, *UNZIPPING) as error:
        raise ImportFormatError(path, f"can't be read as .npz: {error}") from error


def _npy(data: bytearray, name: str) -> NDArray[Any] | None:
    """Return one array, None for objects: those would be unpickled."""
    stream = io.BytesIO(memoryview(data)[:_NPY_HEADER])
    try:
        version = np.lib.format.read_magic(stream)
        header = np.lib.format.read_array_header_1_0 if version == (1, 0) else None
        shape, fortran, dtype = (header or np.lib.format.read_array_header_2_0)(stream)
    except Exception as error:  # it is a Python expression: its parser's errors have many bases
        raise ValueError(f"{name} has no valid header: {error}") from error
    if dtype.hasobject:
        return None
    count = math.prod(shape)
    if min(shape, default=0) < 0 or count * dtype.itemsize > len(data) - stream.tell():
        raise ValueError(f"{name} declares shape {shape}, more than it holds")
    flat = np.frombuffer(data, dtype, count, stream.tell()) if count else np.zeros(0, dtype)
    return flat.reshape(shape, order="F" if fortran else "C")


def _mat(path: Path) -> dict[str, NDArray[Any]]:
    from scipy.io import loadmat, whosmat

    try:
        with path.open("rb") as stream:
            start = stream.read(128)
        if start.startswith((b"MATLAB 7.3", b"\x89HDF")):
            refuse(path, "is a .mat of version 7.3 (HDF5), which is not supported; save with -v7")
        _check_mat(path)
        listed = whosmat(path)
        size = sum(8 * math.prod(shape) for _, shape, _ in listed)
        if size > MOST_BYTES:
            refuse(path, f"declares {size} bytes of arrays; {MOST_BYTES} at most")
        check_cells(path, size // 8)
        numeric = ("double", "single", "logical", "int", "uint")
        names = [name for name, _, kind in listed if kind.startswith(numeric)]
        found = loadmat(path, variable_names=names) if names else {}
    except ImportFormatError:
        raise
    except Exception as error:  # scipy raises whatever a damaged file leads to
        raise ImportFormatError(path, f"can't be read as .mat: {error}") from error
    return {name: found[name] for name in names if isinstance(found.get(name), np.ndarray)}


def _check_mat(path: Path) -> None:
    """Refuse a file of which an element expands too far; what the elements declare may be less.

    Layout: MAT-File Format, "Level 5 MAT-Files": tags of type and size [byte], and zlib streams.
    """
    left = MOST_BYTES
    with path.open("rb") as stream:
        order = "little" if stream.read(128)[126:128] == b"IM" else "big"
        while len(tag := stream.read(8)) == 8:
            kind, size = (int.from_bytes(part, order) for part in (tag[:4], tag[4:]))
            if kind != _COMPRESSED:
                stream.seek(size, io.SEEK_CUR)
                continue
            packed, end = zlib.decompressobj(), stream.tell() + size
            while left > 0 and not packed.eof and (some := stream.read(min(_PIECE, size))):
                size -= len(some)
                while left > 0 and some:
                    left -= len(packed.decompress(some, _PIECE))
                    some = packed.unconsumed_tail
            if left <= 0:
                refuse(path, f"expands to more than {MOST_BYTES} bytes")
            stream.seek(end)


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
    path: Path,
    columns: Sequence[str] | None,
    rows: int,
    holds: Callable[[Any], bool] = lambda _: True,
) -> Iterator[Any]:
    """Yield the rows of some columns, so many at a time, as record batches.

    Args:
        columns: Their names; all of them if None.
        holds: Whether a row group, by its metadata, is to be read.

    Raises:
        ImportFormatError: If the file is damaged, has no such column, has one twice, or packs far
            more rows or numbers than a recording has.
        MissingExtraError: If pyarrow is not installed.
    """
    parquet = arrow("a .parquet table")
    try:
        with parquet.ParquetFile(path) as file:
            names = Counter(cast("list[str]", file.schema_arrow.names))
            for name in names if columns is None else columns:
                if names[name] != 1:
                    refuse(
                        path, f"has {names[name] or 'no'} column{'s' * (names[name] > 1)} {name!r}"
                    )
            metadata = file.metadata
            check_rows(path, metadata.num_rows)
            groups = [k for k in range(metadata.num_row_groups) if holds(metadata.row_group(k))]
            for group in groups:
                columns_of = map(metadata.row_group(group).column, range(metadata.num_columns))
                check_cells(path, sum(column.num_values for column in columns_of))
            yield from file.iter_batches(batch_size=rows, row_groups=groups, columns=columns)
    except LogError:
        raise
    except Exception as error:  # pyarrow has errors of many bases
        raise ImportFormatError(path, f"can't be read as Parquet: {error}") from error


def _open_parquet(path: Path) -> TableFile:
    first = next(read_parquet(path, None, _NARROW), None)
    if first is None or not len(first):
        refuse(path, "has no rows")
    columns = tuple(_parquet_block(first))
    if len(columns) > _WIDEST:
        refuse(path, f"has {len(columns)} columns; {_WIDEST} at most")
    present = set(first.schema.names)

    def read(names: Sequence[str], time: str) -> Iterator[Block]:  # noqa: ARG001
        chosen = [n if n in present else re.sub(r"\[\d+\]$", "", n) for n in names]
        batches = read_parquet(path, list(dict.fromkeys(chosen)), rows_of_block(len(columns)))
        for batch in batches:
            block = _parquet_block(batch)
            if absent := [name for name in names if name not in block]:
                refuse(path, f"has rows without {absent[0]}")
            yield {name: block[name] for name in names}

    table = TableFile(path, columns, read, form="parquet")
    return _pivoted(table) or table


def _parquet_block(batch: Any) -> Block:
    block: Block = {}
    for name, column in zip(batch.schema.names, batch.columns, strict=True):
        kind = str(column.type)
        if kind.startswith(_LISTS):
            block |= _spread(name, vectors_of(column))
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
    if flat.dtype.kind not in "fiub" or not rows or not 1 <= lengths[0] <= _WIDEST:
        return np.zeros((rows, 0))
    if not np.all(lengths == lengths[0]):
        return np.zeros((rows, 0))
    return flat.reshape(rows, -1)


def _spread(name: str, vectors: NDArray[Any]) -> Block:
    return {f"{name}[{i}]": vectors[:, i] for i in range(vectors.shape[1])}


def _open_text(path: Path) -> TableFile:
    try:
        with path.open(encoding="utf-8-sig", newline="") as stream:
            head = stream.read(_SNIFFED)
    except (OSError, UnicodeDecodeError) as error:
        raise ImportFormatError(path, f"can't be read: {error}") from error
    lines = head.splitlines()
    lines = lines[:-1] if len(head) == _SNIFFED and len(lines) > 1 else lines
    skipped = next((i for i, line in enumerate(lines) if line.strip(" \t#%")), len(lines))
    delimiter, rows = _sniffed(path, [line for line in lines[skipped : skipped + 50] if line])
    first = [cell.strip(" #%\t") for cell in rows[0]]
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
        each
        for name in raw
        for each in ([f"{name}[{i}]" for i in range(vectors[name])] if name in vectors else [name])
    )
    if len(columns) > _WIDEST:
        refuse(path, f"has {len(columns)} columns; {_WIDEST} at most")
    read = partial(_read_text, path, raw, vectors, delimiter, decimal, skipped)
    table = TableFile(path, columns, read, delimiter, "headerless" if headerless else "wide")
    return _pivoted(table) or table


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
            if len(rows[0]) > _WIDEST:
                raise ImportFormatError(path, f"has {len(rows[0])} columns; {_WIDEST} at most")
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
    wanted = [name for name in raw if name in names or f"{name}[0]" in names]
    texts = {name: str for name in (*vectors, time) if name in wanted}
    step = rows_of_block(len(raw) + sum(vectors.values()))
    try:
        with pd.read_csv(  # pyright: ignore[reportCallIssue, reportUnknownMemberType]
            path, sep=r"\s+" if delimiter == " " else delimiter, decimal=decimal, names=raw,
            header=None, skiprows=skipped, usecols=wanted, dtype=cast("Any", texts),
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
        block |= _spread(name, rows)
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
    if not 1 <= len(names) < min(_WIDEST, max(2, len(sample[joint]) // 2 + 1)):
        return None
    values = [name for name in table.columns if name != joint and sample[name].dtype.kind in "fiub"]
    time = next((n for n in values if is_time(n)), None)
    values = [name for name in values if name != time]
    if time is None or not values:
        return None

    def read(wanted: Sequence[str], exact: str) -> Iterator[Block]:  # noqa: ARG001
        present = [value for value in values if any(n.startswith(f"{value}[") for n in wanted)]
        blocks = list(table.read([time, joint, *present], ""))
        yield from _wide(table.path, blocks, (time, joint, *present), wanted)

    seen: dict[str, None] = {}
    for block in table.read([joint], ""):
        seen |= dict.fromkeys(map(str, block[joint].tolist()))
        if len(seen) * len(values) > _WIDEST:
            return None
    order = sorted(seen, key=lambda n: (names.index(n) if n in names else len(names), n))
    columns = (time, *(f"{value}[{name}]" for value in values for name in order))
    return TableFile(table.path, columns, read, table.delimiter, "long")


def _wide(
    path: Path, blocks: list[Block], columns: Sequence[str], wanted: Sequence[str]
) -> Iterator[Block]:
    """Put the rows of one time side by side; the table is held whole, in order of time.

    Args:
        columns: Of the times, of the joints, and of the values.
        wanted: The columns to yield.
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
            known = mine[~np.isnan(numbers[mine].astype(float))]
            dense[row[known] - at, codes[known]] = numbers[known]
            block |= {f"{value}[{name}]": dense[:, i] for i, name in enumerate(names)}
        yield {name: block[name] for name in wanted}


_TIMES = ("time", "timestamp", "stamp", "t", "secs", "seconds", "epoch", "ts", "datetime")


def words(name: str) -> list[str]:
    """Return the words of a column's name in lower case: ``des_dofPos`` is des, dof, pos."""
    apart = re.sub(r"([a-z])([A-Z])", r"\1 \2", name)
    return re.findall(r"[a-z]+", apart.lower())


def is_time(name: str) -> bool:
    """Return whether a column is named as times are."""
    found = words(re.sub(r"[\[(].*", "", name))
    return bool(found) and found[0] in _TIMES
