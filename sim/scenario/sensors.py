"""How the robot's sensors measure: rates, errors and resolutions, all of a kind alike."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Annotated

import numpy as np

from undulog.capture.common.arrays import BoolArray, FloatArray
from undulog.capture.common.config import Count, NonNegative, Positive, read, read_fields
from undulog.capture.common.strict_table import StrictTable, at_least, at_most
from undulog.capture.robot.model import Robot, Sensor, SensorKind

_RANGING = (SensorKind.IR, SensorKind.SONAR)
_SIDEWAYS = math.radians(22.5)  # A sensor within this of square to the body looks sideways


@dataclass(frozen=True)
class SideSensor:
    """A sensor that looks sideways.

    Attributes:
        beside: The joints that it looks out for, shape (m,).
    """

    name: str
    beside: BoolArray


@dataclass(frozen=True)
class SensorLayout:
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


def layout(robot: Robot) -> SensorLayout:
    """Sort a robot's range sensors by where they sit and look.

    Looking sideways, on any link: a side sensor. Else on the first link and looking forward: a
    head sensor; on the last link: a tail sensor. Others have no role. A joint is beside the
    nearest sensor of each side, if that is no farther along the body than half the widest gap
    between two sensors of that side; a side's only sensor is beside all joints.

    Returns:
        Who looks where.
    """
    sensors = [sensor for sensor in robot.sensors if sensor.kind in _RANGING]
    bearings = {sensor.name: bearing(sensor) for sensor in sensors}
    sideways = [s for s in sensors if abs(abs(bearings[s.name]) - math.pi / 2) <= _SIDEWAYS]
    others = [sensor for sensor in sensors if sensor not in sideways]
    first, last = robot.links[0].name, robot.links[-1].name
    head = [s.name for s in others if s.link == first and abs(bearings[s.name]) < math.pi / 2]
    return SensorLayout(
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


@dataclass(frozen=True)
class Noise:
    """White noise of what the servos report, as standard deviations.

    Attributes:
        position: [rad].
        velocity: [rad/s].
        effort: [N m].
    """

    position: NonNegative = 0.0
    velocity: NonNegative = 0.0
    effort: NonNegative = 0.0


@dataclass(frozen=True)
class ServoPolling:
    """When and how finely the servos are read and commanded over their bus.

    Attributes:
        slot_s: From one servo's turn to the next in a polling cycle [s]: joint i (from 0) is
            sampled i slots after the cycle's start. 0: all at once, as no real bus can.
        resolution: Step of the encoders [rad]; 0: none.
        dead_band: An encoder tells another angle only when the angle has moved by more than this
            from what it told last [rad].
        command_resolution: Step in which the servos take commands [rad]; 0: none.
    """

    slot_s: NonNegative = 0.0
    resolution: NonNegative = 0.0
    dead_band: NonNegative = 0.0
    command_resolution: NonNegative = 0.0


@dataclass(frozen=True)
class InfraredModel:
    """Infrared distance sensors, :mod:`.sim.physics.ranging`.

    Attributes:
        hold_s: From one measurement of a sensor to its next [s].
        noise_v: Standard deviation of the output voltage [V].
        adc_bits: Resolution of the converter that reads it.
        adc_v: Its full scale [V].
        peak: Distance of the greatest voltage; nearer things are told as farther [m].
    """

    hold_s: Positive = 0.038
    noise_v: NonNegative = 0.029
    adc_bits: Count = 12
    adc_v: Positive = 3.3
    peak: Positive = 0.15


@dataclass(frozen=True)
class SonarModel:
    """Ultrasonic range finders, :mod:`.sim.physics.ranging`.

    Attributes:
        rate_hz: Measurements a second.
        noise: Standard deviation [m].
        resolution: [m].
        rays: How many rays stand for the cone.
    """

    rate_hz: Positive = 20.0
    noise: NonNegative = 0.005
    resolution: NonNegative = 0.01
    rays: Count = 61


@dataclass(frozen=True)
class AccelerometerModel:
    """Accelerometers, :mod:`.sim.physics.sensors`.

    Attributes:
        rate_hz: Measurements a second, each a mean over its period.
        noise: Standard deviation of such a mean, each axis [m/s^2].
        resolution: [m/s^2]; 1 mg by default.
    """

    rate_hz: Positive = 100.0
    noise: NonNegative = 0.03
    resolution: NonNegative = 9.80665e-3


@dataclass(frozen=True)
class CompassModel:
    """Magnetometers, :mod:`.sim.physics.sensors`.

    Attributes:
        rate_hz: Measurements a second.
        noise: Standard deviation, each axis [T].
        resolution: [T].
        horizontal_field: Horizontal part of the earth's field [T].
        inclination: Angle of the field below the horizontal [rad].
        north: Direction of magnetic north, about z from the world's x [rad].
    """

    rate_hz: Positive = 20.0
    noise: NonNegative = 2e-7
    resolution: NonNegative = 1e-7
    horizontal_field: Positive = 2e-5
    inclination: Annotated[float, at_least(-1.57), at_most(1.57)] = 1.1344640137963142  # 65 degrees
    north: float = 0.0


@dataclass(frozen=True)
class SensorModels:
    """All sensor models of a scenario.

    Attributes:
        servo: Of the servos' own readings.
        enabled: Whether the robot's sensors, beside the servos' own, are simulated.
    """

    servo: ServoPolling = field(default_factory=ServoPolling)
    ir: InfraredModel = field(default_factory=InfraredModel)
    sonar: SonarModel = field(default_factory=SonarModel)
    accelerometer: AccelerometerModel = field(default_factory=AccelerometerModel)
    compass: CompassModel = field(default_factory=CompassModel)
    enabled: bool = True


def read_sensing(table: StrictTable, robot: Robot | None, period_s: float) -> SensorModels:
    """Read ``[sensing]``.

    Args:
        robot: Whose sensors they are, None after a fault.
        period_s: Control period [s].

    Returns:
        The models, with defaults where nothing is given.
    """
    return read(table, SensorModels, servo=lambda: _servo(table.table("servo"), robot, period_s))


def _servo(table: StrictTable, robot: Robot | None, period_s: float) -> ServoPolling:
    servo = read_fields(table, ServoPolling)
    if robot is not None and servo.slot_s * len(robot.joints) >= period_s:
        longest = f"{len(robot.joints)} joints' turns in a control period of {period_s:g} s"
        table.fault("slot_s", f"less than {period_s / len(robot.joints):g}, for {longest}")
    table.close()
    return servo
