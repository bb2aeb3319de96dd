"""The ``bus`` table of a robot description: databases, and the map from signals to quantities.

Units of foreign logs, and the unit in which a session holds each quantity.

A session holds SI, except temperatures, which stay in degrees Celsius.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

from ..common.arrays import FloatArray
from ..common.config import read_field
from ..common.errors import UsageError
from ..common.strict_table import Faults, StrictTable, finite_number, listed
from .families import read_family
from .model import Bus, BusPoll, BusSignal, Direction, Joint, Quantity, Sensor, SensorKind

if TYPE_CHECKING:
    from cantools.database.can import Message
    from cantools.database.can.signal import Signal

_STANDARD_GRAVITY = 9.80665  # m/s^2, 3rd CGPM 1901
_TURN = 2 * math.pi

_FACTORS: dict[str, dict[str, float]] = {
    "rad": {"rad": 1.0, "mrad": 1e-3, "deg": math.pi / 180, "rev": _TURN},
    "rad/s": {"rad/s": 1.0, "deg/s": math.pi / 180, "rev/s": _TURN, "rpm": _TURN / 60},
    "N m": {"N m": 1.0, "mN m": 1e-3, "kgf cm": _STANDARD_GRAVITY / 100},
    "A": {"A": 1.0, "mA": 1e-3},
    "V": {"V": 1.0, "mV": 1e-3},
    "degC": {"degC": 1.0, "K": 1.0},
    "m": {"m": 1.0, "cm": 1e-2, "mm": 1e-3},
    "m/s^2": {"m/s^2": 1.0, "g": _STANDARD_GRAVITY, "mg": _STANDARD_GRAVITY / 1000},
    "T": {"T": 1.0, "uT": 1e-6, "G": 1e-4},
    "s": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9},
}

TIME_UNITS: dict[str, int] = {"s": 1_000_000_000, "ms": 1_000_000, "us": 1_000, "ns": 1}
"""Nanoseconds in each unit of time."""

SESSION_UNIT: dict[Quantity, str] = {
    Quantity.COMMAND: "rad",
    Quantity.POSITION: "rad",
    Quantity.VELOCITY: "rad/s",
    Quantity.EFFORT: "N m",
    Quantity.CURRENT: "A",
    Quantity.VOLTAGE: "V",
    Quantity.TEMPERATURE: "degC",
    Quantity.RANGE: "m",
    Quantity.ACCELERATION: "m/s^2",
    Quantity.MAGNETIC_FIELD: "T",
}
"""The unit in which a session holds each quantity."""

_PLACEHOLDER = "{joint}"
_OF_SENSOR = {
    SensorKind.IR: Quantity.RANGE,
    SensorKind.SONAR: Quantity.RANGE,
    SensorKind.ACCELEROMETER: Quantity.ACCELERATION,
    SensorKind.COMPASS: Quantity.MAGNETIC_FIELD,
}
JOINT_QUANTITIES = tuple(q for q in Quantity if q not in _OF_SENSOR.values())
"""What can be known of a joint."""


@dataclass(frozen=True)
class Unit:
    """A unit as an affine map onto the session's unit of the same dimension.

    Attributes:
        dimension: The session's unit it converts to, e.g. ``rad``.
        factor: Session units in one of this unit.
        offset: Added after ``factor``, in session units; zero but for temperatures.
    """

    dimension: str
    factor: float
    offset: float = 0.0

    def convert(self, values: FloatArray) -> FloatArray:
        """Return values in the session's unit, ``factor * values + offset``."""
        scaled = values if self.factor == 1.0 else values * self.factor
        return scaled + self.offset if self.offset else scaled  # keeps -0.0


UNITS: dict[str, Unit] = {
    name: Unit(dimension, factor, -273.15 if name == "K" else 0.0)
    for dimension, factors in _FACTORS.items()
    for name, factor in factors.items()
}
"""Every unit that a robot description or a column map may name."""


@lru_cache
def valid_units(quantity: Quantity) -> tuple[str, ...]:
    """Return the names of the units that fit a quantity, that of sessions first."""
    dimension = SESSION_UNIT[quantity]
    return tuple(name for name, unit in UNITS.items() if unit.dimension == dimension)


