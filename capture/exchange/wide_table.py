"""Joint columns of a session as a wide table: a column for each joint and quantity.

Columns: ``t_ns`` (Unix ns), ``time [s]`` (from the first row), then ``JOINT.QUANTITY [UNIT]``, as
``joint01.command [rad]`` or ``joint01.velocity [rad/s]``; fields that are no quantity of the log
contract are ``JOINT.TOPIC.FIELD [UNIT]``.

Each joint has sampling times of its own. There is a row for every time at which some joint was
sampled, and a row holds the samples of exactly that time: nothing is resampled or filled in. The
other cells are empty in CSV and null in Parquet; ``nan`` is a sample without a number. Samples of
one joint that repeat a time have as many rows of that time, in their order.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..bus.decoded_topics import JOINT_TOPIC
from ..common.arrays import NS, FloatArray, IntArray
from ..common.console import progress
from ..common.errors import DataError, UsageError, some_names
from ..common.files import check_stop, part_file
from ..common.process import StopRequest
from ..common.strict_table import NAME_PATTERN
from ..log.read.session import Session
from ..robot.bus_map import SESSION_UNIT
from ..robot.model import Quantity
from .column_blocks import OpenTable, with_gaps
from .long_table import joint_fields, joint_topics
from .reports import ExportReport
from .session_export import refuse_session

_HEAD = {"t_ns": "int64", "time [s]": "float64"}
"""Columns before those of the joints."""

_MOST_COLUMNS = 2000
_MOST_CELLS = 2_000_000  # of a block
_FORGET_EVERY = 32  # blocks
_MOST_SPARSE = 200_000_000  # cells of a table that is nearly empty
_LEAST_FILLED = 200  # cells for each sample

_QUANTITIES = {(topic, "position"): quantity for quantity, topic in JOINT_TOPIC.items()} | {
    (JOINT_TOPIC[Quantity.POSITION], "velocity"): Quantity.VELOCITY,
    (JOINT_TOPIC[Quantity.POSITION], "effort"): Quantity.EFFORT,
}
"""Topic and field to the quantity that they hold."""


@dataclass(frozen=True)
class WideColumn:
    """One quantity of one joint.

    Attributes:
        t_ns: Sampling times [Unix ns], not decreasing, shape (n,); columns that were sampled
            together may share one array.
        values: Shape (n,), NaN where a sample has no number.
    """

    name: str
    t_ns: IntArray
    values: FloatArray


@dataclass(frozen=True)
class WideBlock:
    """Rows of a wide table.

    Attributes:
        t_ns: Times [Unix ns], not decreasing, shape (n,).
        cells: Rows and values, shape (k,) each, of every column that has some.
        done: Share of the samples that this block and those before it hold.
    """

    t_ns: IntArray
    cells: dict[str, tuple[IntArray, FloatArray]]
    done: float


def wide_blocks(columns: Sequence[WideColumn], cells: int = _MOST_CELLS) -> Iterator[WideBlock]:
    """Yield the rows of columns with sampling times of their own.

    Args:
        cells: Rows times columns of a block, at most about twice; it has a sample at least.
    """
    sampled: dict[int, list[WideColumn]] = {}
    for column in columns:
        sampled.setdefault(id(column.t_ns), []).append(column)
    left: list[IntArray] = [group[0].t_ns for group in sampled.values()]
    at = dict.fromkeys(sampled, 0)
    total, done = sum(map(len, left)), 0
    most = max(1, cells // max(len(columns), 1))
    while left := [t for t in left if at[id(t)] < len(t)]:
        parts = _parts(left, at, most)
        t_ns, rows = _rows(list(zip(left, parts, strict=True)))
        done += sum(part.stop - part.start for part in parts)
        at |= {id(t): part.stop for t, part in zip(left, parts, strict=True)}
        filled = {
            column.name: (row, column.values[part])
            for t, part, row in zip(left, parts, rows, strict=True)
            for column in (sampled[id(t)] if len(row) else ())
        }
        yield WideBlock(t_ns, filled, done / total)


def _parts(times: Sequence[IntArray], at: Mapping[int, int], most: int) -> list[slice]:
    """Return the samples of a block, of each array of times those before one common end.

    The end is where the first of the arrays has been read for one step; the n-th sample of a time
    belongs to the n-th row of that time.

    Args:
        at: Where each array is read from, by its identity.
        most: Samples of all arrays, at most about twice unless the step is one.
    """
    step = most
    while True:
        ends = [(int(t[k]), k - int(t.searchsorted(int(t[k]))))
                for t in times if (k := at[id(t)] + step) < len(t)]  # fmt: skip
        end = min(ends, default=None)
        parts = [slice(at[id(t)], len(t) if end is None else _before(t, end)) for t in times]
        count = sum(part.stop - part.start for part in parts)
        if step == 1 or count <= 2 * most:
            return parts
        step = max(1, min(step // 2, step * most // count))


def _before(t_ns: IntArray, end: tuple[int, int]) -> int:
    """Return the number of samples before the n-th of a time."""
    time, n = end
    first, last = t_ns.searchsorted(time), t_ns.searchsorted(time, side="right")
    return int(min(first + n, last))


def _rows(parts: Sequence[tuple[IntArray, slice]]) -> tuple[IntArray, list[IntArray]]:
    """Return the times of the rows of a block, and the rows of each part's samples."""
    t_ns = np.concatenate([t[part] for t, part in parts])
    each_nth: list[IntArray] = [
        np.arange(part.start, part.stop) - t.searchsorted(t[part]) for t, part in parts
    ]
    nth = np.concatenate(each_nth)
    order = np.lexsort((nth, t_ns))
    is_new = np.ones(len(order), dtype=bool)
    is_new[1:] = (np.diff(t_ns[order]) != 0) | (np.diff(nth[order]) != 0)
    rows = np.empty(len(order), dtype=np.int64)
    rows[order] = np.cumsum(is_new) - 1
    cuts = np.cumsum([part.stop - part.start for _, part in parts])[:-1]
    return t_ns[order][is_new], np.split(rows, cuts)


