"""Units of foreign logs, and the unit in which a session holds each quantity.

A session holds SI, except temperatures, which stay in degrees Celsius.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from ..common.arrays import FloatArray
from ..common.errors import UsageError
from .model import Quantity


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
        """Values in the session's unit.

        Args:
            values: In this unit, any shape.

        Returns:
            ``factor * values + offset``, same shape.
        """
        return values * self.factor + self.offset


_STANDARD_GRAVITY = 9.80665  # m/s^2, 3rd CGPM 1901
_TURN = 2 * math.pi

UNITS: dict[str, Unit] = {
    "rad": Unit("rad", 1.0),
    "mrad": Unit("rad", 1e-3),
    "deg": Unit("rad", math.pi / 180),
    "rev": Unit("rad", _TURN),
    "rad/s": Unit("rad/s", 1.0),
    "deg/s": Unit("rad/s", math.pi / 180),
    "rev/s": Unit("rad/s", _TURN),
    "rpm": Unit("rad/s", _TURN / 60),
    "N m": Unit("N m", 1.0),
    "mN m": Unit("N m", 1e-3),
    "kgf cm": Unit("N m", _STANDARD_GRAVITY / 100),
    "A": Unit("A", 1.0),
    "mA": Unit("A", 1e-3),
    "V": Unit("V", 1.0),
    "mV": Unit("V", 1e-3),
    "degC": Unit("degC", 1.0),
    "K": Unit("degC", 1.0, -273.15),
    "m": Unit("m", 1.0),
    "cm": Unit("m", 1e-2),
    "mm": Unit("m", 1e-3),
    "m/s^2": Unit("m/s^2", 1.0),
    "g": Unit("m/s^2", _STANDARD_GRAVITY),
    "mg": Unit("m/s^2", _STANDARD_GRAVITY / 1000),
    "T": Unit("T", 1.0),
    "uT": Unit("T", 1e-6),
    "G": Unit("T", 1e-4),
    "s": Unit("s", 1.0),
    "ms": Unit("s", 1e-3),
    "us": Unit("s", 1e-6),
    "ns": Unit("s", 1e-9),
}
"""Every unit that a robot description or a column map may name."""

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


def valid_units(quantity: Quantity) -> tuple[str, ...]:
    """Names of the units that fit a quantity.

    Args:
        quantity: The quantity.

    Returns:
        The names, the session's own unit first.
    """
    dimension = SESSION_UNIT[quantity]
    return tuple(name for name, unit in UNITS.items() if unit.dimension == dimension)


def unit_for(name: str, quantity: Quantity) -> Unit:
    """The unit of that name, if it fits the quantity.

    Args:
        name: Unit name, e.g. ``deg``.
        quantity: What is measured in it.

    Returns:
        The unit.

    Raises:
        UsageError: If there is no such unit or it measures something else; lists the valid ones.
    """
    valid = valid_units(quantity)
    if name not in valid:
        raise UsageError(f"unit {name!r} does not fit {quantity}; valid: {', '.join(valid)}")
    return UNITS[name]
