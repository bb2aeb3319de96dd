"""What the columns of a table mean: the map, as a TOML file or as options, and its topics.

A map is a TOML file::

    [time]
    column = "time"
    unit = "s"

    [[columns]]
    column = "s_pos"
    joint = "joint01"
    quantity = "position"
    unit = "rad"
    wrap = 12.566370614359172           # the cell jumps by this period, in `unit`; undone first
    scale = 0.045454545454545456        # then value = scale * cell + offset, in `unit`
    offset = 0.0

or the same as options, ``time=time:s`` and
``s_pos=joint01.position:rad,wrap=12.566370614359172,scale=0.045454545454545456``.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from ..bus.decoded_topics import JOINT_TOPIC
from ..common.arrays import BoolArray, FloatArray, IntArray
from ..common.config import Positive, read_field
from ..common.errors import DescriptionFault, FaultyFileError, UsageError
from ..common.files import read_input
from ..common.strict_table import NAME_PATTERN, NONZERO, Faults, StrictTable, listed
from ..common.untrusted_text import read_toml
from ..log.write.channels import JointStateChannel
from ..log.write.writer import SessionWriter
from ..robot.bus_map import JOINT_QUANTITIES, SESSION_UNIT, TIME_UNITS, unit_for, valid_units
from ..robot.model import Quantity, Robot

_DELIMITERS = (",", ";", "\t", " ")
_OPTION_FORM = (
    "COLUMN=time:UNIT or COLUMN=JOINT.QUANTITY:UNIT[,wrap=PERIOD][,scale=FACTOR][,offset=VALUE]"
)


STATES = "states"
COMMANDS = "commands"

_WITH_POSITION = (Quantity.VELOCITY, Quantity.EFFORT)
"""What stands beside a position of the same row."""

_MOST_PARTS = 100
"""Sets of joints that have a value together; in further ones the others have NaN."""


@dataclass(frozen=True)
class MappedColumn:
    """One column that is read.

    Attributes:
        column: Its name in the header.
        joint: The joint it belongs to.
        quantity: What it is of that joint.
        wrap: Period of its jumps, in ``unit``; 0 if it doesn't wrap around.
        scale: Applied to the unwrapped cell.
        offset: Added after ``scale``, in ``unit``.
        table: ``states``, or ``commands`` where those are a file of their own.
    """

    column: str
    joint: str
    quantity: Quantity
    unit: str
    wrap: Positive = 0.0
    scale: Annotated[float, NONZERO] = 1.0
    offset: float = 0.0
    table: str = STATES

    @property
    def is_plain(self) -> bool:
        """Whether its cells are values in the session's unit."""
        unit = unit_for(self.unit, self.quantity)
        conversion = (self.wrap, self.scale, self.offset, unit.factor, unit.offset)
        return conversion == (0.0, 1.0, 0.0, 1.0, 0.0)


@dataclass(frozen=True)
class ColumnMap:
    """The columns of a CSV log.

    Attributes:
        time_column: Name of the column of times.
        time_unit: ``s``, ``ms``, ``us`` or ``ns``.
        columns: The others; columns that are not named are not read.
        delimiter: What stands between the cells.
        commands_time: Column and unit of the times in the table of commands, if there is one.
    """

    time_column: str
    time_unit: str
    columns: tuple[MappedColumn, ...]
    delimiter: str = ","
    commands_time: tuple[str, str] | None = None

    def time_of(self, table: str) -> tuple[str, str]:
        """Return column and unit of the times in a table."""
        commands_time = self.commands_time if table == COMMANDS else None
        return commands_time or (self.time_column, self.time_unit)

    def toml(self) -> str:
        """Return the map as a TOML file, for the session's attachments."""
        lines = [f"delimiter = {json.dumps(self.delimiter)}", "", "[time]"]
        lines += [f"column = {json.dumps(self.time_column)}", f'unit = "{self.time_unit}"']
        if self.commands_time is not None:
            name, unit = self.commands_time
            lines += ["", "[commands_time]", f"column = {json.dumps(name)}", f'unit = "{unit}"']
        for column in self.columns:
            lines += ["", "[[columns]]", f"column = {json.dumps(column.column)}"]
            lines += [f'joint = "{column.joint}"', f'quantity = "{column.quantity}"']
            lines += [f'unit = "{column.unit}"', f"scale = {column.scale!r}"]
            lines += [f"offset = {column.offset!r}"]
            lines += [f"wrap = {column.wrap!r}"] if column.wrap else []
            lines += [f'table = "{column.table}"'] if column.table != STATES else []
        return "\n".join(lines) + "\n"


