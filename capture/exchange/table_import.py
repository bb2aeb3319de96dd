"""Tables and arrays into sessions: one file, states and commands apart, or a folder of them."""

from __future__ import annotations

import heapq
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from decimal import Decimal
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from ..common.arrays import NS, FloatArray, IntArray
from ..common.console import progress, refuse_existing
from ..common.errors import ImportFormatError, UsageError, some_names
from ..common.files import write_text
from ..common.process import StopRequest
from ..log.mcap.writer import Compression
from ..log.read.facts import TIMES_FROM_FPS
from ..log.write.writer import SessionWriter
from ..robot.bus_map import TIME_UNITS, unit_for
from ..robot.model import Quantity, Robot
from .column_blocks import Block, joined, refuse
from .column_map import (
    COMMANDS,
    STATES,
    ColumnMap,
    JointTopic,
    MappedColumn,
    column_map_from_options,
    read_column_map,
    topics_of,
)
from .frame_log import EARLIEST_NS, LATEST_NS, RELATIVE_EPOCH_NS
from .import_options import ImportOptions
from .marker_tracks import as_joints, with_fps
from .reports import ImportReport
from .session_import import LEVEL, digest_of, imported_session
from .table_file import TableFile, as_wide, is_time, words
from .table_guess import guess_map, parse_units

_MOST = 1e200


@dataclass(frozen=True)
class _Messages:
    """Messages of some time, and what writes them.

    Attributes:
        first: Time of the first one [ns], and the order among those of one time.
    """

    first: tuple[int, int]
    last_ns: int
    write: Callable[[], None]


@dataclass(frozen=True)
class TableSet:
    """The files of one recording.

    Attributes:
        tables: ``states``, ``commands`` or both.
        digest: Returns that of all files' bytes; called once reading has begun, which other threads
            go on with.
        joints: Names in the order of vectors, if a file lists them.
        events: A table of times and texts, if there is one.
        left_out: Names of files that were not read.
        facts: For the session's metadata, beside those of any import.
        compression: Of the session.
    """

    source: Path
    tables: dict[str, TableFile]
    digest: Callable[[], str]
    joints: tuple[str, ...] = ()
    events: TableFile | None = None
    left_out: tuple[str, ...] = ()
    facts: Mapping[str, str] = field(default_factory=dict[str, str])
    compression: Compression = LEVEL


def of_files(table: TableFile, commands: TableFile | None = None) -> TableSet:
    """Return a recording of one table, or of states and commands in two."""
    tables = {STATES: table} | ({COMMANDS: commands} if commands is not None else {})
    return TableSet(table.path, tables, partial(digest_of, [t.path for t in tables.values()]))


def with_options(table_set: TableSet, output: Path, options: ImportOptions) -> ImportReport:
    """Turn tables into a session, by the options of the command; see :func:`import_tables`.

    Raises:
        UsageError: If ``fps`` is given for a table that has times.
    """
    robot = options.described()
    column_map = _column_map(robot, options)
    needed = () if column_map is None else [column.column for column in column_map.columns]
    return import_tables(
        prepared(table_set, options.fps, needed),
        output,
        robot=robot,
        column_map=column_map,
        units=parse_units(options.units),
        write_map=options.write_map,
        force=options.force,
        stop=options.stop,
    )


def _column_map(robot: Robot | None, options: ImportOptions) -> ColumnMap | None:
    """Return the column map that was given; None if it is to be guessed."""
    if options.columns is not None and options.map:
        raise UsageError("--columns MAP.toml or --map options, not both")
    if options.columns is not None:
        return read_column_map(options.columns, robot)
    return column_map_from_options(options.map, robot) if options.map else None


def prepared(
    table_set: TableSet, fps: float | None = None, needed: Collection[str] = ()
) -> TableSet:
    """Return tables of times and joints: long ones made wide, tracks turned into angles.

    Args:
        fps: Rows a second of tables without times.
        needed: Columns that a map names; a table that has all of them stays as it is.

    Raises:
        UsageError: If ``fps`` is given for a table that has times.
    """
    tables = dict(table_set.tables)
    for role, table in tables.items():
        if not needed or not {*table.columns}.issuperset(needed):
            wide = as_wide(table) or table
            tables[role] = as_joints(wide) or wide
    if fps is None:
        return replace(table_set, tables=tables)
    if not 0 < fps < NS:
        raise UsageError(f"--fps {fps:g}: more than 0 and less than 1e9 frames a second")
    made = {
        "import.time": f"made from the number of the frame and fps = {fps:g}",
        TIMES_FROM_FPS: f"{fps:g}",
    }
    tables = {role: with_fps(table, fps) for role, table in tables.items()}
    return replace(table_set, tables=tables, facts={**table_set.facts, **made})


