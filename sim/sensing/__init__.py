"""The robot's sensors: what they measure, when, and how wrongly."""

from .model import Noise, SensorModels, ServoPolling

__all__ = ["Noise", "SensorModels", "ServoPolling"]
