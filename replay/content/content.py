"""What a recording holds: decides which views there are."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from undulog.capture.robot.model import Robot

from .entities import Chart, HeatMap, MeanCycle, Places, Quantity, Series

Tab = Literal["session", "cycles", "mean-cycle"]
"""The tabs of the layout."""


_SHORT = {
    "/joint_current": "Current",
    "/joint_voltage": "Voltage",
    "/joint_temperature": "Temperature",
    "/joint_velocity": "Velocity",
    "/energy_ledger": "Ledger",
    "/joint_power/mechanical": "Mechanical power",
    "/joint_power/mechanical_plus": "Mechanical power, positive part",
    "/joint_power/electrical": "Electrical power",
    "/joint_power/electrical_plus": "Electrical power, positive part",
}
_UNITS = {"degC": "°C"}


def signal_title(topic: str, unit: str) -> str:
    """A title short enough for a tab.

    Args:
        topic: A JointState topic.
        unit: Of its values.

    Returns:
        For example ``Current [A]``; another make's topics keep their names.
    """
    return f"{_SHORT.get(topic, topic.lstrip('/'))} [{_UNITS.get(unit, unit)}]"


@dataclass(frozen=True)
class Signal:
    """A quantity of all joints that is shown as logged.

    Attributes:
        title: What it is, with unit.
        series: Where it was written.
        of_joints: Whether its lines are the robot's joints, known by their colours; other lines
            need a legend.
    """

    title: str
    series: tuple[Series, ...]
    of_joints: bool


@dataclass(frozen=True)
class Start:
    """Where the camera finds the robot.

    Attributes:
        position: The head's first known position [m].
        heading: Direction of the head there, about z [rad].
    """

    position: tuple[float, float, float]
    heading: float


@dataclass(frozen=True)
class AwaitedMap:
    """A map that is still to be computed.

    Attributes:
        entity: Path of its entities.
        title: What it will show, with unit.
    """

    entity: str
    title: str


@dataclass(frozen=True)
class Content:
    """What a recording holds.

    Attributes:
        robot: The robot, or None.
        start: Where the robot starts, or None where no body is drawn.
        power_limit_w: Power at which a segment's colour is full [W]; None if coloured by place.
        places: Joints that stand for the body, or None without joints.
        commanded: Commanded angles.
        measured: Measured angles.
        errors: Tracking errors.
        has_power: Whether the body's total power was written.
        joint_power: Mechanical power of the joints.
        charts: Response bars.
        modes: How often a gait mode began; 0 where none was logged.
        has_events: Whether events were written.
        signals: Further quantities of the joints.
        live: Whether it still grows: the views follow its end.
        cycles: Quantities that were written cycle by cycle, each with where.
        maps: Maps of segments against cycles.
        mean: The mean cycle, or None.
    """

    robot: Robot | None
    start: Start | None
    power_limit_w: float | None
    places: Places | None
    commanded: tuple[Series, ...]
    measured: tuple[Series, ...]
    errors: tuple[Series, ...]
    has_power: bool
    joint_power: tuple[Series, ...]
    charts: tuple[Chart, ...]
    modes: int
    has_events: bool
    signals: tuple[Signal, ...]
    live: bool = False
    cycles: tuple[tuple[Quantity, tuple[Series, ...]], ...] = ()
    maps: tuple[HeatMap | AwaitedMap, ...] = ()
    mean: MeanCycle | None = None
