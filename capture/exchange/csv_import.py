"""CSV logs into sessions, by a column map (:mod:`.capture.exchange.column_map`)."""

from __future__ import annotations

import csv
import math
from array import array
from collections.abc import Callable
from dataclasses import dataclass
from decimal import Decimal
from functools import partial
from pathlib import Path
from typing import TextIO

import numpy as np

from ..common.arrays import FloatArray, IntArray
from ..common.console import progress
from ..common.errors import ImportFormatError
from ..common.process import StopRequest
from ..common.strict_table import listed
from ..robot.bus_map import TIME_UNITS, unit_for
from ..robot.model import Robot
from .can_import import ImportReport, imported_session
from .can_logs import CSV_HEADER
from .column_map import Column, ColumnMap
from .frame_log import LATEST_NS, RELATIVE_EPOCH_NS
from .joint_topics import JointTopic, topics_of

EARLIEST_NS = 10**17
"""1973 [ns]: less is no date but a time since the log's start."""

_ROWS_PER_UPDATE = 4096


def is_frame_csv(path: Path) -> bool:
    """Return whether a file is a CSV of CAN frames by python-can; False if it is unreadable."""
    try:
        with path.open(encoding="utf-8-sig", errors="replace") as stream:
            return stream.readline().startswith(CSV_HEADER)
    except OSError:
        return False


def import_csv(
    source: Path,
    output: Path,
    robot: Robot,
    column_map: ColumnMap,
    *,
    force: bool = False,
    stop: StopRequest | None = None,
) -> ImportReport:
    """Turn a CSV log into a session.

    Positions go to ``/joint_states``, with velocities and efforts beside them; commands, currents,
    voltages and temperatures to their own topics. An empty cell is no sample: NaN where other
    joints have one, no message where none has. Times since the log's start, that is before 1973,
    are put at 2000-01-01T00:00:00Z.

    Args:
        source: The log, with a header line.
        robot: The robot that made the log.
        stop: Ends the import early, with a whole file of what was written so far.

    Raises:
        ImportFormatError: If the log lacks a column or a cell is no number; names row and column.
        OutputExistsError: If the output is there and ``force`` is not given.
        LogWriteError: If the output can't be written.
    """
    table = _read(source, column_map)
    relative = abs(int(table.t_ns[0])) < EARLIEST_NS
    t_ns = table.t_ns + (RELATIVE_EPOCH_NS if relative else 0)
    report = ImportReport(
        source, output, robot.name, start_ns=int(t_ns[0]), end_ns=int(t_ns[-1]), notes=table.notes
    )
    facts = {
        "import.format": "csv",
        "import.time": "counted from the log's start, put at 2000-01-01T00:00:00Z"
        if relative
        else "as recorded",
    }
    with (
        imported_session(
            source, output, robot, epoch_ns=report.start_ns, facts=facts, force=force
        ) as writer,
        progress(f"import {source.name}", len(t_ns)) as bar,
    ):
        writer.attach("columns.toml", "application/toml", column_map.toml().encode())
        values = {
            (column.joint, column.quantity): series
            for column, series in zip(column_map.columns, table.values, strict=True)
        }
        chain = sorted(values, key=lambda key: robot.joint_names.index(key[0]))
        topics = [
            JointTopic(writer, chain, quantities)
            for quantities in topics_of({column.quantity for column in column_map.columns})
        ]
        report.samples = dict.fromkeys((topic.name for topic in topics), 0)
        for at in range(0, len(t_ns), _ROWS_PER_UPDATE):
            bar.update(at)
            if stop is not None and stop.requested:
                report.complete, report.end_ns = False, int(t_ns[at])
                break
            rows = slice(at, at + _ROWS_PER_UPDATE)
            cells = {key: series[rows] for key, series in values.items()}
            for topic in topics:
                report.samples[topic.name] += topic.write(t_ns[rows], cells)
        writer.set_verdict(report.verdict, [*report.problems, *report.notes])
    return report


