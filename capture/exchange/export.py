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

from collections import Counter
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from ..bus.decoded_topics import JOINT_TOPIC
from ..common.arrays import FloatArray, IntArray
from ..common.console import progress, refuse_existing
from ..common.errors import MissingChannelError, UsageError
from ..common.files import as_text, check_stop, csv_writer, number_cells, part_file
from ..common.process import StopRequest
from ..log.messages import frames as wire
from ..log.messages.definitions import JOINT_STATE
from ..log.messages.frames import FrameArray
from ..log.read.joint_messages import UNITS
from ..log.read.sample_times import JointSignals
from ..log.read.session import Session
from .column_blocks import arrow
from .frame_formats import FRAME_FORMATS
from .frame_log import LogBlock, chosen_buses, frame_blocks, frame_facts, is_error, is_remote

_Format = TypeVar("_Format")

_FLAGS = wire.ERROR_FLAG | wire.REMOTE_FLAG | wire.EXTENDED_FLAG

_FIELDS: dict[str, Callable[[FrameArray], NDArray[Any]]] = {
    "identifier": lambda frames: frames["id_flags"] & wire.ID_MASK,
    "flags": lambda frames: frames["id_flags"] & _FLAGS,
    "length code": lambda frames: frames["len"],
    "data": lambda frames: frames["data"],
    "direction": lambda frames: frames["dir"],
    "time below 1 us": lambda frames: frames["t_host_ns"],
    "bit rate switch": lambda frames: frames["fd_flags"] & wire.FD_BRS,
    "error state": lambda frames: frames["fd_flags"] & wire.FD_ESI,
}
"""Field of a frame that a format may lose to its values, one row a frame."""

_FD_NAMES = {"length code": "length"}
"""Names that differ for CAN FD frames."""

_MOST_TOPICS = 500
_ROWS_PER_BLOCK = 100_000


class LossTally:
    """Count of the facts that are lost from a session to a format."""

    def __init__(self) -> None:
        """Start with nothing lost."""
        self._lost: Counter[tuple[str, str]] = Counter()

    def add(self, block: LogBlock, kept: FrameArray) -> None:
        """Compare frames with those that the format keeps, of the same shape."""
        frames, classic = block.frames, ~block.is_fd
        error, remote = is_error(frames), is_remote(frames)
        kinds = {
            "CAN FD frame": block.is_fd,
            "error frame": classic & error,
            "remote frame": classic & remote,
            "data frame": classic & ~error & ~remote,
        }
        for name, values in _FIELDS.items():
            lost = values(frames) != values(kept)
            lost = lost if lost.ndim == 1 else lost.any(axis=1)
            for kind, mask in kinds.items():
                shown = _FD_NAMES.get(name, name) if kind == "CAN FD frame" else name
                self._lost[kind, shown] += int(np.count_nonzero(lost & mask))
        device, host = frames["t_device_ns"], frames["t_host_ns"]
        no_host = (device != 0) & (device != host)
        self._lost["frame", "device time"] += int(np.count_nonzero(no_host))

    def sentences(self) -> list[str]:
        """Return a sentence for each kind of frame and field that lost something."""
        return [
            f"{count} {kind} loses its {name}"
            if count == 1
            else f"{count} {kind}s lose their {name}"
            for (kind, name), count in sorted(self._lost.items())
            if count
        ]


@dataclass(frozen=True)
class ExportReport:
    """Result of an export.

    Attributes:
        what: What was written, as a phrase.
        facts: The same for JSON.
        warnings: Facts that the format doesn't hold or the session lacks, one sentence each.
    """

    what: str
    facts: dict[str, Any]
    warnings: list[str]


def export_log(
    source: Path,
    output: Path,
    *,
    bus: str | None = None,
    force: bool = False,
    stop: StopRequest | None = None,
) -> ExportReport:
    """Write the raw frames of a session as a trace of another format.

    The frames of one bus come in the order they were logged, those of several, and of a bus with
    both classic and CAN FD frames, by their times. Identifier, flags, length code, data, direction
    and time are kept as far as the format holds them; what it doesn't hold is counted in the
    report. A candump log that was imported comes back bit for bit.

    Args:
        output: The trace to write; its suffix is one of
            :data:`.capture.exchange.frame_formats.FRAME_FORMATS`.
        bus: The bus to write; all if None.
        stop: Ends the export, with nothing left behind.

    Raises:
        UsageError: If the suffix is no format that can be written, or the output is the session.
        OutputExistsError: If the output is there and ``force`` is not given.
        MissingChannelError: If the session has no raw frames, or no such bus.
        LogWriteError: If the output can't be written or the export was stopped; nothing is left
            behind then.
    """
    chosen = chosen_format(FRAME_FORMATS, "format", source, output, force=force)
    tally = LossTally()
    with Session.open(source) as session:
        facts = frame_facts(session, chosen_buses(session, bus))
        with (
            part_file(output) as part,
            progress(f"export {output.name}", 1.0) as bar,
            chosen.open(part, facts) as write,
        ):
            for block in frame_blocks(session, facts.buses, fd=chosen.holds_fd):
                kept = chosen.kept(block)
                tally.add(block, kept)
                write(replace(block, frames=kept))
                bar.update(block.done)
                check_stop(output, stop)
        counts, warnings = dict(facts.counts), [*session.warnings, *chosen.notes(facts)]
        if chosen.holds_fd:
            counts = {bus: count + facts.fd_counts[bus] for bus, count in counts.items()}
        elif left_out := sum(facts.fd_counts.values()):
            warnings.append(f"{left_out} CAN FD frames left out: the format has 8 bytes a frame")
        warnings += tally.sentences()
    total = sum(counts.values())
    what = f"{total} frames of {', '.join(counts)}, in the format of {chosen.title}"
    return ExportReport(what, {"frames": total, "buses": counts}, warnings)


