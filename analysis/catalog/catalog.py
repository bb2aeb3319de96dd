"""A catalogue of the sessions in a folder or under a URL.

The catalogue lies beside the sessions, in the folder :data:`FOLDER`, as Parquet files of four
kinds (:data:`.rows.SCHEMAS` and ``sources``). A scan reads what is new or changed, and adds files;
none is ever changed, so any number of scans and analyses may write at once. Of several rows of one
source those of the latest scan count.
"""

from __future__ import annotations

import fcntl
import json
import tempfile
import time
import uuid
from collections.abc import Callable, Generator, Iterable, Mapping, Sequence
from concurrent.futures import (
    FIRST_COMPLETED,
    Future,
    ProcessPoolExecutor,
    ThreadPoolExecutor,
    wait,
)
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, replace
from multiprocessing import active_children, get_context
from pathlib import Path, PurePosixPath
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from undulog.capture.common.errors import (
    DataError,
    InputFileError,
    MissingExtraError,
    NoAnswerError,
    UndulogError,
    UsageError,
)
from undulog.capture.common.process import StopRequest
from undulog.capture.common.remote import ObjectStore
from undulog.capture.common.waits import Standstill, processor_time
from undulog.capture.log.file.parts import split_part_path
from undulog.capture.log.read.facts import LogFacts

from .rows import (
    SCHEMAS,
    Row,
    connect,
    is_result,
    put_together,
    result_rows,
    session_row,
    sweep_rows,
    table_of,
)
from .sources import FOLDER, Scanned, Source, list_sources, source_facts

_ARROW: Any = pa  # comes without types
_PARQUET: Any = pq

_BATCH = 2000
"""Files that are read before their rows are written."""

_MOST_FILES = 64
"""Parquet files of a kind from which on they are put into one,"""
_MOST_ROWS = 50_000
"""and their rows."""

_MOST_RESULT = 256 << 20
_REMOTE_THREADS = 16
STILL_S = 300.0
"""How long the processes that analyse may compute nothing [s]; a network drive that comes back does
so within minutes."""
_LOOK_S = 0.5
_VERSION = 2  # of what is read of a file; those that an earlier one read are read again
_UNREAD = -1  # a size that no file has
_ANALYSED = "analysis of "


@dataclass(frozen=True)
class ScanReport:
    """What a scan found.

    Attributes:
        sessions: Files of sessions that are there.
        read: Files that were read now: sessions, results of ``analyse``, rows of ``sweep``.
        removed: Files that are no longer there.
        damaged: Sessions without a whole summary, and results that can't be read.
        wall_s: How long it took [s].
        complete: Whether it came to its end.
    """

    sessions: int
    read: int
    removed: int
    damaged: int
    wall_s: float
    complete: bool


