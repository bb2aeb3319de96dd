"""The rows of a sweep: Parquet files in a folder, or under a URL of an object store.

A store holds::

    rows/*.parquet       finished runs, each once; `pandas.read_parquet("DIR/rows")` reads all
    pending/KEY.json     rows that are not in a Parquet file yet
    settings/*.json      what the rows of a setting share: scenario, robot, versions
    sessions/KEY.mcap    sessions, where the plan keeps them

A finished run is written at once, as one small JSON object, so that a coordinator that is killed
loses nothing; every :data:`GATHER` of them are put into one Parquet file.
"""

from __future__ import annotations

import fcntl
import json
import shutil
import time
import uuid
from collections.abc import Generator, Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, cast

import pyarrow as pa
import pyarrow.fs as pafs

from undulog.capture.common.errors import InputFileError, LogWriteError, UsageError
from undulog.capture.common.remote import ObjectStore

_ARROW: Any = pa  # comes without types
_FS: Any = pafs

GATHER = 256
"""Rows of one Parquet file."""

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
    """Rows under a folder or a URL such as ``s3://bucket/sweep``."""

    def __init__(self, where: str) -> None:
        """Open a store.

        Raises:
            InputFileError: If the address is none, or can't be reached.
        """
        self.where = where
        self._store = ObjectStore(where)
        self._pending = 0

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
        """Return the key of each row that is there, with its columns status and session.

        Raises:
            InputFileError: If a file of rows can't be read.
        """
        columns = ["key", "status", "session"]
        pending = list(self._pending_rows())
        self._pending = len(pending)
        rows = [{name: row.get(name, "") for name in columns} for row in pending]
        for path in self._row_files():
            rows += self._store.read_table(path, columns).to_pylist()
        return {row["key"]: row for row in rows}

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
        self._store.write(f"pending/{row['key']}.json", json.dumps(row).encode())
        self._pending += 1
        if self._pending >= GATHER:
            self.gather()

    def gather(self) -> None:
        """Put all rows that lie one by one into one Parquet file.

        Raises:
            LogWriteError: If it can't be written.
        """
        pending = list(self._pending_rows())
        gathered = set[str]()
        for path in self._row_files()[-1:] if pending else ():
            gathered.update(self._store.read_table(path, ["key"]).column("key").to_pylist())
        rows = [row for row in pending if row["key"] not in gathered]
        if rows:
            name = f"rows/{time.time_ns()}-{uuid.uuid4().hex[:8]}.parquet"
            self._store.write_table(name, _arrow(rows))
        for row in pending:
            self._store.remove(f"pending/{row['key']}.json")
        self._pending = 0

    def drop(self, keys: Iterable[str]) -> None:
        """Remove rows that are to be run again.

        Raises:
            LogWriteError: If it can't be written.
        """
        unwanted = set(keys)
        if not unwanted:
            return
        self.gather()
        for name in self._row_files():
            rows = self._store.read_table(name).to_pylist()
            kept = [row for row in rows if row["key"] not in unwanted]
            if len(kept) == len(rows):
                continue
            if kept:
                self._store.write_table(name, _arrow(kept))
            else:
                self._store.remove(name)

    def rows(self) -> Iterator[Row]:
        """Yield every row once, in no order."""
        seen = set[str]()
        tables = (self._store.read_table(path).to_pylist() for path in self._row_files())
        for rows in (self._pending_rows(), *tables):
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

    def _pending_rows(self) -> Iterator[Row]:
        for file in self._store.files("pending", [".json"]):
            try:
                yield cast("Row", json.loads(self._store.read(file.name)))
            except ValueError as error:
                raise InputFileError(f"{self.where}/{file.name}", str(error)) from error


def _arrow(rows: list[Row]) -> Any:
    """Return rows as a table; each column has the type of its name, whatever its values are."""
    names = dict.fromkeys(name for row in rows for name in row)
    columns: dict[str, Any] = {}
    for name in names:
        values = [row.get(name) for row in rows]
        kind = _type(name, values)
        if kind == _ARROW.string():
            values = [v if v is None or isinstance(v, str) else json.dumps(v) for v in values]
        columns[name] = _ARROW.array(values, type=kind)
    return _ARROW.table(columns)


def _type(name: str, values: list[Any]) -> Any:
    given = [value for value in values if value is not None]
    if name in _TEXTS or any(isinstance(value, str) for value in given):
        return _ARROW.string()
    if name in _LISTS_OF_TEXTS:
        return _ARROW.list_(_ARROW.string())
    if any(isinstance(value, list) for value in given):
        return _ARROW.list_(_ARROW.float64())
    if name in _INTEGERS:
        return _ARROW.int64()
    if given and all(isinstance(value, bool) for value in given):
        return _ARROW.bool_()
    return _ARROW.float64()
