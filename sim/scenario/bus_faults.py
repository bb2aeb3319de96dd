"""Faults of a bus and its servos, and their forms as text and as TOML.

On the command line a fault is ``KIND[:JOINT][:NUMBER][@FROM[+FOR]]``, times in s after the start::

    lost:joint07:0.1      each reply of joint07 is lost with a probability of 0.1; lost:0.1: all
    stuck:joint07@5       from 5 s on the servo holds the angle that it has by then
    frozen:joint07@5+2    for 2 s its encoder tells the last angle again and again
    over-current:joint07:1.5@5  from 5 s on the servo draws 1.5 A, and says so
    bus-off@5+2           for 2 s the robot is off the bus
    noise:0.001           each frame is hit with this probability: an error frame, then the frame
    delay:0.02            what the robot sends comes 0.02 s late

In a scenario each is a table of ``[[faults]]`` with the keys ``kind``, ``joint``, ``value`` (the
number), ``from_s`` and ``for_s``. They are faults of the bus: ``sim run``, which has none, is
untouched by them.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, NamedTuple

from undulog.capture.common.config import NonNegative, Positive, read_field
from undulog.capture.common.errors import UsageError
from undulog.capture.common.strict_table import StrictTable, above, at_most, listed
from undulog.capture.robot.model import Robot

_SLACK_S = 1e-9  # ticks and sums of decimal fractions differ in the last bit
_TEXT = re.compile(r"(?P<what>[^@]*)(@(?P<from>[^+@]*)(\+(?P<for>[^+@]*))?)?")
FORM = "KIND[:JOINT][:NUMBER][@FROM[+FOR]], e.g. lost:joint07:0.1 or bus-off@5+2"
"""Form of a fault on the command line, for messages."""


class BusFaultKind(StrEnum):
    """Kind of a fault."""

    LOST = "lost"
    STUCK = "stuck"
    FROZEN = "frozen"
    OVER_CURRENT = "over-current"
    BUS_OFF = "bus-off"
    NOISE = "noise"
    DELAY = "delay"


class _Grammar(NamedTuple):
    """Parameters of a kind of fault.

    Attributes:
        joint: Whether it is of a joint: never, if given, or always.
        value: What its number is, with the greatest it can be; None where it has none.
    """

    joint: bool | None
    value: tuple[str, float] | None


_GRAMMAR = {
    BusFaultKind.LOST: _Grammar(None, ("a probability", 1.0)),
    BusFaultKind.STUCK: _Grammar(True, None),
    BusFaultKind.FROZEN: _Grammar(True, None),
    BusFaultKind.OVER_CURRENT: _Grammar(True, ("a current in A", 100.0)),
    BusFaultKind.BUS_OFF: _Grammar(False, None),
    BusFaultKind.NOISE: _Grammar(False, ("a probability", 0.9)),  # frames are repeated until heard
    BusFaultKind.DELAY: _Grammar(False, ("a time in s", 10.0)),
}


@dataclass(frozen=True)
class BusFault:
    """One fault.

    Attributes:
        joint: The joint; empty for all, or for the whole bus.
        value: A probability, a current [A] or a time [s], as the kind has it; 0 where it has none.
        from_s: When it begins, after the start [s].
        for_s: How long it lasts [s].
    """

    kind: BusFaultKind
    joint: str = ""
    value: float = 0.0
    from_s: NonNegative = 0.0
    for_s: Positive = math.inf

    def acts(self, time_s: float) -> bool:
        """Whether it acts.

        Args:
            time_s: Time since the start [s].
        """
        return -_SLACK_S <= time_s - self.from_s < self.for_s - _SLACK_S

    def as_table(self) -> dict[str, Any]:
        """Its table in a scenario; what is as by default is left out."""
        stated = {
            "joint": self.joint or None,
            "value": None if _GRAMMAR[self.kind].value is None else self.value,
            "from_s": self.from_s or None,
            "for_s": self.for_s if math.isfinite(self.for_s) else None,
        }
        entries = {key: value for key, value in stated.items() if value is not None}
        return {"kind": str(self.kind), **entries}


def read_faults(top: StrictTable, robot: Robot | None) -> tuple[BusFault, ...]:
    """Read ``[[faults]]`` of a scenario.

    Args:
        top: The scenario's table; faults of the file are noted in its list.
        robot: The robot, None after a fault.

    Returns:
        The faults, without those that are wrong.
    """
    faults: list[BusFault] = []
    for table in top.tables("faults"):
        kind = table.choice("kind", BusFaultKind)
        if kind is not None:
            faults.append(_read(table, kind, robot))
        table.close()
    return tuple(faults)


def _read(table: StrictTable, kind: BusFaultKind, robot: Robot | None) -> BusFault:
    grammar, joint, value = _GRAMMAR[kind], "", 0.0
    if grammar.joint is False:
        if "joint" in table:
            table.fault("joint", f"leave it out: {kind} is of the whole bus")
    elif grammar.joint or "joint" in table:
        joint = table.text("joint")
        if robot is not None and joint not in robot.joint_names:
            table.fault("joint", listed(robot.joint_names, joint))
    if grammar.value is not None:
        value = table.number("value", above(0.0), at_most(grammar.value[1]))
    elif "value" in table:
        table.fault("value", f"leave it out: {kind} has no number")
    return BusFault(
        kind,
        joint,
        value,
        from_s=read_field(table, BusFault, "from_s"),
        for_s=read_field(table, BusFault, "for_s"),
    )


def parse_faults(texts: Iterable[str], robot: Robot) -> tuple[BusFault, ...]:
    """Read faults as the command line has them.

    Args:
        texts: E.g. ``lost:joint07:0.1``.

    Returns:
        The faults, in that order.

    Raises:
        UsageError: If one is none; says what would be valid.
    """
    return tuple(_parsed(text, robot) for text in texts)


def _parsed(text: str, robot: Robot) -> BusFault:
    match = _TEXT.fullmatch(text)
    if match is None:
        raise UsageError(f"{text!r} is no fault: expected {FORM}")
    word, *rest = match["what"].split(":")
    if word not in list(BusFaultKind):
        raise UsageError(f"{text!r}: no fault {word!r}; valid: {listed(BusFaultKind, word)}")
    kind = BusFaultKind(word)
    grammar, joint, value = _GRAMMAR[kind], "", 0.0
    if grammar.joint or (grammar.joint is None and len(rest) > 1):
        joint = rest.pop(0) if rest else ""
        if joint not in robot.joint_names:
            raise UsageError(f"{text!r}: expected a joint: {listed(robot.joint_names, joint)}")
    if grammar.value is not None:
        what, most = grammar.value
        value = _number(text, rest.pop(0) if rest else "", f"{what} up to {most:g}")
        if not 0.0 < value <= most:
            raise UsageError(f"{text!r}: {value:g} is not {what}, above 0 and up to {most:g}")
    if rest:
        raise UsageError(f"{text!r}: {':'.join(rest)} is too much for {kind}; expected {FORM}")
    from_s = 0.0 if match["from"] is None else _time(text, match["from"])
    for_s = math.inf if match["for"] is None else _time(text, match["for"])
    return BusFault(kind, joint, value, from_s, for_s)


def _time(text: str, word: str) -> float:
    value = _number(text, word, "a time in s")
    if value < 0.0:
        raise UsageError(f"{text!r}: {word} is not a time in s after the start")
    return value


def _number(text: str, word: str, what: str) -> float:
    try:
        value = float(word)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise UsageError(f"{text!r}: {word!r} is not {what}; expected {FORM}")
    return value