class Catalog:
    """The catalogue of a folder or URL."""

    def __init__(self, where: Path | str) -> None:
        """Connect; nothing is read.

        Args:
            where: A folder with sessions, or a URL such as ``s3://bucket/lab``.

        Raises:
            InputFileError: If there is no such folder, or the store can't be reached.
            MissingExtraError: If pyarrow is not installed.
        """
        self.where = str(where)
        self._store = ObjectStore(self.where)
        if self._store.is_local and not Path(self._store.base).is_dir():
            raise InputFileError(where, "there is no such folder")

    # -- reading ---------------------------------------------------------------------------------

    def find(self, where: str = "", *, joints: bool = False) -> Any:
        """Return the sessions that a condition holds for.

        Args:
            where: A condition in SQL over the columns of the view ``catalog``, e.g. ``robot =
                'snake25' and lag_sd > 0.05``; all by default.
            joints: Return a row a joint and window instead, of the view ``joints``.

        Returns:
            A ``pandas.DataFrame``.

        Raises:
            UsageError: If DuckDB doesn't understand the condition.
        """
        view = "joints" if joints else "catalog"
        order = "path, position" if joints else "path"
        condition = f"where {where}" if where.strip() else ""
        return self.sql(f"select * from {view} {condition} order by {order}")  # noqa: S608

    def sql(self, query: str) -> Any:
        """Run a query in DuckDB over the views ``sessions``, ``analyses``, ``joints``, ``catalog``.

        Returns:
            A ``pandas.DataFrame``.

        Raises:
            UsageError: If DuckDB can't run it.
            MissingExtraError: If DuckDB is not installed.
        """
        for attempt in range(3):
            try:
                return self._sql(query)
            except FileNotFoundError:  # another process put files together meanwhile
                if attempt == 2:
                    raise
        raise AssertionError("unreachable")

    def _sql(self, query: str) -> Any:
        import duckdb

        with self._database() as database:
            try:
                return database.execute(query).df()
            except duckdb.IOException as error:
                if "No files found" in str(error) or "Cannot open file" in str(error):
                    raise FileNotFoundError(str(error)) from error
                raise UsageError(f"DuckDB: {error}") from error
            except duckdb.Error as error:
                raise UsageError(f"DuckDB: {error}") from error

    # -- writing ---------------------------------------------------------------------------------

    def scan(
        self,
        *,
        stop: StopRequest | None = None,
        on_read: Callable[[int, int], None] = lambda _done, _total: None,
    ) -> ScanReport:
        """Read the facts of new and changed sessions, and results that lie beside them.

        A result is a file that ``undulog analyse -o`` wrote, or the rows of ``undulog sweep``.

        Args:
            on_read: Called with the number of files read and of those to read.

        Raises:
            InputFileError: If the folder can't be listed.
            LogWriteError: If the catalogue can't be written.
        """
        begun, stop = time.monotonic(), stop or StopRequest()
        known, outdated = self._known()
        listed = {file.name: file for file in list_sources(self._store, known)}
        # Later than all scans before, whatever the clocks of others say.
        scanned_ns = max([time.time_ns(), *(scanned + 1 for _, _, scanned in known.values())])
        facts = {name: (file.size, file.modified_ns) for name, file in listed.items()}
        other = {name for name in listed if known.get(name, (0,))[:2] != facts[name]}
        fresh = [one for one in listed.values() if one.name in other | outdated]
        gone = [name for name in known if name not in listed and not name.startswith(_ANALYSED)]
        changed = [name for name in sorted(other) if listed[name].is_log and name in known]
        self._remove([*gone, *(_ANALYSED + name for name in (*gone, *changed))], scanned_ns)
        read = damaged = 0
        for start in range(0, len(fresh), _BATCH):
            if stop.requested:
                break
            rows: dict[str, list[Row]] = {"sessions": [], "analyses": [], "joints": []}
            sources: list[Row] = []
            for file, found, fault in self._read_files(fresh[start : start + _BATCH]):
                read += 1
                damaged += bool(fault)
                on_read(read, len(fresh))
                stamp = {"scanned_ns": scanned_ns, "modified_ns": file.modified_ns}
                common = {"source": file.name, "removed": False}
                for kind, own in found.items():
                    rows[kind] += [common | row | stamp for row in own]
                own = {"size": file.size, "fault": fault or None, "version": _VERSION}
                sources.append(common | own | stamp)
            for kind, own in rows.items():
                self._write(kind, table_of(kind, own))
            self._write("sources", _ARROW.Table.from_pylist(sources, _SOURCES))
        self._put_together()
        n_sessions = sum(file.is_log for file in listed.values())
        return ScanReport(
            n_sessions, read, len(gone), damaged, time.monotonic() - begun, read == len(fresh)
        )

    def analyse(
        self,
        names: Sequence[str] | None = None,
        *,
        workers: int = 1,
        stop: StopRequest | None = None,
        on_done: Callable[[int, int], None] = lambda _done, _total: None,
    ) -> dict[str, str]:
        """Analyse sessions that have no results yet, and keep their rows.

        Args:
            names: Paths of sessions in the catalogue; all that are not analysed by default.
            workers: Processes at a time.
            on_done: Called with the number of sessions analysed and of those to analyse.

        Returns:
            Path of a session to why it couldn't be analysed.

        Raises:
            LogWriteError: If the rows can't be written.
        """
        stop = stop or StopRequest()
        query = "select path from catalog where status = 'not analysed' and damage is null"
        missing: Sequence[str] = self.sql(query)["path"].to_list() if names is None else names
        faults: dict[str, str] = {}
        for done, (name, outcome) in enumerate(self._analysed(missing, workers, stop), start=1):
            on_done(done, len(missing))
            if isinstance(outcome, str):
                faults[name] = outcome
                continue
            self.add_result(_ANALYSED + name, outcome)
        self._put_together()
        return faults

    def add_result(self, source: str, result: Mapping[str, Any]) -> None:
        """Keep the rows of an analysis; safe in any number of processes at once.

        Args:
            source: Names where it comes from; a later result of the same source replaces it.
            result: JSON object of the analysis.

        Raises:
            DataError: If it is no result of one session.
            LogWriteError: If it can't be written.
        """
        analysis, joints = _checked(source, result)
        stamp = {"source": source, "scanned_ns": time.time_ns(), "removed": False}
        self._write("analyses", table_of("analyses", [analysis | stamp]))
        self._write("joints", table_of("joints", [joint | stamp for joint in joints]))

    # -- inside ----------------------------------------------------------------------------------

    def _known(self) -> tuple[dict[str, Scanned], set[str]]:
        """Return the files that were read and are there, and those of an earlier version."""
        latest: dict[str, tuple[int, int, int, bool, int | None]] = {}
        for name in self._files("sources"):
            table = self._store.read_table(name).to_pydict()
            columns = [table[key] for key in _SCANNED]
            columns.append(table.get("version", [None] * len(columns[0])))
            for source, size, modified, scanned, removed, version in zip(*columns, strict=True):
                if source not in latest or latest[source][2] < scanned:
                    latest[source] = size, modified, scanned, removed, version
        there = {name: facts for name, facts in latest.items() if not facts[3]}
        outdated = {name for name, facts in there.items() if facts[4] != _VERSION}
        return {name: facts[:3] for name, facts in there.items()}, outdated

    def _read_files(
        self, files: Sequence[Source]
    ) -> Iterable[tuple[Source, dict[str, list[Row]], str]]:
        if self._store.is_local:
            return map(self._read_file, files)
        with ThreadPoolExecutor(_REMOTE_THREADS) as pool:
            return list(pool.map(self._read_file, files))

    def _read_file(self, file: Source) -> tuple[Source, dict[str, list[Row]], str]:
        """Return the rows of a file, and why it has none."""
        try:
            if file.is_log:
                found = source_facts(self._store, file)
                return file, {"sessions": [self._session(file, found)]}, found.damage
            if file.name.endswith(".parquet"):
                return file, self._sweep(file), ""
            return file, self._result(file) if file.name.endswith(".json") else {}, ""
        except MissingExtraError as error:  # read again, when the extra may be there
            rows = [self._session(file, LogFacts(damage=str(error)))]
            return replace(file, size=_UNREAD), {"sessions": rows}, str(error)
        except (UndulogError, OSError, ValueError, KeyError, TypeError, RecursionError) as error:
            facts = [LogFacts(damage=str(error))] if file.is_log else []
            return file, {"sessions": [self._session(file, one) for one in facts]}, str(error)

    def _session(self, file: Source, facts: LogFacts) -> Row:
        row = session_row(facts)
        head = split_part_path(Path(file.name))[0].as_posix() if row["part"] > 1 else file.name
        name = PurePosixPath(self._store.path(head)).stem  # as a session without an id calls itself
        return {**row, "session_id": facts.session_id or name, "path": file.name, "head": head} | {
            "size": file.size
        }

    def _sweep(self, file: Source) -> dict[str, list[Row]]:
        every = map(sweep_rows, self._store.read_table(file.name).to_pylist())
        known = [found for found in every if found is not None]
        joints = [joint for _, own in known for joint in own]
        return {"analyses": [analysis for analysis, _ in known], "joints": joints}

    def _result(self, file: Source) -> dict[str, list[Row]]:
        if file.size > _MOST_RESULT:
            return {}
        value = json.loads(self._store.read(file.name))
        if not is_result(value):
            return {}
        analysis, joints = _checked(file.name, value)
        return {"analyses": [analysis], "joints": joints}

    def _remove(self, names: Sequence[str], scanned_ns: int) -> None:
        gone = [{"source": name, "scanned_ns": scanned_ns, "removed": True} for name in names]
        for kind in SCHEMAS:
            own = [row | ({"path": row["source"]} if kind == "sessions" else {}) for row in gone]
            self._write(kind, table_of(kind, own))
        self._write("sources", _ARROW.Table.from_pylist(gone, _SOURCES))

    def _analysed(
        self, names: Sequence[str], workers: int, stop: StopRequest
    ) -> Generator[tuple[str, str | dict[str, Any]]]:
        """Yield the result of each session, or why it has none."""
        others = set(active_children())
        with ProcessPoolExecutor(workers, get_context("spawn")) as pool:
            running: dict[Future[str | dict[str, Any]], str] = {
                pool.submit(_analyse, self.where, name): name for name in names
            }
            still = Standstill(STILL_S)
            while running:
                done, _ = wait(running, timeout=_LOOK_S, return_when=FIRST_COMPLETED)
                for future in done:
                    yield running.pop(future), future.result()
                if stop.requested:  # what has begun is waited for, with the same limit
                    running = {one: name for one, name in running.items() if not one.cancel()}
                processes = [one for one in active_children() if one not in others]
                if not still.reached(processor_time(one.pid or 0 for one in processes)):
                    continue
                for one in processes:
                    one.kill()
                advice = "they were ended; run the command again, which goes on with the rest"
                raise NoAnswerError("the analyses of the sessions", STILL_S, advice)

    def _files(self, kind: str) -> list[str]:
        """Names of the Parquet files of a kind, without those that another one replaces."""
        names = [file.name for file in self._store.files(f"{FOLDER}/{kind}", [".parquet"])]
        replaced: set[str] = set()
        for name in names:
            if _is_base(name):
                path, filesystem = self._store.path(name), self._store.filesystem
                schema: Any = _PARQUET.read_schema(path, filesystem=filesystem)
                replaced.update(json.loads(schema.metadata[b"replaces"]))
        return [name for name in names if name not in replaced]

    def _write(self, kind: str, table: Any, prefix: str = "rows") -> None:
        if not table.num_rows:
            return
        self._store.make_folders(f"{FOLDER}/{kind}")
        name = f"{FOLDER}/{kind}/{prefix}-{time.time_ns()}-{uuid.uuid4().hex[:8]}.parquet"
        self._store.write_table(name, table)

    def _database(self) -> AbstractContextManager[Any]:
        base: dict[str, list[str]] = {}
        new: dict[str, list[str]] = {}
        for kind in SCHEMAS:
            names = self._files(kind)
            base[kind] = [name for name in names if _is_base(name)][-1:]
            new[kind] = [name for name in names if name not in base[kind]]
        return connect(self._store, base, new)

    def _put_together(self) -> None:
        """Put many small files into one; on an object store they stay as they are."""
        if not self._store.is_local:
            return
        kinds = [kind for kind in (*SCHEMAS, "sources") if self._is_scattered(kind)]
        if not kinds:
            return
        with _lock(Path(self._store.path(f"{FOLDER}/lock"))) as locked:
            if not locked:
                return
            for kind in kinds:
                names = self._files(kind)
                if kind == "sources":
                    table = _ARROW.concat_tables(
                        [self._store.read_table(name) for name in names], promote_options="default"
                    )
                else:
                    with self._database() as database:
                        table = put_together(database, kind)
                facts = {b"replaces": json.dumps(names).encode()}
                self._write(kind, table.replace_schema_metadata(facts), "all")
                for name in names:
                    self._store.remove(name)

    def _is_scattered(self, kind: str) -> bool:
        new = [name for name in self._files(kind) if not _is_base(name)]
        if len(new) >= _MOST_FILES:
            return True
        rows = [_PARQUET.read_metadata(self._store.path(name)).num_rows for name in new]
        return sum(rows) >= _MOST_ROWS


