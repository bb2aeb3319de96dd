"""The guess of a column map from the names and first cells of a table; each guess is stated.

A name such as ``des_dof_pos[3]``, ``knee_velocity (deg/s)`` or ``q2`` is cut into words: some name
the quantity, what is left names the joint. What has no place in a session is listed, not dropped
silently.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..common.errors import ImportFormatError, UsageError, some_names
from ..common.strict_table import NAME_PATTERN
from ..robot.bus_map import JOINT_QUANTITIES, SESSION_UNIT, TIME_UNITS, UNITS, valid_units
from ..robot.description import numbered
from ..robot.model import Quantity
from .column_blocks import WIDEST, Block
from .column_map import COMMANDS, STATES, ColumnMap, MappedColumn
from .frame_log import LATEST_NS
from .marker_tracks import is_frame_number
from .table_file import TableFile, is_time, words

_COMMAND = {
    "cmd", "cmds", "command", "commands", "commanded", "des", "desired", "target", "targets",
    "goal", "ref", "reference", "setpoint", "action", "actions", "control", "output",
}  # fmt: skip
_WORDS = {
    Quantity.POSITION: "pos position positions angle angles q qpos theta encoder state states",
    Quantity.VELOCITY: "vel velocity velocities speed speeds qvel dq qd rate",
    Quantity.EFFORT: "torque torques effort efforts tau trq",
    Quantity.CURRENT: "current currents amps amp",
    Quantity.VOLTAGE: "voltage voltages volt volts",
    Quantity.TEMPERATURE: "temp temperature temperatures",
}
_QUANTITY = {word: quantity for quantity, text in _WORDS.items() for word in text.split()}
_FILLERS = {
    "dof", "joint", "joints", "measured", "actual", "observation", "feedback", "present", "meas",
    "motor", "motors", "value", "values", "column",
}  # fmt: skip
_UNIT_WORDS = {
    "rads": "rad/s", "degs": "deg/s", "nm": "N m", "n·m": "N m", "n*m": "N m", "c": "degC",
    "celsius": "degC", "degree": "deg", "degrees": "deg", "radian": "rad", "radians": "rad",
    "°": "deg", "sec": "s", "seconds": "s", "secs": "s",
}  # fmt: skip
_BY_LOWER = {name.lower(): name for name in UNITS} | _UNIT_WORDS
_STATED = re.compile(
    rf"(?P<joint>{NAME_PATTERN.pattern})\.(?P<quantity>{'|'.join(JOINT_QUANTITIES)}) "
    rf"\[(?P<unit>{'|'.join(map(re.escape, UNITS))})\]"
)
"""A name as :mod:`.capture.exchange.wide_table` writes it, which leaves nothing to guess."""
_WRAPS = (2 * math.pi, 4 * math.pi, 360.0, 720.0)
_PLURAL = {Quantity.VELOCITY: "velocities"}
_USUAL_HZ = 100.0
_LEAST_JUMP = 0.8  # of the period, between two samples


@dataclass(frozen=True)
class Guess:
    """A map that was guessed.

    Attributes:
        notes: What was taken for what and why, one sentence each.
        left_out: Columns without a place.
    """

    column_map: ColumnMap
    notes: list[str] = field(default_factory=list[str])
    left_out: list[str] = field(default_factory=list[str])


@dataclass(frozen=True)
class _Name:
    """What the words of a column's name say."""

    quantity: Quantity | None
    joint: str
    index: int | None
    unit: str


def parse_units(options: Sequence[str]) -> dict[str, str]:
    """Read ``QUANTITY=UNIT`` options.

    Raises:
        UsageError: If one names no quantity or a unit that does not fit it.
    """
    units: dict[str, str] = {}
    for option in options:
        name, _, unit = option.partition("=")
        if name == "time":
            valid = tuple(TIME_UNITS)
        elif name in JOINT_QUANTITIES:
            valid = valid_units(Quantity(name))
        else:
            quantities = ", ".join(["time", *JOINT_QUANTITIES])
            raise UsageError(f"--unit {option!r} is not QUANTITY=UNIT; quantities: {quantities}")
        if unit not in valid:
            raise UsageError(f"--unit {option!r}: valid for {name}: {', '.join(valid)}")
        units[name] = unit
    return units


