"""What a session tells of how it was run: which servos, on which ground, at which physics rate.

A session of the twin carries its scenario, and a scenario may change the robot's servos and links
(``[servo]``, ``[servo_of.JOINT]``, ``[link_of.LINK]``) and leave out the ground.
"""

from __future__ import annotations

import dataclasses
from typing import Any, cast

from undulog.capture import SessionView
from undulog.capture.common.strict_table import read_toml
from undulog.capture.robot.model import Joint, Link, Robot, Servo

DRAG_RATIO = 10.0
"""K = c_n / c_t where nothing says otherwise; 0.5 / 0.05 of the twin's ground."""


_SERVO_FIELDS = frozenset(field.name for field in dataclasses.fields(Servo))


def scenario_of(session: SessionView) -> dict[str, Any] | None:
    """The attached scenario's tables.

    Args:
        session: An open session.

    Returns:
        As in the TOML; None of a session that is not of the twin, or whose scenario can't be read.
    """
    text = session.attachments.get("scenario.toml")
    if text is None:
        return None
    try:
        return read_toml(text.decode())
    except ValueError:
        return None


def touches(scenario: dict[str, Any] | None) -> bool | None:
    """Whether the robot was in contact with anything but itself.

    Args:
        scenario: From :func:`scenario_of`.

    Returns:
        None where no scenario says so.
    """
    if scenario is None:
        return None
    world = _table(scenario, "world")
    return world.get("surface", "flat") != "none" or bool(world.get("obstacles"))


def start_heading_rad(scenario: dict[str, Any] | None) -> float | None:
    """Heading of the robot at the start of a simulated session [rad].

    Args:
        scenario: From :func:`scenario_of`.

    Returns:
        The heading; None of a real robot.
    """
    if scenario is None:
        return None
    return float(_table(scenario, "world").get("heading", 0.0))


def physics_step_s(scenario: dict[str, Any] | None) -> float:
    """Physics step of a simulated session [s]; 0 of a real robot.

    Args:
        scenario: From :func:`scenario_of`.

    Returns:
        The step.
    """
    rate = None if scenario is None else scenario.get("physics_rate_hz", 1000)
    return 1.0 / float(rate) if rate else 0.0


def robot_as_run(robot: Robot, scenario: dict[str, Any] | None) -> Robot:
    """The robot with what the scenario changes of its modules.

    Args:
        robot: As it is described.
        scenario: From :func:`scenario_of`.

    Returns:
        The robot; as described where there is no scenario.
    """
    if scenario is None:
        return robot
    everywhere, each = _table(scenario, "servo"), _table(scenario, "servo_of")
    links = _table(scenario, "link_of")
    return dataclasses.replace(
        robot,
        joints=tuple(
            _refitted(joint, everywhere | _table(each, joint.name)) for joint in robot.joints
        ),
        links=tuple(
            _heavier(link, float(_table(links, link.name).get("mass_factor", 1.0)))
            for link in robot.links
        ),
    )


def _refitted(joint: Joint, changes: dict[str, Any]) -> Joint:
    known = {name: float(value) for name, value in changes.items() if name in _SERVO_FIELDS}
    return dataclasses.replace(joint, servo=dataclasses.replace(joint.servo, **known))


def _heavier(link: Link, factor: float) -> Link:
    ixx, iyy, izz = (factor * moment for moment in link.inertia)
    return dataclasses.replace(link, mass=factor * link.mass, inertia=(ixx, iyy, izz))


def _table(values: dict[str, Any], name: str) -> dict[str, Any]:
    found = values.get(name, {})
    return cast("dict[str, Any]", found) if isinstance(found, dict) else {}
