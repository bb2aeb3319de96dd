"""As-run facts: with which servos, masses, contact and physics rate a twin ran.

A scenario may change the robot's servos and links, while the robot description in the session stays
that of the robot as built. What ran is in the metadata record ``undulog.run``. A session of a twin
that was written before this record existed has the facts in its attached scenario only.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, cast

from ..common.config import declared
from ..common.strict_table import above
from ..common.untrusted_text import read_toml
from .model import Servo

RUN_RECORD = "undulog.run"

_SERVO = "servo."
_KEYS = {
    "supply_v": "supply_v",
    "stall_torque": "stall_torque_n_m",
    "torque_constant": "torque_constant_n_m_per_a",
    "proportional_gain": "proportional_gain_per_rad",
    "rotor_inertia": "rotor_inertia_kg_m2",
    "viscous_friction": "viscous_friction_n_m_s_per_rad",
    "coulomb_friction": "coulomb_friction_n_m",
    "gear_stiffness": "gear_stiffness_n_m_per_rad",
    "gear_damping": "gear_damping_n_m_s_per_rad",
    "backlash": "backlash_rad",
    "static_friction": "static_friction_n_m",
    "stribeck_speed": "stribeck_speed_rad_per_s",
}
"""Parameter of a servo to its name in the record."""


@dataclass(frozen=True)
class TwinRun:
    """What a twin ran.

    Attributes:
        physics_rate_hz: Physics steps per second.
        start_heading_rad: Direction of the head at the start, about z.
        contact: Whether there was ground or an obstacle to touch.
        drag_ratio: mu_normal / mu_tangential of the ground; None without ground or friction.
        servo_of: Joint to the parameters of its servo, by the names of :class:`Servo`, in SI units.
        mass_factor: Link to the factor of its mass and moments of inertia, where it isn't 1.

    Raises:
        ValueError: If a number is out of its range.
    """

    physics_rate_hz: float
    start_heading_rad: float
    contact: bool
    drag_ratio: float | None
    servo_of: Mapping[str, Mapping[str, float]]
    mass_factor: Mapping[str, float]

    def __post_init__(self) -> None:
        """Check the numbers: readers divide by them."""
        servos = [item for servo in self.servo_of.values() for item in servo.items()]
        for name, value in [("physics_rate_hz", self.physics_rate_hz), *servos]:
            bounds = (above(0.0),) if name == "physics_rate_hz" else declared(Servo)[name].bounds
            if not (value < math.inf and all(bound.holds(value) for bound in bounds)):
                raise ValueError(f"{name} is {value}")

    def record(self) -> dict[str, str]:
        """Return the entries of the metadata record."""
        values: dict[str, Any] = {**vars(self), "mass_factor": dict(self.mass_factor)}
        del values["servo_of"]
        if self.drag_ratio is None:
            del values["drag_ratio"]
        for joint, servo in self.servo_of.items():
            values[_SERVO + joint] = {_KEYS[name]: value for name, value in servo.items()}
        return {key: json.dumps(value) for key, value in values.items()}


def run_from_record(facts: Mapping[str, str]) -> TwinRun:
    """Read the entries of the metadata record.

    Raises:
        ValueError: If one is missing or isn't what it should be.
    """
    try:
        servos = {
            key.removeprefix(_SERVO): json.loads(text)
            for key, text in facts.items()
            if key.startswith(_SERVO)
        }
        return TwinRun(
            physics_rate_hz=float(facts["physics_rate_hz"]),
            start_heading_rad=float(facts["start_heading_rad"]),
            contact=bool(json.loads(facts["contact"])),
            drag_ratio=drag_ratio(facts.get("drag_ratio", 0.0), 1.0),
            servo_of={
                joint: {name: float(servo[key]) for name, key in _KEYS.items() if key in servo}
                for joint, servo in servos.items()
            },
            mass_factor={
                link: float(factor) for link, factor in json.loads(facts["mass_factor"]).items()
            },
        )
    except (ArithmeticError, AttributeError, LookupError, RecursionError, TypeError) as error:
        raise ValueError(f"{type(error).__name__} {error}") from error


def run_from_scenario(text: bytes, joint_names: Iterable[str]) -> TwinRun | None:
    """Read the attached scenario of a session without the record; None if it is unreadable."""
    try:
        scenario = read_toml(text.decode())
        world, servos = _table(scenario, "world"), _table(scenario, "servo_of")
        ground, links = _table(world, "ground"), _table(scenario, "link_of")
        return TwinRun(
            physics_rate_hz=float(scenario.get("physics_rate_hz", 1000)),
            start_heading_rad=float(world.get("heading", 0.0)),
            contact=world.get("surface", "flat") != "none" or bool(world.get("obstacles")),
            drag_ratio=drag_ratio(ground.get("mu_normal", 0), ground.get("mu_tangential", 0)),
            servo_of={
                joint: _numbers(_table(scenario, "servo") | _table(servos, joint))
                for joint in joint_names
            },
            mass_factor={name: _table(links, name).get("mass_factor", 1.0) for name in links},
        )
    except (TypeError, ValueError):
        return None


def drag_ratio(mu_normal: float | str, mu_tangential: float) -> float | None:
    """Return mu_normal / mu_tangential, or None if that is no positive number."""
    ratio = float(mu_normal) / float(mu_tangential) if mu_tangential else 0.0
    return ratio if 0 < ratio < math.inf else None


def _numbers(servo: Mapping[str, Any]) -> dict[str, float]:
    return {name: float(value) for name, value in servo.items() if name in _KEYS}


def _table(values: Mapping[str, Any], name: str) -> dict[str, Any]:
    table = values.get(name, {})
    return cast("dict[str, Any]", table) if isinstance(table, dict) else {}