def chosen_format(
    formats: Mapping[str, _Format], what: str, source: Path, output: Path, *, force: bool
) -> _Format:
    """Return the format by the suffix of the output, which must not be the session itself."""
    if output.suffix.lower() not in formats:
        valid = ", ".join(formats)
        raise UsageError(f"{output}: no {what} has the suffix {output.suffix!r}; valid: {valid}")
    if output.exists() and source.exists() and output.samefile(source):
        raise UsageError(f"{output} is the session itself; choose another name")
    refuse_existing(output, force=force)
    return formats[output.suffix.lower()]


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


WriteRows = Callable[[RowBlock], None]


def export_columns(
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
        output: The table to write; its suffix is one of :data:`TABLE_FORMATS`.
        topics: JointState topics; if none, commands and all quantities that the joints measure.
        stop: Ends the export, with nothing left behind.

    Raises:
        UsageError: If the suffix is no format that can be written, the output is the session, or
            so many topics would make too wide a table.
        OutputExistsError: If the output is there and ``force`` is not given.
        MissingChannelError: If the session has no such topic, or none of the default ones.
        DataError: If a topic is not of JointStates.
        MissingExtraError: If a package for the format is not installed.
        LogWriteError: If the output can't be written or the export was stopped; nothing is left
            behind then.
    """
    open_table = chosen_format(TABLE_FORMATS, "table", source, output, force=force)
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
            open_table(part, columns) as write,
        ):
            for number, (topic, names) in enumerate(fields.items()):
                for block, done in _blocks(session, topic, names) if names else ():
                    write(block)
                    rows[topic] += len(block.t_ns)
                    bar.update(number + done)
                    check_stop(output, stop)
        warnings += session.warnings
    total = sum(rows.values())
    what = f"{total} rows of {', '.join(rows)}"
    return ExportReport(what, {"rows": total, "topics": rows}, warnings)


@contextmanager
def _open_csv(path: Path, columns: Sequence[str]) -> Generator[WriteRows]:
    """Write CSV in UTF-8; floats with all digits that are needed, NaN as an empty cell."""
    with path.open("w", encoding="utf-8", newline="") as stream:
        head = ["t_ns", "topic", "joint", *map(as_text, columns)]
        csv_writer(stream, head).writerow(head)

        def write(block: RowBlock) -> None:
            empty = [""] * len(block.t_ns)
            cells = [
                number_cells(block.values[name]) if name in block.values else empty
                for name in columns
            ]
            row_joints: list[int] = block.joint.tolist()
            names = [as_text(name) for name in block.names]
            joints = [names[j] for j in row_joints]
            topics = [as_text(block.topic)] * len(joints)
            writer = csv_writer(stream, [*names, *topics[:1]])
            writer.writerows(zip(block.t_ns.tolist(), topics, joints, *cells, strict=True))

        yield write


@contextmanager
def _open_parquet(path: Path, columns: Sequence[str]) -> Generator[WriteRows]:
    """Parquet: t_ns int64, topic and joint dictionaries of strings, the rest float64 or null."""
    head = {"t_ns": "int64", "topic": "text", "joint": "text"}
    with open_parquet(path, head, columns) as (module, write_arrays):

        def write(block: RowBlock) -> None:
            count = len(block.t_ns)
            topic = np.zeros(count, dtype=np.int32)
            arrays: list[Any] = [
                module.array(block.t_ns),
                module.DictionaryArray.from_arrays(topic, [block.topic]),
                module.DictionaryArray.from_arrays(block.joint.astype(np.int32), block.names),
            ]
            arrays += [
                module.array(block.values[name], mask=np.isnan(block.values[name]))
                if name in block.values
                else module.nulls(count, module.float64())
                for name in columns
            ]
            write_arrays(arrays)

        yield write


@contextmanager
def open_parquet(
    path: Path, head: Mapping[str, str], numbers: Sequence[str]
) -> Generator[tuple[Any, Callable[[list[Any]], None]]]:
    """Create a Parquet table.

    Args:
        head: First columns to their types: ``int64``, ``float64``, or ``text`` in a dictionary.
        numbers: Columns of float64 after them.

    Yields:
        pyarrow, whose types are incomplete, and a function that writes arrays, one a column.

    Raises:
        MissingExtraError: If pyarrow is not installed.
    """
    parquet = arrow("a .parquet table")
    import pyarrow as pa

    module: Any = pa
    kinds = {"int64": module.int64(), "float64": module.float64()}
    kinds["text"] = module.dictionary(module.int32(), module.string())
    columns = {**head, **dict.fromkeys(numbers, "float64")}
    schema = module.schema([(name, kinds[kind]) for name, kind in columns.items()])
    with parquet.ParquetWriter(path, schema) as writer:
        yield (
            module,
            lambda arrays: writer.write_table(module.Table.from_arrays(arrays, schema=schema)),
        )


TABLE_FORMATS = {".csv": _open_csv, ".parquet": _open_parquet}
"""Suffix to the function that creates a table with columns of some names."""


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
