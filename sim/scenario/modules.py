"""Modules that differ: a scenario's own servo and link parameters, in place of the robot's.

A robot description is what the robot is meant to be. What a scenario changes stays out of the
robot description that its sessions carry, as a worn servo or a load on one link would: it is in
the attached scenario and the record of what ran.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import TypeAlias

from undulog.capture.common.config import read_field
from undulog.capture.common.strict_table import Table, above
from undulog.capture.robot.model import Robot, Servo

Fields: TypeAlias = Mapping[str, float]
"""Parameter name to value."""

MASS_FACTOR = "mass_factor"
"""Multiplies a link's mass and its moments of inertia, as a denser material of that shape would."""


@dataclasses.dataclass(frozen=True)
class Modules:
    """What a scenario changes of the robot's modules.

    Attributes:
        servo: Servo parameters of all joints.
        servo_of: The same of single joints, by joint name.
        link_of: :data:`MASS_FACTOR` of single links, by link name.
    """

    servo: Fields = dataclasses.field(default_factory=dict[str, float])
    servo_of: Mapping[str, Fields] = dataclasses.field(default_factory=dict[str, Fields])
    link_of: Mapping[str, Fields] = dataclasses.field(default_factory=dict[str, Fields])

    def fitted(self, robot: Robot) -> Robot:
        """The robot with these modules.

        Args:
            robot: As it is described.

        Returns:
            As the scenario has it.
        """
        servo_of = {
            name: {**self.servo, **self.servo_of.get(name, {})} for name in robot.joint_names
        }
        return robot.with_modules(servo_of, self.mass_factor)

    @property
    def mass_factor(self) -> Fields:
        """Factors of mass and moments of inertia by link name, where they are given."""
        return {
            name: fields[MASS_FACTOR]
            for name, fields in self.link_of.items()
            if MASS_FACTOR in fields
        }

    def tables(self) -> dict[str, dict[str, object]]:
        """The tables of a scenario file that say this; empty ones are left out."""
        tables: dict[str, dict[str, object]] = {
            "servo": dict(self.servo),
            "servo_of": {name: dict(one) for name, one in self.servo_of.items()},
            "link_of": {name: dict(one) for name, one in self.link_of.items()},
        }
        return {name: table for name, table in tables.items() if table}


def read_modules(top: Table, robot: Robot | None) -> Modules:
    """Read ``[servo]``, ``[servo_of.JOINT]`` and ``[link_of.LINK]`` of a scenario.

    Args:
        top: The scenario.
        robot: The robot; None after a fault: then names can't be checked.

    Returns:
        The modules.
    """
    servo = _servo_fields(top.table("servo"))
    servos, links = top.table("servo_of"), top.table("link_of")
    if robot is None:
        return Modules(servo)
    servo_of = {name: _servo_fields(servos.table(name)) for name in robot.joint_names}
    link_of = {link.name: _link_fields(links.table(link.name)) for link in robot.links}
    servos.close()
    links.close()
    modules = Modules(
        servo,
        {name: given for name, given in servo_of.items() if given},
        {name: given for name, given in link_of.items() if given},
    )
    _check_rest(top, modules.fitted(robot))
    return modules


def _check_rest(top: Table, robot: Robot) -> None:
    """A rotor at rest withstands no less than a moving one: add a fault where it would."""
    for joint in robot.joints:
        servo = joint.servo
        if 0 < servo.static_friction < servo.coulomb_friction:
            top.fault(
                "servo.static_friction",
                f"0, or at least coulomb_friction = {servo.coulomb_friction:g} of {joint.name}",
                f"{servo.static_friction:g}",
            )
            return


def _servo_fields(table: Table) -> dict[str, float]:
    """The servo parameters that a table gives."""
    names = [item.name for item in dataclasses.fields(Servo) if item.name in table]
    given = {name: read_field(table, Servo, name) for name in names}
    table.close()
    return given


def _link_fields(table: Table) -> dict[str, float]:
    given = {MASS_FACTOR: table.number(MASS_FACTOR, above(0.0))} if MASS_FACTOR in table else {}
    table.close()
    return given