def read_column_map(path: Path, robot: Robot | None) -> ColumnMap:
    """Read a map from its TOML file.

    Raises:
        InputFileError: If the file isn't there or can't be read.
        FaultyFileError: If it has faults; lists all of them.
    """
    try:
        values = read_toml(read_input(path).decode("utf-8"))
    except ValueError as error:
        raise FaultyFileError(path, [DescriptionFault("syntax", str(error), "TOML 1.0")]) from error
    column_map, faults = _parse(values, robot)
    if faults:
        raise FaultyFileError(path, faults)
    return column_map


def column_map_from_options(options: Sequence[str], robot: Robot | None) -> ColumnMap:
    """Read a map from command line options.

    Args:
        options: One a column, as the module describes.
        robot: The robot whose joints they name.

    Raises:
        UsageError: If they have faults; lists all of them.
    """
    values: dict[str, Any] = {"columns": []}
    for option in options:
        column, equals, meaning = option.rpartition("=") if "," not in option else _cut(option)
        head, *extras = meaning.split(",")
        target, colon, unit = head.partition(":")
        joint, dot, quantity = target.partition(".")
        if not (equals and colon and column) or (target != "time" and not dot):
            file = "; a map in a file: --columns" if option.endswith(".toml") else ""
            raise UsageError(f"--map {option!r} is not of the form {_OPTION_FORM}{file}")
        if target == "time":
            values["time"] = {"column": column, "unit": unit}
            continue
        entry: dict[str, Any] = {"column": column, "joint": joint, "quantity": quantity}
        entry["unit"] = unit
        for extra in extras:
            key, _, number = extra.partition("=")
            try:
                entry[key.strip()] = float(number)
            except ValueError as error:
                raise UsageError(f"--map {option!r}: {extra!r} is not KEY=NUMBER") from error
        values["columns"].append(entry)
    column_map, faults = _parse(values, robot)
    if faults:
        raise UsageError("\n  ".join(["--map has faults:", *map(str, faults)]))
    return column_map


def _cut(option: str) -> tuple[str, str, str]:
    """Split at the last equals sign before the first comma: a column's name may have others."""
    head, comma, extras = option.partition(",")
    column, equals, meaning = head.rpartition("=")
    return column, equals, meaning + comma + extras


def _parse(
    values: dict[str, Any], robot: Robot | None
) -> tuple[ColumnMap, tuple[DescriptionFault, ...]]:
    faults = Faults()
    top = StrictTable(values, "", faults)
    delimiter = top.text("delimiter", ",")
    if delimiter not in _DELIMITERS:
        top.fault("delimiter", " ".join(json.dumps(delimiter) for delimiter in _DELIMITERS))
    time = _time(top.table("time"))
    commands_time = _time(top.table("commands_time")) if "commands_time" in top else None
    entries = top.tables("columns")
    if not entries:
        top.fault("columns", "at least one column")
    columns = tuple(_column(entry, robot.joint_names if robot else None) for entry in entries)
    top.close()
    _note_repeated(faults, columns)
    return ColumnMap(*time, columns, delimiter, commands_time), faults.all()


def _time(table: StrictTable) -> tuple[str, str]:
    column, unit = table.text("column"), table.text("unit")
    if unit not in TIME_UNITS:
        table.fault("unit", listed(TIME_UNITS, unit))
    table.close()
    return column, unit


def _column(table: StrictTable, joints: Iterable[str] | None) -> MappedColumn:
    name, joint = table.text("column"), table.text("joint")
    if joint and joints is not None and joint not in joints:
        table.fault("joint", listed(joints, joint))
    elif joint and joints is None and not NAME_PATTERN.fullmatch(joint):
        table.fault("joint", "a letter, then letters, digits, - and _", json.dumps(joint))
    quantity, unit = table.choice("quantity", JOINT_QUANTITIES), table.text("unit")
    if quantity is not None:
        try:
            unit_for(unit, quantity)
        except UsageError:
            table.fault("unit", f"for {quantity}: {listed(valid_units(quantity), unit)}")
    place = table.text("table", STATES)
    if place not in {STATES, COMMANDS}:
        table.fault("table", f"{STATES}, {COMMANDS}")
    column = MappedColumn(
        column=name,
        joint=joint,
        quantity=quantity or Quantity.POSITION,
        unit=unit,
        wrap=read_field(table, MappedColumn, "wrap"),
        scale=read_field(table, MappedColumn, "scale"),
        offset=read_field(table, MappedColumn, "offset"),
        table=place,
    )
    table.close()
    return column


