"""A bus map from a family of motors and their numbers: the short form of a ``bus`` table.

::

    [bus]
    family = "feetech"            # see `docs/reference/motor-families.md`
    model = "sts3215"
    ids = [1, 2, 3]               # of the joints, head to tail

``motors`` in the place of ``ids`` names each: ``{ joint = "joint01", id = 11, scale = -0.125 }``.
"""

from __future__ import annotations

from dataclasses import replace
from importlib.metadata import entry_points
from typing import TYPE_CHECKING

from ..common.config import read
from ..common.strict_table import Table, listed
from .can_families import CAN_FAMILIES, Frame, dbc_text
from .model import Bus, BusSignal, Direction, Joint, Motor, Quantity
from .servo_registers import SERVOS

if TYPE_CHECKING:
    from collections.abc import Mapping

DECODERS = "undulog.decoders"
"""Entry point group: the name is a family, the object a class with the methods of
:class:`.capture.bus.decoding.Decoder`, called with the robot."""

_SCALED = (Quantity.COMMAND, Quantity.POSITION, Quantity.VELOCITY)
_DEFAULT_BITRATE = 1_000_000


def family_names() -> tuple[str, ...]:
    """Return every family that a robot's description may name."""
    return (*CAN_FAMILIES, *SERVOS, *sorted(entry_points(group=DECODERS).names))


def is_serial(bus: Bus | None) -> bool:
    """Whether a bus is a line of serial servos."""
    return bus is not None and bus.family in SERVOS


def models_of(family: str) -> tuple[str, ...]:
    """Return the models of a family, the default first; none where there are no different ones."""
    if family in CAN_FAMILIES:
        return tuple(filter(None, CAN_FAMILIES[family].models))
    return tuple(SERVOS.get(family, ()))


def read_family(
    table: Table, joints: tuple[Joint, ...], unit_factor: Mapping[str, float]
) -> tuple[Bus, tuple[tuple[str, str], ...]]:
    """Read the ``bus`` table of a family; return it with the databases that it stands for.

    Args:
        unit_factor: Session units in one of each unit.
    """
    family = table.text("family")
    names = family_names()
    if family not in names:
        table.fault("family", listed(names, family))
    motors = _motors(table, joints, models_of(family))
    for what, found in (("id", [m.id for m in motors]), ("joint", [m.joint for m in motors])):
        if len(set(found)) < len(found):
            table.fault("motors", f"every {what} once", f"one of {found} is repeated")
    own = CAN_FAMILIES[family].bitrate if family in CAN_FAMILIES else _DEFAULT_BITRATE
    bitrate = table.integer("bitrate", 1, default=own)
    table.close()
    if table.faults.all():
        return Bus((), bitrate, (), family=family), ()
    signals, frames = _signals(family, motors, unit_factor)
    databases = tuple(
        (f"{family}-{way}.dbc", dbc_text(of_way))
        for way in Direction
        if (of_way := {name: each for name, each in frames.items() if each.direction is way})
    )
    names_of = tuple(name for name, _ in databases)
    return Bus(names_of, bitrate, signals, family=family, motors=motors), databases


def _motors(table: Table, joints: tuple[Joint, ...], models: tuple[str, ...]) -> tuple[Motor, ...]:
    names = [joint.name for joint in joints]
    usual = table.text("model", models[0]) if models else ""
    if models and usual not in models:
        table.fault("model", listed(models, usual))
    if len(models) > 1 and "model" not in table and "ids" in table:
        table.fault("model", listed(models))
    if "motors" not in table:
        ids = table.numbers("ids", len(joints)) if joints else ()
        if not all(number >= 0 and number.is_integer() for number in ids):
            table.fault("ids", f"{len(joints)} whole numbers, at least 0")
            return ()
        return tuple(Motor(name, int(one), usual) for name, one in zip(names, ids, strict=False))
    motors: list[Motor] = []
    for entry in table.tables("motors"):
        base = entry.over(entry.replaced({"model": usual})) if models else entry
        motor = read(base, Motor)
        if motor.joint not in names:
            entry.fault("joint", listed(names, motor.joint))
        if models and motor.model not in models:
            entry.fault("model", listed(models, motor.model))
        motors.append(motor)
    return tuple(motors)


def _signals(
    family: str, motors: tuple[Motor, ...], unit_factor: Mapping[str, float]
) -> tuple[tuple[BusSignal, ...], dict[str, Frame]]:
    signals: list[BusSignal] = []
    frames: dict[str, Frame] = {}
    for motor in motors:
        rows: list[tuple[str, str, Direction, Quantity, str, int | None]] = []
        for register in SERVOS.get(family, {}).get(motor.model, ()):
            message = f"servo {motor.id}"
            rows.append(
                (message, register.name, register.direction, register.quantity, register.unit, None)
            )
        for frame in CAN_FAMILIES[family].frames(motor) if family in CAN_FAMILIES else ():
            message = f"{motor.joint}_{frame.name}"
            frames[message] = frame
            rows += [
                (message, one.name, frame.direction, one.quantity, one.unit, one.unknown)
                for one in frame.fields
                if one.quantity is not None
            ]
        for message, name, way, quantity, unit, unknown in rows:
            scale = motor.scale if quantity in _SCALED else 1.0
            angle = quantity in _SCALED[:2]
            offset = motor.offset / unit_factor[unit] if angle else 0.0
            signals.append(
                BusSignal(message, name, way, motor.joint, quantity, unit, scale, offset,
                          unknown=unknown)
            )  # fmt: skip
    joined = _one_an_identifier(frames, signals)
    return tuple(signals), joined


def _one_an_identifier(frames: dict[str, Frame], signals: list[BusSignal]) -> dict[str, Frame]:
    """Join the messages of motors that share an identifier; each motor's fields get own names."""
    first: dict[tuple[Direction, int, bool], str] = {}
    joined: dict[str, Frame] = {}
    for name, frame in frames.items():
        key = (frame.direction, frame.id, frame.extended)
        host = first.setdefault(key, name)
        if host == name:
            joined[name] = frame
            continue
        renamed = tuple(replace(one, name=f"{name}_{one.name}") for one in frame.fields)
        joined[host] = replace(joined[host], fields=(*joined[host].fields, *renamed))
        for k, signal in enumerate(signals):
            if signal.message == name:
                signals[k] = replace(signal, message=host, signal=f"{name}_{signal.signal}")
    return joined
