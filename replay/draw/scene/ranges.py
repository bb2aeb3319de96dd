"""What the distance sensors see: an arrow from each to the thing in front of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from undulog.capture import SessionView
from undulog.capture.common.arrays import FloatArray, IntArray
from undulog.capture.robot.model import Robot, Sensor, SensorKind

from ...samples.sampling import hold, ordered
from ...samples.timeline import Clock
from .body import ROUNDING, rounded_to
from .motion import Motion

RANGES = "/world/snake/ranges"

_AT_ONCE = 4
"""Sensors that are read in one pass over the file: an hour of each takes memory."""
_COLOR = (232, 214, 130, 255)


def rays(
    robot: Robot,
    sensors: tuple[Sensor, ...],
    centre: FloatArray,
    rotation: FloatArray,
    reading: FloatArray | NDArray[np.float32],
) -> tuple[FloatArray, FloatArray]:
    """From each range sensor to what it sees.

    Args:
        robot: The robot, m joints.
        sensors: The sensors, k of them; rays leave along their x axes.
        centre: Link centres [m], shape (n, m + 1, 3).
        rotation: Link orientations, shape (n, m + 1, 3, 3).
        reading: Distances [m], shape (n, k); infinite, NaN or at the sensor's limit where
            nothing is seen.

    Returns:
        Origins and vectors [m], each of shape (n, k, 3); vectors NaN where nothing is seen.
    """
    names = [link.name for link in robot.links]
    carrier = [names.index(sensor.link) for sensor in sensors]
    mount = np.array([sensor.position for sensor in sensors])
    _, pitch, yaw = np.array([sensor.rpy for sensor in sensors]).T
    # The x axis of Rz(yaw) Ry(pitch) Rx(roll).
    axis = np.stack([np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), -np.sin(pitch)], -1)
    limit = np.array([np.inf if s.range_max is None else s.range_max for s in sensors])
    seen = np.where(reading < limit, reading, np.nan)
    turn = rotation[:, carrier]
    origin = centre[:, carrier] + np.einsum("nkij,kj->nki", turn, mount)
    return origin, seen[..., None] * np.einsum("nkij,kj->nki", turn, axis)


@dataclass(frozen=True)
class Readings:
    """What the distance sensors said at the times at which they are drawn.

    Attributes:
        sensors: The sensors, k of them.
        distance: The last reading at each time, held until the next [m], shape (n, k).
    """

    sensors: tuple[Sensor, ...]
    distance: NDArray[np.float32]


def read_ranges(session: SessionView, robot: Robot, at_ns: IntArray) -> Readings:
    """Read all distance sensors.

    Args:
        session: The session.
        robot: The robot.
        at_ns: When they are drawn [ns], shape (n,).

    Returns:
        The readings; without sensors where none was logged.
    """
    sensors = tuple(one for one in range_sensors(robot) if one.topic in session.channels)
    distance = np.full((at_ns.size, len(sensors)), np.nan, dtype=np.float32)
    for first in range(0, len(sensors), _AT_ONCE):
        some = sensors[first : first + _AT_ONCE]
        tables = session.columns({}, {sensor.topic: ["range"] for sensor in some})[1]
        for i, sensor in enumerate(some, start=first):
            table = tables.pop(sensor.topic)
            t_ns, values = table.index.to_numpy(dtype=np.int64), table["range"].to_numpy(np.float64)
            distance[:, i] = hold(*ordered(t_ns, values), at_ns)
        session.forget()
    return Readings(sensors, distance)


def range_sensors(robot: Robot) -> tuple[Sensor, ...]:
    """The robot's distance sensors.

    Args:
        robot: The robot.

    Returns:
        Infrared and ultrasound, in the robot's order.
    """
    kinds = (SensorKind.IR, SensorKind.SONAR)
    return tuple(sensor for sensor in robot.sensors if sensor.kind in kinds)


def log_rays(
    rec: rr.RecordingStream,
    clock: Clock,
    motion: Motion,
    chosen: IntArray,
    *,
    sensors: tuple[Sensor, ...],
    reading: FloatArray | NDArray[np.float32],
) -> None:
    """Draw what distance sensors see.

    Args:
        rec: The recording.
        clock: Its timelines.
        motion: What moved.
        chosen: Which of its drawing times, shape (n,).
        sensors: The sensors, k of them.
        reading: Distances at those times [m], shape (n, k); NaN where there is none.
    """
    t_ns = motion.t_ns[chosen]
    look = rr.Arrows3D.from_fields(colors=_COLOR, radii=rr.Radius.ui_points(1.0))
    rec.log(RANGES, look, static=True)
    for part, times in clock.rows(t_ns):
        origin, vector = rays(motion.robot, sensors, *motion.links(chosen[part]), reading[part])
        known = np.isfinite(origin).all(axis=-1) & np.isfinite(vector).all(axis=-1)
        columns = rr.Arrows3D.columns(
            origins=rounded_to(origin[known], ROUNDING),
            vectors=rounded_to(vector[known], ROUNDING),
        ).partition(np.count_nonzero(known, axis=1))
        rec.send_columns(RANGES, times, columns)
