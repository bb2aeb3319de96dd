"""The table of formats, and the choice of one for a file that is read or written."""

from __future__ import annotations

import gzip
import zlib
from collections.abc import Generator
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from pkgutil import iter_modules
from typing import TYPE_CHECKING

from ...common.errors import DataError, ImportFormatError, UndulogError, UsageError, raised_as
from ...common.files import is_file, why_no_file
from ...common.looks import has_signature, looks_like
from ...common.strict_table import listed
from ..formats.format import Format, Reader, Writer
from ..packed import format_suffix, is_packed
from ..table_format import TableReader, TableWriter, WideTableWriter
from .added import added_formats
from .table_folder import table_folder

if TYPE_CHECKING:
    from ..table_file import TableFile

_FOLDER = "undulog.capture.exchange.formats"

_FIRST = (
    *("candump", "blf", "asc", "can_msgs", "trc", "can_db", "mf4", "csv_table", "can_csv"),
    *("parquet", "npz", "mat", "torch_tensors", "rosbag", "lerobot", "tum", "foxglove"),
)
"""Of formats that fit a file alike the first of these is taken, then others by their names."""


WIDE = "wide"
"""What ``--to`` names for a table with a column for each joint and quantity."""

_SURE, _LEAST = 0.5, 0.01
"""A file of another suffix is of a format that fits it so well at least, and a folder."""

_HEAD = 1 << 16
"""Bytes of a file that are looked at."""

_GZIP = b"\x1f\x8b"


def _listed() -> tuple[Format, ...]:
    """Return the formats of this package, each from its file or folder."""
    modules = {
        entry.name: import_module(f"{_FOLDER}.{entry.name}{'.format' if entry.ispkg else ''}")
        for entry in iter_modules(import_module(_FOLDER).__path__)
        if entry.name != "format"  # what a format is
    }
    ranks = {name: rank for rank, name in enumerate(_FIRST)}
    names = sorted(modules, key=lambda name: (ranks.get(name, len(_FIRST)), name))
    return tuple(modules[name].FORMAT for name in names)


FORMATS = _listed()
"""The formats of this package."""


def formats() -> tuple[Format, ...]:
    """Return all formats: of this package, of others, and folders of tables.

    Raises:
        UsageError: If a format of another package can't be used.
    """
    taken = (*(form.name for form in FORMATS), WIDE)
    return (*FORMATS, *added_formats(taken), table_folder(_is_table, open_table))


def format_of(path: Path) -> tuple[Format, Reader]:
    """Return the format of a log, by its suffix and its first bytes, and what reads it.

    Among formats of its suffix the one that fits best is taken. A file that none of them fits is
    of another format if that fits well; else the format of its suffix reports what is wrong.

    Raises:
        ImportFormatError: If there is no such file, or it is of none of the formats: the error
            names what it looks like.
        UsageError: If a format of another package can't be used.
    """
    if not path.is_dir() and not is_file(path):
        raise ImportFormatError(path, why_no_file(path))
    head, packed = _head(path), is_packed(path)
    fits = [
        (form, form.read, _fit(form, head, path)) for form in formats() if form.read is not None
    ]
    named = [
        entry
        for entry in fits
        if format_suffix(path) in entry[0].suffixes and (entry[0].packed or not packed)
    ]
    by_name = max(named, key=lambda entry: entry[2], default=None)
    by_look = max(fits, key=lambda entry: entry[2])
    if by_name is not None and by_name[2]:
        return by_name[:2]
    if by_look[2] >= (_SURE if head else _LEAST):
        if by_look[0].packed or not packed:
            return by_look[:2]
    elif by_name is not None and not has_signature(head):
        return by_name[:2]
    raise ImportFormatError(path, _unknown(head, path, [form for form, *_ in fits]))


@contextmanager
def guarded(form: Format, path: Path) -> Generator[None]:
    """Turn a failure of a format of another package into an error that names both.

    Args:
        path: What it reads or writes.

    Raises:
        DataError: If it raises what is no error of this tree.
    """
    try:
        yield
    except (UndulogError, OSError, MemoryError):
        raise
    except Exception as error:
        if form in FORMATS:
            raise
        raise DataError(
            f"{path}: the format {form.name!r} failed: {type(error).__name__}: {error}; correct or "
            "remove it"
        ) from error


def _fit(form: Format, head: bytes, path: Path) -> float:
    with guarded(form, path):
        return float(form.sniff(head, path))


def _unknown(head: bytes, path: Path, readable: list[Format]) -> str:
    valid = ", ".join(dict.fromkeys(suffix for form in readable for suffix in form.suffixes))
    inside, unpack = "", ""
    if is_packed(path) and not head.startswith(_GZIP):
        inside, unpack = "is compressed by gzip; inside it ", "unpack it or "
    return (
        f"is of no format that can be imported: it {inside}{looks_like(head)}; {unpack}export it "
        f"as one of {valid}"
    )


def _head(path: Path) -> bytes:
    """Return the first bytes of a file, those behind ``.gz`` where it is what its name says.

    Raises:
        ImportFormatError: If it can't be read.
    """
    if path.is_dir():
        return b""
    with (
        raised_as(ImportFormatError, path, "can't be read", OSError),
        path.open("rb") as stream,
    ):
        head = stream.read(_HEAD)
    if not is_packed(path):
        return head
    try:
        with gzip.open(path, "rb") as stream:
            return stream.read(_HEAD)
    except (OSError, EOFError, zlib.error):
        return head


def _is_table(path: Path) -> bool:
    suffix = path.suffix.lower()
    return any(isinstance(form.read, TableReader) and suffix in form.suffixes for form in formats())


def open_table(path: Path) -> TableFile:
    """Open a file as a table.

    Raises:
        ImportFormatError: If it is none, or damaged.
        MissingExtraError: If a package that reads it is not installed.
    """
    form, reader = format_of(path)
    if not isinstance(reader, TableReader):
        raise ImportFormatError(path, f"is no table: it {reader.holds} ({form.title})")
    with guarded(form, path):
        return reader.open(path)


def format_for(output: Path, to: str | None = None) -> tuple[str, Format, Writer]:
    """Return how an output is named in messages, its format, and what writes it.

    Args:
        to: Name of the format, where the suffix doesn't select it.

    Raises:
        UsageError: If there is none of this suffix or name, or a format of another package can't
            be used.
    """
    suffix = output.suffix.lower()
    writers = [(form, form.write) for form in formats() if form.write is not None]
    by_suffix = {form.suffixes[0]: (form, writer) for form, writer in writers if writer.by_suffix}
    by_name = {form.name: (form, writer) for form, writer in writers if not writer.by_suffix}
    if to == WIDE:
        tables = {
            key: (form, w) for key, (form, w) in by_suffix.items() if isinstance(w, TableWriter)
        }
        if suffix not in tables:
            valid = ", ".join(tables)
            raise UsageError(f"{output}: no wide table has the suffix {suffix!r}; valid: {valid}")
        form, writer = tables[suffix]
        return f"--to {to}", form, WideTableWriter(writer)
    if to in by_name:
        return f"--to {to}", *by_name[to]
    if to is None and suffix in by_suffix:
        return f"a {suffix} file", *by_suffix[suffix]
    if to is not None:
        valid = listed([WIDE, *by_name], to)
        raise UsageError(f"--to {to}: no format has this name; valid: {valid}")
    valid = f"{', '.join(by_suffix)}, or --to {', '.join([WIDE, *by_name])}"
    raise UsageError(f"{output}: no format has the suffix {suffix!r}; valid: {valid}")