def unit_for(name: str, quantity: Quantity) -> Unit:
    """Return the unit of a name, e.g. ``deg``, if it fits the quantity.

    Raises:
        UsageError: If there is no such unit or it measures something else; lists the valid ones.
    """
    valid = valid_units(quantity)
    if name not in valid:
        raise UsageError(f"unit {name!r} does not fit {quantity}; valid: {', '.join(valid)}")
    return UNITS[name]


def database_messages(databases: Mapping[str, str], faults: Faults) -> dict[str, Message] | None:
    """Read DBC databases.

    Args:
        databases: DBC file name to text.
        faults: Where faults are noted: syntax, overlapping signals, repeated message names.

    Returns:
        Message name to message, None if a database could not be read.
    """
    from cantools.database.errors import UnsupportedDatabaseFormatError

    messages: dict[str, Message] = {}
    readable = True
    for name, text in databases.items():
        where = f"bus.databases: {name}"
        try:
            parsed = _messages(text)
        except UnsupportedDatabaseFormatError as error:
            faults.add(where, str(error.e_dbc), "a DBC without overlaps")
            readable = False
            continue
        for message in parsed:
            for signal in message.signals:
                if None in map(finite_number, (signal.scale, signal.offset)):
                    why = f"{message.name}.{signal.name} is scaled by a number that is not finite"
                    faults.add(where, why, "a factor and an offset that a double can hold")
                    readable = False
            if message.name in messages:
                valid = "message names that are unique in all databases together"
                faults.add(where, f"a second message {message.name}", valid)
            messages[message.name] = message
    return messages if readable else None


@lru_cache(maxsize=16)  # every session of a robot carries the same databases
def _messages(text: str) -> tuple[Message, ...]:
    from cantools.database import load_string
    from cantools.database.can import Database

    database = load_string(text, database_format="dbc", strict=True)
    return tuple(database.messages) if isinstance(database, Database) else ()


def read_bus(
    table: StrictTable,
    joints: tuple[Joint, ...],
    sensors: tuple[Sensor, ...],
    read_database: Callable[[str], str | None],
    *,
    in_full: bool = True,
) -> tuple[Bus, tuple[tuple[str, str], ...]]:
    """Read the bus of a robot; return it with the file name and text of each database.

    Args:
        table: The ``bus`` table; faults are noted in its list.
        joints: The robot's joints.
        sensors: The robot's sensors.
        read_database: Text of a DBC file by name, None where there is none.
        in_full: Whether the databases are parsed, and the map is held against them.
    """
    if "family" in table:
        return read_family(table, joints, {name: unit.factor for name, unit in UNITS.items()})
    databases: dict[str, str] = {}
    names = table.words("databases")
    if not names:
        table.fault("databases", 'an array of DBC file names, e.g. ["robot.dbc"]')
    for name in names:
        plain = name.endswith(".dbc") and not set(name) & set("/\\:")
        text = read_database(name) if plain else None
        if text is None:
            valid = "the name of a DBC file that lies beside the description"
            table.faults.add(f"{table.key('databases')}: {name}", "no such file", valid)
        else:
            databases[name] = text
    bitrate: int = read_field(table, Bus, "bitrate")
    messages = database_messages(databases, table.faults) if in_full else None
    if len(databases) != len(names):
        messages = None  # what a missing database holds is not a fault of the map
    signals: dict[BusSignal, None] = {}
    for entry in _expanded(table.tables("signals"), joints):
        signal = _signal(entry, messages, joints, sensors)
        entry.close()
        if signal in signals:
            entry.fault("signal", "one entry a signal, target and quantity", "a repeated entry")
        signals[signal] = None
    polls: dict[BusPoll, None] = {}
    for entry in _expanded(table.tables("polls"), joints):
        polls[_poll(entry, messages, joints)] = None
        entry.close()
    table.close()
    return Bus(tuple(databases), bitrate, tuple(signals), tuple(polls)), tuple(databases.items())


def _poll(
    entry: StrictTable, messages: Mapping[str, Message] | None, joints: tuple[Joint, ...]
) -> BusPoll:
    """Read a request; its target, if any, only names the joint that it is for."""
    names = [joint.name for joint in joints]
    if "target" in entry and (target := entry.text("target")) not in names:
        entry.fault("target", listed([*names, _PLACEHOLDER], target))
    message, signals = _message(entry, messages)
    table = entry.table("signals")
    lengths = {name: signal.length for name, signal in (signals or {}).items()}
    names = table.values if signals is None else [name for name in lengths if name in table]
    numbers = sorted((name, table.integer(name, 0)) for name in names)
    for name, number in numbers:
        if name in lengths and number >> lengths[name]:
            table.fault(name, f"a raw number of {lengths[name]} bits")
    table.close()
    return BusPoll(message, tuple(numbers))


