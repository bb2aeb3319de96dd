"""The ground floor of undulog: the log, and the robot's description.

::

    from undulog.capture import Session

    with Session.open("run.mcap") as session:
        measured = session.joints("/joint_states", "position")
        print(measured.names, measured.unit, session.warnings)

Names are imported when first used, so that ``import undulog.capture`` costs nothing.
"""

# pyright: reportUnusedImport=false

from __future__ import annotations

from typing import TYPE_CHECKING

from .common.extras import attach

if TYPE_CHECKING:
    from .log.columns.topics import Channel as Channel
    from .log.read.sample_times import JointSignals as JointSignals
    from .log.read.sample_times import Signal as Signal
    from .log.read.session import Session as Session
    from .log.read.session_view import SessionView as SessionView
    from .log.write.writer import SessionWriter as SessionWriter
    from .robot.description import load_robot as load_robot
    from .robot.description import robot_names as robot_names
    from .robot.model import Robot as Robot

__getattr__, __all__ = attach(  # pyright: ignore[reportUnsupportedDunderAll]
    __name__,
    {
        "Channel": "log.columns.topics",
        "JointSignals": "log.read.sample_times",
        "Robot": "robot.model",
        "Session": "log.read.session",
        "SessionView": "log.read.session_view",
        "SessionWriter": "log.write.writer",
        "Signal": "log.read.sample_times",
        "load_robot": "robot.description",
        "robot_names": "robot.description",
    },
)
