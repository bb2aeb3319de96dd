"""Units of a scenario's numbers, by key."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from fnmatch import fnmatchcase
from typing import Any, cast

_UNITS = (
    ("s", "*_s"),
    ("Hz", "*_hz"),
    ("V", "*_v"),
    ("rad", "gait.*amplitude gait.*lag gait.*offset gait.*phase gait.*kick_size noise.position"),
    ("rad", "*.heading *.slope *.slope_heading *.inclination *.north sensing.servo.* *.backlash"),
    ("rad", "controller.*.f0 controller.*.largest"),
    ("rad/s", "gait.*.detuning noise.velocity *.stribeck_speed"),
    ("1/s", "gait.*.forward gait.*.backward gait.*.approach_rate gait.*.attraction"),
    ("1/s", "gait.*.feedback"),
    ("1/m", "controller.*.k"),
    ("1/rad", "*.proportional_gain"),
    ("N", "disturbances.force"),
    ("N m", "noise.effort *.stall_torque *.coulomb_friction *.static_friction"),
    ("N m/A", "*.torque_constant"),
    ("N m/rad", "*.gear_stiffness"),
    ("N m s/rad", "*.viscous_friction *.gear_damping"),
    ("kg m^2", "*.rotor_inertia"),
    ("N/m", "world.*.stiffness"),
    ("N s/m", "world.*.damping world.*.drag_tangential world.*.drag_normal"),
    ("m/s", "world.velocity world.*.slip_speed"),
    ("m/s^2", "world.gravity sensing.accelerometer.noise sensing.accelerometer.resolution"),
    ("T", "sensing.compass.noise sensing.compass.resolution sensing.compass.horizontal_field"),
    ("m", "sensing.sonar.noise sensing.sonar.resolution sensing.ir.peak *_m"),
    ("m", "*.position *.radius *.height *.size *.from *.to *.thickness *.centre *.clear *.gap"),
)
_NUMBERS = (  # without a unit
    "*seed *.count *.rays *_bits *.mu *.mu_tangential *.mu_normal *.gain *_gain *.slip_ratio "
    "*.smallest *.mass_factor *.feedback_bias faults.value"
)


def unit_of(key: str) -> str | None:
    """Return the unit of a number of a scenario.

    Args:
        key: With dots, and an index in brackets in a list: ``world.obstacles[2].radius``.

    Returns:
        The unit, in SI; empty for a number without one; None if the key is unknown.
    """
    plain = re.sub(r"\[\d+\]", "", key)
    for unit, patterns in (*_UNITS, ("", _NUMBERS)):
        if any(fnmatchcase(plain, pattern) for pattern in patterns.split()):
            return unit
    return None


def leaves(values: Mapping[str, Any], before: str = "") -> Iterator[tuple[str, Any]]:
    """Yield each value of a scenario's tables with its key, in order."""
    for name, value in values.items():
        key = f"{before}{name}"
        if isinstance(value, dict):
            yield from leaves(cast("dict[str, Any]", value), f"{key}.")
        elif isinstance(value, list) and value and isinstance(value[0], dict):
            for k, item in enumerate(cast("list[dict[str, Any]]", value)):
                yield from leaves(item, f"{key}[{k}].")
        else:
            yield key, value
