"""How the robot's sensors measure: rates, errors and resolutions, all of a kind alike."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field

from undulog.capture.common.strict_table import Table
from undulog.capture.robot.model import Robot


@dataclass(frozen=True)
class Noise:
    """White noise of what the servos report, as standard deviations.

    Attributes:
        position: [rad].
        velocity: [rad/s].
        effort: [N m].
    """

    position: float = 0.0
    velocity: float = 0.0
    effort: float = 0.0


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

    slot_s: float = 0.0
    resolution: float = 0.0
    dead_band: float = 0.0
    command_resolution: float = 0.0


@dataclass(frozen=True)
class InfraredModel:
    """Infrared distance sensors, :mod:`.sim.sensing.ranging`.

    Attributes:
        hold_s: From one measurement of a sensor to its next [s].
        noise_v: Standard deviation of the output voltage [V].
        adc_bits: Resolution of the converter that reads it.
        adc_v: Its full scale [V].
        peak: Distance of the greatest voltage; nearer things are told as farther [m].
    """

    hold_s: float = 0.038
    noise_v: float = 0.029
    adc_bits: int = 12
    adc_v: float = 3.3
    peak: float = 0.15


@dataclass(frozen=True)
class SonarModel:
    """Ultrasonic range finders, :mod:`.sim.sensing.ranging`.

    Attributes:
        rate_hz: Measurements a second.
        noise: Standard deviation [m].
        resolution: [m].
        rays: How many rays stand for the cone.
    """

    rate_hz: float = 20.0
    noise: float = 0.005
    resolution: float = 0.01
    rays: int = 61


@dataclass(frozen=True)
class AccelerometerModel:
    """Accelerometers, :mod:`.sim.sensing.accelerometer`.

    Attributes:
        rate_hz: Measurements a second, each a mean over its period.
        noise: Standard deviation of such a mean, each axis [m/s^2].
        resolution: [m/s^2]; 1 mg by default.
    """

    rate_hz: float = 100.0
    noise: float = 0.03
    resolution: float = 9.80665e-3


@dataclass(frozen=True)
class CompassModel:
    """Magnetometers, :mod:`.sim.sensing.compass`.

    Attributes:
        rate_hz: Measurements a second.
        noise: Standard deviation, each axis [T].
        resolution: [T].
        horizontal_field: Horizontal part of the earth's field [T].
        inclination: Angle of the field below the horizontal [rad].
        north: Direction of magnetic north, about z from the world's x [rad].
    """

    rate_hz: float = 20.0
    noise: float = 2e-7
    resolution: float = 1e-7
    horizontal_field: float = 2e-5
    inclination: float = 1.1344640137963142  # 65 degrees
    north: float = 0.0


@dataclass(frozen=True)
class SensorModels:
    """All sensor models of a scenario.

    Attributes:
        servo: Of the servos' own readings.
        ir: Of infrared sensors.
        sonar: Of sonars.
        accelerometer: Of accelerometers.
        compass: Of compasses.
        enabled: Whether the robot's sensors, beside the servos' own, are simulated.
    """

    servo: ServoPolling = field(default_factory=ServoPolling)
    ir: InfraredModel = field(default_factory=InfraredModel)
    sonar: SonarModel = field(default_factory=SonarModel)
    accelerometer: AccelerometerModel = field(default_factory=AccelerometerModel)
    compass: CompassModel = field(default_factory=CompassModel)
    enabled: bool = True


def read_noise(table: Table) -> Noise:
    """Read ``[noise]``.

    Args:
        table: The table.

    Returns:
        Standard deviations, 0 where nothing is given.
    """
    names = [item.name for item in dataclasses.fields(Noise)]
    noise = Noise(**{name: table.number(name, default=0.0, at_least=0.0) for name in names})
    table.close()
    return noise


def read_sensing(table: Table, robot: Robot | None, period_s: float) -> SensorModels:
    """Read ``[sensing]``.

    Args:
        table: The table.
        robot: Whose sensors they are, None after a fault.
        period_s: Control period [s].

    Returns:
        The models, with defaults where nothing is given.
    """
    models = SensorModels(
        servo=_servo(table.table("servo"), robot, period_s),
        ir=_infrared(table.table("ir")),
        sonar=_sonar(table.table("sonar")),
        accelerometer=_accelerometer(table.table("accelerometer")),
        compass=_compass(table.table("compass")),
        enabled=table.flag("enabled", default=SensorModels.enabled),
    )
    table.close()
    return models


def _servo(table: Table, robot: Robot | None, period_s: float) -> ServoPolling:
    def step(key: str) -> float:
        return table.number(key, default=0.0, at_least=0.0)

    servo = ServoPolling(
        slot_s=step("slot_s"),
        resolution=step("resolution"),
        dead_band=step("dead_band"),
        command_resolution=step("command_resolution"),
    )
    if robot is not None and servo.slot_s * len(robot.joints) >= period_s:
        longest = f"{len(robot.joints)} joints' turns in a control period of {period_s:g} s"
        table.fault("slot_s", f"less than {period_s / len(robot.joints):g}, for {longest}")
    table.close()
    return servo


def _infrared(table: Table) -> InfraredModel:
    default = InfraredModel
    model = InfraredModel(
        hold_s=table.number("hold_s", default=default.hold_s, above=0.0),
        noise_v=table.number("noise_v", default=default.noise_v, at_least=0.0),
        adc_bits=table.integer("adc_bits", at_least=1) if "adc_bits" in table else default.adc_bits,
        adc_v=table.number("adc_v", default=default.adc_v, above=0.0),
        peak=table.number("peak", default=default.peak, above=0.0),
    )
    table.close()
    return model


def _sonar(table: Table) -> SonarModel:
    default = SonarModel
    model = SonarModel(
        rate_hz=table.number("rate_hz", default=default.rate_hz, above=0.0),
        noise=table.number("noise", default=default.noise, at_least=0.0),
        resolution=table.number("resolution", default=default.resolution, at_least=0.0),
        rays=table.integer("rays", at_least=1) if "rays" in table else default.rays,
    )
    table.close()
    return model


def _accelerometer(table: Table) -> AccelerometerModel:
    default = AccelerometerModel
    model = AccelerometerModel(
        rate_hz=table.number("rate_hz", default=default.rate_hz, above=0.0),
        noise=table.number("noise", default=default.noise, at_least=0.0),
        resolution=table.number("resolution", default=default.resolution, at_least=0.0),
    )
    table.close()
    return model


def _compass(table: Table) -> CompassModel:
    default = CompassModel
    model = CompassModel(
        rate_hz=table.number("rate_hz", default=default.rate_hz, above=0.0),
        noise=table.number("noise", default=default.noise, at_least=0.0),
        resolution=table.number("resolution", default=default.resolution, at_least=0.0),
        horizontal_field=table.number(
            "horizontal_field", default=default.horizontal_field, above=0.0
        ),
        inclination=table.number(
            "inclination", default=default.inclination, at_least=-1.57, at_most=1.57
        ),
        north=table.number("north", default=default.north),
    )
    table.close()
    return model
