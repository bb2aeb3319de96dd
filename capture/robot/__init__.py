"""What a robot is: its model, its description file, and where its links are."""

from .model import (
    Bus,
    BusPoll,
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
from .safety import OnFault, Safety

__all__ = [
    "Bus",
    "BusPoll",
    "BusSignal",
    "ClockDomain",
    "Direction",
    "Joint",
    "Link",
    "OnFault",
    "Plane",
    "Quantity",
    "Robot",
    "Safety",
    "Sensor",
    "SensorKind",
    "Servo",
]
