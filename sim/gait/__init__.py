"""Gaits: what the joints are commanded to do. :mod:`sim.gait.contract` says what each offers."""

from .contract import WALK, Gait, GaitTick, Generator, Modulation
from .serpentine import Serpentine, SerpentineGait
from .wave import VALUE_NAMES, PlaneGait, Wave

__all__ = [
    "VALUE_NAMES",
    "WALK",
    "Gait",
    "GaitTick",
    "Generator",
    "Modulation",
    "PlaneGait",
    "Serpentine",
    "SerpentineGait",
    "Wave",
]
