"""The ground floor of undulog: the log, and the robot's description.

::

    from undulog.capture import Session

    with Session.open("run.mcap") as session:
        measured = session.joints("/joint_states", "position")
        print(measured.names, measured.unit, session.warnings)

Names are imported when first used, so that ``import capture`` costs nothing.
"""

# pyright: reportUnusedImport=false

from __future__ import annotations

from typing import TYPE_CHECKING

from .lazy import attach

if TYPE_CHECKING:
    from .log.session import Session
    from .log.signals import JointSignals, Signal
    from .log.topics import Channel
    from .log.writer import SessionWriter
    from .robot import Robot
    from .robot.description import load_robot, robot_names

__getattr__, __all__ = attach(  # pyright: ignore[reportUnsupportedDunderAll]
    __name__,
    {
        "Channel": "log.topics",
        "JointSignals": "log.signals",
        "Robot": "robot",
        "Session": "log.session",
        "SessionWriter": "log.writer",
        "Signal": "log.signals",
        "load_robot": "robot.description",
        "robot_names": "robot.description",
    },
)