def guess_map(
    tables: Mapping[str, TableFile], joints: Sequence[str], units: Mapping[str, str]
) -> Guess:
    """Guess what the columns of tables mean.

    Args:
        tables: ``states``, ``commands`` or both.
        joints: Names of the joints in the order of vectors; empty if the table has to tell.
        units: Quantity, or ``time``, to the unit that the user gave.

    Raises:
        ImportFormatError: If there is no column of times or none of a joint.
    """
    notes: list[str] = []
    left_out: list[str] = []
    entries: list[tuple[str, str, _Name]] = []
    times: dict[str, tuple[str, str]] = {}
    samples: dict[str, Block] = {}
    for role, table in tables.items():
        samples[role] = sample = table.sample()
        left_out += table.left_out
        time = _time_column(table, sample)
        times[role] = (time, _time_unit(table, time, sample[time], units, notes))
        for name in (name for name in table.columns if name != time):
            meaning = _meaning(name, role, headerless=table.form == "headerless")
            if meaning.quantity is None or not _numeric(sample[name]):
                left_out.append(name)
            else:
                entries.append((role, name, meaning))
    first = next(iter(tables.values()))
    if not entries:
        raise ImportFormatError(
            first.path,
            "no column is named as a position, command, velocity, torque, current, voltage or "
            f"temperature; name them by --columns or --map. It has {some_names(first.columns, 20)}",
        )
    names = _joint_names(entries, joints, first.path, notes)
    columns = _columns(entries, names, units, samples, notes, left_out)
    main = times.get(STATES) or times[COMMANDS]
    separate = times.get(COMMANDS)
    commands_time = separate if separate is not None and separate != main else None
    return Guess(ColumnMap(*main, tuple(columns), first.delimiter, commands_time), notes, left_out)


def _numeric(cells: NDArray[Any]) -> bool:
    return cells.dtype.kind in "fiub"


def _time_column(table: TableFile, sample: Block) -> str:
    named = [name for name in table.columns if is_time(name)]
    rising = [n for n in table.columns if _numeric(sample[n]) and _rises(sample[n])]
    if chosen := [name for name in named if name in rising] or named[:1]:
        return chosen[0]
    if rising and rising[0] == table.columns[0] and not is_frame_number(rising[0]):
        return rising[0]
    raise ImportFormatError(
        table.path,
        "no column is named as a time, nor does the first one rise; name it by --columns or --map, "
        "or give the rate of its rows by --fps, if that is constant. It has "
        f"{some_names(table.columns, 20)}",
    )


def _rises(cells: NDArray[Any]) -> bool:
    with np.errstate(over="ignore", invalid="ignore"):
        steps = np.diff(cells.astype(float))
    return bool(len(steps) and np.all(steps >= 0) and np.any(steps > 0))


def _time_unit(
    table: TableFile, name: str, cells: NDArray[Any], units: Mapping[str, str], notes: list[str]
) -> str:
    """Return the unit of times: given, named, or that whose rate is nearest 100 Hz."""
    if given := units.get("time") or _named_unit(name, tuple(TIME_UNITS)):
        return given
    if not _numeric(cells):
        raise ImportFormatError(table.path, f"column {name!r} holds no numbers, so no times")
    stamps = np.unique(cells[np.abs(cells.astype(float)) < LATEST_NS]).astype(float)
    step = float(np.median(np.diff(stamps))) if len(stamps) > 1 else 0.0
    if step <= 0:
        notes.append(f"{table.path.name}: times ({name}) taken as s: no unit given")
        return "s"
    rates = {unit: 1e9 / (step * ns) for unit, ns in TIME_UNITS.items()}
    unit = min(rates, key=lambda u: abs(math.log(rates[u] / _USUAL_HZ)))
    notes.append(
        f"{table.path.name}: times ({name}) taken as {unit}: no unit given; {step:g} from row to "
        f"row is {rates[unit]:.4g} Hz (--unit time=UNIT overrides)"
    )
    return unit


def _named_unit(name: str, valid: Sequence[str]) -> str:
    """Return the unit that a name ends with: ``[rad/s]``, ``(deg)``, ``_ms``; empty if none."""
    bracket = re.search(r"[\[(]\s*([^\[\]()]+?)\s*[\])](?:\[\w+\])?$", name)
    ending = re.search(r"[_ .]([A-Za-z]+)(?:\[\w+\])?$", name)
    for match in (bracket, ending):
        text = match.group(1) if match else ""
        unit = text if text in UNITS else _BY_LOWER.get(text.lower(), "")
        if unit in valid:
            return unit
    return ""


def _meaning(name: str, role: str, *, headerless: bool) -> _Name:
    if stated := _STATED.fullmatch(name):
        return _Name(Quantity(stated["quantity"]), stated["joint"], None, stated["unit"])
    if headerless:
        quantity = Quantity.COMMAND if role == COMMANDS else Quantity.POSITION
        return _Name(quantity, "", int(re.findall(r"\d+", name)[0]) - 2, "")
    pivot = re.search(r"\[([^\[\]]+)\]$", name)
    place = pivot.group(1) if pivot and pivot.group(1) not in UNITS else ""
    base = name[: pivot.start()] if pivot and place else name
    unit = _named_unit(base, tuple(UNITS))
    plain = re.sub(r"[\[(][^\[\]()]*[\])]", "", base)
    parts = words(plain)
    commanded = role == COMMANDS or bool(_COMMAND.intersection(parts))
    quantities = [_QUANTITY[word] for word in parts if word in _QUANTITY]
    specific = [quantity for quantity in quantities if quantity is not Quantity.POSITION]
    measured = (specific or quantities or [None])[0]
    if commanded and measured in {None, Quantity.POSITION}:
        quantity: Quantity | None = Quantity.COMMAND
    else:
        quantity = None if commanded else measured
    if place.isdigit():
        return _Name(quantity, "", int(place), unit)
    return _Name(quantity, _identifier(place) or _rest(plain, unit), None, unit)


