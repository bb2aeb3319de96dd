"""From a gait's parameters to its generator."""

from __future__ import annotations

from typing import TypeAlias

from undulog.capture.robot.model import Robot

from .contract import Generator
from .delay_blocks import DelayBlockGait, DelayBlocks
from .oscillators import OscillatorChains, OscillatorGait
from .serpentine import Serpentine, SerpentineGait

GaitParameters: TypeAlias = Serpentine | DelayBlocks | OscillatorChains
"""What a scenario says of its gait."""


def generator(parameters: GaitParameters, robot: Robot, *, per_joint: bool = False) -> Generator:
    """The generator of a gait, at time zero with straight joints.

    Args:
        parameters: What to do.
        robot: Who is to do it.
        per_joint: Tell every joint's own values too; a controller that sets joints apart asks for
            it, so that the log tells what each joint was meant to do.

    Returns:
        The generator.
    """
    if isinstance(parameters, DelayBlocks):
        return DelayBlockGait(parameters, robot)
    if isinstance(parameters, OscillatorChains):
        return OscillatorGait(parameters, robot)
    return SerpentineGait(parameters, robot, per_joint=per_joint)
