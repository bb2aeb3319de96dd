"""The twin: body, ground, servos and gait of an undulating robot, recorded like the robot itself.

This package imports light; :mod:`sim.twin` and :mod:`sim.record` bring the physics engine.
"""

from .gait import Gait, GaitTick, PlaneGait, Serpentine, SerpentineGait, Wave
from .readings import Readings
from .scenario import Scenario
from .scenario_file import load_scenario, parse_scenario, scenario_names
from .sensing import Noise, SensorModels, ServoPolling
from .world import FrictionLaw, Ground, World

__all__ = [
    "FrictionLaw",
    "Gait",
    "GaitTick",
    "Ground",
    "Noise",
    "PlaneGait",
    "Readings",
    "Scenario",
    "SensorModels",
    "Serpentine",
    "SerpentineGait",
    "ServoPolling",
    "Wave",
    "World",
    "load_scenario",
    "parse_scenario",
    "scenario_names",
]
