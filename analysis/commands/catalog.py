"""Command ``catalog``."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

from undulog.capture.common.console import (
    UNLIMITED,
    TerminalColumn,
    complain,
    echo,
    emit_json,
    output_width,
    progress,
    table,
)
from undulog.capture.common.errors import UsageError
from undulog.capture.common.files import check_output, part_file
from undulog.capture.common.process import interruptible

if TYPE_CHECKING:
    from ..catalog.catalog import ScanReport

_ENDINGS = (".csv", ".json", ".parquet")
_SHOWN = 500
_SPARE = {"path": 0, "joint": 0, "robot": 2, "start": 3, "duration_s": 1, "verdict": 2}
_COLUMNS = {
    False: ("path", "robot", "start", "duration_s", "verdict", "sentence"),
    True: ("path", "joint", "plane", "gain", "lag_rad", "energy_abs_j", "flags"),
}


def catalog(
    where: str,
    /,
    *,
    find: Annotated[str, Parameter(name="--where")] = "",
    joints: bool = False,
    sql: str = "",
    analyse: bool = False,
    scan: Annotated[bool, Parameter(negative="--no-scan")] = True,
    workers: int = 1,
    json: bool = False,
    output: Annotated[Path | None, Parameter(name=["--output", "-o"])] = None,
    force: bool = False,
) -> int:
    """Find sessions by robot, gait, date, verdict and results.

    Reads what is new or changed in a folder and its subfolders, or under a URL of an object store,
    and keeps it there in `.undulog-catalog`: of each session (`.mcap`, `.bag`, `.db3`, rosbag2
    folder) topics, times and counts, of each result that `undulog analyse -o` or `undulog sweep`
    wrote its numbers. Conditions are SQL for DuckDB; angles are in rad, `NAME_low` and `NAME_high`
    are the ends of 95 % intervals.

    Example: `undulog catalog lab --where "robot = 'snake25' and lag_sd > 0.05"`

    Args:
        where: A folder, or a URL such as `s3://bucket/lab`.
        find: Condition on the sessions, or, with `--joints`, on their joints.
        joints: Show a row a joint and window instead of a row a session.
        sql: A whole query over the views `catalog`, `sessions`, `analyses` and `joints`.
        analyse: Analyse sessions that have no results yet; each is read whole.
        scan: Look for new and changed files first.
        workers: Processes that analyse.
        json: Print one JSON object instead of a table.
        output: Write all columns to this file too, `.csv`, `.json` or `.parquet`.
        force: Replace the output file if it exists.
    """
    if sql and (find or joints):
        raise UsageError("--sql is a whole query; leave out --where and --joints")
    if workers < 1:
        raise UsageError(f"--workers {workers}: give 1 or more")
    if output is not None:
        why = f"{output}: end its name in {', '.join(_ENDINGS)}"
        check_output(output, _ENDINGS, why, force=force)
    from ..catalog.catalog import Catalog

    catalogue = Catalog(where)
    report, faults, complete = None, dict[str, str](), True
    with interruptible() as stop:
        if scan:
            with progress("catalog", total=1) as bar:
                report = catalogue.scan(
                    stop=stop, on_read=lambda k, n: bar.update(k / n, f"{k} of {n}")
                )
            complete = report.complete
            for text in report.set_aside:
                complain(text)
        if analyse and complete:
            with progress("analyse", total=1) as bar:
                faults = catalogue.analyse(
                    workers=workers,
                    stop=stop,
                    on_done=lambda k, n: bar.update(k / n, f"{k} of {n}"),
                )
            complete = not stop.requested
    rows = catalogue.sql(sql) if sql else catalogue.find(find, joints=joints)
    if output is not None:
        _write(rows, output)
    for name, why in faults.items():
        complain(f"{name}: {why}")
    if json:
        scanned = None if report is None else asdict(report)
        emit_json({"scan": scanned, "faults": faults, "rows": _plain(rows)})
    else:
        _print(rows, None if sql else _COLUMNS[joints], report)
    return 0 if complete and not faults else 1


def _plain(rows: Any) -> list[dict[str, Any]]:
    """Rows as JSON takes them; times as ISO 8601 text, what is missing as null."""
    import json

    return json.loads(rows.to_json(orient="records", date_format="iso", date_unit="ns"))


def _write(rows: Any, output: Path) -> None:
    with part_file(output) as part:
        if output.suffix == ".parquet":
            rows.to_parquet(part, index=False, engine="pyarrow")
        elif output.suffix == ".csv":
            rows.to_csv(part, index=False)
        else:
            rows.to_json(part, orient="records", date_format="iso", date_unit="ns", indent=1)


def _print(rows: Any, names: tuple[str, ...] | None, report: ScanReport | None) -> None:
    width = output_width()
    names = tuple(rows.columns) if names is None else names
    cells = [
        [(_text(value), "") for value in row]
        for row in rows.loc[:, list(names)].head(_SHOWN).itertuples(index=False)
    ]
    columns = [
        TerminalColumn(name, left=rows[name].dtype.kind not in "iuf", spare=_SPARE.get(name, 0))
        for name in names
    ]
    lines, _ = table(columns, cells, width, cropped=width != UNLIMITED)
    echo(*(line.plain for line in lines))
    if (more := len(rows) - _SHOWN) > 0:
        echo(f"... and {more} more; -o FILE.csv or .parquet has all of them, with all columns")
    summary = f"{len(rows)} row{'' if len(rows) == 1 else 's'}"
    if report is not None:
        summary += f"; {report.sessions} sessions, {report.read} files read now"
        summary += f" in {report.wall_s:.1f} s"
        if report.damaged:
            summary += f", {report.damaged} of them damaged (column damage)"
    echo(summary)


def _text(value: Any) -> str:
    if isinstance(value, str):
        return value
    if hasattr(value, "__len__"):
        return " ".join(map(str, value))
    if value is None or value != value:  # noqa: PLR0124 - a missing number or time
        return ""
    if hasattr(value, "strftime"):
        return value.strftime("%Y-%m-%d %H:%M:%S")
    return f"{value:.4g}" if isinstance(value, float) else str(value)
