"""The twin: body, ground, servos and gait of an undulating robot, recorded like the robot itself.

This package imports light; :mod:`.sim.twin` and :mod:`.sim.recording` bring the physics engine.
"""

# pyright: reportUnusedImport=false

from __future__ import annotations

from typing import TYPE_CHECKING

from undulog.capture.lazy import attach

if TYPE_CHECKING:
    from .gait.contract import Gait, GaitTick
    from .gait.serpentine import Serpentine, SerpentineGait
    from .gait.wave import PlaneGait, Wave
    from .readings import Readings
    from .recording import record
    from .scenario import Scenario
    from .scenario_file import load_scenario, parse_scenario, scenario_names
    from .sensing.model import (
        AccelerometerModel,
        CompassModel,
        InfraredModel,
        Noise,
        SensorModels,
        ServoPolling,
        SonarModel,
    )
    from .twin import Twin
    from .world.field import RandomField
    from .world.ground import FrictionLaw, Ground
    from .world.model import World
    from .world.obstacles import Box, Cylinder, ObstacleMaterial, Target, Wall

__getattr__, __all__ = attach(  # pyright: ignore[reportUnsupportedDunderAll]
    __name__,
    {
        "AccelerometerModel": "sensing.model",
        "Box": "world.obstacles",
        "CompassModel": "sensing.model",
        "Cylinder": "world.obstacles",
        "FrictionLaw": "world.ground",
        "Gait": "gait.contract",
        "GaitTick": "gait.contract",
        "Ground": "world.ground",
        "InfraredModel": "sensing.model",
        "Noise": "sensing.model",
        "ObstacleMaterial": "world.obstacles",
        "PlaneGait": "gait.wave",
        "RandomField": "world.field",
        "Readings": "readings",
        "Scenario": "scenario",
        "SensorModels": "sensing.model",
        "Serpentine": "gait.serpentine",
        "SerpentineGait": "gait.serpentine",
        "ServoPolling": "sensing.model",
        "SonarModel": "sensing.model",
        "Target": "world.obstacles",
        "Twin": "twin",
        "Wall": "world.obstacles",
        "Wave": "gait.wave",
        "World": "world.model",
        "load_scenario": "scenario_file",
        "parse_scenario": "scenario_file",
        "record": "recording",
        "scenario_names": "scenario_file",
    },
)
