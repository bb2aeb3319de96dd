"""The robot's surroundings."""

from .field import RandomField
from .ground import FrictionLaw, Ground
from .model import World
from .obstacles import Box, Cylinder, Obstacle, ObstacleMaterial, Target, Wall
from .push import Push

__all__ = [
    "Box",
    "Cylinder",
    "FrictionLaw",
    "Ground",
    "Obstacle",
    "ObstacleMaterial",
    "Push",
    "RandomField",
    "Target",
    "Wall",
    "World",
]