@dataclass(frozen=True)
class _TimedColumns:
    """Times [ns] since whatever the log counts from, (n,), and values of each column, (n,)."""

    t_ns: IntArray
    values: list[FloatArray]
    notes: list[str]


def _read(source: Path, column_map: ColumnMap) -> _TimedColumns:
    try:
        with source.open(encoding="utf-8-sig", newline="") as stream:
            return _read_stream(source, stream, column_map)
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise ImportFormatError(source, f"can't be read: {error}") from error


def _read_stream(source: Path, stream: TextIO, column_map: ColumnMap) -> _TimedColumns:
    reader = csv.reader(stream, delimiter=column_map.delimiter, skipinitialspace=True)
    header = [name.strip() for name in next(reader, list[str]())]
    wanted = [column_map.time_column, *(column.column for column in column_map.columns)]
    places = [_place(source, header, name) for name in wanted]
    unit_ns = TIME_UNITS[column_map.time_unit]
    times: list[int] = []
    cells = [array("d") for _ in column_map.columns]
    for row in reader:
        if not row:
            continue
        if len(row) != len(header):
            raise ImportFormatError(
                source, f"row {reader.line_num} has {len(row)} cells, the header {len(header)}"
            )
        where = partial(_fault, source, reader.line_num)
        t_ns = time_ns(row[places[0]], unit_ns, where, wanted[0])
        if times and t_ns < times[-1]:
            raise where(wanted[0], f"time goes back, from {times[-1] / unit_ns:g}")
        times.append(t_ns)
        for numbers, place, name in zip(cells, places[1:], wanted[1:], strict=True):
            numbers.append(_number(row[place], where, name))
    if not times:
        raise ImportFormatError(source, "has no rows below its header")
    series = [np.frombuffer(numbers, dtype=np.float64) for numbers in cells]
    notes: list[str] = []
    values: list[FloatArray] = []
    for column, cells_of in zip(column_map.columns, series, strict=True):
        if count := int(np.isnan(cells_of).sum()):
            notes.append(f"column {column.column!r}: {count} cells without a value")
        values.append(_converted(column, cells_of))
    return _TimedColumns(np.array(times, dtype=np.int64), values, notes)


def _fault(source: Path, row: int, column: str, what: str) -> ImportFormatError:
    return ImportFormatError(source, f"row {row}, column {column!r}: {what}")


def _place(source: Path, header: list[str], name: str) -> int:
    if header.count(name) != 1:
        found = f"{header.count(name)} columns" if name in header else "no column"
        raise ImportFormatError(source, f"has {found} {name!r}; it has {listed(header, name)}")
    return header.index(name)


def time_ns(
    cell: str, unit_ns: int, where: Callable[[str, str], ImportFormatError], name: str
) -> int:
    """Parse a time [ns] in decimal: a double can't hold Unix times to the ns."""
    try:
        t_ns = Decimal(cell.strip()) * unit_ns
        if abs(t_ns) < LATEST_NS:
            return round(t_ns)
    except (ArithmeticError, ValueError) as error:
        raise where(name, f"{cell!r} is not a time") from error
    raise where(name, f"{cell[:40]!r} is no time before 2038, which stamps hold")


def _number(cell: str, where: Callable[[str, str], ImportFormatError], name: str) -> float:
    if not cell or cell.isspace():
        return math.nan
    try:
        number = float(cell)
    except ValueError as error:
        raise where(name, f"{cell!r} is not a number") from error
    if math.isinf(number):
        raise where(name, f"{cell!r} is not a finite number")
    return number


def _converted(column: Column, values: FloatArray) -> FloatArray:
    """Convert cells to the session's unit: unwrapped, scaled and offset."""
    plain = values.copy()
    if column.wrap:
        known = ~np.isnan(plain)
        plain[known] = np.unwrap(plain[known], period=column.wrap)
    return unit_for(column.unit, column.quantity).convert(column.scale * plain + column.offset)
