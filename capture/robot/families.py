"""A bus map from a family of motors and their numbers: the short form of a ``bus`` table.

::

    [bus]
    family = "feetech"            # see `docs/reference/motor-families.md`
    model = "sts3215"
    ids = [1, 2, 3]               # of the joints, head to tail

``motors`` in the place of ``ids`` names each: ``{ joint = "joint01", id = 11, scale = -0.125 }``.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

from ..common.config import read
from ..common.strict_table import StrictTable, listed
from .model import Bus, BusSignal, Direction, Joint, Motor, Quantity
from .serial_servos import SERVOS

TX, RX = Direction.TX, Direction.RX

_DAMIAO: Mapping[str, tuple[float, float, float]] = {
    "dm4310": (12.5, 30, 10), "dm4310-48v": (12.5, 50, 10), "dm4340": (12.5, 8, 28),
    "dm4340-48v": (12.5, 10, 28), "dm6006": (12.5, 45, 20), "dm8006": (12.5, 45, 40),
    "dm8009": (12.5, 45, 54), "dm10010l": (12.5, 25, 200), "dm10010": (12.5, 20, 200),
    "dmh3510": (12.5, 280, 1), "dmh6215": (12.5, 45, 10), "dmg6220": (12.5, 45, 10),
}  # fmt: skip
"""Model to PMAX [rad], VMAX [rad/s], TMAX [N m], as DM_Control_Python lists them; all three are
settings of the motor."""

_AK: Mapping[str, tuple[float, float, float]] = {
    "ak10-9": (12.5, 50, 65), "ak60-6": (12.5, 45, 15), "ak70-10": (12.5, 50, 25),
    "ak80-6": (12.5, 76, 12), "ak80-9": (12.5, 50, 18), "ak80-64": (12.5, 8, 144),
    "ak80-8": (12.5, 37.5, 32),
}  # fmt: skip
"""Model to ranges of position [rad], velocity [rad/s] and torque [N m]: AK series manual."""

_ROBSTRIDE: Mapping[str, tuple[float, float, float]] = {
    "cybergear": (4 * math.pi, 30, 12),
    "rs00": (4 * math.pi, 33, 14), "rs01": (4 * math.pi, 44, 17), "rs02": (4 * math.pi, 44, 17),
    "rs03": (4 * math.pi, 20, 60), "rs04": (4 * math.pi, 15, 120), "rs05": (4 * math.pi, 50, 5.5),
    "rs06": (4 * math.pi, 50, 36),
}  # fmt: skip
"""Model to ranges of position [rad], velocity [rad/s] and torque [N m]: the motors' manuals."""

_RMD_STATE = (0x9C, *range(0xA1, 0xAA))

DECODERS = "undulog.decoders"
"""Entry point group: the name is a family, the object a class with the methods of
:class:`.capture.bus.decoding.Decoder`, called with the robot."""

_SCALED = (Quantity.COMMAND, Quantity.POSITION, Quantity.VELOCITY)
_DEFAULT_BITRATE = 1_000_000


@dataclass(frozen=True)
class SignalField:
    """One signal of a message: DBC bit field, and what it means.

    Attributes:
        bits: ``START|LENGTH@ORDERSIGN`` as in a DBC file.
        quantity: None for a signal that the session doesn't hold.
        selector: Values of the message's multiplexer that select it; empty for all.
        is_float: IEEE 754 of 32 bits.
        unknown: Raw number that stands for no value.
    """

    name: str
    bits: str
    quantity: Quantity | None = None
    unit: str = ""
    scale: float = 1.0
    offset: float = 0.0
    selector: tuple[int, ...] = ()
    is_float: bool = False
    unknown: int | None = None


@dataclass(frozen=True)
class Frame:
    """A message of a motor.

    Attributes:
        id: Identifier.
        multiplexer: Bit field that selects fields; empty for none.
    """

    name: str
    direction: Direction
    id: int
    fields: tuple[SignalField, ...]
    multiplexer: str = ""
    extended: bool = False
    size: int = 8