def _note_repeated(faults: Faults, columns: Sequence[MappedColumn]) -> None:
    targets = [f"{column.joint}.{column.quantity}" for column in columns]
    for target in sorted({target for target in targets if targets.count(target) > 1}):
        faults.add("columns", f"{targets.count(target)} columns for {target}", "one at most")


def topics_of(present: set[Quantity]) -> Iterator[tuple[Quantity, ...]]:
    """Yield the quantities of each topic; a row's velocity and effort belong to its position."""
    together = [q for q in _WITH_POSITION if q in present and Quantity.POSITION in present]
    for quantity in JOINT_TOPIC:
        if quantity is Quantity.POSITION and quantity in present:
            yield (quantity, *together)
        elif quantity in present and quantity not in together:
            yield (quantity,)


class JointTopic:
    """One JointState topic of a table, with the joints that have a column for it."""

    def __init__(
        self,
        writer: SessionWriter,
        columns: Sequence[tuple[str, Quantity]],
        quantities: Sequence[Quantity],
    ) -> None:
        """Open the topic.

        Args:
            columns: Joint and quantity of each column, no two the same; the joints in their order
                in a message.
            quantities: One of :func:`topics_of`.
        """
        self._joints = list(dict.fromkeys(joint for joint, kind in columns if kind in quantities))
        self._fields = (quantities[0], *(q for q in _WITH_POSITION if q in quantities[1:]))
        self._places = [
            [self._joints.index(joint) for joint, kind in columns if kind is quantity]
            for quantity in self._fields
        ]
        self._rest = [q in quantities[1:] for q in _WITH_POSITION]
        self.name = JOINT_TOPIC[quantities[0]]
        velocity, effort = self._rest
        self._channel = writer.joint_state(
            self.name, self._joints, unit=SESSION_UNIT[quantities[0]],
            velocity=velocity, effort=effort,
        )  # fmt: skip
        self._parts: dict[bytes, JointStateChannel] = {}

    def write(self, t_ns: IntArray, values: Mapping[Quantity, FloatArray]) -> int:
        """Write the rows that have any value; a joint without any value in a row has no sample.

        Args:
            t_ns: Times of the rows [Unix ns], shape (n,), n > 0.
            values: Quantity to the cells of its columns, in their order, (n, m).

        Returns:
            Number of rows written.
        """
        columns = [
            self._spread(values[q], at) for q, at in zip(self._fields, self._places, strict=True)
        ]
        if not any(np.isnan(field.min()) for field in columns):
            self._write_part(t_ns, columns, np.ones(len(self._joints), dtype=bool))
            return len(t_ns)
        fields = np.stack(columns)
        absent = np.isnan(fields)
        sampled: BoolArray = ~np.all(absent, axis=0)
        filled = np.any(sampled, axis=1)
        if not filled.all():
            t_ns, fields, sampled = t_ns[filled], fields[:, filled], sampled[filled]
        if not len(t_ns):
            return 0
        changes = np.flatnonzero(np.any(sampled[1:] != sampled[:-1], axis=1)) + 1
        edges = [0, *changes.tolist(), len(t_ns)]
        for start, stop in pairwise(edges):
            self._write_part(t_ns[start:stop], fields[:, start:stop], sampled[start])
        return len(t_ns)

    def _spread(self, cells: FloatArray, places: Sequence[int]) -> FloatArray:
        """Return the cells of all joints, NaN for those without a column."""
        if list(places) == list(range(len(self._joints))):
            return cells
        field = np.full((len(cells), len(self._joints)), np.nan)
        field[:, places] = cells
        return field

    def _write_part(self, t_ns: IntArray, fields: Iterable[FloatArray], sampled: BoolArray) -> None:
        """Write rows, (n, joints) of each field, that all have samples of the same joints."""
        channel, which = self._part(sampled)
        rows = iter(fields if which.all() else [field[:, which] for field in fields])
        none = np.empty((len(t_ns), 0))
        position = next(rows)
        velocity, effort = (next(rows) if present else none for present in self._rest)
        channel.write_rows(t_ns, position, velocity, effort)

    def _part(self, sampled: BoolArray) -> tuple[JointStateChannel, BoolArray]:
        """Return the channel of some joints, and which they are; all if there are too many sets."""
        key = sampled.tobytes()
        if key not in self._parts and not sampled.all() and len(self._parts) < _MOST_PARTS:
            names = [name for name, is_in in zip(self._joints, sampled, strict=True) if is_in]
            self._parts[key] = self._channel.part(names)
        if key not in self._parts:
            return self._channel, np.ones_like(sampled)
        return self._parts[key], sampled
