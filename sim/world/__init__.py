"""The robot's surroundings."""

from .field import RandomField
from .ground import FrictionLaw, Ground
from .model import World
from .obstacles import Box, Cylinder, Obstacle, ObstacleMaterial, Target, Wall

__all__ = [
    "Box",
    "Cylinder",
    "FrictionLaw",
    "Ground",
    "Obstacle",
    "ObstacleMaterial",
    "RandomField",
    "Target",
    "Wall",
    "World",
]
