"""How the robot's sensors measure: rates, errors and resolutions, all of a kind alike."""

from __future__ import annotations

from dataclasses import dataclass, field


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
    """Infrared distance sensors, :mod:`.sim.sensing.ir`.

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
    """Ultrasonic range finders, :mod:`.sim.sensing.sonar`.

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
