"""Rows of a catalogue (sessions, analyses, results of joints) and their views in DuckDB.

Angles are in rad, energies in J, times in s. ``NAME_low`` and ``NAME_high`` are the ends of the
95 % interval of ``NAME``. What was not analysed or can't be computed is null.
"""

from __future__ import annotations

import json
from collections.abc import Generator, Iterable, Mapping, Sequence
from contextlib import contextmanager
from importlib.util import find_spec
from typing import Any, TypeAlias

import pyarrow as pa

from undulog.capture.common.arrays import NS
from undulog.capture.common.errors import MissingExtraError
from undulog.capture.common.object_store import ObjectStore
from undulog.capture.log.read.facts import LogFacts

_ARROW: Any = pa  # comes without types

Row = dict[str, Any]

INDICES = (
    "gain_cv",
    "lag_sd",
    "boundary_contrast_gain",
    "boundary_contrast_lag",
    "energy_cv",
    "energy_gini",
    "module_share",
)
"""Heterogeneity indices that an analysis row has."""

_JOINT_NUMBERS = (
    "command_amplitude_rad",
    "energy_net_j",
    "energy_plus_j",
    "energy_abs_j",
    "energy_el_j",
    "coverage",
)

_TRACKING = ("tracking_gain", "tracking_lag_s", "offset_rad")
_TRACKED = {
    "explained": "tracking_explained",
    "freedom": "tracking_freedom",
    "commanded_rad": "commanded_range_rad",
    "command_mean_rad": "command_mean_rad",
    "speed_rad_s": "command_speed_rad_s",
}
"""Numbers of a joint whose commands are no gait, and their columns."""

_OF_SESSION = ("session_id", "robot", "scenario", "operator", "engine")

_CLOSED = (
    "python_enable_replacements = false",
    "enable_external_access = false",
    "lock_configuration = true",
)

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
select path, session_id, robot, metadata ->> '$.serial' as serial, scenario, operator, engine,
  verdict, software, seed, start, start_ns, end_ns, duration_s, messages, size, 1 as parts,
  damage, topics, metadata
from files
"""

_SPLIT_SESSIONS = """
create temp view sessions as
select head as path, first(session_id order by part) as session_id,
  first(robot order by part) as robot, first(metadata ->> '$.serial' order by part) as serial,
  first(scenario order by part) as scenario,
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
select sessions.path, sessions.robot, sessions.serial, sessions.start,
  all_joints.* exclude (modified_ns, scanned_ns)
from all_joints left join sessions on sessions.session_id = all_joints.session_id and {own}
"""

# A damaged copy has the id of the whole session, but not its results.
_OWN = """
(damage is null
  or sessions.session_id not in (select session_id from sessions where damage is null))
"""


_Config: TypeAlias = dict[str, str | bool | int | float | list[str]]

_CONFIG: _Config = {"memory_limit": "800MB", "autoinstall_known_extensions": "false"}

_BOUNDED: _Config = {
    **_CONFIG,
    "memory_limit": "500MB",
    "temp_directory": "",  # nothing is written beside the catalogue
    "autoload_known_extensions": "false",
}


def _with_interval(*names: str) -> list[str]:
    return [column for name in names for column in (name, f"{name}_low", f"{name}_high")]


def _schema(**kinds: str) -> Any:
    """Return an Arrow schema; a kind is a type's name with the columns' names."""
    types = {
        "texts": _ARROW.string(),
        "integers": _ARROW.int64(),
        "numbers": _ARROW.float64(),
        "lists": _ARROW.list_(_ARROW.string()),
        "flags": _ARROW.bool_(),
        "times": _ARROW.timestamp("ns"),  # UTC
    }
    return _ARROW.schema(
        [(name, types[kind]) for kind, names in kinds.items() for name in names.split()]
    )


SCHEMAS: Mapping[str, Any] = {
    "sessions": _schema(
        texts="path head session_id robot scenario operator engine verdict software damage "
        "metadata",
        integers="part size modified_ns scanned_ns start_ns end_ns messages seed",
        numbers="duration_s",
        lists="topics",
        flags="removed",
        times="start",
    ),
    "analyses": _schema(
        texts="source session_id answer sentence detail gait_wave changes",
        integers="modified_ns scanned_ns joints joints_compared",
        numbers=" ".join(
            [
                *("start_s", "stop_s", "cycles", "distance_m", "cost_of_transport"),
                *_with_interval("frequency_hz", *INDICES),
            ]
        ),
        lists="warnings not_following stand_out",
        flags="latest removed",
    ),
    "joints": _schema(
        texts="source session_id joint plane",
        integers="modified_ns scanned_ns position",
        numbers=" ".join(
            [
                *("start_s", "stop_s", "cycles", "frequency_hz", *_JOINT_NUMBERS),
                *_with_interval("gain", "lag_rad", *_TRACKING),
                *_TRACKED.values(),
            ]
        ),
        lists="flags",
        flags="removed",
    ),
}
"""Kind of row to its Arrow schema. ``source`` names the file that a result was read from."""


def table_of(kind: str, rows: Sequence[Row]) -> Any:
    """Return rows of a kind as a ``pyarrow.Table``; columns that a row lacks are null."""
    schema = SCHEMAS[kind]
    columns = [
        _ARROW.array([row.get(field.name) for row in rows], type=field.type) for field in schema
    ]
    return _ARROW.table(columns, schema=schema)


def session_row(facts: LogFacts) -> Row:
    """Return the columns of a session's row that its file gives."""
    metadata = facts.metadata.get("undulog", {})
    part = facts.metadata.get("undulog.part", {})
    start_ns, end_ns, duration_s = facts.start_ns, facts.end_ns, None
    if start_ns is not None and end_ns is not None:
        duration_s = (end_ns - start_ns) / NS
        if max(start_ns, end_ns) >= 1 << 63:  # beyond what a time can be
            start_ns = end_ns = None
    return {
        **{name: metadata.get(name) for name in _OF_SESSION},
        "software": metadata.get("undulog"),
        "seed": _integer(metadata.get("seed")),
        "part": _integer(part.get("part")) or 1,
        "verdict": facts.metadata.get("undulog.health", {}).get("verdict"),
        "start_ns": start_ns,
        "end_ns": end_ns,
        "start": start_ns,
        "duration_s": duration_s,
        "messages": facts.messages,
        "topics": list(facts.topics),
        "damage": facts.damage or None,
        "metadata": json.dumps(dict(metadata), sort_keys=True) if metadata else None,
    }


