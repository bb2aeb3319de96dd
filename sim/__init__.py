"""The twin: body, ground, servos and gait of an undulating robot, recorded like the robot itself.

This package imports light; :mod:`sim.twin` and :mod:`sim.record` bring the physics engine.
"""

from .gait import Gait, GaitTick, PlaneGait, Serpentine, SerpentineGait, Wave
from .readings import Readings
from .scenario import Scenario
from .scenario_file import load_scenario, parse_scenario, scenario_names
from .sensing import (
    AccelerometerModel,
    CompassModel,
    InfraredModel,
    Noise,
    SensorModels,
    ServoPolling,
    SonarModel,
)
from .world import (
    Box,
    Cylinder,
    FrictionLaw,
    Ground,
    ObstacleMaterial,
    RandomField,
    Target,
    Wall,
    World,
)

__all__ = [
    "AccelerometerModel",
    "Box",
    "CompassModel",
    "Cylinder",
    "FrictionLaw",
    "Gait",
    "GaitTick",
    "Ground",
    "InfraredModel",
    "Noise",
    "ObstacleMaterial",
    "PlaneGait",
    "RandomField",
    "Readings",
    "Scenario",
    "SensorModels",
    "Serpentine",
    "SerpentineGait",
    "ServoPolling",
    "SonarModel",
    "Target",
    "Wall",
    "Wave",
    "World",
    "load_scenario",
    "parse_scenario",
    "scenario_names",
]
