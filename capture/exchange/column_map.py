"""What the columns of a table mean: the map, as a TOML file or as options.

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
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from ..common.config import Positive, read_field
from ..common.errors import Fault, FaultyFileError, UsageError
from ..common.files import read_input
from ..common.strict_table import NAME_PATTERN, NONZERO, Faults, Table, listed, read_toml
from ..robot.bus_map import JOINT_QUANTITIES, TIME_UNITS, unit_for, valid_units
from ..robot.model import Quantity, Robot

_DELIMITERS = (",", ";", "\t", " ")
_OPTION_FORM = (
    "COLUMN=time:UNIT or COLUMN=JOINT.QUANTITY:UNIT[,wrap=PERIOD][,scale=FACTOR][,offset=VALUE]"
)


STATES = "states"
COMMANDS = "commands"


@dataclass(frozen=True)
class Column:
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
    columns: tuple[Column, ...]
    delimiter: str = ","
    commands_time: tuple[str, str] | None = None

    def time_of(self, table: str) -> tuple[str, str]:
        """Return column and unit of the times in a table."""
        own = self.commands_time if table == COMMANDS else None
        return own or (self.time_column, self.time_unit)

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
        raise FaultyFileError(path, [Fault("syntax", str(error), "TOML 1.0")]) from error
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


def _parse(values: dict[str, Any], robot: Robot | None) -> tuple[ColumnMap, tuple[Fault, ...]]:
    faults = Faults()
    top = Table(values, "", faults)
    delimiter = top.text("delimiter", ",")
    if delimiter not in _DELIMITERS:
        top.fault("delimiter", " ".join(json.dumps(each) for each in _DELIMITERS))
    time = top.table("time")
    time_column, time_unit = time.text("column"), time.text("unit")
    if time_unit not in TIME_UNITS:
        time.fault("unit", listed(TIME_UNITS, time_unit))
    time.close()
    commands_time = None
    if "commands_time" in top:
        own = top.table("commands_time")
        commands_time = (own.text("column"), own.text("unit"))
        if commands_time[1] not in TIME_UNITS:
            own.fault("unit", listed(TIME_UNITS, commands_time[1]))
        own.close()
    entries = top.tables("columns")
    if not entries:
        top.fault("columns", "at least one column")
    columns = tuple(_column(entry, robot.joint_names if robot else None) for entry in entries)
    top.close()
    _note_repeated(faults, columns)
    return ColumnMap(time_column, time_unit, columns, delimiter, commands_time), faults.all()


def _column(table: Table, joints: Iterable[str] | None) -> Column:
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
    column = Column(
        column=name,
        joint=joint,
        quantity=quantity or Quantity.POSITION,
        unit=unit,
        wrap=read_field(table, Column, "wrap"),
        scale=read_field(table, Column, "scale"),
        offset=read_field(table, Column, "offset"),
        table=place,
    )
    table.close()
    return column


def _note_repeated(faults: Faults, columns: Sequence[Column]) -> None:
    targets = [f"{column.joint}.{column.quantity}" for column in columns]
    for target in sorted({target for target in targets if targets.count(target) > 1}):
        faults.add("columns", f"{targets.count(target)} columns for {target}", "one at most")