def export_wide(
    open_file: OpenTable,
    source: Path,
    output: Path,
    *,
    topics: Sequence[str] = (),
    force: bool = False,
    stop: StopRequest | None = None,
) -> ExportReport:
    """Write joint columns of a session as a wide table.

    The columns are held in files without names beside the output where they are large.

    Args:
        open_file: Creates the file.
        output: The table to write.
        topics: JointState topics; if none, commands and all quantities that the joints measure.
        stop: Ends the export, with nothing left behind.

    Raises:
        UsageError: If the output is the session, or the table would be too wide, or large and
            nearly empty.
        OutputExistsError: If the output is there and ``force`` is not given.
        MissingChannelError: If the session has no such topic, or none of the default ones.
        DataError: If a topic is not of JointStates, or two columns would have one name.
        MissingExtraError: If a package for the format is not installed.
        LogWriteError: If the output can't be written or the export was stopped; nothing is left
            behind then.
    """
    refuse_session(source, output, force=force)
    with Session.open(source, column_folder=output.parent) as session:
        columns, warnings = wide_columns(session, topics)
        names = [column.name for column in columns]
        start_ns, count, samples = min(int(column.t_ns[0]) for column in columns), 0, 0
        with (
            part_file(output) as part,
            progress(f"export {output.name}", 1.0) as bar,
            open_file(part, {**_HEAD, **dict.fromkeys(names, "float64")}) as write,
        ):
            for number, block in enumerate(wide_blocks(columns)):
                if number % _FORGET_EVERY == 0:
                    session.forget()
                write(_cells(block, names, start_ns))
                count += len(block.t_ns)
                samples += sum(len(rows) for rows, _ in block.cells.values())
                if count * len(names) > max(_MOST_SPARSE, _LEAST_FILLED * samples):
                    raise UsageError(
                        f"{source}: a wide table of {len(names)} columns would be empty but for "
                        f"{samples / (count * len(names)):.1%} of its cells; choose columns "
                        "with --topics, or the long table (without --to wide)"
                    )
                bar.update(block.done)
                check_stop(output, stop)
        empty = 1.0 - samples / (count * len(columns))
        if empty > 0.5:
            warnings.append(
                f"{empty:.0%} of the cells are empty: joints were sampled at times of their own; "
                "the long table (without --to wide) has no such cells"
            )
        warnings += session.warnings
    names = [*_HEAD, *names]
    what = f"{count} rows of {len(names)} columns"
    return ExportReport(what, {"rows": count, "columns": names}, warnings)


def wide_columns(
    session: Session, topics: Sequence[str] = ()
) -> tuple[list[WideColumn], list[str]]:
    """Return the columns of JointState topics that have samples, and what is to be noted.

    Args:
        topics: The topics; if none, commands and all quantities that the joints measure.

    Raises:
        UsageError: If there are too many.
        MissingChannelError: If the session has no such topic, or none of the default ones.
        DataError: If a topic is not of JointStates, has no samples, or two columns would have one
            name.
    """
    by_topic = {
        topic: list(joint_fields(session, topic)) for topic in joint_topics(session, topics)
    }
    warnings = [f"{topic} carries no values" for topic, fields in by_topic.items() if not fields]
    read = session.joint_columns({topic: fields for topic, fields in by_topic.items() if fields})
    columns: dict[str, WideColumn] = {}
    unknown: list[str] = []
    for (topic, part), signals in read.items():
        quantity = _QUANTITIES.get((topic, part))
        plain = quantity is not None and signals.unit == SESSION_UNIT[quantity]
        for joint, t_ns, values in zip(signals.names, signals.t_ns, signals.values, strict=True):
            name = f"{joint}.{quantity} [{signals.unit}]"
            if not plain or name in columns:
                name = f"{joint}.{topic.removeprefix('/')}.{part} [{signals.unit}]"
            if name in columns:
                raise DataError(
                    f"{session.path}: {topic} names {joint} twice, and a column can't; the long "
                    "table (without --to wide) can"
                )
            if not plain or not NAME_PATTERN.fullmatch(joint):
                unknown.append(name)
            if len(t_ns):
                columns[name] = WideColumn(name, t_ns, values)
    if not columns:
        raise DataError(f"{session.path}: {some_names(list(by_topic), 10)} carry no values")
    if len(columns) > _MOST_COLUMNS:
        raise UsageError(
            f"{session.path} has {len(columns)} joint columns; a wide table takes at most "
            f"{_MOST_COLUMNS}: name those that you want with --topics"
        )
    if unknown:
        warnings.append(
            "undulog import doesn't know these columns by their names, give it a map (--columns): "
            f"{some_names(unknown, 6)}"
        )
    return list(columns.values()), warnings


def _cells(block: WideBlock, names: Sequence[str], start_ns: int) -> list[NDArray[Any]]:
    """Return an array for each column; a cell without a sample is masked, NaN is a sample."""
    columns: list[NDArray[Any]] = [block.t_ns, (block.t_ns - start_ns) / NS]
    count = len(block.t_ns)
    none = with_gaps(np.zeros(count), np.ones(count, dtype=bool))
    for name in names:
        if name not in block.cells:
            columns.append(none)
            continue
        rows, values = block.cells[name]
        cells, missing = np.zeros(count), np.ones(count, dtype=bool)
        cells[rows], missing[rows] = values, False
        columns.append(with_gaps(cells, missing))
    return columns
