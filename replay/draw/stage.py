"""The body in its surroundings, drawn stretch by stretch."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Sequence
from typing import Any

import numpy as np
import rerun as rr
from numpy.typing import NDArray
from rerun.components import FillMode

from undulog.capture import SessionView
from undulog.capture.common.arrays import FloatArray, IntArray
from undulog.capture.common.strict_table import Faults, StrictTable
from undulog.capture.common.untrusted_text import read_toml
from undulog.capture.robot.model import Robot, Sensor, SensorKind
from undulog.sim.scenario.obstacles import Box, Cylinder, Obstacle, Target, Wall
from undulog.sim.scenario.world import World, read_world

from ..samples.timeline import DrawnSpan, SpanSamples, TimeColumns
from ..samples.tracks import decimate, gaps, hold, ordered
from . import body
from .body import ROUNDING, Look, rounded_to
from .motion import HeadPath, Motion, assemble, frames_of

RANGES = "/world/snake/ranges"

_AT_ONCE = 4  # sensors that are read in one pass over the file: an hour of each takes memory
_RANGE_COLOR = (232, 214, 130, 255)

TRAIL = "/world/trail"
TRAIL_RATE_HZ = 10.0
TRAIL_SECONDS = 20.0

_COLOR = (104, 108, 128, 255)
_WHOLE = DrawnSpan()

CYLINDERS = "/world/obstacles/cylinders"
BOXES = "/world/obstacles/boxes"
TARGET = "/world/target"

_STONE = (120, 126, 134, 255)
_GOAL = (92, 200, 120, 255)
_RIM_SIDES = 64


def rays(
    robot: Robot,
    sensors: tuple[Sensor, ...],
    centre: FloatArray,
    rotation: FloatArray,
    reading: FloatArray | NDArray[np.float32],
) -> tuple[FloatArray, FloatArray]:
    """Return the rays from each range sensor to the obstacle that it detects.

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


def read_ranges(
    session: SessionView, sensors: Sequence[Sensor], at_ns: IntArray
) -> NDArray[np.float32]:
    """Read distance sensors.

    Args:
        sensors: Those of which something was logged, k of them.
        at_ns: When they are drawn [ns], shape (n,).

    Returns:
        The last reading at each time, held until the next [m], shape (n, k).
    """
    distance = np.full((at_ns.size, len(sensors)), np.nan, dtype=np.float32)
    for first in range(0, len(sensors), _AT_ONCE):
        some = sensors[first : first + _AT_ONCE]
        logged = session.arrays({sensor.topic: ["range"] for sensor in some})
        for i, sensor in enumerate(some, start=first):
            fields = logged.pop(sensor.topic)
            values = fields.values["range"].astype(np.float64)
            distance[:, i] = hold(*ordered(fields.t_ns, values), at_ns)
        session.forget()
    return distance


def range_sensors(robot: Robot, topics: Collection[str]) -> tuple[Sensor, ...]:
    """Return the robot's distance sensors that were logged.

    Args:
        topics: Topics that were.

    Returns:
        Infrared and ultrasound, in the robot's order.
    """
    kinds = (SensorKind.IR, SensorKind.SONAR)
    return tuple(
        sensor for sensor in robot.sensors if sensor.kind in kinds and sensor.topic in topics
    )


def log_rays(
    rec: rr.RecordingStream,
    clock: TimeColumns,
    motion: Motion,
    chosen: IntArray,
    *,
    sensors: tuple[Sensor, ...],
    reading: FloatArray | NDArray[np.float32],
) -> None:
    """Draw the rays of the distance sensors.

    Args:
        chosen: Which of its drawing times, shape (n,).
        sensors: The sensors, k of them.
        reading: Distances at those times [m], shape (n, k); NaN where there is none.
    """
    if not sensors:
        return
    look = rr.Arrows3D.from_fields(colors=_RANGE_COLOR, radii=rr.Radius.ui_points(1.0))
    rec.log(RANGES, look, static=True)
    for part, times in clock.rows(motion.t_ns[chosen]):
        origin, vector = rays(motion.robot, sensors, *motion.links(chosen[part]), reading[part])
        finite = np.isfinite(origin).all(axis=-1) & np.isfinite(vector).all(axis=-1)
        columns = rr.Arrows3D.columns(
            origins=rounded_to(origin[finite], ROUNDING),
            vectors=rounded_to(vector[finite], ROUNDING),
        ).partition(np.count_nonzero(finite, axis=1))
        rec.send_columns(RANGES, times, columns)


def trail_segments(t_ns: IntArray, position: FloatArray) -> tuple[IntArray, NDArray[np.float32]]:
    """Return line segments between successive head positions.

    Args:
        t_ns: Times [ns], ascending, shape (n,).
        position: Head positions [m], shape (n, 3).

    Returns:
        Times at which the pieces end [ns], shape (k,), and pieces, shape (k, 2, 3); none across
        a gap.
    """
    pieces = np.stack([position[:-1], position[1:]], axis=1).astype(np.float32)
    whole = ~gaps(t_ns) & np.isfinite(pieces).all(axis=(1, 2))
    return t_ns[1:][whole], pieces[whole]


def log_trail(
    rec: rr.RecordingStream,
    clock: TimeColumns,
    head: HeadPath,
    rows: Callable[[IntArray], slice] = _WHOLE.rows,
    origin_ns: int | None = None,
) -> None:
    """Draw the head's path; the view shows its last 20 s.

    Args:
        head: The head's path, or a part of it.
        rows: Of the times of its points, those that are drawn.
        origin_ns: First time of the whole path [ns]; None for that of this part.
    """
    chosen = decimate(head.t_ns, TRAIL_RATE_HZ, origin_ns)
    t_ns, pieces = trail_segments(head.t_ns[chosen], head.position[chosen])
    part = rows(t_ns)
    t_ns, pieces = t_ns[part], pieces[part]
    look = rr.LineStrips3D.from_fields(colors=_COLOR, radii=rr.Radius.ui_points(1.0))
    rec.log(TRAIL, look, static=True)
    for part, times in clock.rows(t_ns):
        rec.send_columns(TRAIL, times, rr.LineStrips3D.columns(strips=pieces[part]))