def _rest(name: str, unit: str) -> str:
    """Return what a name has besides quantity and unit: the joint's name."""
    apart = re.sub(r"([a-z0-9])([A-Z])", r"\1_\2", name)
    parts = [part for part in re.split(r"[^A-Za-z0-9]+", apart) if part]
    kept = [part for part in parts if not _says_quantity(part)]
    if kept and unit and _BY_LOWER.get(kept[-1].lower(), kept[-1]) == unit:
        kept.pop()
    numbers = re.findall(r"\d+", name)
    if numbers and not any(re.search(r"[A-Za-z]", part) for part in kept):
        return f"joint{int(numbers[-1]):02d}" if len(numbers[-1]) < 7 else ""
    if not any(re.search(r"\d", part) for part in kept):
        kept = [part for part in kept if part.lower() not in _FILLERS]
    rest = "_".join(kept)
    return _identifier(rest) if len(rest) > 1 else ""


def _says_quantity(part: str) -> bool:
    word = re.sub(r"\d+$", "", part).lower()
    return word in _QUANTITY or word in _COMMAND


def _identifier(text: str) -> str:
    """Return a text as a joint's name: a letter first, then letters, digits, - and _."""
    plain = re.sub(r"[^A-Za-z0-9_-]+", "_", text).strip("_-")
    return f"joint_{plain}" if plain and not plain[0].isalpha() else plain


def _joint_names(
    entries: Sequence[tuple[str, str, _Name]], joints: Sequence[str], path: Path, notes: list[str]
) -> list[str]:
    """Return the names of joints that columns have by number only."""
    indices = [meaning.index for _, _, meaning in entries if meaning.index is not None]
    count = max(indices, default=-1) + 1
    if count > WIDEST:
        raise ImportFormatError(path, f"has a joint of the number {count - 1}; {WIDEST} at most")
    if joints and count > len(joints):
        raise ImportFormatError(path, f"has {count} joints, the list of names {len(joints)}")
    if joints or not count:
        return list(joints)
    notes.append(f"joints named joint01 to joint{count:02d} in the order of the columns")
    return numbered("joint", count)


def _columns(  # noqa: PLR0917 - each is filled or read here
    entries: Sequence[tuple[str, str, _Name]],
    names: Sequence[str],
    units: Mapping[str, str],
    samples: Mapping[str, Block],
    notes: list[str],
    left_out: list[str],
) -> list[MappedColumn]:
    columns: list[MappedColumn] = []
    taken: dict[tuple[str, Quantity], str] = {}
    assumed: dict[Quantity, str] = {}
    single = _single_joint(entries, names)
    for role, name, meaning in entries:
        quantity = meaning.quantity
        if quantity is None:
            continue
        joint = meaning.joint or single
        if meaning.index is not None:
            joint = names[meaning.index]
        if (joint, quantity) in taken:
            left_out.append(name)
            notes.append(f"{name} left out: a second {quantity} of {joint} beside "
                        f"{taken[joint, quantity]}")  # fmt: skip
            continue
        taken[joint, quantity] = name
        unit = units.get(quantity) or (
            meaning.unit if meaning.unit in valid_units(quantity) else ""
        )
        if not unit:
            assumed[quantity] = unit = SESSION_UNIT[quantity]
        stated = _STATED.fullmatch(name) is not None
        wrap = 0.0 if stated else _wrap(samples[role][name], quantity, unit)
        if wrap:
            notes.append(f"{name} jumps by {wrap:.6g} {unit}: taken as wrapping around, undone")
        columns.append(MappedColumn(name, joint, quantity, unit, wrap=wrap, table=role))
    notes += [
        f"{_PLURAL.get(quantity, f'{quantity}s')} taken as {unit}: no unit given "
        f"(--unit {quantity}=UNIT overrides)"
        for quantity, unit in assumed.items()
    ]
    return columns


def _single_joint(
    entries: Sequence[tuple[str, str, _Name]],
    names: Sequence[str],
) -> str:
    """Return the name of the joint that columns without a name belong to."""
    named = {meaning.joint for _, _, meaning in entries if meaning.joint}
    if len(names) == 1:
        return names[0]
    return next(iter(named)) if len(named) == 1 else "joint01"


def _wrap(cells: NDArray[Any], quantity: Quantity, unit: str) -> float:
    """Return the period of an angle's jumps: several of one size, far above all other steps."""
    if quantity not in {Quantity.POSITION, Quantity.COMMAND} or unit not in {"rad", "deg"}:
        return 0.0
    with np.errstate(over="ignore", invalid="ignore"):
        steps = np.abs(np.diff(cells.astype(float)))
    steps = steps[np.isfinite(steps)]
    for period in _WRAPS[:2] if unit == "rad" else _WRAPS[2:]:
        jumps = steps > _LEAST_JUMP * period
        fits = np.all(steps[jumps] < (2 - _LEAST_JUMP) * period)
        if np.any(jumps) and fits and np.all(steps[~jumps] < period / 4):
            return period
    return 0.0