def import_tables(
    table_set: TableSet,
    output: Path,
    *,
    robot: Robot | None = None,
    column_map: ColumnMap | None = None,
    units: Mapping[str, str] | None = None,
    map_notes: Sequence[str] = (),
    write_map: Path | None = None,
    force: bool = False,
    stop: StopRequest | None = None,
) -> ImportReport:
    """Turn tables into a session; what was guessed is in the report's notes.

    Args:
        robot: The robot that made them; without it joints are named by the columns.
        column_map: What the columns mean; guessed if None.
        units: Quantity, or ``time``, to unit, for the guess.
        map_notes: Notes on a map that is given.
        write_map: Where to write the map.
        stop: Ends the import early, with a whole file of what was written so far.

    Raises:
        ImportFormatError: If a table lacks a column or has a cell that is no number.
        OutputExistsError: If the output or the map is there and ``force`` is not given.
        LogWriteError: If the output can't be written.
    """
    if write_map is not None:
        refuse_existing(write_map, force=force)
    refuse_existing(output, force=force)
    notes: list[str] = list(map_notes)
    if column_map is None:
        joints = table_set.joints or (robot.joint_names if robot else ())
        guess = guess_map(table_set.tables, joints, units or {})
        column_map, notes = guess.column_map, [*map_lines(guess.column_map), *guess.notes]
        if guess.left_out:
            names = list(dict.fromkeys(name.partition("[")[0] for name in guess.left_out))
            notes.append(f"columns without a place left out: {some_names(names, 20)}")
    notes += [f"file left out: {name}" for name in table_set.left_out]
    if write_map is not None:
        write_text(write_map, column_map.toml())
        notes.append(f"map written to {write_map}; edit it and give it back by --columns")
    unknown = {column.table for column in column_map.columns} - table_set.tables.keys()
    if unknown:
        raise UsageError(f"the map has columns of {', '.join(unknown)}, but no such table is given")
    report = ImportReport(table_set.source, output, robot.name if robot else "unknown robot")
    report.notes = notes
    _write(table_set, column_map, robot, report, force=force, stop=stop)
    return report


def _write(
    table_set: TableSet,
    column_map: ColumnMap,
    robot: Robot | None,
    report: ImportReport,
    *,
    force: bool,
    stop: StopRequest | None,
) -> None:
    sources = [
        source
        for role, table in table_set.tables.items()
        if (source := _Source(table, role, column_map)).columns
    ]
    first_ns = min(source.first_ns() for source in sources)
    relative = abs(first_ns) < EARLIEST_NS
    offset = RELATIVE_EPOCH_NS if relative else 0
    report.start_ns = report.end_ns = first_ns + offset
    if report.start_ns < 0:
        raise ImportFormatError(table_set.source, "not all times are from 1970 to 2038")
    form = next(iter(table_set.tables.values()))
    facts = {
        "import.format": form.path.suffix.removeprefix(".").lower() or "csv",
        "import.time": "counted from the log's start, put at 2000-01-01T00:00:00Z"
        if relative
        else "as recorded",
        **table_set.facts,
    }
    with (
        imported_session(
            table_set.source, report.output, robot, epoch_ns=report.start_ns, facts=facts,
            force=force, digest=table_set.digest, compression=table_set.compression,
        ) as writer,
        progress(f"import {table_set.source.name}", 1.0) as bar,
    ):  # fmt: skip
        writer.attach("columns.toml", "application/toml", column_map.toml().encode())
        streams = [source.messages(writer, offset, report) for source in sources]
        if table_set.events is not None:
            unit = column_map.time_of(COMMANDS if COMMANDS in table_set.tables else STATES)[1]
            streams.append(_events(table_set.events, unit, offset, writer, report))
        for block in heapq.merge(*streams, key=lambda block: block.first):
            block.write()
            report.end_ns = max(report.end_ns, block.last_ns)
            bar.update(0.0, note=f"{sum(report.samples.values())} messages")
            if stop is not None and stop.requested:
                report.complete = False
                break
        if not report.samples:
            raise ImportFormatError(table_set.source, "has no row with a value of a mapped column")
        for source in sources:
            report.notes += source.missing()
        writer.set_verdict(report.verdict, [*report.problems, *report.notes])


def map_lines(column_map: ColumnMap) -> list[str]:
    """Return what each quantity was taken from, one sentence each."""
    lines: list[str] = []
    for quantity in dict.fromkeys(column.quantity for column in column_map.columns):
        mine = [column for column in column_map.columns if column.quantity is quantity]
        pairs = [f"{column.column} -> {column.joint}" for column in mine]
        table = f" of {mine[0].table}" if column_map.commands_time or len(mine) > 1 else ""
        lines.append(f"{quantity} [{mine[0].unit}]{table}: {some_names(pairs, 6)}")
    return lines


