"""The robot's sensors: what they measure, when, and how wrongly."""

from .model import (
    AccelerometerModel,
    CompassModel,
    InfraredModel,
    Noise,
    SensorModels,
    ServoPolling,
    SonarModel,
)

__all__ = [
    "AccelerometerModel",
    "CompassModel",
    "InfraredModel",
    "Noise",
    "SensorModels",
    "ServoPolling",
    "SonarModel",
]
