"""Parameters of the controllers. All distances in m, offsets in rad; see :mod:`.sim.control`."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from enum import StrEnum
from typing import Annotated, Any, TypeAlias

from undulog.capture.common.config import NonNegative, Positive, read
from undulog.capture.common.strict_table import Table, at_least, at_most
from undulog.capture.robot.model import Plane, Robot, SensorKind

from .sensors import Layout, layout

Share: TypeAlias = Annotated[float, at_least(0.0), at_most(1.0)]


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
    """Calibration of a robot's gait on free ground.

    Attributes:
        slip_ratio: K of :class:`.sim.control.filters.SlipOdometry`.
        turn_gain: c of :class:`.sim.control.filters.PathHeading`.
        turn_radius_m: Of the turn with the course's largest offset [m].
    """

    slip_ratio: Positive = 50.0
    turn_gain: NonNegative = 1.6
    turn_radius_m: NonNegative = 0.42


@dataclass(frozen=True)
class Lookout:
    """What counts as in the way.

    Attributes:
        half_width_m: Half the width of the robot's way [m]: the undulation and a margin.
        memory_s: How long an echo is kept [s]: a gait period, so that the head has swung once.
    """

    half_width_m: Positive = 0.3
    memory_s: NonNegative = 2.0


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

    f0: NonNegative = 0.22
    k: NonNegative = 2.0
    range_m: NonNegative = 1.0
    margin_m: NonNegative = 0.05
    hold_s: NonNegative = 1.0
    filter_s: NonNegative = 0.25


@dataclass(frozen=True)
class SideShrinking:
    """Shrinks the amplitude of the joints beside a wall, A~(d) = A (1 - (1 - s) exp(-k d)).

    Attributes:
        smallest: s, A_min / A_max.
        k: How fast it fades [1/m].
        filter_s: Time constant of the amplitude [s].
    """

    smallest: Share = 0.3
    k: NonNegative = 3.0
    filter_s: NonNegative = 0.5


@dataclass(frozen=True)
class TailHaste:
    """Raises omega while an obstacle is near the tail, omega~(d) = omega (1 + g exp(-k d)).

    Attributes:
        gain: g, the share added at contact.
        k: How fast it fades [1/m].
        range_m: What is farther is left alone [m].
        filter_s: Time constant of omega [s].
    """

    gain: Share = 0.5
    k: NonNegative = 2.0
    range_m: NonNegative = 0.4
    filter_s: NonNegative = 0.25


@dataclass(frozen=True)
class RandomTurns:
    """Bends at random: offsets drawn evenly from +-largest, kept for times drawn evenly.

    Attributes:
        largest: Of the offsets [rad].
        shortest_s: Shortest time [s].
        longest_s: Longest time [s].
    """

    largest: NonNegative = 0.15
    shortest_s: Positive = 2.0
    longest_s: Positive = 6.0

    def contradictions(self) -> Iterator[tuple[str, str]]:
        """The longest time is no shorter than the shortest one."""
        if self.longest_s < self.shortest_s:
            yield "longest_s", f"at least shortest_s = {self.shortest_s:g}"


@dataclass(frozen=True)
class TargetHeading:
    """Holds the heading to a target at a known position.

    Attributes:
        gain: Offset per heading error.
        largest: Of the offsets [rad].
        filter_s: Time constant with which the compass puts the reckoned heading right [s].
    """

    gain: NonNegative = 0.35
    largest: NonNegative = 0.2
    filter_s: NonNegative = 2.0


@dataclass(frozen=True)
class Controller:
    """One controller, complete.

    Attributes:
        near_hold_s: How long a reading near a sensor's fold is believed [s].
        calibration: Calibration of the gait.
        lookout: What counts as in the way.
        head: Steering by the head's sensors.
        side: What walls beside the body do; None: nothing.
        tail: What an obstacle at the tail does; None: nothing.
        course: Where to go when nothing is in the way; None: straight ahead.
    """

    kind: ControllerKind
    near_hold_s: NonNegative = 1.0
    calibration: Calibration = Calibration()
    lookout: Lookout = Lookout()
    head: HeadSteering = HeadSteering()
    side: SideShrinking | None = None
    tail: TailHaste | None = None
    course: RandomTurns | TargetHeading | None = None


# What the kinds have beside what all have.
_PARTS: dict[ControllerKind, dict[str, type[Any]]] = {
    ControllerKind.RANDOM_WALK: {"course": RandomTurns},
    ControllerKind.TARGET_FOLLOWING: {"course": TargetHeading},
    ControllerKind.CORRIDOR: {"side": SideShrinking},
    ControllerKind.AVOIDANCE: {"side": SideShrinking, "tail": TailHaste},
}


def read_controller(
    table: Table, robot: Robot | None, *, horizontal: bool, target: bool
) -> Controller | None:
    """Read ``[controller]``; faults are noted in the table.

    Args:
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

    def part(name: str) -> Any:
        return read(table.table(name), _PARTS[kind][name]) if name in _PARTS[kind] else None

    return read(
        table,
        Controller,
        kind=lambda: kind,
        side=lambda: part("side"),
        tail=lambda: part("tail"),
        course=lambda: part("course"),
    )


def _check(table: Table, kind: ControllerKind, robot: Robot, roles: Layout) -> None:
    """Whether the robot has the sensors."""
    missing: list[str] = []
    if not roles.head:
        missing.append("a range sensor that looks ahead from its first link")
    if "side" in _PARTS[kind] and not roles.sides:
        missing.append("a range sensor that looks sideways")
    if "tail" in _PARTS[kind] and not roles.tail:
        missing.append("a range sensor on its last link")
    compasses = [one for one in robot.sensors if one.kind is SensorKind.COMPASS]
    on_head = [one for one in compasses if one.link == robot.links[0].name]
    if kind is ControllerKind.TARGET_FOLLOWING and not on_head:
        missing.append("a compass on its first link")
    if not len(robot.joint_indices(Plane.HORIZONTAL)):
        missing.append("horizontal joints")
    if missing:
        table.fault("kind", f"a robot with {' and '.join(missing)}; {robot.name} has none")