class _Source:
    """One table on its way into the session, block by block."""

    def __init__(self, table: TableFile, role: str, column_map: ColumnMap) -> None:
        self.table = table
        self.columns = [column for column in column_map.columns if column.table == role]
        self._time, unit = column_map.time_of(role)
        self._unit_ns = TIME_UNITS[unit]
        names = [self._time, *(column.column for column in self.columns)]
        for name in names if self.columns else ():
            if (count := table.columns.count(name)) != 1:
                refuse(
                    table.path,
                    f"has {count or 'no'} column{'s' if count else ''} {name!r}; it has "
                    f"{some_names(table.columns, 20)}",
                )
        self._names = list(dict.fromkeys(names))
        self._order = 0 if role == COMMANDS else 1
        self._last_ns: int | None = None
        self._rows = 0
        self._unwrapped: dict[str, tuple[float, float]] = {}
        self._missing: dict[str, int] = {}
        self._blocks = table.read(self._names, self._time) if self.columns else iter(())

    def first_ns(self) -> int:
        """Return the time of the first row [ns]."""
        block = next(self._blocks, None)
        if block is None or not len(block[self._time]):
            refuse(self.table.path, f"has no rows{' below its header' if self.table.row else ''}")
        self._blocks = chain([block], self._blocks)
        return int(self._times(block[self._time][:1])[0])

    def messages(
        self, writer: SessionWriter, offset: int, report: ImportReport
    ) -> Iterator[_Messages]:
        """Yield the messages of each block, in order of time."""
        mapping = {(column.joint, column.quantity): column for column in self.columns}
        columns: dict[Quantity, list[MappedColumn]] = {}
        for (_, quantity), column in mapping.items():
            columns.setdefault(quantity, []).append(column)
        topics = [
            JointTopic(writer, list(mapping), quantities) for quantities in topics_of(set(columns))
        ]
        for block in self._blocks:
            if not len(block[self._time]):
                continue
            t_ns = self._checked(self._times(block[self._time]), offset)
            values = {key: self._converted(group, block) for key, group in columns.items()}
            self._rows += len(t_ns)
            yield _Messages(
                (int(t_ns[0]), self._order),
                int(t_ns[-1]),
                partial(_write_block, topics, t_ns, values, report),
            )

    def missing(self) -> list[str]:
        """Return how many cells of each column had no value."""
        names = [column.column for column in self.columns if self._missing.get(column.column)]
        return [f"column {name!r}: {self._missing[name]} cells without a value" for name in names]

    def _fault(self, column: str, at: int, why: str) -> NoReturn:
        """Refuse a cell of the block at hand; its row is named where the file has such rows."""
        row = f"row {self.table.row(self._rows + at)}, " if self.table.row else ""
        refuse(self.table.path, f"{row}column {column!r}: {why}")

    def _times(self, cells: NDArray[Any]) -> IntArray:
        unit, name = self._unit_ns, self._time
        if cells.dtype.kind in "iuf":
            with np.errstate(over="ignore"):
                t_ns = cells.astype(float) * unit
            if not np.all(np.abs(t_ns) < LATEST_NS):
                refuse(self.table.path, f"column {name!r}: no time before 2038")
            return cells.astype(np.int64) * unit if cells.dtype.kind != "f" else _rounded(t_ns)
        exact = np.empty(len(cells), dtype=np.int64)
        for at, cell in enumerate(cells):
            text = str(cell)
            try:
                exact[at] = _exact_ns(text.replace(",", "."), unit)
            except OverflowError:
                self._fault(name, at, f"{text[:40]!r} is no time before 2038")
            except (ArithmeticError, ValueError):
                self._fault(name, at, f"{text[:40]!r} is not a time")
        return exact

    def _checked(self, t_ns: IntArray, offset: int) -> IntArray:
        """Return the times of a session, which don't go back."""
        before = self._last_ns if self._last_ns is not None else int(t_ns[0])
        steps = np.diff(t_ns, prepend=before)
        back = np.flatnonzero(steps < 0)
        if len(back):
            at = int(back[0])
            now = int(t_ns[at])
            ago = now - int(steps[at])
            self._fault(self._time, at, f"time goes back, from {ago / NS:g} to {now / NS:g} s")
        self._last_ns = int(t_ns[-1])
        stamps = t_ns + offset
        if not 0 <= int(stamps[0]) <= int(stamps[-1]) < LATEST_NS:
            refuse(self.table.path, f"column {self._time!r}: not all times are from 1970 to 2038")
        return stamps

    def _converted(self, columns: Sequence[MappedColumn], block: Block) -> FloatArray:
        """Return the cells of some columns in the session's unit, shape (n, m).

        They have single precision if all of them had it and none is converted.
        """
        cells = [self._numbers(column, block[column.column]) for column in columns]
        changed = [k for k, column in enumerate(columns) if not column.is_plain]
        values: FloatArray = joined(cells)
        if not -_MOST < float(values.min()) <= float(values.max()) < _MOST:
            present = ~np.isnan(values)
            for column, numbers, there in zip(columns, values.T, present.T, strict=True):
                if len(bad := np.flatnonzero(there & ~(np.abs(numbers) < _MOST))):
                    text = str(numbers[bad[0]])
                    why = f"{text!r} is not a finite number, or beyond {_MOST:g}"
                    self._fault(column.column, int(bad[0]), why)
                missing = self._missing.get(column.column, 0) + int(len(numbers) - there.sum())
                self._missing[column.column] = missing
        if changed:
            values = values.astype(np.float64)
        for k in changed:
            values[:, k] = self._in_unit(columns[k], values[:, k])
        return values

    def _numbers(self, column: MappedColumn, cells: NDArray[Any]) -> NDArray[Any]:
        if cells.dtype.kind in "fiu":
            return cells
        try:
            return cells.astype(np.float64)
        except (ValueError, TypeError):
            bad = next((at for at, cell in enumerate(cells) if not _is_number(cell)), 0)
            self._fault(column.column, bad, f"{str(cells[bad])[:40]!r} is not a number")

    def _in_unit(self, column: MappedColumn, values: FloatArray) -> FloatArray:
        """Convert numbers to the session's unit: unwrapped over blocks, scaled and offset."""
        present = ~np.isnan(values)
        if column.wrap and present.any():
            raw = values[present]
            before = self._unwrapped.get(column.column, (raw[0], raw[0]))
            turns = np.unwrap(np.concatenate([[before[0]], raw]), period=column.wrap)
            values[present] = turns[1:] + (before[1] - before[0])
            self._unwrapped[column.column] = (raw[-1], values[present][-1])
        scaled = values if column.scale == 1.0 else column.scale * values
        unit = unit_for(column.unit, column.quantity)
        return unit.convert(scaled + column.offset if column.offset else scaled)  # keeps -0.0


