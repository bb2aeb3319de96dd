"""Units against their definitions."""

import math

import numpy as np
import pytest

from undulog.capture.common.errors import UsageError
from undulog.capture.robot.bus_map import SESSION_UNIT, UNITS, unit_for, valid_units
from undulog.capture.robot.model import Quantity


@pytest.mark.parametrize(
    ("name", "quantity", "value", "session_value"),
    [
        ("deg", Quantity.POSITION, 180.0, math.pi),
        ("rpm", Quantity.VELOCITY, 60.0, 2 * math.pi),
        ("rev/s", Quantity.VELOCITY, 1.0, 2 * math.pi),
        ("mA", Quantity.CURRENT, 1500.0, 1.5),
        ("mV", Quantity.VOLTAGE, 6000.0, 6.0),
        ("K", Quantity.TEMPERATURE, 300.0, 26.85),
        ("kgf cm", Quantity.EFFORT, 10.0, 0.980665),
        ("cm", Quantity.RANGE, 150.0, 1.5),
        ("mg", Quantity.ACCELERATION, 1000.0, 9.80665),
        ("G", Quantity.MAGNETIC_FIELD, 0.5, 5e-5),
    ],
)
def test_conversion(name, quantity, value, session_value):
    converted = unit_for(name, quantity).convert(np.array([value]))
    assert converted == pytest.approx(session_value, rel=1e-12)


def test_every_quantity_has_a_unit_that_is_its_own():
    for quantity, name in SESSION_UNIT.items():
        assert valid_units(quantity)[0] == name
        assert (UNITS[name].factor, UNITS[name].offset) == (1.0, 0.0)
    assert set(SESSION_UNIT) == set(Quantity)


def test_a_unit_that_does_not_fit_lists_those_that_do():
    with pytest.raises(UsageError, match=r"unit 'deg' does not fit velocity; valid: rad/s, deg/s"):
        unit_for("deg", Quantity.VELOCITY)