def dbc_text(frames: Mapping[str, Frame]) -> str:
    """Return a DBC database of messages by name, all of one direction."""
    lines = ['VERSION ""', "", "NS_ :", " SG_MUL_VAL_", " SIG_VALTYPE_", "", "BS_:", "", "BU_:"]
    extra: list[str] = []
    for name, frame in frames.items():
        number = frame.id | (0x8000_0000 if frame.extended else 0)
        lines += ["", f"BO_ {number} {name}: {frame.size} Vector__XXX"]
        if frame.multiplexer:
            lines.append(f' SG_ selector M : {frame.multiplexer} (1,0) [0|0] "" Vector__XXX')
        for part in frame.fields:
            mark = f" m{part.selector[0]}" if part.selector else ""
            scaled = f"({part.scale!r},{part.offset!r})"
            lines.append(f' SG_ {part.name}{mark} : {part.bits} {scaled} [0|0] "" Vector__XXX')
            if part.is_float:
                extra.append(f"SIG_VALTYPE_ {number} {part.name} : 1;")
            if len(part.selector) > 1:
                ranges = ", ".join(f"{value}-{value}" for value in part.selector)
                extra.append(f"SG_MUL_VAL_ {number} {part.name} selector {ranges};")
    return "\n".join([*lines, "", *extra, ""])


def _mapped(name: str, bits: str, most: float, **meaning: object) -> SignalField:
    """Return a number that spans -most to most, both included, as MIT's mini-cheetah has it."""
    length = int(bits[bits.index("|") + 1 : bits.index("@")])
    scale = 2 * most / ((1 << length) - 1)
    return SignalField(name, bits, scale=scale, offset=-most, **meaning)  # pyright: ignore[reportArgumentType]


def _state(
    places: tuple[str, str, str], most: tuple[float, float, float], selector: tuple[int, ...] = ()
) -> tuple[SignalField, ...]:
    """Return position, velocity and torque, which span -most to most."""
    names = ("position", "velocity", "torque")
    kinds = (Quantity.POSITION, "rad"), (Quantity.VELOCITY, "rad/s"), (Quantity.EFFORT, "N m")
    return tuple(
        _mapped(name, bits, limit, quantity=quantity, unit=unit, selector=selector)
        for name, bits, limit, (quantity, unit) in zip(names, places, most, kinds, strict=True)
    )


def _mit_command(id_: int, position: float, velocity: float) -> Frame:
    """Position 16, velocity 12, gains 12 and 12, torque 12 bits, most significant bit first.

    ``FF FF FF FF FF FF FF FC`` and its like (enter, exit, set zero) are no commands, so a position
    of 0xFFFF has no value.
    """
    kind = {"quantity": Quantity.COMMAND, "unit": "rad", "unknown": 0xFFFF}
    command = _mapped("position_command", "7|16@0+", position, **kind)
    return Frame("mit", TX, id_, (command, _mapped("velocity_command", "23|12@0+", velocity)))


def _mit_reply(
    id_: int, motor: int, most: tuple[float, float, float], *, low_nibble: bool, warmth: float
) -> Frame:
    """Motor number, position 16, velocity 12, torque 12 bits, temperature."""
    selector = (motor,)
    fields = (
        *_state(("15|16@0+", "31|12@0+", "35|12@0+"), most, selector),
        SignalField("temperature", "48|8@1+", Quantity.TEMPERATURE, "degC", 1.0, warmth, selector),
    )
    return Frame("reply", RX, id_, fields, "0|4@1+" if low_nibble else "0|8@1+")


