"""Commands on the bus of snake25, decoded by cantools."""

import cantools
import numpy as np

from undulog.capture import load_robot
from undulog.sim.drive.loop import CommandEncoder

ROBOT = load_robot("snake25")
ENCODER = CommandEncoder(ROBOT)
DATABASE = cantools.database.load_string(dict(ROBOT.databases)["snake25.dbc"], "dbc")
MESSAGES = {message.frame_id: message for message in DATABASE.messages}


def on_the_bus(command):
    """Return the angles in the frames of a command [rad]."""
    decoded = [
        MESSAGES[int(frame["id_flags"])].decode(bytes(frame["data"][: frame["dlc"]]))
        for frame in ENCODER.frames(command)
    ]
    assert len(decoded) == len(command)
    return np.radians([frame["position"] for frame in decoded])
