"""A session as a Rerun recording: columns in, one .rrd file out.

The recording is a cache: the MCAP file stays the truth, and the same session always gives the
same recording id, so that a rebuilt recording takes the old one's place in the viewer.
"""

from __future__ import annotations

import uuid
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from rerun.chunk import RrdReader

from analysis.result import Analysis
from capture import Session
from capture.errors import DataError, LogWriteError
from capture.part_file import part_file
from capture.robot import Robot
from capture.robot.kinematics import rotation_from_quaternion

from . import body, facts, gait, joints, markers, power, ranges, trail
from .blueprint import build_blueprint
from .content import Content, Signal, Start
from .motion import HeadPath, assemble, read_head
from .response import charts, log_charts
from .surroundings import log_surroundings, world_of
from .timeline import Clock
from .tracks import Columns, Track, read_columns
from .views import body_title

APPLICATION = "undulog"

DRAWN = {"/joint_states", "/joint_commands", "/gait"}
"""JointState topics that have views of their own."""
_NAMESPACE = uuid.UUID("8f4b6f0e-6f0a-5d3f-9a53-5d1f7a3f2c11")


@dataclass(frozen=True)
class Recording:
    """What was written.

    Attributes:
        path: The .rrd file.
        recording_id: Follows from the session id.
        content: What it holds.
        warnings: What is missing or was assumed, a sentence each.
    """

    path: Path
    recording_id: str
    content: Content
    warnings: tuple[str, ...]


@dataclass
class _Sources:
    """What is read from the session before anything is drawn."""

    session: Session
    columns: Columns
    measured: tuple[Track, ...]
    commanded: tuple[Track, ...]
    mechanical: tuple[Track, ...]
    electrical: tuple[Track, ...]
    warnings: list[str]


def recording_id(session_id: str) -> str:
    """The recording's id, the same for the same session on every machine.

    Args:
        session_id: The session's id.

    Returns:
        A name-based UUID (RFC 9562, version 5).
    """
    return str(uuid.uuid5(_NAMESPACE, session_id))


def write_recording(
    session: Session,
    path: Path,
    *,
    analysis: Analysis | None = None,
    notes: Sequence[str] = (),
    layout: Callable[[Content], rrb.Blueprint] = build_blueprint,
) -> Recording:
    """Convert a session.

    Args:
        session: The session, open.
        path: Where the .rrd file goes; an existing one is replaced when the new one is whole.
        analysis: The session's analysis, for the response bars; None leaves them out.
        notes: What the caller has to say about the session, a sentence each.
        layout: Makes the blueprint from what the recording holds.

    Returns:
        What was written.

    Raises:
        DataError: If the session holds nothing that can be drawn.
        LogWriteError: If the file can't be written.
    """
    rr.set_strict_mode(True)
    sources = _read(session)
    rhythm = gait.rhythm_of(sources.columns.get(("/gait", "position"), ()))
    clock = Clock(session.start_ns, rhythm)
    identity = recording_id(session.session_id)
    with part_file(path) as draft:
        rec = rr.RecordingStream(APPLICATION, recording_id=identity, send_properties=False)
        try:
            rec.set_log_time_enabled(False)
            rec.set_log_tick_enabled(False)
            _save(rec, draft, path)
            rec.send_recording_name(session.session_id)
            rec.send_recording_start_time_nanos(session.start_ns)
            content = _log(rec, clock, sources, analysis)
            told = tuple(dict.fromkeys([*notes, *sources.warnings, *session.warnings]))
            text = facts.markdown(
                session,
                analysis,
                notes=told,
                colors=body_title(content),
                has_cycles=rhythm is not None,
            )
            facts.log_facts(rec, text)
            rec.send_blueprint(layout(content))
        finally:
            rec.disconnect()
        require_whole(draft, path)
    return Recording(path, identity, content, told)


def _read(session: Session) -> _Sources:
    if not any(channel.count for channel in session.channels.values()):
        raise DataError(f"{session.path}: the session holds no messages; nothing can be drawn")
    columns = read_columns(session)
    measured = columns.get(("/joint_states", "position"), ())
    missing: list[str] = []
    if session.robot is None:
        missing.append("no robot description in the session: the body can't be drawn")
    if not measured:
        missing.append("no measured joint angles on /joint_states")
    return _Sources(
        session,
        columns,
        measured=measured,
        commanded=columns.get(("/joint_commands", "position"), ()),
        mechanical=power.mechanical_power(columns),
        electrical=power.electrical_power(columns),
        warnings=missing,
    )


