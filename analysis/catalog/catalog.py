"""A catalogue of the sessions in a folder or under a URL.

The catalogue lies beside the sessions as Parquet files (:mod:`.files`). A scan reads what is new or
changed, and adds files; none is ever changed, so any number of scans and analyses may write at
once. Of several rows of one source those of the latest scan count. Where a file of the catalogue is
damaged, a scan reads all sources again and sets it aside.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Generator, Iterable, Mapping, Sequence
from concurrent.futures import (
    FIRST_COMPLETED,
    Future,
    ProcessPoolExecutor,
    ThreadPoolExecutor,
    wait,
)
from dataclasses import dataclass, replace
from multiprocessing import active_children, get_context
from pathlib import Path, PurePosixPath
from typing import Any

from undulog.capture.common.errors import (
    DataError,
    InputFileError,
    MissingExtraError,
    NoAnswerError,
    UndulogError,
    UsageError,
)
from undulog.capture.common.object_store import ObjectStore
from undulog.capture.common.process import StopRequest
from undulog.capture.common.untrusted_text import read_json
from undulog.capture.common.waits import Standstill, processor_time
from undulog.capture.log.file.parts import split_part_path
from undulog.capture.log.read.facts import LogFacts

from .files import CatalogFiles, settled
from .queries import TOO_LARGE, query_process
from .rows import (
    SCHEMAS,
    SWEPT,
    Row,
    check_installed,
    is_result,
    raise_if_vanished,
    result_rows,
    session_row,
    sweep_rows,
    table_of,
)
from .sources import ResultSource, list_sources, source_facts

_BATCH = 2000
"""Files that are read before their rows are written."""

_MOST_RESULT = 256 << 20
"""Bytes of a result file; a larger one is none."""
_MOST_SWEPT = 65_536
"""Rows of a Parquet file of a sweep; one with more is none."""
_FAULTS = (ValueError, LookupError, TypeError, AttributeError, ArithmeticError)
"""What values of other kinds than a result's end in."""
_LONGEST_FAULT = 1000
"""Characters of DuckDB's message, which repeats the query."""
_REMOTE_THREADS = 16
STILL_S = 300.0
"""How long the processes that analyse may compute nothing [s]; a network drive that comes back does
so within minutes."""
_LOOK_S = 0.5
_VERSION = 3  # of what is read of a file; those that an earlier one read are read again
_UNREAD = -1  # a size that no file has
_ANALYSED = "analysis of "
_HALVES = """
with own as (select source, session_id, joints, scanned_ns from all_analyses
  where starts_with(source, $1)),
parts as (select distinct source from all_joints where starts_with(source, $1))
select source from own where joints > 0 and source not in (from parts)
union select source from parts where source not in (select source from own)
union select own.source from own join files on own.source = $1 || files.path
  where files.modified_ns > own.scanned_ns
"""


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
        set_aside: Files of the catalogue that were damaged, what was wrong and where they are now.
    """

    sessions: int
    read: int
    removed: int
    damaged: int
    wall_s: float
    complete: bool
    set_aside: tuple[str, ...] = ()


class Catalog:
    """The catalogue of a folder or URL.

    Example::

        catalog = undulog.Catalog(".")
    """

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
        self._files = CatalogFiles(self._store)
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

        It runs in a process of its own (:mod:`.queries`), which reads nothing but the catalogue and
        writes nothing.

        Returns:
            A ``pandas.DataFrame``.

        Raises:
            UsageError: If DuckDB can't run it, or it takes too much memory or time.
            DamagedFileError: If a file of the catalogue is damaged; a scan sets it aside.
            MissingExtraError: If DuckDB is not installed.
        """
        check_installed()
        return query_process().run(self.where, query)

    def sql_here(self, query: str) -> Any:
        """Run a query in this process, without its limits; see :meth:`sql`."""
        return settled(lambda: self._sql(query))

    def _sql(self, query: str) -> Any:
        import duckdb

        kinds = duckdb.StatementType
        with self._files.database(bounded=True) as database:
            try:
                given = duckdb.extract_statements(query)
                read = (kinds.SELECT, kinds.EXPLAIN, kinds.MULTI)  # MULTI is a pivot
                if len(given) != 1 or given[0].type not in read:
                    raise UsageError("DuckDB: give one query or condition that only reads")
                return database.execute(given[0]).df()
            except duckdb.OutOfMemoryException as error:
                raise UsageError(f"DuckDB: {TOO_LARGE}") from error
            except duckdb.IOException as error:
                raise_if_vanished(error)
                raise UsageError(f"DuckDB: {error}") from error
            except (duckdb.Error, RuntimeError) as error:
                raise UsageError(f"DuckDB: {str(error)[:_LONGEST_FAULT]}") from error

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
            InputFileError: If the folder can't be listed, or a file of the catalogue can't be read.
            LogWriteError: If the catalogue can't be written.
        """
        begun, stop = time.monotonic(), stop or StopRequest()
        damaged_files = self._files.find_damaged()
        earlier, versions = settled(self._files.scanned)
        outdated = {name for name in earlier if damaged_files or versions[name] != _VERSION}
        mentioned = settled(self._files.mentioned) if damaged_files else {}
        listed = {file.name: file for file in list_sources(self._store, earlier)}
        # Later than all scans before, whatever the clocks of others say.
        before_ns = [*(scanned for _, _, scanned in earlier.values()), *mentioned.values()]
        scanned_ns = max([time.time_ns(), *(scanned + 1 for scanned in before_ns)])
        facts = {name: (file.size, file.modified_ns) for name, file in listed.items()}
        other = {name for name in listed if earlier.get(name, (0,))[:2] != facts[name]}
        fresh = [file for file in listed.values() if file.name in other | outdated]
        named = dict.fromkeys([*earlier, *(name.removeprefix(_ANALYSED) for name in mentioned)])
        gone = [name for name in named if name not in listed]
        changed = [name for name in sorted(other) if listed[name].is_log and name in earlier]
        self._remove([*gone, *(_ANALYSED + name for name in (*gone, *changed))], scanned_ns)
        read = damaged = 0
        for start in range(0, len(fresh), _BATCH):
            if stop.requested:
                break
            rows: dict[str, list[Row]] = {"sessions": [], "analyses": [], "joints": []}
            sources: list[Row] = []
            for file, rows_by_kind, fault in self._read_files(fresh[start : start + _BATCH]):
                read += 1
                damaged += bool(fault)
                on_read(read, len(fresh))
                stamp = {"scanned_ns": scanned_ns, "modified_ns": file.modified_ns}
                common = {"source": file.name, "removed": False}
                for kind, added in rows_by_kind.items():
                    rows[kind] += [common | row | stamp for row in added]
                details = {"size": file.size, "fault": fault or None, "version": _VERSION}
                sources.append(common | details | stamp)
            for kind, added in rows.items():
                self._files.write(kind, added)
            self._files.write("sources", sources)
        complete, set_aside = read == len(fresh), list[str]()
        if damaged_files and complete:
            self._remove(settled(self._halves), scanned_ns)
            set_aside = self._files.set_damaged_aside()
        if complete:
            self._files.put_together()
        return ScanReport(
            sessions=sum(file.is_log for file in listed.values()),
            read=read,
            removed=len(gone),
            damaged=damaged,
            wall_s=time.monotonic() - begun,
            complete=complete,
            set_aside=tuple(set_aside),
        )

    def _halves(self) -> list[str]:
        """Return analyses that were made for the catalogue and of which rows are lost, or outdated.

        What a damaged file held is not known: rows of an analysis, rows of its joints, or that the
        session has changed since.
        """
        with self._files.database() as database:
            return [name for (name,) in database.execute(_HALVES, [_ANALYSED]).fetchall()]

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
        missing: Sequence[str] = self.sql_here(query)["path"].to_list() if names is None else names
        faults: dict[str, str] = {}
        for done, (name, outcome) in enumerate(self._analysed(missing, workers, stop), start=1):
            on_done(done, len(missing))
            if isinstance(outcome, str):
                faults[name] = outcome
                continue
            self.add_result(_ANALYSED + name, outcome)
        self._files.put_together()
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
        self._files.write("analyses", [analysis | stamp])
        self._files.write("joints", [joint | stamp for joint in joints])

    # -- inside ----------------------------------------------------------------------------------

    def _read_files(
        self, files: Sequence[ResultSource]
    ) -> Iterable[tuple[ResultSource, dict[str, list[Row]], str]]:
        if self._store.is_local:
            return map(self._read_file, files)
        with ThreadPoolExecutor(_REMOTE_THREADS) as pool:
            return list(pool.map(self._read_file, files))

    def _read_file(self, file: ResultSource) -> tuple[ResultSource, dict[str, list[Row]], str]:
        """Return the rows of a file, and why it has none."""
        try:
            if file.is_log:
                log_facts = source_facts(self._store, file)
                return file, {"sessions": [self._session(file, log_facts)]}, log_facts.damage
            if file.name.endswith(".parquet"):
                return file, self._sweep(file), ""
            return file, self._result(file) if file.name.endswith(".json") else {}, ""
        except MissingExtraError as error:  # read again, when the extra may be there
            rows = [self._session(file, LogFacts(damage=str(error)))]
            return replace(file, size=_UNREAD), {"sessions": rows}, str(error)
        except (UndulogError, *_FAULTS, OSError) as error:
            facts = [LogFacts(damage=str(error))] if file.is_log else []
            return file, {"sessions": [self._session(file, fact) for fact in facts]}, str(error)

    def _session(self, file: ResultSource, facts: LogFacts) -> Row:
        row = session_row(facts)
        head = split_part_path(Path(file.name))[0].as_posix() if row["part"] > 1 else file.name
        name = PurePosixPath(self._store.path(head)).stem  # as a session without an id calls itself
        return {**row, "session_id": facts.session_id or name, "path": file.name, "head": head} | {
            "size": file.size
        }

    def _sweep(self, file: ResultSource) -> dict[str, list[Row]]:
        # The folder may come from anyone, and so may the checksum.
        table = self._store.read_table(file.name, SWEPT, tried=True)
        if table.num_rows > _MOST_SWEPT:
            return {}
        every = map(sweep_rows, table.to_pylist())
        results = [result for result in every if result is not None]
        joints = [joint for _, joint_rows in results for joint in joint_rows]
        rows = {"analyses": [analysis for analysis, _ in results], "joints": joints}
        for kind, row in rows.items():
            table_of(kind, row)
        return rows

    def _result(self, file: ResultSource) -> dict[str, list[Row]]:
        if file.size > _MOST_RESULT:
            return {}
        value = read_json(self._store.read(file.name))
        if not is_result(value):
            return {}
        analysis, joints = _checked(file.name, value)
        return {"analyses": [analysis], "joints": joints}

    def _remove(self, names: Sequence[str], scanned_ns: int) -> None:
        gone = [{"source": name, "scanned_ns": scanned_ns, "removed": True} for name in names]
        for kind in SCHEMAS:
            removed = [
                row | ({"path": row["source"]} if kind == "sessions" else {}) for row in gone
            ]
            self._files.write(kind, removed)
        self._files.write("sources", gone)

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
                    running = {
                        future: name for future, name in running.items() if not future.cancel()
                    }
                processes = [child for child in active_children() if child not in others]
                if not still.reached(processor_time(child.pid or 0 for child in processes)):
                    continue
                for child in processes:
                    child.kill()
                advice = "they were ended; run the command again, which goes on with the rest"
                raise NoAnswerError("the analyses of the sessions", STILL_S, advice)


def _checked(source: str, result: Mapping[str, Any]) -> tuple[Row, list[Row]]:
    try:
        analysis, joints = result_rows(result)
        for kind, rows in (("analyses", [analysis]), ("joints", joints)):
            table_of(kind, rows)
    except _FAULTS as error:
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