def _integer(text: str | None) -> int | None:
    return int(text) if text is not None and text.isascii() and text.isdigit() else None


def is_result(value: Any) -> bool:
    """Return whether a JSON value is what ``undulog analyse`` writes of one session."""
    keys = ("session", "answer", "gait", "joints", "heterogeneity", "warnings")
    return isinstance(value, dict) and all(key in value for key in keys)


def result_rows(result: Mapping[str, Any]) -> tuple[Row, list[Row]]:
    """Return the row of an analysis and the rows of its joints.

    Args:
        result: JSON object of an analysis, as :meth:`.Analysis.to_dict` gives it.

    Raises:
        KeyError, TypeError, ValueError: If it is damaged.
    """
    answer, gait = result["answer"], result["gait"]
    windows = gait["windows"]
    window: Row = {
        "session_id": result["session"]["id"],
        "start_s": windows[0]["start_s"] if windows else None,
        "stop_s": windows[-1]["stop_s"] if windows else None,
        "cycles": sum(window["cycles"] for window in windows) if windows else None,
    }
    analysis = window | {
        "answer": answer["verdict"],
        "sentence": answer["sentence"],
        "detail": answer["detail"],
        "gait_wave": gait["wave"],
        "joints": len(result["joints"]),
        "joints_compared": answer["compared"],
        "warnings": list(result["warnings"]),
        "not_following": [fault["joint"] for fault in answer["not_following"]],
        "stand_out": [deviation["joint"] for deviation in answer["stand_out"]],
        **_estimate("frequency_hz", gait["frequency_hz"], gait["frequency_ci95"]),
    }
    for name in INDICES:
        if (index := result["heterogeneity"].get(name)) is not None:
            analysis |= _estimate(name, index["value"], index["ci95"])
    if result.get("energy") is not None:
        transport = result["energy"]["transport"]
        analysis |= {"distance_m": transport["distance_m"], "cost_of_transport": transport["abs"]}
    tracking = {joint["joint"]: joint for joint in result.get("tracking") or ()}
    return analysis, [
        window
        | {"joint": joint["name"], "plane": joint["plane"], "position": position}
        | {name: joint[name] for name in ("frequency_hz", *_JOINT_NUMBERS)}
        | {"flags": list(joint["flags"])}
        | _estimate("gain", joint["gain"], joint["gain_ci95"])
        | _estimate("lag_rad", joint["lag_rad"], joint["lag_ci95"])
        | {"command_mean_rad": joint.get("command_mean_rad")}
        | _estimate("offset_rad", joint.get("offset_rad"), joint.get("offset_ci95"))
        | _tracking_row(tracking.get(joint["name"]))
        for position, joint in enumerate(result["joints"])
    ]


def _tracking_row(joint: Mapping[str, Any] | None) -> Row:
    """Return the columns of a joint whose commands are no gait; none for the others."""
    if joint is None:
        return {}
    return {
        **{column: joint.get(key) for key, column in _TRACKED.items()},
        **_estimate("tracking_gain", joint["gain"], joint["gain_ci95"]),
        **_estimate("tracking_lag_s", joint["lag_s"], joint["lag_s_ci95"]),
        **_estimate("offset_rad", joint["offset_rad"], joint["offset_ci95"]),
    }


