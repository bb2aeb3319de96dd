"""The twin: body, ground, servos and gait of an undulating robot, recorded like the robot itself.

This package imports light; :mod:`.twin.twin` and :mod:`.twin.recording` bring the physics engine.
"""

# pyright: reportUnusedImport=false

from __future__ import annotations

from typing import TYPE_CHECKING

from undulog.capture.common.lazy import attach

if TYPE_CHECKING:
    from .batch.batch import BatchRun, run_batch
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

_HOMES = {
    "batch.batch": "BatchRun run_batch",
    "gait.contract": "Gait GaitTick Readings",
    "gait.wave": "PlaneGait Serpentine SerpentineGait Wave",
    "scenario.obstacles": "Box Cylinder ObstacleMaterial RandomField Target Wall",
    "scenario.scenario": "Scenario",
    "scenario.scenario_file": "load_scenario parse_scenario scenario_names",
    "scenario.sensors": "AccelerometerModel CompassModel InfraredModel Noise SensorModels"
    " ServoPolling SonarModel",
    "scenario.world": "FrictionLaw Ground World",
    "twin.recording": "record",
    "twin.twin": "Twin",
}

__getattr__, __all__ = attach(  # pyright: ignore[reportUnsupportedDunderAll]
    __name__, {name: module for module, names in _HOMES.items() for name in names.split()}
)