def _rounded(t_ns: FloatArray) -> IntArray:
    return np.rint(t_ns).astype(np.int64)


def _exact_ns(text: str, unit_ns: int) -> int:
    """Parse a time [ns].

    Raises:
        ArithmeticError: If it is none, or no stamp can hold it.
    """
    t_ns = Decimal(text) * unit_ns
    if not abs(t_ns) < LATEST_NS:  # before it is rounded: 1e999999999 has as many digits
        raise OverflowError(f"{text[:40]} is no time before 2038")
    return round(t_ns)


def _is_number(cell: object) -> bool:
    try:
        float(str(cell))
    except ValueError:
        return False
    return True


def _write_block(
    topics: Sequence[JointTopic],
    t_ns: IntArray,
    values: Mapping[Quantity, FloatArray],
    report: ImportReport,
) -> None:
    for topic in topics:
        if count := topic.write(t_ns, values):
            report.samples[topic.name] = report.samples.get(topic.name, 0) + count


def _events(
    table: TableFile, unit: str, offset: int, writer: SessionWriter, report: ImportReport
) -> Iterator[_Messages]:
    """Yield the events of a table, a time and a text a row, in order of time."""
    path = table.path
    time = next((name for name in table.columns if is_time(name)), None)
    if time is None:
        refuse(path, "has no column of times")
    text = next((name for name in table.columns if "event" in words(name)), table.columns[-1])
    log = writer.log()
    events: list[tuple[int, str]] = []
    for block in table.read([time, text], time):
        for stamp, event in zip(block[time].tolist(), block[text].tolist(), strict=True):
            try:
                t_ns = _exact_ns(str(stamp), TIME_UNITS[unit]) + offset
            except ArithmeticError as error:
                why = f"{stamp!r} is no time before 2038"
                raise ImportFormatError(path, why) from error
            if not 0 <= t_ns < LATEST_NS:
                refuse(path, f"{stamp!r} is no time before 2038")
            events.append((t_ns, str(event)))

    def writing(t_ns: int, event_text: str) -> Callable[[], None]:
        def write() -> None:
            log.write(t_ns, "info", path.stem, event_text)
            report.samples["/rosout"] = report.samples.get("/rosout", 0) + 1

        return write

    for t_ns, event in sorted(events):
        yield _Messages((t_ns, 2), t_ns, writing(t_ns, event))
