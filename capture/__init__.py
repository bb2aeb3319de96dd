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
    from .robot import Robot
    from .robot_file import load_robot, robot_names
    from .session import Session
    from .signals import JointSignals, Signal
    from .topics import Channel
    from .writer import SessionWriter

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
    "Channel": "topics",
    "JointSignals": "signals",
    "Robot": "robot",
    "Session": "session",
    "SessionWriter": "writer",
    "Signal": "signals",
    "load_robot": "robot_file",
    "robot_names": "robot_file",
}


def __getattr__(name: str) -> Any:
    """Import a public name from its module on first use."""
    if name not in _HOMES:
        raise AttributeError(f"module 'capture' has no attribute {name!r}")
    return getattr(import_module(f".{_HOMES[name]}", __name__), name)
