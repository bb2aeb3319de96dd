"""The requests of a bus map, as frames: what makes a robot tell its state that doesn't unasked."""

from __future__ import annotations

import numpy as np

from ..common.errors import DataError
from ..log.messages.frames import DIR_TX, FrameArray, empty_frames
from ..robot.model import Robot
from .bit_field import BitField
from .map_entry import bus_messages, frame_id

_MOST_BYTES = 8


def poll_frames(robot: Robot) -> FrameArray:
    """The frames that ask for the robot's state.

    Args:
        robot: The robot.

    Returns:
        Records of :data:`.FRAME_DTYPE`, without times, in the order of the map;
        none where nothing has to be asked.

    Raises:
        DataError: If the robot has no bus, or a request that is no classic CAN frame.
    """
    bus, messages = bus_messages(robot)
    frames = empty_frames(len(bus.polls))
    frames["dir"] = DIR_TX
    for frame, poll in zip(frames, bus.polls, strict=True):
        message = messages[poll.message]
        if message.length > _MOST_BYTES:
            raise DataError(
                f"{poll.message} of {robot.name} is a CAN FD frame; only classic are sent"
            )
        fields = {each.name: BitField.of(each) for each in message.signals}
        word = 0
        for name, number in poll.signals:
            word |= fields[name].placed(number, message.length)
        frame["id_flags"], frame["dlc"] = frame_id(message), message.length
        data = word.to_bytes(message.length, "little").ljust(_MOST_BYTES, b"\0")
        frame["data"] = np.frombuffer(data, np.uint8)
    return frames