def _message(
    entry: StrictTable, messages: Mapping[str, Message] | None
) -> tuple[str, dict[str, Signal] | None]:
    """Read the name of a message; return it with its signals, None where it is unknown."""
    name = entry.text("message")
    if messages is None or name not in messages:
        if messages is not None and name:
            entry.fault("message", listed(messages, name))
        return name, None
    return name, {signal.name: signal for signal in messages[name].signals}


def _expanded(entries: Iterable[StrictTable], joints: tuple[Joint, ...]) -> Iterator[StrictTable]:
    """Yield each entry, or one entry a joint where its target is the placeholder."""
    for entry in entries:
        if entry.values.get("target") != _PLACEHOLDER:
            yield entry
            continue
        for joint in joints:
            yield entry.replaced(
                {
                    key: value.replace(_PLACEHOLDER, joint.name)
                    if isinstance(value, str)
                    else value
                    for key, value in entry.values.items()
                }
            )


def _signal(
    entry: StrictTable,
    messages: Mapping[str, Message] | None,
    joints: tuple[Joint, ...],
    sensors: tuple[Sensor, ...],
) -> BusSignal:
    message, signals = _message(entry, messages)
    signal = entry.text("signal")
    dbc = (signals or {}).get(signal)
    if signals is not None and signal and dbc is None:
        entry.fault("signal", f"a signal of {message}: {listed(signals, signal)}")
    direction = entry.choice("direction", Direction) or Direction.RX
    target, quantity = entry.text("target"), entry.choice("quantity", Quantity)
    unit = entry.text("unit")
    axis = entry.text("axis", "")
    fitting = _quantities(target, joints, sensors)
    if target and not fitting:
        names = [part.name for part in (*joints, *sensors)]
        entry.fault("target", listed([*names, _PLACEHOLDER], target))
    if quantity is not None:
        if fitting and quantity not in fitting:
            entry.fault("quantity", f"what {target} has: {', '.join(fitting)}")
        try:
            unit_for(unit, quantity)
        except UsageError:
            entry.fault("unit", f"for {quantity}: {listed(valid_units(quantity), unit)}")
        _check_axis(entry, axis, [s for s in sensors if s.name == target])
    if quantity is not Quantity.RANGE and "out_of_range" in entry:
        entry.fault("out_of_range", "leave it out: only a range has it")
    return BusSignal(
        message=message,
        signal=signal,
        direction=direction,
        target=target,
        quantity=quantity or Quantity.POSITION,
        unit=unit,
        scale=read_field(entry, BusSignal, "scale"),
        offset=read_field(entry, BusSignal, "offset"),
        axis=axis,
        unknown=_code(entry, "unknown", dbc),
        out_of_range=_code(entry, "out_of_range", dbc),
    )


def _code(entry: StrictTable, key: str, dbc: Signal | None) -> int | None:
    """Read a raw number with a special meaning; None where there is none."""
    if key not in entry:
        return None
    if dbc is None:
        return entry.integer(key, -(1 << 63))
    least = -(1 << (dbc.length - 1)) if dbc.is_signed else 0
    greatest = least + (1 << dbc.length) - 1
    number = entry.integer(key, least)
    if dbc.is_float:
        entry.fault(key, "leave it out: a float has numbers for that, NaN and inf")
    elif number > greatest:
        entry.fault(key, f"a raw number of {dbc.length} bits, {least} to {greatest}")
    return number


def _quantities(
    target: str, joints: tuple[Joint, ...], sensors: tuple[Sensor, ...]
) -> tuple[Quantity, ...]:
    """Return the quantities of a target, none if there is no such target."""
    if any(joint.name == target for joint in joints):
        return JOINT_QUANTITIES
    return tuple(_OF_SENSOR[sensor.kind] for sensor in sensors if sensor.name == target)


def _check_axis(entry: StrictTable, axis: str, sensors: list[Sensor]) -> None:
    """Note an axis that the target does not measure, or one that is missing."""
    axes = sensors[0].axes if sensors else ()
    if axes and axis not in axes:
        entry.fault("axis", listed(axes, axis))
    elif axis and not axes:
        entry.fault("axis", "leave it out: the target has no axes")
