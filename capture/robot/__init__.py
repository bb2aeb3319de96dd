"""What a robot is: its model, its description file, and where its links are."""

from .model import (
    Bus,
    BusSignal,
    ClockDomain,
    Direction,
    Joint,
    Link,
    Plane,
    Quantity,
    Robot,
    Sensor,
    SensorKind,
    Servo,
)

__all__ = [
    "Bus",
    "BusSignal",
    "ClockDomain",
    "Direction",
    "Joint",
    "Link",
    "Plane",
    "Quantity",
    "Robot",
    "Sensor",
    "SensorKind",
    "Servo",
]