def _log(
    rec: rr.RecordingStream, clock: Clock, sources: _Sources, analysis: Analysis | None
) -> Content:
    """Write everything but the facts."""
    session, robot = sources.session, sources.session.robot
    moving = sources.measured or sources.commanded
    palette = palette_of(robot, [track.name for track in moving])
    places = joints.head_middle_tail(robot, sources.commanded or sources.measured)
    head, limit = _log_world(rec, clock, sources, places, palette)
    if places is not None:
        joints.log_places(
            rec,
            clock,
            places,
            measured=sources.measured,
            commanded=sources.commanded,
            palette=palette,
        )
    errors = joints.tracking_errors(sources.measured, sources.commanded)
    found = charts(analysis) if analysis is not None else ()
    log_charts(rec, found, palette)
    return Content(
        robot=robot,
        start=None if head is None else start_of(head),
        power_limit_w=limit,
        places=places,
        commanded=joints.log_angles(rec, clock, joints.COMMANDED, sources.commanded),
        measured=joints.log_angles(rec, clock, joints.MEASURED, sources.measured, palette),
        errors=joints.log_angles(rec, clock, joints.ERROR, errors, palette),
        has_power=power.log_total(
            rec, clock, mechanical=sources.mechanical, electrical=sources.electrical
        ),
        joint_power=joints.log_scalars(rec, clock, power.MECHANICAL, sources.mechanical, palette),
        charts=found,
        modes=gait.log_mode(rec, clock, session, sources.warnings),
        has_events=gait.log_events(rec, clock, session, sources.warnings),
        signals=_log_signals(rec, clock, sources, palette),
    )


def _log_world(
    rec: rr.RecordingStream,
    clock: Clock,
    sources: _Sources,
    places: joints.Places | None,
    palette: dict[str, joints.Color],
) -> tuple[HeadPath | None, float | None]:
    """The 3D scene, where there is a robot whose joints were measured."""
    robot = sources.session.robot
    if robot is None or not sources.measured:
        return None, None
    head = read_head(sources.session, robot, sources.measured, sources.warnings)
    motion = assemble(
        robot,
        head,
        positions=sources.measured,
        commands=sources.commanded,
        power=sources.mechanical,
        end_ns=sources.session.end_ns,
    )
    missing = [n for n in robot.joint_names if n not in {track.name for track in sources.measured}]
    if missing:
        sources.warnings.append(
            f"no angles of {', '.join(missing)}: the body is drawn up to the first of these"
        )
    rec.log("/world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    world = world_of(sources.session, sources.warnings)
    if world is not None:
        log_surroundings(rec, world)
    limit = body.log_body(rec, clock, motion)
    body.log_ghost(rec, clock, motion)
    ranges.log_ranges(rec, clock, sources.session, motion)
    if places is not None:
        markers.log_markers(rec, clock, motion, places, palette)
    if head.tracked:
        trail.log_trail(rec, clock, head)
    return head, limit


def _log_signals(
    rec: rr.RecordingStream, clock: Clock, sources: _Sources, palette: dict[str, joints.Color]
) -> tuple[Signal, ...]:
    """Every other JointState topic as it is: currents, voltages, temperatures, foreign ones."""
    found: list[Signal] = []
    for (topic, field), tracks in sources.columns.items():
        if topic in DRAWN or field != "position" or not tracks:
            continue
        names = [track.name for track in tracks]
        of_joints = bool(set(names) & set(palette))
        colors = palette if of_joints else joints.joint_palette(names)
        series = joints.log_scalars(rec, clock, f"/signals{topic}", tracks, colors)
        unit = sources.session.channels[topic].metadata.get("unit", "rad")
        found.append(Signal(f"{topic.lstrip('/')} [{unit}]", series, of_joints))
    return tuple(found)


def palette_of(robot: Robot | None, names: Sequence[str]) -> dict[str, joints.Color]:
    """Colours of the robot's joints, or of those in the log where there is no robot.

    Args:
        robot: The robot, or None.
        names: Joints in the log, head to tail.

    Returns:
        Colour by joint name; joints that the robot doesn't have are grey.
    """
    if robot is None:
        return joints.joint_palette(names)
    return dict.fromkeys(names, joints.GREY) | joints.joint_palette(robot.joint_names)


def start_of(head: HeadPath) -> Start | None:
    """Where the camera finds the robot.

    Args:
        head: The head's path.

    Returns:
        Its first known pose, or None where none is known.
    """
    known = np.flatnonzero(np.isfinite(head.position).all(axis=1))
    if not known.size:
        return None
    x, y, z = head.position[known[0]].tolist()
    forward = rotation_from_quaternion(head.quaternion[known[0]])[:, 0]
    heading = float(np.arctan2(forward[1], forward[0]))
    return Start((x, y, z), heading if np.isfinite(heading) else 0.0)


def _save(rec: rr.RecordingStream, draft: Path, path: Path) -> None:
    try:
        rec.save(draft)
    except (RuntimeError, OSError) as error:
        raise LogWriteError(path, f"can't be written: {error}") from error


def require_whole(draft: Path, path: Path) -> None:
    """Check that a recording has its footer: Rerun only logs that its disk was full.

    Args:
        draft: The file.
        path: What it will be called, for the message.

    Raises:
        LogWriteError: If it isn't whole.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            RrdReader(draft).store()
    except (RuntimeError, ValueError, Warning) as error:
        raise LogWriteError(path, "couldn't be written whole; is the disk full?") from error
