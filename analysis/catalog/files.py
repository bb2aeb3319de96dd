"""The files of a catalogue: listed, checked, written, put together.

They lie in the folder :data:`.sources.FOLDER`, one folder a kind of row (:data:`.rows.SCHEMAS` and
``sources``). None is ever changed: a file adds rows, or replaces other files, which its metadata
names. The names carry checksums; a file is compared with its checksum before anything else reads
it, once in each process.
"""

from __future__ import annotations

import fcntl
import json
import time
import uuid
from collections.abc import Callable, Generator, Mapping
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path, PurePosixPath
from typing import Any, TypeVar, cast

import pyarrow as pa
import pyarrow.parquet as pq

from undulog.capture.common.errors import DamagedFileError, InputFileError
from undulog.capture.common.object_store import ObjectStore, checksum_in

from .rows import SCHEMAS, Row, connect, put_together, table_of
from .sources import FOLDER, Scanned

_ARROW: Any = pa  # comes without types
_PARQUET: Any = pq
_Value = TypeVar("_Value")

_MOST_FILES = 64
"""Parquet files of a kind from which on they are put into one,"""
_MOST_ROWS = 50_000
"""and their rows."""
_ATTEMPTS = 10
"""How often files are listed anew because another process put them together meanwhile."""
_CURE = "; a scan of the catalogue sets it aside and reads the sessions again"

_SOURCES: Any = _ARROW.schema(
    [
        ("source", _ARROW.string()),
        ("size", _ARROW.int64()),
        ("modified_ns", _ARROW.int64()),
        ("scanned_ns", _ARROW.int64()),
        ("removed", _ARROW.bool_()),
        ("fault", _ARROW.string()),
        ("version", _ARROW.int64()),
    ]
)
_SCANNED = "source", "size", "modified_ns", "scanned_ns", "removed"
_KINDS: Mapping[str, Any] = {**SCHEMAS, "sources": _SOURCES}
_BASE, _NEW = "all-", "rows-"


def settled(read: Callable[[], _Value]) -> _Value:
    """Call a function again where a file vanished meanwhile: another process put it into one."""
    for _ in range(_ATTEMPTS - 1):
        try:
            return read()
        except OSError as error:
            if not any(isinstance(e, FileNotFoundError) for e in (error, error.__cause__)):
                raise
    return read()