def damiao(motor: Motor) -> tuple[Frame, ...]:
    """Damiao: MIT mode, position-velocity mode (0x100 + id), replies at the master's identifier."""
    most = _DAMIAO[motor.model]
    speed = SignalField("position_command", "0|32@1-", Quantity.COMMAND, "rad", is_float=True)
    # Byte 6 is the temperature of the transistors, byte 7 that of the winding.
    reply = _mit_reply(motor.reply_id or 0, motor.id & 0xF, most, low_nibble=True, warmth=0.0)
    return (
        _mit_command(motor.id, most[0], most[1]),
        Frame("position_velocity", TX, 0x100 + motor.id, (speed,)),
        reply,
    )


def tmotor_ak(motor: Motor) -> tuple[Frame, ...]:
    """T-Motor AK series in MIT mode."""
    most = _AK[motor.model]
    reply = _mit_reply(motor.reply_id or 0, motor.id, most, low_nibble=False, warmth=-40.0)
    return (_mit_command(motor.id, most[0], most[1]), reply)


def _robstride(motor: Motor) -> tuple[Frame, ...]:
    """RobStride and CyberGear, private protocol: 29-bit identifiers ``type:5 data:16 target:8``.

    Type 1 has the torque in its identifier, type 2 the motor, its mode and faults:
    :func:`robstride_key` takes away what isn't the type and the motor.
    """
    most = _ROBSTRIDE[motor.model]
    position = _mapped(
        "position_command", "7|16@0+", most[0], quantity=Quantity.COMMAND, unit="rad"
    )

    def command(selector: int, quantity: Quantity | None) -> SignalField:
        return SignalField(
            "loc_ref", "32|32@1-", quantity, "rad", selector=(selector,), is_float=True
        )

    return (
        Frame("control", TX, 1 << 24 | motor.id, (position,), extended=True),
        Frame("write", TX, 18 << 24 | motor.id, (command(0x7016, Quantity.COMMAND),), "0|16@1+",
              extended=True),
        Frame("feedback", RX, 2 << 24 | motor.id << 8, (
            *_state(("7|16@0+", "23|16@0+", "39|16@0+"), most),
            SignalField("temperature", "55|16@0+", Quantity.TEMPERATURE, "degC", 0.1),
        ), extended=True),
    )  # fmt: skip


def rmd(motor: Motor) -> tuple[Frame, ...]:
    """MyActuator RMD: byte 0 is the command; a reply repeats it.

    Model ``v3`` is the protocol of V3 and V4 (replies at 0x240 + id), ``v2`` the older one, whose
    requests and replies share the identifier 0x140 + id: they differ in direction only.
    """
    old = motor.model == "v2"
    reply = motor.reply_id if motor.reply_id is not None else (0x140 if old else 0x240) + motor.id
    bits = "8|56@1-" if old else "32|32@1-"
    where = SignalField("position", bits, Quantity.POSITION, "deg", 0.01,
                  selector=(0x92,))  # fmt: skip
    state = (
        SignalField(
            "temperature", "8|8@1-", Quantity.TEMPERATURE, "degC", selector=(0x9A, *_RMD_STATE)
        ),
        SignalField("torque_current", "16|16@1-", Quantity.CURRENT, "A", 33 / 2048 if old else 0.01,
              selector=_RMD_STATE),
        SignalField("velocity", "32|16@1-", Quantity.VELOCITY, "deg/s", selector=_RMD_STATE),
        SignalField("voltage", "24|16@1+" if old else "32|16@1+", Quantity.VOLTAGE, "V", 0.1,
              selector=(0x9A,)),
    )  # fmt: skip
    command = SignalField("position_command", "32|32@1-", Quantity.COMMAND, "deg", 0.01,
                    selector=(0xA3, 0xA4) if old else (0xA4,))  # fmt: skip
    return (
        Frame("request", TX, 0x140 + motor.id, (command,), "0|8@1+"),
        Frame("reply", RX, reply, (where, *state), "0|8@1+"),
    )


