"""The rows of a sweep: Parquet files in a folder, or under a URL of an object store.

A store holds::

    rows/*.parquet       finished runs, each once; `pandas.read_parquet("DIR/rows")` reads all
    pending/KEY-*.json   rows that are not in a Parquet file yet
    settings/*.json      what the rows of a setting share: scenario, robot, versions
    sessions/KEY.mcap    sessions, where the plan keeps them
    damaged/*.damaged    files of rows that were found damaged, never read

A finished run is written at once, as one small JSON object, so that a coordinator that is killed
loses nothing; every :data:`GATHER` of them are put into one Parquet file. The names of both carry a
checksum (:mod:`undulog.capture.common.object_store`), so a changed byte is found; files of earlier
versions have none and are read as far as they can be.
"""

from __future__ import annotations

import fcntl
import json
import shutil
import time
import uuid
from collections.abc import Generator, Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path, PurePosixPath
from typing import Any, cast

import pyarrow as pa
import pyarrow.fs as pafs

from undulog.capture.common.errors import (
    DamagedFileError,
    InputFileError,
    LogWriteError,
    UsageError,
)
from undulog.capture.common.object_store import ObjectStore
from undulog.capture.common.untrusted_text import read_json

_ARROW: Any = pa  # comes without types
_FS: Any = pafs
_TEXT: Any = _ARROW.string()

GATHER = 256
"""Rows of one Parquet file."""

_FACTS = ("key", "status", "session")
"""Columns that every row has."""
_KEY_DIGITS = 32
"""Characters of a key, with which the name of a pending row begins."""
_CURE = "; the sweep's own command sets such files aside and makes their runs again"

_INTEGERS = ("seed", "joints")
_TEXTS = (
    "key",
    "setting",
    "changes",
    "status",
    "error",
    "session",
    "session_id",
    "verdict",
    "answer",
    "sentence",
    "worker",
)
_LISTS_OF_TEXTS = ("joint", "warnings")

Row = dict[str, Any]