class CatalogFiles:
    """The Parquet files of a catalogue."""

    def __init__(self, store: ObjectStore) -> None:
        """Connect; nothing is read."""
        self._store = store
        self._whole = set[str]()
        self._damaged: dict[str, str] = {}

    def find_damaged(self) -> dict[str, str]:
        """Check all files; return the name of each damaged one and what is wrong with it.

        From then on these are passed over, until :meth:`set_damaged_aside`.

        Raises:
            InputFileError: If a file can't be read for another reason, such as its permissions.
        """
        return settled(self._find_damaged)

    def _find_damaged(self) -> dict[str, str]:
        damaged: dict[str, str] = {}
        for kind in _KINDS:
            folder = f"{FOLDER}/{kind}"
            damaged |= dict.fromkeys(self._store.not_files(folder, ".parquet"), "is no file")
            for file in self._store.files(folder, [".parquet"]):
                try:
                    self._check(kind, file.name)
                except DamagedFileError as error:
                    damaged[file.name] = str(error).removeprefix(f"{error.path}: ")
        self._damaged = damaged
        return damaged

    def set_damaged_aside(self) -> list[str]:
        """Move damaged files to the folder ``damaged`` of the catalogue; return a text on each.

        Raises:
            LogWriteError: If one can't be moved.
        """
        goals = {n: self._store.set_aside(n, f"{FOLDER}/damaged") for n in self._damaged}
        done = [
            f"{self._store.where}/{name}: {why}; moved to {goals[name]}"
            for name, why in self._damaged.items()
            if goals[name]  # another process did it before
        ]
        self._damaged = {}
        return done

    def scanned(self) -> tuple[dict[str, Scanned], dict[str, int | None]]:
        """Return the sources that were read and are there, and the version that read each."""
        latest: dict[str, tuple[int, int, int, bool, int | None]] = {}
        for name in self.names("sources"):
            table = self._store.read_table(name).to_pydict()
            columns = [table[key] for key in _SCANNED]
            columns.append(table.get("version", [None] * len(columns[0])))
            for source, size, modified, scanned, removed, version in zip(*columns, strict=True):
                if source not in latest or latest[source][2] < scanned:
                    latest[source] = size, modified, scanned, removed, version
        there = {name: facts for name, facts in latest.items() if not facts[3]}
        versions = {name: facts[4] for name, facts in there.items()}
        return {name: facts[:3] for name, facts in there.items()}, versions

    def mentioned(self) -> dict[str, int]:
        """Return every source that any row names, removed ones too, and its latest scan [ns]."""
        latest: dict[str, int] = {}
        for kind in _KINDS:
            column = "path" if kind == "sessions" else "source"
            for name in self.names(kind):
                rows = self._store.read_table(name, [column, "scanned_ns"]).to_pydict()
                for source, scanned in zip(rows[column], rows["scanned_ns"], strict=True):
                    if source is not None:
                        latest[source] = max(latest.get(source, 0), scanned or 0)
        return latest

    def names(self, kind: str) -> list[str]:
        """Return the files of a kind, without those that another one replaces.

        Raises:
            DamagedFileError: If one is damaged that :meth:`find_damaged` hasn't returned.
        """
        folder = f"{FOLDER}/{kind}"
        for name in self._store.not_files(folder, ".parquet"):
            if name not in self._damaged:
                raise DamagedFileError(f"{self._store.where}/{name}", f"is no file{_CURE}")
        names = [file.name for file in self._store.files(folder, [".parquet"])]
        names = [name for name in names if name not in self._damaged]
        for name in names:
            if self._store.is_local:  # others are checked when they are read
                self._check(kind, name)
        replaced: set[str] = set()
        for name in names:
            if _is_base(name):
                replaced.update(json.loads(self._schema(name).metadata[b"replaces"]))
        return [name for name in names if name not in replaced]

    def write(self, kind: str, rows: list[Row]) -> None:
        """Add rows of a kind.

        Raises:
            LogWriteError: If they can't be written.
        """
        self._write(kind, _table(kind, rows), _NEW)

    def _write(self, kind: str, table: Any, prefix: str) -> None:
        if not table.num_rows:
            return
        self._store.make_folders(f"{FOLDER}/{kind}")
        stem = f"{FOLDER}/{kind}/{prefix}{time.time_ns()}-{uuid.uuid4().hex[:8]}"
        self._whole.add(self._store.write_table(stem, table))

    def database(self, *, bounded: bool = False) -> AbstractContextManager[Any]:
        """Open the rows in DuckDB; see :func:`.rows.connect`."""
        base: dict[str, list[str]] = {}
        new: dict[str, list[str]] = {}
        for kind in SCHEMAS:
            names = self.names(kind)
            base[kind] = [name for name in names if _is_base(name)][-1:]
            new[kind] = [name for name in names if name not in base[kind]]
        return connect(self._store, base, new, bounded=bounded)

    def put_together(self) -> None:
        """Put many small files into one; on an object store they stay as they are.

        Raises:
            InputFileError: If the lock of the catalogue can't be opened.
            LogWriteError: If a file can't be written or removed.
        """
        if not self._store.is_local:
            return
        kinds = [kind for kind in _KINDS if settled(lambda kind=kind: self._is_scattered(kind))]
        if not kinds:
            return
        with _lock(Path(self._store.path(f"{FOLDER}/lock"))) as locked:
            if not locked:
                return
            for kind in kinds:
                names = self.names(kind)
                if kind == "sources":
                    tables = [self._store.read_table(name) for name in names]
                    table = _ARROW.concat_tables(tables, promote_options="default")
                else:
                    with self.database() as database:
                        table = put_together(database, kind)
                facts = {b"replaces": json.dumps(names).encode()}
                self._write(kind, table.replace_schema_metadata(facts), _BASE)
                for name in names:
                    self._store.remove(name)

    def _is_scattered(self, kind: str) -> bool:
        """Whether a kind has many small files, or one of an earlier version, without checksum."""
        names = self.names(kind)
        new = [name for name in names if not _is_base(name)]
        if len(new) >= _MOST_FILES or any(checksum_in(name) is None for name in names):
            return True
        rows = [_PARQUET.read_metadata(self._store.path(name)).num_rows for name in new]
        return sum(rows) >= _MOST_ROWS

    def _check(self, kind: str, name: str) -> None:
        if name in self._whole:
            return
        path = f"{self._store.where}/{name}"
        try:
            self._store.check_parquet(name)
        except DamagedFileError as error:
            raise DamagedFileError(path, str(error).removeprefix(f"{path}: ") + _CURE) from error
        if why := _foreign(_KINDS[kind], self._schema(name), is_base=_is_base(name)):
            raise DamagedFileError(path, why + _CURE)
        self._whole.add(name)

    def _schema(self, name: str) -> Any:
        return _PARQUET.read_schema(self._store.path(name), filesystem=self._store.filesystem)


def _table(kind: str, rows: list[Row]) -> Any:
    return _ARROW.Table.from_pylist(rows, _SOURCES) if kind == "sources" else table_of(kind, rows)


def _is_base(name: str) -> bool:
    return PurePosixPath(name).name.startswith(_BASE)


def _foreign(expected: Any, schema: Any, *, is_base: bool) -> str:
    """Return why a file is none of a kind, or an empty text; an earlier version has fewer columns.

    Args:
        expected: Schema of the kind.
    """
    needed = (expected.names[0], "scanned_ns", "removed")
    if lacking := [name for name in needed if name not in schema.names]:
        return f"holds no rows of its kind: no columns {lacking}"
    types = {field.name: field.type for field in schema}
    for field in expected:
        if types.get(field.name, field.type) not in (field.type, _ARROW.null()):
            return f"holds no rows of its kind: {field.name} is {types[field.name]}"
    if not is_base:
        return ""
    try:
        metadata = cast("dict[bytes, bytes]", schema.metadata or {})
        replaces: object = json.loads(metadata[b"replaces"])
    except (KeyError, ValueError, RecursionError):
        replaces = None
    return "" if isinstance(replaces, list) else "does not name the files that it replaces"


@contextmanager
def _lock(path: Path) -> Generator[bool]:
    """Hold a lock file; False where another process holds it."""
    try:
        lock = path.open("w")
    except OSError as error:
        raise InputFileError(path, f"can't be opened: {error.strerror}; remove it") from error
    with lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            yield False
            return
        yield True
