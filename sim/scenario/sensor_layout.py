"""Which range sensor looks where, and which joints are beside it: read off the description."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from undulog.capture.common.arrays import BoolArray, FloatArray
from undulog.capture.robot.model import Robot, Sensor, SensorKind

_RANGING = (SensorKind.IR, SensorKind.SONAR)
_SIDEWAYS = math.radians(22.5)
"""A sensor within this of square to the body looks sideways."""


@dataclass(frozen=True)
class SideSensor:
    """A sensor that looks sideways.

    Attributes:
        name: The sensor.
        beside: The joints that it looks out for, shape (m,).
    """

    name: str
    beside: BoolArray


@dataclass(frozen=True)
class Layout:
    """The roles of a robot's range sensors.

    Attributes:
        head: Names of those that look ahead from the first link.
        tail: Of those on the last link.
        sides: Those that look sideways, with the joints beside them.
        fold_m: Name to the distance below which a sensor folds back [m], 0 if it does not.
    """

    head: tuple[str, ...]
    tail: tuple[str, ...]
    sides: tuple[SideSensor, ...]
    fold_m: dict[str, float]


def layout(robot: Robot) -> Layout:
    """Sort a robot's range sensors by where they sit and look.

    Looking sideways, on any link: a side sensor. Else on the first link and looking forward: a
    head sensor; on the last link: a tail sensor. Others have no role. A joint is beside the
    nearest sensor of each side, if that is no farther along the body than half the widest gap
    between two sensors of that side; a side's only sensor is beside all joints.

    Args:
        robot: The robot.

    Returns:
        Who looks where.
    """
    sensors = [sensor for sensor in robot.sensors if sensor.kind in _RANGING]
    bearings = {sensor.name: bearing(sensor) for sensor in sensors}
    sideways = [s for s in sensors if abs(abs(bearings[s.name]) - math.pi / 2) <= _SIDEWAYS]
    others = [sensor for sensor in sensors if sensor not in sideways]
    first, last = robot.links[0].name, robot.links[-1].name
    head = [s.name for s in others if s.link == first and abs(bearings[s.name]) < math.pi / 2]
    return Layout(
        head=tuple(head),
        tail=tuple(s.name for s in others if s.link == last and s.name not in head),
        sides=tuple(
            side
            for sign in (1.0, -1.0)
            for side in _side(robot, [s for s in sideways if bearings[s.name] * sign > 0.0])
        ),
        fold_m={s.name: (s.range_min or 0.0) if s.kind is SensorKind.IR else 0.0 for s in sensors},
    )


def bearing(sensor: Sensor) -> float:
    """Where a sensor looks in its link's horizontal plane.

    Args:
        sensor: The sensor.

    Returns:
        Direction from straight ahead, to the left positive [rad].
    """
    _, pitch, yaw = sensor.rpy
    return math.atan2(math.sin(yaw) * math.cos(pitch), math.cos(yaw) * math.cos(pitch))


def _side(robot: Robot, sensors: list[Sensor]) -> list[SideSensor]:
    """The sensors of one side with their joints."""
    if not sensors:
        return []
    lengths = np.array([link.length for link in robot.links])
    ends: FloatArray = np.cumsum(lengths)  # each link's rear end, from the nose
    joints = ends[:-1]
    number = {link.name: i for i, link in enumerate(robot.links)}
    at = np.array([ends[(i := number[s.link])] - lengths[i] / 2 - s.position[0] for s in sensors])
    gap = np.diff(np.sort(at)).max(initial=0.0)
    reach = gap / 2 * (1 + 1e-9) if gap > 0.0 else math.inf
    distance = np.abs(joints[:, None] - at)
    nearest = distance.argmin(axis=1)
    near = distance.min(axis=1) <= reach
    return [SideSensor(s.name, near & (nearest == k)) for k, s in enumerate(sensors)]
