"""The ground floor of undulog: the log, and the robot's description.

::

    from capture import Session

    with Session.open("run.mcap") as session:
        measured = session.joints("/joint_states", "position")
        print(measured.names, measured.unit, session.warnings)

Names are imported when first used, so that ``import capture`` costs nothing.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .log.session import Session
    from .log.signals import JointSignals, Signal
    from .log.topics import Channel
    from .log.writer import SessionWriter
    from .robot import Robot
    from .robot.description import load_robot, robot_names

__all__ = [
    "Channel",
    "JointSignals",
    "Robot",
    "Session",
    "SessionWriter",
    "Signal",
    "load_robot",
    "robot_names",
]

_HOMES = {
    "Channel": "log.topics",
    "JointSignals": "log.signals",
    "Robot": "robot",
    "Session": "log.session",
    "SessionWriter": "log.writer",
    "Signal": "log.signals",
    "load_robot": "robot.description",
    "robot_names": "robot.description",
}


def __getattr__(name: str) -> Any:
    """Import a public name from its module on first use."""
    if name not in _HOMES:
        raise AttributeError(f"module 'capture' has no attribute {name!r}")
    return getattr(import_module(f".{_HOMES[name]}", __name__), name)
