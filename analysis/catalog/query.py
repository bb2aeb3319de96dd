"""Views of a catalogue in DuckDB."""

from __future__ import annotations

from collections.abc import Generator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

from undulog.capture.common.errors import MissingExtraError
from undulog.capture.common.object_store import ObjectStore

from .rows import SCHEMAS, table_of

_MEMORY = "800MB"

# The base holds one row of each source (and joint), the other rows are few: only these are sorted.
_CURRENT = """
create temp view {view} as
select * exclude (removed) from {table}_base
where {source} not in (select {source} from {table}_new)
union all by name
select * exclude (removed) from {table}_new
qualify scanned_ns = max(scanned_ns) over (partition by {source}) and not removed
"""

_SESSIONS = """
create temp view sessions as
select path, session_id, robot, scenario, operator, engine, verdict, software, seed, start,
  start_ns, end_ns, duration_s, messages, size, 1 as parts, damage, topics, metadata
from files
"""

_SPLIT_SESSIONS = """
create temp view sessions as
select head as path, first(session_id order by part) as session_id,
  first(robot order by part) as robot, first(scenario order by part) as scenario,
  first(operator order by part) as operator, first(engine order by part) as engine,
  last(verdict order by part) as verdict, first(software order by part) as software,
  first(seed order by part) as seed, min(start) as start, min(start_ns) as start_ns,
  max(end_ns) as end_ns, (max(end_ns) - min(start_ns)) / 1e9 as duration_s,
  sum(messages)::bigint as messages, sum(size)::bigint as size, count(*) as parts,
  string_agg(damage, '; ' order by part) as damage, first(topics order by part) as topics,
  first(metadata order by part) as metadata
from files group by head
"""

_AFFECTED = """
create temp table affected as
select session_id from analyses_new where session_id is not null
union select session_id from analyses_base where source in (select source from analyses_new)
"""

_ANALYSES = """
create temp view analyses as
select * exclude (latest) from all_analyses
where latest and session_id not in (from affected)
union all by name
select * exclude (latest) from all_analyses where session_id in (from affected)
qualify row_number() over (partition by session_id order by scanned_ns desc, source) = 1
"""

_LATEST = "row_number() over (partition by session_id order by scanned_ns desc, source) = 1"

_CATALOG = """
create temp view catalog as
select sessions.*,
  case when analyses.session_id is null then 'not analysed' else 'analysed' end as status,
  analyses.* exclude (session_id, modified_ns, scanned_ns)
from sessions left join analyses on sessions.session_id = analyses.session_id and {own}
"""

_JOINTS = """
create temp view joints as
select sessions.path, sessions.robot, sessions.start, all_joints.* exclude (modified_ns, scanned_ns)
from all_joints left join sessions on sessions.session_id = all_joints.session_id and {own}
"""

# A damaged copy has the id of the whole session, but not its results.
_OWN = """
(damage is null
  or sessions.session_id not in (select session_id from sessions where damage is null))
"""


@contextmanager
def connect(
    store: ObjectStore, base: Mapping[str, Sequence[str]], new: Mapping[str, Sequence[str]]
) -> Generator[Any]:
    """Open a database in memory with the views of a catalogue.

    ``sessions`` has a row a session, ``analyses`` the latest results of each, ``catalog`` both side
    by side, ``joints`` a row a joint and window of every result.

    Args:
        base: Kind of row to the Parquet file that :func:`put_together` made, or none.
        new: Kind of row to the names of its other Parquet files.

    Raises:
        MissingExtraError: If DuckDB is not installed.
    """
    try:
        import duckdb
    except ImportError as error:
        raise MissingExtraError("catalog", "catalog", "duckdb") from error
    database: Any = duckdb.connect(
        config={"memory_limit": _MEMORY, "autoinstall_known_extensions": "false"}
    )
    try:
        database.execute("set TimeZone = 'UTC'")
        for kind in SCHEMAS:
            _open_rows(database, store, f"{kind}_base", base[kind], kind)
            _open_rows(database, store, f"{kind}_new", new[kind], kind)
        for view, table, source in (
            ("files", "sessions", "path"),
            ("all_analyses", "analyses", "source"),
            ("all_joints", "joints", "source"),
        ):
            database.execute(_CURRENT.format(view=view, table=table, source=source))
        split = database.execute("select count(*) from files where part > 1").fetchone()[0]
        for statement in (
            _SPLIT_SESSIONS if split else _SESSIONS,
            _AFFECTED,
            _ANALYSES,
            _CATALOG.format(own=_OWN),
            _JOINTS.format(own=_OWN),
        ):
            database.execute(statement)
        yield database
    finally:
        database.close()


def put_together(database: Any, kind: str) -> Any:
    """Return the current rows of a kind as a ``pyarrow.Table``, for a base."""
    view = {"sessions": "files", "analyses": "all_analyses", "joints": "all_joints"}[kind]
    columns = "*"
    if kind == "analyses":
        columns = f"* replace ({_LATEST} as latest)"
    query = f"select {columns}, false as removed from {view}"  # noqa: S608
    table = database.sql(query).to_arrow_table()
    return table.select(SCHEMAS[kind].names).cast(SCHEMAS[kind])


def _open_rows(
    database: Any, store: ObjectStore, view: str, names: Sequence[str], kind: str
) -> None:
    """Make rows a view of the database; local ones are read when needed."""
    if names and store.is_local:
        paths = ", ".join("'" + store.path(name).replace("'", "''") + "'" for name in names)
        database.execute(
            f"create temp view {view} as select * from read_parquet([{paths}], union_by_name=true)"  # noqa: S608
        )
        return
    import pyarrow as pa

    arrow: Any = pa
    tables = [store.read_table(name) for name in names] or [table_of(kind, [])]
    database.register(view, arrow.concat_tables(tables))
