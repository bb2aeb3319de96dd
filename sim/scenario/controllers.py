"""Parameters of the controllers. All distances in m, offsets in rad; the laws: :mod:`.laws`."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

from undulog.capture.common.strict_table import Table
from undulog.capture.robot.model import Plane, Robot, SensorKind

from .sensor_layout import Layout, layout


class ControllerKind(StrEnum):
    """The controllers of the paper.

    ``random-walk``: bio-inspired, with the head's sensors only; turns at random until the target
    is met. ``target-following``: bio-inspired; the compass holds the heading to the target.
    ``corridor``: amplitude adapted to the walls beside the body. ``avoidance``: tech-inspired,
    with all range sensors.
    """

    RANDOM_WALK = "random-walk"
    TARGET_FOLLOWING = "target-following"
    CORRIDOR = "corridor"
    AVOIDANCE = "avoidance"


@dataclass(frozen=True)
class Calibration:
    """What a robot knows of its gait on free ground, by trying it out once.

    Attributes:
        slip_ratio: K of :class:`.sim.control.reckoning.SlipOdometry`.
        turn_gain: c of :class:`.sim.control.phase_history.PathHeading`.
        turn_radius_m: Of the turn with the course's largest offset [m].
    """

    slip_ratio: float = 50.0
    turn_gain: float = 1.6
    turn_radius_m: float = 0.42


@dataclass(frozen=True)
class Lookout:
    """What counts as in the way.

    Attributes:
        half_width_m: Half the width of the robot's way [m]: the undulation and a margin.
        memory_s: How long an echo is kept [s]: a gait period, so that the head has swung once.
    """

    half_width_m: float = 0.3
    memory_s: float = 2.0


@dataclass(frozen=True)
class HeadSteering:
    """Bends away from what the head's sensors see, f(d) = sgn f0 exp(-k d).

    Attributes:
        f0: Offset at contact [rad].
        k: How fast it fades [1/m].
        range_m: What is farther is left alone [m].
        margin_m: A side is freer when it is so by more than this [m].
        hold_s: The side of the turn is kept at least so long [s].
        filter_s: Time constant of the offset [s].
    """

    f0: float = 0.22
    k: float = 2.0
    range_m: float = 1.0
    margin_m: float = 0.05
    hold_s: float = 1.0
    filter_s: float = 0.25


@dataclass(frozen=True)
class SideShrinking:
    """Shrinks the amplitude of the joints beside a wall, A~(d) = A (1 - (1 - s) exp(-k d)).

    Attributes:
        smallest: s, A_min / A_max.
        k: How fast it fades [1/m].
        filter_s: Time constant of the amplitude [s].
    """

    smallest: float = 0.3
    k: float = 3.0
    filter_s: float = 0.5


@dataclass(frozen=True)
class TailHaste:
    """Raises omega while an obstacle is near the tail, omega~(d) = omega (1 + g exp(-k d)).

    Attributes:
        gain: g, the share added at contact.
        k: How fast it fades [1/m].
        range_m: What is farther is left alone [m].
        filter_s: Time constant of omega [s].
    """

    gain: float = 0.5
    k: float = 2.0
    range_m: float = 0.4
    filter_s: float = 0.25


@dataclass(frozen=True)
class RandomTurns:
    """Bends at random: offsets drawn evenly from +-largest, kept for times drawn evenly.

    Attributes:
        largest: Of the offsets [rad].
        shortest_s: Shortest time [s].
        longest_s: Longest time [s].
    """

    largest: float = 0.15
    shortest_s: float = 2.0
    longest_s: float = 6.0


@dataclass(frozen=True)
class TargetHeading:
    """Holds the heading to a target whose place the robot was told.

    Attributes:
        gain: Offset per heading error.
        largest: Of the offsets [rad].
        filter_s: Time constant with which the compass puts the reckoned heading right [s].
    """

    gain: float = 0.35
    largest: float = 0.2
    filter_s: float = 2.0


@dataclass(frozen=True)
class Controller:
    """One controller, complete.

    Attributes:
        kind: Which one.
        near_hold_s: How long a reading near a sensor's fold is believed [s].
        calibration: What it knows of its gait.
        lookout: What counts as in the way.
        head: Steering by the head's sensors.
        side: What walls beside the body do; None: nothing.
        tail: What an obstacle at the tail does; None: nothing.
        course: Where to go when nothing is in the way; None: straight ahead.
    """

    kind: ControllerKind
    near_hold_s: float = 1.0
    calibration: Calibration = Calibration()
    lookout: Lookout = Lookout()
    head: HeadSteering = HeadSteering()
    side: SideShrinking | None = None
    tail: TailHaste | None = None
    course: RandomTurns | TargetHeading | None = None


_WITH_SIDES = (ControllerKind.CORRIDOR, ControllerKind.AVOIDANCE)


def read_controller(
    table: Table, robot: Robot | None, *, horizontal: bool, target: bool
) -> Controller | None:
    """Read ``[controller]``; faults are noted in the table.

    Args:
        table: The table.
        robot: Who is to be controlled; None where that is a fault already.
        horizontal: Whether the gait drives the horizontal plane.
        target: Whether the world has a target.

    Returns:
        The controller, of use only if no fault was noted.
    """
    kind = table.choice("kind", ControllerKind)
    if kind is None:
        return None
    if not horizontal:
        table.fault("kind", "no controller: the gait drives no horizontal joints")
    if kind is ControllerKind.TARGET_FOLLOWING and not target:
        table.fault("kind", "a [world.target] to follow")
    if robot is not None:
        _check(table, kind, robot, layout(robot))
    controller = Controller(
        kind=kind,
        near_hold_s=table.number("near_hold_s", default=Controller.near_hold_s, at_least=0.0),
        calibration=_calibration(table.table("calibration")),
        lookout=_lookout(table.table("lookout")),
        head=_head(table.table("head")),
        side=_side(table.table("side")) if kind in _WITH_SIDES else None,
        tail=_tail(table.table("tail")) if kind is ControllerKind.AVOIDANCE else None,
        course=_course(table, kind),
    )
    table.close()
    return controller


def controller_table(controller: Controller) -> dict[str, Any]:
    """A controller as the table that :func:`read_controller` reads.

    Args:
        controller: The controller.

    Returns:
        Values for TOML, every one written out.
    """
    values = dataclasses.asdict(controller)
    return {key: value for key, value in values.items() if value is not None}


def _check(table: Table, kind: ControllerKind, robot: Robot, roles: Layout) -> None:
    """Whether the robot has the sensors."""
    missing: list[str] = []
    if not roles.head:
        missing.append("a range sensor that looks ahead from its first link")
    if kind in _WITH_SIDES and not roles.sides:
        missing.append("a range sensor that looks sideways")
    if kind is ControllerKind.AVOIDANCE and not roles.tail:
        missing.append("a range sensor on its last link")
    compasses = [one for one in robot.sensors if one.kind is SensorKind.COMPASS]
    on_head = [one for one in compasses if one.link == robot.links[0].name]
    if kind is ControllerKind.TARGET_FOLLOWING and not on_head:
        missing.append("a compass on its first link")
    if not len(robot.joint_indices(Plane.HORIZONTAL)):
        missing.append("horizontal joints")
    if missing:
        table.fault("kind", f"a robot with {' and '.join(missing)}; {robot.name} has none")


def _calibration(table: Table) -> Calibration:
    default = Calibration
    calibration = Calibration(
        slip_ratio=table.number("slip_ratio", default=default.slip_ratio, above=0.0),
        turn_gain=table.number("turn_gain", default=default.turn_gain, at_least=0.0),
        turn_radius_m=table.number("turn_radius_m", default=default.turn_radius_m, at_least=0.0),
    )
    table.close()
    return calibration


def _lookout(table: Table) -> Lookout:
    lookout = Lookout(
        half_width_m=table.number("half_width_m", default=Lookout.half_width_m, above=0.0),
        memory_s=table.number("memory_s", default=Lookout.memory_s, at_least=0.0),
    )
    table.close()
    return lookout


def _head(table: Table) -> HeadSteering:
    default = HeadSteering
    head = HeadSteering(
        f0=table.number("f0", default=default.f0, at_least=0.0),
        k=table.number("k", default=default.k, at_least=0.0),
        range_m=table.number("range_m", default=default.range_m, at_least=0.0),
        margin_m=table.number("margin_m", default=default.margin_m, at_least=0.0),
        hold_s=table.number("hold_s", default=default.hold_s, at_least=0.0),
        filter_s=table.number("filter_s", default=default.filter_s, at_least=0.0),
    )
    table.close()
    return head


def _side(table: Table) -> SideShrinking:
    default = SideShrinking
    side = SideShrinking(
        smallest=table.number("smallest", default=default.smallest, at_least=0.0, at_most=1.0),
        k=table.number("k", default=default.k, at_least=0.0),
        filter_s=table.number("filter_s", default=default.filter_s, at_least=0.0),
    )
    table.close()
    return side


def _tail(table: Table) -> TailHaste:
    default = TailHaste
    tail = TailHaste(
        gain=table.number("gain", default=default.gain, at_least=0.0, at_most=1.0),
        k=table.number("k", default=default.k, at_least=0.0),
        range_m=table.number("range_m", default=default.range_m, at_least=0.0),
        filter_s=table.number("filter_s", default=default.filter_s, at_least=0.0),
    )
    table.close()
    return tail


def _course(table: Table, kind: ControllerKind) -> RandomTurns | TargetHeading | None:
    if kind is ControllerKind.RANDOM_WALK:
        part, default = table.table("course"), RandomTurns
        turns = RandomTurns(
            largest=part.number("largest", default=default.largest, at_least=0.0),
            shortest_s=part.number("shortest_s", default=default.shortest_s, above=0.0),
            longest_s=part.number("longest_s", default=default.longest_s, above=0.0),
        )
        if turns.longest_s < turns.shortest_s:
            part.fault("longest_s", f"at least shortest_s = {turns.shortest_s:g}")
        part.close()
        return turns
    if kind is ControllerKind.TARGET_FOLLOWING:
        part, default = table.table("course"), TargetHeading
        heading = TargetHeading(
            gain=part.number("gain", default=default.gain, at_least=0.0),
            largest=part.number("largest", default=default.largest, at_least=0.0),
            filter_s=part.number("filter_s", default=default.filter_s, at_least=0.0),
        )
        part.close()
        return heading
    return None
