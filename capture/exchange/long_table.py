"""Joint columns of a session as a table of rows, one a sample, for pandas and its like.

Columns: ``t_ns`` (the sample's own time, Unix ns), ``topic``, ``joint``, and one for each quantity,
named ``TOPIC.FIELD [UNIT]`` without the topic's leading slash, or ``TOPIC [UNIT]`` where the topic
is the quantity: ``joint_states.velocity [rad/s]``, ``joint_current [A]``. A row has the quantities
of its topic, and nothing in the columns of other topics. Nothing is resampled or filled in: joints
that were sampled one after the other have rows at different times. Rows are sorted by time within a
topic.

Names in a CSV are escaped as :mod:`.capture.common.files` says.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..bus.decoded_topics import JOINT_TOPIC
from ..common.arrays import FloatArray, IntArray
from ..common.console import progress
from ..common.errors import MissingChannelError, UsageError
from ..common.files import check_stop, part_file
from ..common.process import StopRequest
from ..log.messages.definitions import JOINT_STATE
from ..log.read.joint_messages import UNITS
from ..log.read.sample_times import JointSignals
from ..log.read.session import Session
from .column_blocks import OpenTable, with_gaps
from .reports import ExportReport
from .session_export import refuse_session

_HEAD = {"t_ns": "int64", "topic": "text", "joint": "text"}
"""Columns before those of the quantities."""

_MOST_TOPICS = 500
_ROWS_PER_BLOCK = 100_000


@dataclass(frozen=True)
class RowBlock:
    """Rows of one topic.

    Attributes:
        joint: Index into ``names`` for each row, shape (n,).
        t_ns: Sampling times [Unix ns], shape (n,).
        values: Column name to values, shape (n,); NaN where a sample has none.
    """

    topic: str
    names: tuple[str, ...]
    joint: IntArray
    t_ns: IntArray
    values: dict[str, FloatArray]


def export_columns(
    open_file: OpenTable,
    source: Path,
    output: Path,
    *,
    topics: Sequence[str] = (),
    force: bool = False,
    stop: StopRequest | None = None,
) -> ExportReport:
    """Write joint columns of a session as a table.

    One topic is held in memory at a time.

    Args:
        open_file: Creates the file.
        output: The table to write.
        topics: JointState topics; if none, commands and all quantities that the joints measure.
        stop: Ends the export, with nothing left behind.

    Raises:
        UsageError: If the output is the session, or so many topics would make too wide a table.
        OutputExistsError: If the output is there and ``force`` is not given.
        MissingChannelError: If the session has no such topic, or none of the default ones.
        DataError: If a topic is not of JointStates.
        MissingExtraError: If a package for the format is not installed.
        LogWriteError: If the output can't be written or the export was stopped; nothing is left
            behind then.
    """
    refuse_session(source, output, force=force)
    with Session.open(source) as session:
        chosen = joint_topics(session, topics)
        if len(chosen) > _MOST_TOPICS:
            raise UsageError(
                f"{source} has {len(chosen)} joint topics; a table takes at most {_MOST_TOPICS}: "
                "name those that you want with --topics"
            )
        fields = {topic: joint_fields(session, topic) for topic in chosen}
        columns = [name for names in fields.values() for name in names.values()]
        rows = dict.fromkeys(fields, 0)
        warnings = [
            f"{topic} carries no values" for topic, columns in fields.items() if not columns
        ]
        with (
            part_file(output) as part,
            progress(f"export {output.name}", len(fields)) as bar,
            open_file(part, {**_HEAD, **dict.fromkeys(columns, "float64")}) as write,
        ):
            for number, (topic, names) in enumerate(fields.items()):
                for block, done in _blocks(session, topic, names) if names else ():
                    write(_cells(block, columns))
                    rows[topic] += len(block.t_ns)
                    bar.update(number + done)
                    check_stop(output, stop)
        warnings += session.warnings
    total = sum(rows.values())
    what = f"{total} rows of {', '.join(rows)}"
    return ExportReport(what, {"rows": total, "topics": rows}, warnings)


def _cells(block: RowBlock, columns: Sequence[str]) -> list[NDArray[Any]]:
    """Return an array for each column; NaN is no value, and so are columns of other topics."""
    names, count = np.array(block.names, dtype=object), len(block.t_ns)
    none = with_gaps(np.zeros(count), np.ones(count, dtype=bool))
    return [
        block.t_ns,
        np.full(count, block.topic, dtype=object),
        names[block.joint],
        *(
            none if (values := block.values.get(name)) is None
            else with_gaps(values, np.isnan(values))
            for name in columns
        ),
    ]  # fmt: skip


def joint_topics(session: Session, topics: Sequence[str]) -> list[str]:
    """Return the requested JointState topics; if none, commands and what the joints measure.

    Raises:
        MissingChannelError: If none are requested and the session has none.
    """
    if topics:
        return list(dict.fromkeys(topics))
    joint = [t for t, channel in session.channels.items() if channel.type_name == JOINT_STATE]
    if not joint:
        raise MissingChannelError(session.path, "joint topics", sorted(session.channels))
    return [topic for topic in JOINT_TOPIC.values() if topic in joint] or sorted(joint)


def joint_fields(session: Session, topic: str) -> dict[str, str]:
    """Return the fields that a topic carries, with the names of their columns."""
    columns: dict[str, str] = {}
    for name in UNITS:
        try:
            unit = session.joints(topic, name).unit
        except MissingChannelError:
            if topic not in session.channels:
                raise
            continue
        # The contract puts every quantity of a joint, not only angles, into a position.
        named_by_topic = name == "position" and unit != UNITS[name]
        columns[name] = (
            topic.removeprefix("/") + ("" if named_by_topic else f".{name}") + f" [{unit}]"
        )
    return columns


def _blocks(
    session: Session, topic: str, columns: Mapping[str, str]
) -> Iterator[tuple[RowBlock, float]]:
    """Yield a topic's rows, sorted by time, and the share that is done, 0 to 1."""
    read = session.joint_columns({topic: list(columns)})
    sets = _aligned([read[topic, name] for name in columns])
    for number, signals in enumerate(sets):
        for block, done in _sorted_blocks(signals, [columns[signal.field] for signal in signals]):
            yield block, (number + done) / len(sets)