def world_of(session: SessionView, warnings: list[str]) -> World | None:
    """Return the world of the session's scenario.

    Args:
        warnings: Extended by what can't be read.

    Returns:
        The world; None where the session is of no twin, or its scenario can't be read.
    """
    data = session.attachments.get("scenario.toml")
    if data is None:
        return None
    try:
        values: dict[str, Any] = read_toml(data.decode())
    except ValueError as error:
        warnings.append(f"the attached scenario can't be read, obstacles are not drawn: {error}")
        return None
    faults = Faults()
    world = read_world(StrictTable(values, "", faults).table("world"), None, 0)
    if problems := faults.all():
        reason = "; ".join(map(str, problems))
        warnings.append(f"the attached scenario has faults, obstacles are not drawn: {reason}")
        return None
    return world


def log_surroundings(rec: rr.RecordingStream, world: World) -> None:
    """Draw obstacles and target."""
    cylinders = [obstacle for obstacle in world.obstacles if isinstance(obstacle, Cylinder)]
    boxes = [_box(obstacle) for obstacle in world.obstacles if not isinstance(obstacle, Cylinder)]
    if cylinders:
        shapes = rr.Cylinders3D(
            lengths=[cylinder.height for cylinder in cylinders],
            radii=[cylinder.radius for cylinder in cylinders],
            centers=[(*cylinder.position, cylinder.height / 2) for cylinder in cylinders],
            colors=[_STONE],
            fill_mode=FillMode.Solid,
        )
        rec.log(CYLINDERS, shapes, static=True)
    if boxes:
        shapes = rr.Boxes3D(
            sizes=[(*box.size, box.height) for box in boxes],
            centers=[(*box.position, box.height / 2) for box in boxes],
            quaternions=[
                (0.0, 0.0, math.sin(box.heading / 2), math.cos(box.heading / 2)) for box in boxes
            ],
            colors=[_STONE],
            fill_mode=FillMode.Solid,
        )
        rec.log(BOXES, shapes, static=True)
    if world.target is not None:
        rec.log(TARGET, _rim(world.target), static=True)


def _box(obstacle: Obstacle) -> Box:
    assert not isinstance(obstacle, Cylinder)  # noqa: S101 - the caller sorted them
    return obstacle.box if isinstance(obstacle, Wall) else obstacle


def _rim(target: Target) -> rr.LineStrips3D:
    """The edge of the target on the ground."""
    (x, y), r = target.position, target.radius
    turns = [2 * math.pi * k / _RIM_SIDES for k in range(_RIM_SIDES + 1)]
    rim = [(x + r * math.cos(turn), y + r * math.sin(turn), 0.002) for turn in turns]
    return rr.LineStrips3D([rim], colors=[_GOAL], radii=[0.01], labels=["target"])


def log_motion(
    rec: rr.RecordingStream,
    clock: TimeColumns,
    motion: Motion,
    sparse: IntArray,
    *,
    look: Look,
    ranges: tuple[tuple[Sensor, ...], FloatArray | NDArray[np.float32]],
) -> None:
    """Draw the body, and what moves with it.

    Args:
        sparse: Which of its drawing times are drawn of what moves beside the body, shape (n,).
        ranges: Distance sensors, k of them, and their readings at those times [m], shape (n, k).
    """
    body.log_body(rec, clock, motion, limit_w=look.limit_w)
    body.log_ghost(rec, clock, motion, sparse)
    log_rays(rec, clock, motion, sparse, sensors=ranges[0], reading=ranges[1])
    body.log_marks(rec, clock, motion, look.named, sparse)
    body.log_markers(rec, clock, motion, look.places, look.palette, named=sparse)


class Scene:
    """The 3D scene of a session with a robot whose joints were measured."""

    def __init__(
        self,
        rec: rr.RecordingStream,
        clock: TimeColumns,
        session: SessionView,
        robot: Robot,
        head: HeadPath,
        *,
        look: Look,
        warnings: list[str],
        span: DrawnSpan,
    ) -> None:
        """Draw the static surroundings and the head's trail.

        Args:
            head: Where its head was.
            warnings: Grows by a sentence where the surroundings can't be drawn.
            span: The part of the trail that is drawn.
        """
        self._rec, self._clock, self._robot, self._look = rec, clock, robot, look
        self._head, sparse = frames_of(head, session.end_ns)
        self._sparse = np.flatnonzero(sparse)
        self._sensors = range_sensors(robot, session.channels)
        self._distance = read_ranges(session, self._sensors, self._head.t_ns[self._sparse])
        rec.log("/world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        if (world := world_of(session, warnings)) is not None:
            log_surroundings(rec, world)
        if head.tracked:
            log_trail(rec, clock, head, span.rows)

    def write(self, stretch: SpanSamples) -> None:
        """Draw a stretch."""
        rows = stretch.span.rows(self._head.t_ns)
        if rows.stop <= rows.start:
            return
        motion = assemble(self._robot, self._head.at(rows), stretch.columns)
        part = slice(*np.searchsorted(self._sparse, [rows.start, rows.stop]).tolist())
        sparse = self._sparse[part] - rows.start
        ranges = self._sensors, self._distance[part]
        log_motion(self._rec, self._clock, motion, sparse, look=self._look, ranges=ranges)
