"""What moves the robot in a scenario: its tables ``[gait]`` and ``[controller]``.

The keys of a gait: ``docs/reference/gaits.md``. Of a controller all distances are in m, offsets in
rad; what it computes: :mod:`.sim.twin.adaptive`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from enum import StrEnum
from typing import Annotated, Any, TypeAlias, cast

from undulog.capture.common.config import (
    Declared,
    NonNegative,
    Positive,
    declared,
    read,
    read_fields,
    write,
)
from undulog.capture.common.strict_table import StrictTable, at_least, at_most
from undulog.capture.robot.model import Plane, Robot, SensorKind

from ..gait.contract import Generator
from ..gait.delay_blocks import DelayBlockGait, DelayBlocks, DelayLine
from ..gait.oscillators import (
    Numbers,
    OscillatorChain,
    OscillatorChains,
    OscillatorGait,
    OscillatorKind,
)
from ..gait.wave import PlaneGait, Serpentine, SerpentineGait
from .sensors import SensorLayout, layout

GaitParameters: TypeAlias = Serpentine | DelayBlocks | OscillatorChains
"""Gait parameters of a scenario."""


PlaneParameters: TypeAlias = PlaneGait | DelayLine | OscillatorChain

Share: TypeAlias = Annotated[float, at_least(0.0), at_most(1.0)]


def generator(parameters: GaitParameters, robot: Robot, *, per_joint: bool = False) -> Generator:
    """The generator of a gait, at time zero with straight joints.

    Args:
        robot: The robot.
        per_joint: Log the values of every joint, for a controller that sets joints apart.
    """
    if isinstance(parameters, DelayBlocks):
        return DelayBlockGait(parameters, robot)
    if isinstance(parameters, OscillatorChains):
        return OscillatorGait(parameters, robot)
    return SerpentineGait(parameters, robot, per_joint=per_joint)


class GaitKind(StrEnum):
    """The generators there are."""

    SERPENTINE = "serpentine"
    DELAY_BLOCKS = "delay-blocks"
    OSCILLATORS = "oscillators"


_KINDS: dict[GaitKind, tuple[type[GaitParameters], type[PlaneParameters]]] = {
    GaitKind.SERPENTINE: (Serpentine, PlaneGait),
    GaitKind.DELAY_BLOCKS: (DelayBlocks, DelayLine),
    GaitKind.OSCILLATORS: (OscillatorChains, OscillatorChain),
}


def read_gait(table: StrictTable, robot: Robot | None) -> GaitParameters:
    """Read the gait; faults are noted in the table.

    Args:
        table: The table ``[gait]``.
        robot: The robot; None where that is a fault already.

    Returns:
        The parameters; of use only if no fault was noted.
    """
    kind = table.choice("kind", GaitKind, GaitKind.SERPENTINE)
    if kind is None:  # no way to tell which keys belong here
        return read_fields(table, Serpentine, planes=dict)
    gait, part = _KINDS[kind]
    return read(table, gait, planes=lambda: _planes(table, robot, part))


def gait_table(parameters: GaitParameters) -> dict[str, Any]:
    """The table that gives these parameters when it is read.

    Args:
        parameters: Of any kind of gait.

    Returns:
        Keys and values, every one written out.
    """
    values = write(parameters)
    del values["planes"]
    kind = next(kind for kind, (gait, _) in _KINDS.items() if isinstance(parameters, gait))
    values = {"kind": kind, **values}
    for plane, plane_parameters in parameters.planes.items():
        part = values[str(plane)] = write(plane_parameters)
        if part.get("oscillator") is OscillatorKind.PHASE:
            del part["attraction"]  # which only Hopf oscillators have
    return values


def _planes(
    table: StrictTable, robot: Robot | None, part: type[PlaneParameters]
) -> dict[Plane, PlaneParameters]:
    planes: dict[Plane, PlaneParameters] = {}
    for plane in Plane:
        if plane not in table:
            continue
        count = None if robot is None else len(robot.joint_indices(plane))
        plane_table = table.table(plane)
        planes[plane] = (
            _oscillator_chain(plane_table, count)
            if part is OscillatorChain
            else read(plane_table, part)
        )
        if robot is not None and not count:
            table.fault(plane, f"leave it out: {robot.name} has no {plane} joints")
    if not planes:
        table.fault(Plane.HORIZONTAL, "a table for at least one plane, horizontal or vertical")
    return planes


def _oscillator_chain(part: StrictTable, count: int | None) -> OscillatorChain:
    def numbers(name: str, number: int | None) -> Callable[[], Numbers]:
        return lambda: _numbers(part, declared(OscillatorChain)[name], number)

    pairs = None if count is None else count - 1
    chain = read_fields(
        part,
        OscillatorChain,
        forward=numbers("forward", pairs),
        backward=numbers("backward", pairs),
        detuning=numbers("detuning", count),
        start_phase=numbers("start_phase", count),
        feedback_bias=numbers("feedback_bias", count),
    )
    if chain.oscillator is OscillatorKind.PHASE and "attraction" in part:
        part.fault("attraction", "leave it out: phase oscillators have no radius to attract")
    part.close()
    return chain


def _numbers(part: StrictTable, declaration: Declared, count: int | None) -> Numbers:
    """One number, or an array of ``count``."""
    value = part.look(declaration.key)[1]
    if not isinstance(value, list):
        return part.number(declaration.key, *declaration.bounds, default=declaration.default)
    entries = cast("list[object]", value)
    if count is not None and len(entries) != count:
        part.fault(
            declaration.key, f"a number, or an array of {count}", f"an array of {len(entries)}"
        )
        return declaration.default
    elements = {f"{part.key(declaration.key)}[{i}]": entry for i, entry in enumerate(entries)}
    listed = StrictTable(elements, "", part.faults)
    return tuple(listed.number(name, *declaration.bounds) for name in elements)


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
        slip_ratio: K of :class:`.sim.twin.filters.SlipOdometry`.
        turn_gain: c of :class:`.sim.twin.filters.PathHeading`.
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
    table: StrictTable, robot: Robot | None, *, horizontal: bool, target: bool
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


def _check(table: StrictTable, kind: ControllerKind, robot: Robot, roles: SensorLayout) -> None:
    """Whether the robot has the sensors."""
    missing: list[str] = []
    if not roles.head:
        missing.append("a range sensor that looks ahead from its first link")
    if "side" in _PARTS[kind] and not roles.sides:
        missing.append("a range sensor that looks sideways")
    if "tail" in _PARTS[kind] and not roles.tail:
        missing.append("a range sensor on its last link")
    compasses = [sensor for sensor in robot.sensors if sensor.kind is SensorKind.COMPASS]
    on_head = [compass for compass in compasses if compass.link == robot.links[0].name]
    if kind is ControllerKind.TARGET_FOLLOWING and not on_head:
        missing.append("a compass on its first link")
    if not len(robot.joint_indices(Plane.HORIZONTAL)):
        missing.append("horizontal joints")
    if missing:
        table.fault("kind", f"a robot with {' and '.join(missing)}; {robot.name} has none")