def odrive(motor: Motor) -> tuple[Frame, ...]:
    """ODrive CANSimple: identifier ``node << 5 | command``, IEEE 754, revolutions."""

    def number(name: str, first: int, quantity: Quantity, unit: str) -> SignalField:
        return SignalField(name, f"{first}|32@1-", quantity, unit, is_float=True)

    def frame(name: str, way: Direction, command: int, *fields: SignalField) -> Frame:
        return Frame(name, way, motor.id << 5 | command, fields)

    return (
        frame("set_input_pos", TX, 0x0C, number("input_pos", 0, Quantity.COMMAND, "rev")),
        frame("get_encoder_estimates", RX, 0x09,
              number("pos_estimate", 0, Quantity.POSITION, "rev"),
              number("vel_estimate", 32, Quantity.VELOCITY, "rev/s")),
        frame("get_iq", RX, 0x14, number("iq_measured", 32, Quantity.CURRENT, "A")),
        frame("get_temperature", RX, 0x15, number("motor", 32, Quantity.TEMPERATURE, "degC")),
        frame("get_bus_voltage_current", RX, 0x17, number("bus", 0, Quantity.VOLTAGE, "V")),
        frame("get_torques", RX, 0x1C, number("torque_estimate", 32, Quantity.EFFORT, "N m")),
    )  # fmt: skip


@dataclass(frozen=True)
class Family:
    """A family of motors on CAN.

    Attributes:
        frames: The messages of one motor.
        models: Valid models, the default first.
        bitrate: Usual [bit/s].
    """

    frames: Callable[[Motor], tuple[Frame, ...]]
    models: tuple[str, ...] = field(default=("",))
    bitrate: int = 1_000_000


CAN_FAMILIES: Mapping[str, Family] = {
    "damiao": Family(damiao, tuple(_DAMIAO)),
    "tmotor-ak": Family(tmotor_ak, tuple(_AK)),
    "robstride": Family(_robstride, tuple(name for name in _ROBSTRIDE if name != "cybergear")),
    "cybergear": Family(_robstride, ("cybergear",)),
    "rmd": Family(rmd, ("v3", "v2")),
    "odrive": Family(odrive, bitrate=250_000),
}
"""Every family on CAN whose frames a DBC can describe."""


def family_names() -> tuple[str, ...]:
    """Return every family that a robot's description may name."""
    from importlib.metadata import entry_points

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
    table: StrictTable, joints: tuple[Joint, ...], unit_factor: Mapping[str, float]
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
    for what, values in (("id", [m.id for m in motors]), ("joint", [m.joint for m in motors])):
        if len(set(values)) < len(values):
            table.fault("motors", f"every {what} once", f"one of {values} is repeated")
    usual = CAN_FAMILIES[family].bitrate if family in CAN_FAMILIES else _DEFAULT_BITRATE
    bitrate = table.integer("bitrate", 1, default=usual)
    table.close()
    if table.faults.all():
        return Bus((), bitrate, (), family=family), ()
    signals, frames = _signals(family, motors, unit_factor)
    databases = tuple(
        (f"{family}-{way}.dbc", dbc_text(of_way))
        for way in Direction
        if (of_way := {name: frame for name, frame in frames.items() if frame.direction is way})
    )
    names_of = tuple(name for name, _ in databases)
    return Bus(names_of, bitrate, signals, family=family, motors=motors), databases


def _motors(
    table: StrictTable, joints: tuple[Joint, ...], models: tuple[str, ...]
) -> tuple[Motor, ...]:
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
        return tuple(
            Motor(name, int(number), usual) for name, number in zip(names, ids, strict=False)
        )
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
                (message, part.name, frame.direction, part.quantity, part.unit, part.unknown)
                for part in frame.fields
                if part.quantity is not None
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
        renamed = tuple(replace(part, name=f"{name}_{part.name}") for part in frame.fields)
        joined[host] = replace(joined[host], fields=(*joined[host].fields, *renamed))
        for k, signal in enumerate(signals):
            if signal.message == name:
                signals[k] = replace(signal, message=host, signal=f"{name}_{signal.signal}")
    return joined
