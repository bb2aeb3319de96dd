"""The twin: body, ground, servos and gait of an undulating robot, recorded like the robot itself.

This package imports light; :mod:`.twin.twin` and :mod:`.twin.recording` bring the physics engine.
"""

# pyright: reportUnusedImport=false

from __future__ import annotations

from typing import TYPE_CHECKING

from undulog.capture.common.extras import attach

if TYPE_CHECKING:
    from .batch.batch import BatchRun as BatchRun
    from .batch.batch import run_batch as run_batch
    from .gait.contract import Gait as Gait
    from .gait.contract import GaitTick as GaitTick
    from .gait.contract import Readings as Readings
    from .gait.wave import PlaneGait as PlaneGait
    from .gait.wave import Serpentine as Serpentine
    from .gait.wave import SerpentineGait as SerpentineGait
    from .gait.wave import Wave as Wave
    from .scenario.obstacles import Box as Box
    from .scenario.obstacles import Cylinder as Cylinder
    from .scenario.obstacles import ObstacleMaterial as ObstacleMaterial
    from .scenario.obstacles import RandomField as RandomField
    from .scenario.obstacles import Target as Target
    from .scenario.obstacles import Wall as Wall
    from .scenario.scenario import Scenario as Scenario
    from .scenario.scenario_file import load_scenario as load_scenario
    from .scenario.scenario_file import parse_scenario as parse_scenario
    from .scenario.scenario_file import scenario_names as scenario_names
    from .scenario.sensors import AccelerometerModel as AccelerometerModel
    from .scenario.sensors import CompassModel as CompassModel
    from .scenario.sensors import InfraredModel as InfraredModel
    from .scenario.sensors import Noise as Noise
    from .scenario.sensors import SensorModels as SensorModels
    from .scenario.sensors import ServoPolling as ServoPolling
    from .scenario.sensors import SonarModel as SonarModel
    from .scenario.world import FrictionLaw as FrictionLaw
    from .scenario.world import Ground as Ground
    from .scenario.world import World as World
    from .twin.recording import record as record
    from .twin.twin import Twin as Twin

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
