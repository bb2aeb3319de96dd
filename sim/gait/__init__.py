"""Gaits: what the joints are commanded to do. :mod:`.sim.gait.contract` says what each offers."""

from .build import GaitParameters, generator
from .contract import WALK, Gait, GaitTick, Generator, Modulation
from .delay_blocks import DelayBlockGait, DelayBlocks, DelayLine
from .oscillators import OscillatorChain, OscillatorChains, OscillatorGait, OscillatorKind
from .serpentine import Serpentine, SerpentineGait
from .wave import JOINT_VALUE_NAMES, VALUE_NAMES, PlaneGait, Wave

__all__ = [
    "JOINT_VALUE_NAMES",
    "VALUE_NAMES",
    "WALK",
    "DelayBlockGait",
    "DelayBlocks",
    "DelayLine",
    "Gait",
    "GaitParameters",
    "GaitTick",
    "Generator",
    "Modulation",
    "OscillatorChain",
    "OscillatorChains",
    "OscillatorGait",
    "OscillatorKind",
    "PlaneGait",
    "Serpentine",
    "SerpentineGait",
    "Wave",
    "generator",
]
