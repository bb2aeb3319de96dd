"""The twin: body, ground, servos and gait of an undulating robot, recorded like the robot itself.

This package imports light; :mod:`.twin.twin` and :mod:`.twin.recording` bring the physics engine.
"""

# pyright: reportUnusedImport=false

from __future__ import annotations

from typing import TYPE_CHECKING

from undulog.capture.common.lazy import attach

if TYPE_CHECKING:
    from .gait.contract import Gait, GaitTick, Readings
    from .gait.wave import PlaneGait, Serpentine, SerpentineGait, Wave
    from .scenario.obstacles import Box, Cylinder, ObstacleMaterial, RandomField, Target, Wall
    from .scenario.scenario import Scenario
    from .scenario.scenario_file import load_scenario, parse_scenario, scenario_names
    from .scenario.sensors import (
        AccelerometerModel,
        CompassModel,
        InfraredModel,
        Noise,
        SensorModels,
        ServoPolling,
        SonarModel,
    )
    from .scenario.world import FrictionLaw, Ground, World
    from .twin.recording import record
    from .twin.twin import Twin

__getattr__, __all__ = attach(  # pyright: ignore[reportUnsupportedDunderAll]
    __name__,
    {
        "AccelerometerModel": "scenario.sensors",
        "Box": "scenario.obstacles",
        "CompassModel": "scenario.sensors",
        "Cylinder": "scenario.obstacles",
        "FrictionLaw": "scenario.world",
        "Gait": "gait.contract",
        "GaitTick": "gait.contract",
        "Ground": "scenario.world",
        "InfraredModel": "scenario.sensors",
        "Noise": "scenario.sensors",
        "ObstacleMaterial": "scenario.obstacles",
        "PlaneGait": "gait.wave",
        "RandomField": "scenario.obstacles",
        "Readings": "gait.contract",
        "Scenario": "scenario.scenario",
        "SensorModels": "scenario.sensors",
        "Serpentine": "gait.wave",
        "SerpentineGait": "gait.wave",
        "ServoPolling": "scenario.sensors",
        "SonarModel": "scenario.sensors",
        "Target": "scenario.obstacles",
        "Twin": "twin.twin",
        "Wall": "scenario.obstacles",
        "Wave": "gait.wave",
        "World": "scenario.world",
        "load_scenario": "scenario.scenario_file",
        "parse_scenario": "scenario.scenario_file",
        "record": "twin.recording",
        "scenario_names": "scenario.scenario_file",
    },
)
