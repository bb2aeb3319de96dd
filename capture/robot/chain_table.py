"""The chain of a robot description: its joints with their servos, and its links."""

from __future__ import annotations

from typing import Any

from ..common.strict_table import Table, listed
from .mesh import MESH_TYPES, is_mesh
from .model import Joint, Link, Plane, Servo
from .repeated import note_repeated

LONGEST_CHAIN = 1000
"""Joints of a chain that is described by its length: far beyond any robot, short of a slip."""


def read_joints(top: Table, defaults: Table) -> tuple[Joint, ...]:
    """Read ``joints``, or a ``chain`` of like ones, with ``defaults`` of joint and servo.

    Args:
        top: The description.
        defaults: Its ``defaults``.

    Returns:
        The joints, the one next to the head first.
    """
    common, servo = defaults.table("joint"), defaults.table("servo")
    entries = _chain(top) if "chain" in top else top.tables("joints")
    if not entries:
        top.fault("joints", "an array of at least one table, the joint next to the head first")
    joints: list[Joint] = []
    for values, where in entries:
        table = Table(values, where, top.faults, common)
        joint = Joint(
            name=table.name("name"),
            plane=table.choice("plane", Plane) or Plane.HORIZONTAL,
            lower=table.number("lower", default=Joint.lower),
            upper=table.number("upper", default=Joint.upper),
            max_velocity=table.number("max_velocity", default=Joint.max_velocity, above=0),
            servo=_servo(table.table("servo", servo)),
        )
        if joint.lower >= joint.upper:
            table.fault("upper", f"more than lower = {joint.lower:g}", f"{joint.upper:g}")
        table.close()
        joints.append(joint)
    if entries:
        common.close()
        servo.close()
    return tuple(joints)


def _chain(top: Table) -> list[tuple[dict[str, Any], str]]:
    """Entries for ``joints`` of a chain that is described by its length."""
    if "joints" in top:
        top.fault("joints", "leave it out: the chain has them")
    table = top.table("chain")
    count = table.integer("joints", at_least=1)
    if count > LONGEST_CHAIN:
        table.fault("joints", f"at most {LONGEST_CHAIN}")
        count = 1
    planes = table.words("planes", valid=Plane) or tuple(Plane)
    table.close()
    names = numbered("joint", count)
    return [
        ({"name": name, "plane": planes[i % len(planes)]}, "chain") for i, name in enumerate(names)
    ]


def numbered(word: str, count: int) -> list[str]:
    """Names of like parts that sort as they stand in the chain.

    Args:
        word: What they are.
        count: How many.

    Returns:
        ``joint01``, ``joint02``, ...; three digits for more than 99.
    """
    width = max(2, len(str(count)))
    return [f"{word}{i:0{width}d}" for i in range(1, count + 1)]


def _servo(table: Table) -> Servo:
    servo = Servo(
        supply_v=table.number("supply_v", default=Servo.supply_v, above=0),
        stall_torque=table.number("stall_torque", default=Servo.stall_torque, above=0),
        torque_constant=table.number("torque_constant", default=Servo.torque_constant, above=0),
        proportional_gain=table.number(
            "proportional_gain", default=Servo.proportional_gain, above=0
        ),
        rotor_inertia=table.number("rotor_inertia", default=Servo.rotor_inertia, above=0),
        viscous_friction=table.number(
            "viscous_friction", default=Servo.viscous_friction, at_least=0
        ),
        coulomb_friction=table.number(
            "coulomb_friction", default=Servo.coulomb_friction, at_least=0
        ),
        gear_stiffness=table.number("gear_stiffness", default=Servo.gear_stiffness, above=0),
        gear_damping=table.number("gear_damping", default=Servo.gear_damping, at_least=0),
        backlash=table.number("backlash", default=Servo.backlash, at_least=0),
        static_friction=table.number("static_friction", default=Servo.static_friction, at_least=0),
        stribeck_speed=table.number("stribeck_speed", default=Servo.stribeck_speed, above=0),
    )
    if 0 < servo.static_friction < servo.coulomb_friction:
        table.fault(
            "static_friction", f"0, or at least coulomb_friction = {servo.coulomb_friction:g}"
        )
    table.close()
    return servo


def read_links(top: Table, defaults: Table, joint_count: int) -> tuple[Link, ...]:
    """Read ``links``, or make one more than joints as ``defaults`` say.

    Args:
        top: The description.
        defaults: Its ``defaults``.
        joint_count: Number of joints.

    Returns:
        The links, the head first.
    """
    common = defaults.table("link")
    entries = top.tables("links")
    if "links" not in top:
        entries = [({"name": name}, "defaults.link") for name in numbered("link", joint_count + 1)]
    elif len(entries) != joint_count + 1:
        top.fault("links", f"{joint_count + 1}, one more than joints", str(len(entries)))
    links: list[Link] = []
    for values, where in entries:
        table = Table(values, where, top.faults, common)
        link = Link(
            name=table.name("name"),
            length=table.number("length", above=0),
            radius=table.number("radius", above=0),
            mass=table.number("mass", above=0),
            inertia=table.triple("inertia", above=0),
            mesh=table.text("mesh", ""),
            mesh_scale=table.number("mesh_scale", default=Link.mesh_scale, above=0),
        )
        if link.mesh and not is_mesh(link.mesh):
            table.fault("mesh", f"a file {listed(MESH_TYPES)}, or leave it out")
        # Each principal moment of a rigid body is at most the sum of the other two.
        if 2 * max(link.inertia) > sum(link.inertia) * (1 + 1e-12):
            table.fault("inertia", "moments of which none exceeds the sum of the other two")
        table.close()
        links.append(link)
    if entries:
        common.close()
    note_repeated(top.faults, "links", [link.name for link in links])
    return tuple(links)