def _aligned(signals: Sequence[JointSignals]) -> list[list[JointSignals]]:
    """Group signals that have the same joints and times, so that they share rows.

    That is one set, but for foreign logs that leave a field empty in some messages.
    """
    sets: list[list[JointSignals]] = []
    for signal in signals:
        for group in sets:
            if group[0].names == signal.names and all(
                np.array_equal(a, b) for a, b in zip(group[0].t_ns, signal.t_ns, strict=True)
            ):
                group.append(signal)
                break
        else:
            sets.append([signal])
    return sets


def _sorted_blocks(
    signals: Sequence[JointSignals], columns: Sequence[str]
) -> Iterator[tuple[RowBlock, float]]:
    """Yield the rows of signals that share joints and times."""
    first = signals[0]
    if not first.names:
        return
    orders = [np.argsort(t_ns, kind="stable") for t_ns in first.t_ns]
    times = [t_ns[order] for t_ns, order in zip(first.t_ns, orders, strict=True)]
    longest = max(times, key=len)
    step = max(1, _ROWS_PER_BLOCK // len(times))
    edges = np.unique(longest[step::step])
    cuts = [[0, *np.searchsorted(t_ns, edges).tolist(), len(t_ns)] for t_ns in times]
    for k in range(len(edges) + 1):
        pieces = [slice(cut[k], cut[k + 1]) for cut in cuts]
        t_ns = np.concatenate([t[piece] for t, piece in zip(times, pieces, strict=True)])
        joint = np.repeat(np.arange(len(times)), [piece.stop - piece.start for piece in pieces])
        rows = np.argsort(t_ns, kind="stable")
        values = {
            name: np.concatenate(
                [
                    values[order[piece]]
                    for values, order, piece in zip(signal.values, orders, pieces, strict=True)
                ]
            )[rows]
            for name, signal in zip(columns, signals, strict=True)
        }
        block = RowBlock(first.topic, first.names, joint[rows], t_ns[rows], values)
        yield block, (k + 1) / (len(edges) + 1)
