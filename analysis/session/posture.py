"""How the robot lay in a run: its heading as it was put down, and how recorded gravity leans."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from undulog.capture import SessionView
from undulog.capture.robot.model import Sensor, SensorKind

from ..results.analysis import Window

HEADING = "heading_rad"
"""Key of the metadata records ``undulog.plan`` and ``undulog`` with the heading [rad]."""


@dataclass(frozen=True)
class Posture:
    """How the robot lay.

    Attributes:
        heading_rad: Direction of its head, counter-clockwise from a direction that is the same in
            all runs [rad]; NaN where it is unknown.
        lean_rad: Fall of the body along itself by recorded gravity, downhill towards the head
            positive [rad]; NaN where none is recorded.
    """

    heading_rad: float = math.nan
    lean_rad: float = math.nan


UNKNOWN_POSTURE = Posture()


def posture(session: SessionView, windows: Sequence[Window]) -> Posture:
    """Read how the robot lay in a session.

    Args:
        session: An open session.
        windows: Whole gait cycles, over which the motion's own acceleration nearly vanishes.

    Returns:
        The heading of its plan's record, else of its own metadata, else of its twin's start;
        and the lean of its accelerometers, the mean of several.
    """
    return Posture(_heading(session), _lean(session, windows))


def _heading(session: SessionView) -> float:
    for record in ("undulog.plan", "undulog"):
        text = session.metadata.get(record, {}).get(HEADING)
        if text is not None:
            return _number(text)
    return math.nan if session.run is None else session.run.start_heading_rad


def _number(text: object) -> float:
    try:
        value = float(str(text))
    except ValueError:
        return math.nan
    return value if math.isfinite(value) else math.nan


def _lean(session: SessionView, windows: Sequence[Window]) -> float:
    robot = session.robot
    if robot is None or not windows:
        return math.nan
    leans = [
        lean
        for sensor in robot.sensors
        if sensor.kind is SensorKind.ACCELEROMETER
        and set("xyz") <= set(sensor.axes)
        and sensor.topic in session.channels
        and math.isfinite(lean := _lean_of(session, sensor, windows))
    ]
    return float(np.mean(leans)) if leans else math.nan


def _lean_of(session: SessionView, sensor: Sensor, windows: Sequence[Window]) -> float:
    """Lean of the link that carries one accelerometer; its specific force is gravity's opposite."""
    table = session.table(sensor.topic)
    t_s = (table.index.to_numpy() - session.start_ns) * 1e-9
    inside = np.zeros(len(t_s), dtype=np.bool_)
    for window in windows:
        inside |= (t_s >= window.start_s) & (t_s < window.stop_s)
    columns = [f"linear_acceleration.{axis}" for axis in "xyz"]
    if not inside.any() or not set(columns) <= set(table.columns):
        return math.nan
    mean = table[columns].to_numpy(dtype=np.float64)[inside].mean(axis=0)
    if not np.isfinite(mean).all():
        return math.nan
    # First and third row of Rz(yaw) Ry(pitch) Rx(roll): the link's x and z.
    roll, pitch, yaw = sensor.rpy
    cr, sr, cp, sp = math.cos(roll), math.sin(roll), math.cos(pitch), math.sin(pitch)
    cy, sy = math.cos(yaw), math.sin(yaw)
    x = float(mean @ [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr])
    z = float(mean @ [-sp, cp * sr, cp * cr])
    return math.atan2(-x, z)
