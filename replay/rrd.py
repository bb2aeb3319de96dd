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

from analysis.cycles import CycleMaps
from analysis.results.analysis import Analysis
from capture import Session
from capture.errors import DataError, LogWriteError
from capture.part_file import part_file
from capture.robot import Robot
from capture.robot.kinematics import rotation_from_quaternion

from . import facts
from .blueprint import build_blueprint
from .content import Content, Signal, Start, signal_title
from .cycles.heat_maps import heat_maps, log_maps
from .cycles.mean_cycle import (
    Look,
    averaged_ns,
    log_mean_cycle,
    read_channels,
)
from .cycles.steps import cycle_tables, log_cycles
from .layer import Layer, Named
from .plots import gait, joints, power
from .plots.other_topics import log_others, log_words
from .plots.response import charts, log_charts, log_current
from .plots.write import Plots
from .samples.stretches import stretches
from .samples.survey import GAIT, Survey, survey
from .samples.timeline import Clock
from .samples.tracks import Track, read_columns
from .scene.motion import BODY_RATE_HZ, HeadPath, read_head
from .scene.stage import Scene
from .views import body_title

APPLICATION = "undulog"

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
    """What is known of the session before anything is drawn."""

    session: Session
    found: Survey
    warnings: list[str]

    @property
    def measured(self) -> tuple[Track, ...]:
        """Some samples of each measured angle [rad]."""
        return self.found.samples.get(joints.MEASURED, ())

    @property
    def commanded(self) -> tuple[Track, ...]:
        """Some samples of each commanded angle [rad]."""
        return self.found.samples.get(joints.COMMANDED, ())


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
    steady: CycleMaps | None = None,
    named: Sequence[Named] = (),
    notes: Sequence[str] = (),
    layout: Callable[[Content], rrb.Blueprint] = build_blueprint,
) -> Recording:
    """Convert a session.

    Args:
        session: The session, open.
        path: Where the .rrd file goes; an existing one is replaced when the new one is whole.
        analysis: The session's analysis, for the response bars and the cycles; None leaves them
            out.
        steady: The cycles of its steady gait, for a session whose phase was not logged.
        named: Modules that tests name, to be marked.
        notes: What the caller has to say about the session, a sentence each.
        layout: Makes the blueprint from what the recording holds.

    Returns:
        What was written.

    Raises:
        DataError: If the session holds nothing that can be drawn.
        LogWriteError: If the file can't be written.
    """
    rr.set_strict_mode(True)
    layer = Layer(analysis, steady, tuple(named))
    sources = _read(session)
    rhythm = gait.rhythm_of(_gait_tracks(session))
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
            content = _log(rec, clock, sources, layer)
            told = tuple(dict.fromkeys([*notes, *sources.warnings, *session.warnings]))
            text = facts.markdown(
                session,
                analysis,
                notes=told,
                colors=body_title(content),
                content=content,
                named=layer.named,
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
    found = survey(session, BODY_RATE_HZ)
    missing: list[str] = []
    if session.robot is None:
        missing.append("no robot description in the session: the body can't be drawn")
    if joints.MEASURED not in found.samples:
        missing.append("no measured joint angles on /joint_states")
    return _Sources(session, found, warnings=missing)


def _gait_tracks(session: Session) -> tuple[Track, ...]:
    if GAIT not in session.channels:
        return ()
    return read_columns(session, {GAIT: ["position"]}).get((GAIT, "position"), ())


def _log(
    rec: rr.RecordingStream,
    clock: Clock,
    sources: _Sources,
    layer: Layer,
) -> Content:
    """Write everything but the facts."""
    analysis, named = layer.analysis, [one.joint for one in layer.named]
    session, robot = sources.session, sources.session.robot
    moving = sources.measured or sources.commanded
    palette = palette_of(robot, [track.name for track in moving])
    places = joints.head_middle_tail(robot, sources.commanded or sources.measured)
    plots = Plots(rec, clock, sources.found, places, palette)
    head, scene = _open_scene(rec, clock, sources, places, palette)
    if scene is not None:
        scene.named = named
    session.forget()
    limit = None if head is None else sources.found.power_limit_w
    for stretch in stretches(session, sources.found.wanted, sources.found.context_ns):
        plots.write(stretch)
        if scene is not None:
            scene.write(stretch)
        rec.flush()  # what is drawn is written before more is read
    found = charts(analysis) if analysis is not None else ()
    tables = cycle_tables(analysis, layer.steady) if analysis is not None else ()
    maps = heat_maps(analysis, tables, tuple(palette)) if analysis is not None else ()
    log_charts(rec, found, palette, named)
    log_current(rec, clock, found, tables)
    log_maps(rec, clock, maps, named)
    return Content(
        robot=robot,
        start=None if head is None else start_of(head),
        power_limit_w=limit,
        places=places,
        commanded=plots.series(joints.COMMANDED),
        measured=plots.series(joints.MEASURED),
        errors=plots.series(joints.ERROR),
        has_power=any(entity.startswith(power.TOTAL) for entity in sources.found.samples),
        joint_power=plots.series(power.MECHANICAL),
        charts=found,
        modes=gait.log_mode(rec, clock, session, sources.warnings),
        has_events=any(
            (
                gait.log_events(rec, clock, session, sources.warnings),
                log_words(rec, clock, session),
            )
        ),
        signals=(
            *_signals(session, plots, palette),
            *log_others(rec, clock, session, sources.warnings),
        ),
        cycles=log_cycles(rec, clock, tables, palette),
        maps=maps,
        mean=log_mean_cycle(
            rec,
            clock,
            read_channels(session, sources.found.wanted, averaged_ns(clock, analysis)),
            Look(robot, places, palette, limit),
            analysis=analysis,
            warnings=sources.warnings,
        ),
    )


def _open_scene(
    rec: rr.RecordingStream,
    clock: Clock,
    sources: _Sources,
    places: joints.Places | None,
    palette: dict[str, joints.Color],
) -> tuple[HeadPath | None, Scene | None]:
    """The 3D scene, where there is a robot whose joints were measured."""
    robot, measured = sources.session.robot, sources.measured
    if robot is None or not measured:
        return None, None
    times = Track(measured[0].name, sources.found.drawing_ns, np.zeros(0))
    head = read_head(sources.session, robot, [times], sources.warnings)
    missing = [name for name in robot.joint_names if name not in {one.name for one in measured}]
    if missing:
        sources.warnings.append(
            f"no angles of {', '.join(missing)}: the body is drawn up to the first of these"
        )
    scene = Scene(
        rec,
        clock,
        sources.session,
        robot,
        head,
        places=places,
        palette=palette,
        limit_w=sources.found.power_limit_w,
        warnings=sources.warnings,
    )
    return head, scene


def _signals(
    session: Session, plots: Plots, palette: dict[str, joints.Color]
) -> tuple[Signal, ...]:
    """Every other JointState topic as it is: currents, voltages, temperatures, foreign ones."""
    found: list[Signal] = []
    for topic, series in plots.signals.items():
        unit = session.channels[topic].metadata.get("unit", "rad")
        of_joints = any(name in palette for one in series for name in one.names)
        found.append(Signal(signal_title(topic, unit), series, of_joints))
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
