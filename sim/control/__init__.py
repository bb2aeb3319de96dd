"""Adaptive control: how distances and the compass change a gait."""

from .adaptive import AVOID, HASTEN, SHRINK, TURN, AdaptiveGait
from .build import build_gait
from .parameters import (
    Calibration,
    Controller,
    ControllerKind,
    HeadSteering,
    Lookout,
    RandomTurns,
    SideShrinking,
    TailHaste,
    TargetHeading,
)

__all__ = [
    "AVOID",
    "HASTEN",
    "SHRINK",
    "TURN",
    "AdaptiveGait",
    "Calibration",
    "Controller",
    "ControllerKind",
    "HeadSteering",
    "Lookout",
    "RandomTurns",
    "SideShrinking",
    "TailHaste",
    "TargetHeading",
    "build_gait",
]