def _estimate(name: str, value: float | None, ci95: Sequence[float] | None) -> Row:
    low, high = ci95 or (None, None)
    return {name: value, f"{name}_low": low, f"{name}_high": high}


_SWEPT = ("distance_m", "cost_of_transport", *_with_interval("frequency_hz", *INDICES))
_OF_SWEPT_JOINTS = (*_JOINT_NUMBERS, *_with_interval("gain", "lag_rad"))
SWEPT = (
    *("status", "session_id", "answer", "sentence", "joint", "warnings", "changes"),
    *(*_SWEPT, *_OF_SWEPT_JOINTS),
)
"""Columns of a sweep's rows that a catalogue takes."""


def sweep_rows(row: Mapping[str, Any]) -> tuple[Row, list[Row]] | None:
    """Return the rows of a finished run of ``undulog sweep``; None where it has no results."""
    if row.get("status") != "done" or not row.get("session_id"):
        return None
    names: list[str] = row.get("joint") or []
    analysis: Row = {
        "session_id": row["session_id"],
        "answer": row.get("answer"),
        "sentence": row.get("sentence"),
        "joints": len(names),
        "warnings": row.get("warnings") or [],
        "changes": row.get("changes"),
        **{name: row.get(name) for name in _SWEPT},
    }
    columns = [name for name in _OF_SWEPT_JOINTS if isinstance(row.get(name), list)]
    return analysis, [
        {
            "session_id": row["session_id"],
            "joint": joint,
            "position": position,
            "frequency_hz": row.get("frequency_hz"),
            **{name: row[name][position] for name in columns},
        }
        for position, joint in enumerate(names)
    ]


@contextmanager
def connect(
    store: ObjectStore,
    base: Mapping[str, Sequence[str]],
    new: Mapping[str, Sequence[str]],
    *,
    bounded: bool = False,
) -> Generator[Any]:
    """Open a database in memory with the views of a catalogue.

    ``sessions`` has a row a session, ``analyses`` the latest results of each, ``catalog`` both side
    by side, ``joints`` a row a joint and window of every result.

    Args:
        base: Kind of row to the Parquet file that :func:`put_together` made, or none.
        new: Kind of row to the names of its other Parquet files.
        bounded: For a query of any origin: nothing but the views can be read, nothing written.

    Raises:
        FileNotFoundError: If a file is no longer there.
        MissingExtraError: If DuckDB is not installed.
    """
    check_installed()
    import duckdb

    database: Any = duckdb.connect(config=_BOUNDED if bounded else _CONFIG)
    try:
        try:
            _open_views(database, store, base, new)
        except duckdb.IOException as error:
            raise_if_vanished(error)
            raise
        if bounded:
            _close_off(database, store, [*base.values(), *new.values()])
        yield database
    finally:
        database.close()


def _open_views(
    database: Any,
    store: ObjectStore,
    base: Mapping[str, Sequence[str]],
    new: Mapping[str, Sequence[str]],
) -> None:
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


def raise_if_vanished(error: Exception) -> None:
    """Raise an error of DuckDB as what it is where another process removed a file meanwhile.

    Raises:
        FileNotFoundError: If it is one.
    """
    if "No files found" in str(error) or "Cannot open file" in str(error):
        raise FileNotFoundError(str(error)) from error


def check_installed() -> None:
    """Check that DuckDB is there.

    Raises:
        MissingExtraError: If it is not.
    """
    if find_spec("duckdb") is None:
        raise MissingExtraError("catalog", "catalog", "duckdb")


def _close_off(database: Any, store: ObjectStore, names: Iterable[Sequence[str]]) -> None:
    """Leave a database nothing to read or write but the files of its views."""
    if store.is_local:
        paths = ", ".join(_quoted(store.path(name)) for part in names for name in part)
        database.execute(f"set allowed_paths = [{paths}]")
    for setting in _CLOSED:
        database.execute(f"set {setting}")


def _quoted(text: str) -> str:
    return "'" + text.replace("'", "''") + "'"


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
    """Make rows a view of the database; local ones are read when needed.

    Columns that files of earlier versions lack are null.
    """
    if names and store.is_local:
        paths = ", ".join(_quoted(store.path(name)) for name in names)
        database.register(f"{view}_columns", table_of(kind, []))
        database.execute(
            f"create temp view {view} as select * from {view}_columns union all by name "  # noqa: S608
            f"select * from read_parquet([{paths}], union_by_name=true)"
        )
        return
    tables = [table_of(kind, []), *(store.read_table(name) for name in names)]
    database.register(view, _ARROW.concat_tables(tables, promote_options="default"))
