"""What the distance sensors see: an arrow from each to the thing in front of it."""

from __future__ import annotations

import numpy as np
import rerun as rr

from capture import Session
from capture.arrays import FloatArray, IntArray
from capture.robot import Robot, Sensor, SensorKind

from .motion import Motion
from .sampling import decimate, hold, ordered
from .timeline import Clock

RANGES = "/world/snake/ranges"
RANGES_RATE_HZ = 25.0

_COLOR = (232, 214, 130, 255)


def rays(
    robot: Robot,
    sensors: tuple[Sensor, ...],
    centre: FloatArray,
    rotation: FloatArray,
    reading: FloatArray,
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


def log_ranges(rec: rr.RecordingStream, clock: Clock, session: Session, motion: Motion) -> None:
    """Draw what the distance sensors see, the last reading held until the next.

    Args:
        rec: The recording.
        clock: Its timelines.
        session: The session.
        motion: What moved.
    """
    sensors = tuple(
        sensor for sensor in range_sensors(motion.robot) if sensor.topic in session.channels
    )
    if not sensors:
        return
    chosen = decimate(motion.t_ns, RANGES_RATE_HZ)
    t_ns = motion.t_ns[chosen]
    reading = np.stack([_readings(session, sensor, t_ns) for sensor in sensors], axis=1)
    log_rays(rec, clock, motion, chosen, sensors=sensors, reading=reading)


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
    reading: FloatArray,
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
            origins=origin[known].astype(np.float32), vectors=vector[known].astype(np.float32)
        ).partition(np.count_nonzero(known, axis=1))
        rec.send_columns(RANGES, times, columns)


def _readings(session: Session, sensor: Sensor, at_ns: IntArray) -> FloatArray:
    table = session.table(sensor.topic)
    t_ns, distance = ordered(
        table.index.to_numpy(dtype=np.int64), table["range"].to_numpy(dtype=np.float64)
    )
    return hold(t_ns, distance, at_ns)