def _is_base(name: str) -> bool:
    return PurePosixPath(name).name.startswith("all-")


_SCANNED = "source", "size", "modified_ns", "scanned_ns", "removed"
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


@contextmanager
def _lock(path: Path) -> Generator[bool]:
    """Hold a lock file; False where another process holds it."""
    with path.open("w") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            yield False
            return
        yield True


def _checked(source: str, result: Mapping[str, Any]) -> tuple[Row, list[Row]]:
    try:
        analysis, joints = result_rows(result)
        for kind, rows in (("analyses", [analysis]), ("joints", joints)):
            table_of(kind, rows)
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
        raise DataError(f"{source}: a damaged result: {error!r}") from error
    return analysis, joints


def _analyse(where: str, name: str) -> str | dict[str, Any]:
    """Analyse one session, in a process of its own; return why not where it can't be."""
    from undulog.capture import Session

    from ..session.analyse import analyse_session

    store = ObjectStore(where)
    try:
        with tempfile.TemporaryDirectory(prefix="undulog-catalog-") as folder:
            path = Path(store.path(name))
            if not store.is_local:
                path = Path(folder) / PurePosixPath(name).name
                path.write_bytes(store.read(name))
            with Session.open(path) as session:
                return analyse_session(session).to_dict()
    except (UndulogError, OSError) as error:
        return str(error)