class RowStore:
    """Rows under a folder or a URL such as ``s3://bucket/sweep``.

    Attributes:
        damaged: Name of each damaged file that :meth:`facts` came upon to what is wrong with it.
    """

    def __init__(self, where: str) -> None:
        """Open a store.

        Raises:
            InputFileError: If the address is none, or can't be reached.
        """
        self.where = where
        self.damaged: dict[str, str] = {}
        self._store = ObjectStore(where)
        self._pending = 0
        self._has_doubles = False

    @contextmanager
    def writing(self) -> Generator[None]:
        """Make the folders of a store, and lock it where it is a folder of this computer.

        Raises:
            InputFileError: If it can't be written.
            UsageError: If another sweep writes there.
        """
        with ExitStack() as stack:
            self._store.make_folders("pending", "rows", "settings", "sessions")
            try:
                if self._store.is_local:
                    lock = stack.enter_context((Path(self._store.base) / "lock").open("w"))
                    fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError as error:
                raise UsageError(f"{self.where}: another sweep is writing there") from error
            except OSError as error:
                raise InputFileError(self.where, str(error)) from error
            yield

    def facts(self) -> dict[str, Row]:
        """Return the key of each row that can be read, with its columns status and session.

        Every file is read whole and compared with its checksum. Files with faults are left out, and
        listed in :attr:`damaged`.

        Raises:
            InputFileError: If a file can't be read for another reason, such as its permissions.
        """
        self.damaged = {
            name: "is no file"
            for folder, ending in (("pending", ".json"), ("rows", ".parquet"))
            for name in self._store.not_files(folder, ending)
        }
        pending = [row for name in self._pending_files() for row in self._or_damaged(name)]
        self._pending = len(pending)
        there = {row["key"]: {name: row.get(name, "") for name in _FACTS} for row in pending}
        gathered = set[str]()
        for name in self._row_files():
            for row in self._or_damaged(name):
                self._has_doubles |= row["key"] in gathered
                gathered.add(row["key"])
                there[row["key"]] = row
        return there

    def set_damaged_aside(self) -> list[str]:
        """Move the files that :meth:`facts` found damaged to the folder ``damaged``.

        Returns:
            What was wrong with each and where it is now, one text each.

        Raises:
            LogWriteError: If one can't be moved.
        """
        done = [
            f"{self.where}/{name}: {why}; moved to {self._store.set_aside(name, 'damaged')}"
            for name, why in self.damaged.items()
        ]
        self.damaged = {}
        return done

    def settle(self, digest: str, setting: Mapping[str, Any]) -> None:
        """Store what the rows of a setting share.

        Raises:
            LogWriteError: If it can't be written.
        """
        self._store.write(f"settings/{digest}.json", json.dumps(setting, indent=1).encode())

    def add(self, row: Row) -> None:
        """Store a row; the process may be killed when this returns.

        Raises:
            LogWriteError: If it can't be written.
        """
        self._store.write_checked(f"pending/{row['key']}", ".json", json.dumps(row).encode())
        self._pending += 1
        if self._pending >= GATHER:
            self.gather()

    def gather(self) -> None:
        """Put all rows that lie one by one into one Parquet file.

        Damaged files stay where they are, for :meth:`facts` to find.

        Raises:
            LogWriteError: If it can't be written.
        """
        pending = {name: row for name in self._pending_files() for row in self._or_damaged(name)}
        last = self._row_files()[-1:] if pending else []
        gathered = {row["key"] for name in last for row in self._or_damaged(name)}
        rows = {row["key"]: row for row in pending.values() if row["key"] not in gathered}
        if rows:
            self._store.write_table(_new_name(), _arrow(list(rows.values())))
        for name in pending:
            self._store.remove(name)
        self._pending = 0

    def drop(self, keys: Iterable[str]) -> None:
        """Remove rows that are to be run again, and those that are in two files in one of them.

        Raises:
            DamagedFileError: If a file is damaged.
            LogWriteError: If it can't be written.
        """
        unwanted = set(keys)
        if not (unwanted or self._has_doubles):
            return
        self.gather()
        for name in reversed(self._row_files()):  # of equal rows the newest stay
            table = self._table(name)
            listed = table.column("key").to_pylist()
            keep = [key not in unwanted for key in listed]
            unwanted.update(listed)
            if all(keep):
                continue
            if any(keep):
                self._store.write_table(_new_name(), table.filter(_ARROW.array(keep)))
            self._store.remove(name)
        self._has_doubles = False

    def rows(self) -> Iterator[Row]:
        """Yield every row once, in no order.

        Raises:
            DamagedFileError: If a file is damaged.
        """
        seen = set[str]()
        tables = (self._table(name).to_pylist() for name in self._row_files())
        for rows in (map(self._pending_row, self._pending_files()), *tables):
            for row in rows:
                if row["key"] not in seen:
                    seen.add(row["key"])
                    yield row

    def keep_session(self, path: Path) -> str:
        """Move a finished session into the store; return its name there.

        Raises:
            LogWriteError: If it can't be written.
        """
        name = f"sessions/{path.name}"
        goal = self._store.path(name)
        try:
            if self._store.is_local:
                shutil.move(path, f"{goal}.part")
                Path(f"{goal}.part").replace(goal)
            else:
                _FS.copy_files(path.as_posix(), goal, _FS.LocalFileSystem(), self._store.filesystem)
        except OSError as error:
            raise LogWriteError(f"{self.where}/{name}", str(error)) from error
        return name

    def _row_files(self) -> list[str]:
        return [file.name for file in self._store.files("rows", [".parquet"])]

    def _pending_files(self) -> list[str]:
        return [file.name for file in self._store.files("pending", [".json"])]

    def _or_damaged(self, name: str) -> list[Row]:
        """Return the facts of the rows of a file; note a damaged one, which has none."""
        try:
            if name.endswith(".json"):
                return [self._pending_row(name)]
            return self._table(name, _FACTS).to_pylist()
        except DamagedFileError as error:
            self.damaged[name] = str(error).removeprefix(f"{error.path}: ").removesuffix(_CURE)
            return []

    def _table(self, name: str, columns: tuple[str, ...] | None = None) -> Any:
        """Read a file of rows."""
        path = f"{self.where}/{name}"
        with _with_cure(path):
            table = self._store.read_table(name, columns)
        texts = [f.name for f in table.schema if f.type in (_TEXT, _ARROW.large_string())]
        if lacking := [column for column in _FACTS if column not in texts]:
            raise DamagedFileError(path, f"holds no rows of a sweep: no texts {lacking}{_CURE}")
        if table.column("key").null_count:
            raise DamagedFileError(path, f"has rows without a key{_CURE}")
        return table

    def _pending_row(self, name: str) -> Row:
        path = f"{self.where}/{name}"
        with _with_cure(path):
            data = self._store.read(name)
        try:
            row: object = read_json(data)
        except ValueError as error:
            raise DamagedFileError(path, f"is no JSON: {error}{_CURE}") from error
        key = PurePosixPath(name).stem[:_KEY_DIGITS]
        if not isinstance(row, dict) or cast("Row", row).get("key") != key:
            raise DamagedFileError(path, f"does not hold the row {key}{_CURE}")
        return cast("Row", row)


@contextmanager
def _with_cure(path: str) -> Generator[None]:
    try:
        yield
    except DamagedFileError as error:
        raise DamagedFileError(path, str(error).removeprefix(f"{path}: ") + _CURE) from error


def _new_name() -> str:
    """Name a new file of rows, up to its checksum; names are in the order of time."""
    return f"rows/{time.time_ns()}-{uuid.uuid4().hex[:8]}"


def _arrow(rows: list[Row]) -> Any:
    """Return rows as a table; each column has the type of its name, whatever its values are."""
    names = dict.fromkeys(name for row in rows for name in row)
    columns: dict[str, Any] = {}
    for name in names:
        values = [row.get(name) for row in rows]
        kind = _type(name, values)
        try:
            columns[name] = _texts(values) if kind == _TEXT else _ARROW.array(values, type=kind)
        except (_ARROW.ArrowException, OverflowError):  # lists beside numbers
            columns[name] = _texts(values)
    return _ARROW.table(columns)


def _texts(values: list[Any]) -> Any:
    texts = [v if v is None or isinstance(v, str) else json.dumps(v) for v in values]
    return _ARROW.array(texts, type=_TEXT)


def _type(name: str, values: list[Any]) -> Any:
    given = [value for value in values if value is not None]
    if name in _TEXTS or any(isinstance(value, str) for value in given):
        return _TEXT
    if name in _LISTS_OF_TEXTS:
        return _ARROW.list_(_TEXT)
    if any(isinstance(value, list) for value in given):
        return _ARROW.list_(_ARROW.float64())
    if name in _INTEGERS:
        return _ARROW.int64()
    if given and all(isinstance(value, bool) for value in given):
        return _ARROW.bool_()
    return _ARROW.float64()
