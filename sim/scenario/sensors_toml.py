"""The ``[noise]`` and ``[sensing]`` tables of a scenario."""

from __future__ import annotations

import dataclasses

from undulog.capture.common.strict_table import Table
from undulog.capture.robot.model import Robot

from .sensors import (
    AccelerometerModel,
    CompassModel,
    InfraredModel,
    Noise,
    SensorModels,
    ServoPolling,
    SonarModel,
)


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
