"""The channel of a sensor: its topic, its message type, and what its frame and range are."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

from ...common.arrays import FloatArray
from ...robot.model import Sensor, SensorKind
from .openers import ChannelOpeners

SensorWrite: TypeAlias = Callable[[FloatArray, int, int], None]
"""Writes a distance, shape (1,), or a vector, shape (3,), with sampling and log time [Unix ns]."""


def open_sensor(writer: ChannelOpeners, sensor: Sensor) -> SensorWrite:
    """Open a sensor's channel on the topic of its description; its frame has its name.

    Args:
        writer: The session.
        sensor: The sensor.

    Returns:
        What writes one sample.

    Raises:
        DataError: If the topic is open already.
    """
    if sensor.kind is SensorKind.ACCELEROMETER:
        imu = writer.imu(sensor.topic, frame=sensor.name)
        return lambda values, t_ns, log_ns: imu.write(t_ns, values, log_time_ns=log_ns)
    if sensor.kind is SensorKind.COMPASS:
        compass = writer.magnetic_field(sensor.topic, frame=sensor.name)
        return lambda values, t_ns, log_ns: compass.write(t_ns, values, log_time_ns=log_ns)
    distance = writer.range(
        sensor.topic,
        frame=sensor.name,
        min_range=sensor.range_min or 0.0,
        max_range=sensor.range_max or 0.0,
        field_of_view=sensor.field_of_view or 0.0,
        infrared=sensor.kind is SensorKind.IR,
    )
    return lambda values, t_ns, log_ns: distance.write(t_ns, float(values[0]), log_time_ns=log_ns)
