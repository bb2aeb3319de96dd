"""The decoder of a robot's bus: by registers, by plug-in, or by databases."""

from __future__ import annotations

from importlib.metadata import entry_points

from ..robot.families import DECODERS, is_serial
from ..robot.model import Robot
from .decoding import BusDecoder, Decoder
from .register_decoding import RegisterDecoder


def open_decoder(robot: Robot, *, directions: bool = True) -> Decoder:
    """Return the decoder of a robot's bus.

    Args:
        directions: Whether the frames' directions are known.

    Raises:
        DataError: As :class:`.BusDecoder`.
    """
    family = robot.bus.family if robot.bus is not None else ""
    if is_serial(robot.bus):
        return RegisterDecoder(robot)
    for plugin in entry_points(group=DECODERS, name=family) if family else ():
        return plugin.load()(robot)
    return BusDecoder(robot, directions=directions)
