"""The robot's surroundings."""

from .ground import FrictionLaw, Ground
from .model import World

__all__ = ["FrictionLaw", "Ground", "World"]
