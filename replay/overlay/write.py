"""Sessions side by side as one Rerun recording.

Recordings of several sessions as one stream of chunks: columns are moved, never rows.

Every entity gets its session's name in front, and a session whose zero isn't that of its own
recording is moved along the timelines.
"""

from __future__ import annotations

import itertools
import tempfile
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from enum import StrEnum
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import rerun as rr
from rerun.chunk import Chunk, LazyChunkStream, RrdReader

from undulog.analysis.compare.compare import Choices, compare_fitted
from undulog.analysis.compare.side import ComparedSession, changes
from undulog.capture import Session, SessionView
from undulog.capture.common.errors import UndulogError
from undulog.capture.common.files import check_stop
from undulog.capture.common.process import StopRequest
from undulog.capture.log.read.joint_topics import COMMAND_TOPIC, RESPONSE_TOPIC

from ..draw.body import body_title
from ..draw.drawing import log_facts
from ..draw.plots import Plot
from ..recording import Recording, recording_file, recording_id
from ..samples.content import Color
from ..samples.timeline import GAIT_CYCLE, SESSION_TIME
from ..samples.tracks import Track, decimate
from ..stream import BoundedStream
from . import draw
from . import layout as words
from .layout import SEPARATE, Found, SessionContent, build_blueprint
from .sessions import (
    Align,
    Placement,
    Side,
    align,
    convert,
    head_distance,
    names_of,
    placement,
    placement_text,
    read_side,
)

_ARROW: Any = pa  # comes without types
_CHUNK: Any = Chunk
_AHEAD = 32  # chunks that may wait to be written

_PROPERTIES = "/__properties/**"

ANGLES = "/angles"
"""Differences of the measured angles, below a session's own path."""

_APART_RATE_HZ = 25.0


def chunks_of(
    recording: Path, entity: str, *, later_ns: int = 0, more_cycles: int = 0
) -> LazyChunkStream:
    """Return a recording's chunks under a path of their own.

    Args:
        entity: Path to put in front of every entity's, e.g. ``/twin``.
        later_ns: Added to ``session_time`` [ns].
        more_cycles: Added to ``gait_cycle``.

    Returns:
        The stream, which reads when it is used. The recording's own properties are left out.
    """
    moves = {SESSION_TIME: later_ns, GAIT_CYCLE: more_cycles * 1_000_000_000}

    def placed(chunk: Chunk) -> Chunk:
        chunk = chunk.with_entity_path(f"{entity}{chunk.entity_path}")
        return chunk if chunk.is_static or not any(moves.values()) else _moved(chunk, moves)

    return RrdReader(recording).stream().drop(content=_PROPERTIES).map(placed)


def send(rec: BoundedStream, streams: Sequence[LazyChunkStream]) -> None:
    """Write chunks as they are read.

    Left to itself the reader runs ahead of the writer, and hours of chunks, unpacked, wait in
    between; so now and then it waits until all are written.
    """
    count = itertools.count(1)
    read = 0

    def waiting(chunk: Chunk) -> Chunk:
        nonlocal read
        read = next(count)
        if read % _AHEAD == 0:
            rec.flush()
        return chunk

    rec.send_stream(LazyChunkStream.merge(*streams).map(waiting), lambda: read)


def _moved(chunk: Any, moves: dict[str, int]) -> Chunk:
    """Shift a chunk along its timelines; rows that aren't on one stay off it."""
    batch = chunk.to_record_batch()
    for timeline, by in moves.items():
        place = batch.schema.get_field_index(timeline)
        if place >= 0 and by:
            field = batch.schema.field(place)
            later = batch.column(place).to_numpy() + np.timedelta64(by, "ns")
            batch = batch.set_column(place, field, _ARROW.array(later, field.type))
    (moved,) = _CHUNK.from_record_batch(batch)
    return moved


class Place(StrEnum):
    """Where the bodies are drawn."""

    START = "start"
    """Where the first one starts."""

    WORLD = "world"
    """At the poses of their own sessions."""


@dataclass(frozen=True)
class Converted:
    """A session, its recording and its input of a comparison.

    Attributes:
        side: The session and its place on the timelines.
        seen: Its input of a comparison, or None where it can't be analysed.
    """

    side: Side
    recording: Recording
    seen: ComparedSession | None


@dataclass(frozen=True)
class Overlay:
    """What was written.

    Attributes:
        recording_id: Follows from the sessions' ids and names, and how they are aligned and placed.
        shown: What it holds of each session.
        outcomes: Result of the comparison with the first session, by the others' names.
        placements: How bodies are moved, by name; those that aren't are left out.
        warnings: What is missing or was assumed, a sentence each.
    """

    path: Path
    recording_id: str
    shown: tuple[SessionContent, ...]
    outcomes: Mapping[str, Found]
    placements: Mapping[str, Placement]
    warnings: tuple[str, ...]


def write_overlay(
    sessions: Sequence[Converted],
    path: Path,
    how: Align,
    *,
    place: Place = Place.START,
    stop: StopRequest | None = None,
) -> Overlay:
    """Combine converted sessions in one recording.

    Args:
        sessions: Two or more; differences are from the first.
        path: Where the .rrd file goes; an existing one is replaced when the new one is whole.
        place: Where the bodies are drawn.
        stop: Checked now and then; once a stop is requested, nothing is written.

    Raises:
        LogWriteError: If the file can't be written, or a stop is requested.
    """
    sides = [session.side for session in sessions]
    warnings = [
        f"{session.side.name}: {text}"
        for session in sessions
        for text in session.recording.warnings
    ]
    outcomes = {session.side.name: _compare(sessions[0], session) for session in sessions[1:]}
    for name, outcome in outcomes.items():
        warnings += [f"{name} (B): {text}" if len(outcomes) > 1 else text for text in outcome.notes]
    placements = _placements(sessions, how, place, warnings)
    names = [side.name for side in sides]
    identity = recording_id("\n".join([*(side.session_id for side in sides), *names, how, place]))
    with recording_file(path, identity, ", ".join(names), sides[0].start_ns, stop) as rec:
        check_stop(path, stop)
        send(rec, [_chunks(session) for session in sessions])
        check_stop(path, stop)
        shown = _log(rec, sessions, outcomes, placements, how)
        seen = [(session.side, session.seen) for session in sessions if session.seen is not None]
        quantities = draw.log_bars(rec, seen)
        title = _title(shown)
        text = words.markdown(
            sides,
            outcomes,
            how,
            has_cycles=any(side.rhythm is not None for side in sides),
            legend=_legend(shown, title),
            notes=warnings,
        )
        log_facts(rec, text, words.FACTS)
        rec.send_blueprint(build_blueprint(shown, quantities, how, title))
    return Overlay(path, identity, shown, outcomes, placements, tuple(dict.fromkeys(warnings)))


def _chunks(session: Converted) -> LazyChunkStream:
    """Return a session's own recording under its name and on the common timelines."""
    side = session.side
    later_ns = side.start_ns - side.zero_ns
    return chunks_of(
        session.recording.path, side.entity, later_ns=later_ns, more_cycles=side.cycles
    )


def _compare(first: Converted, other: Converted) -> Found:
    changed = changes([first.side.facts], [other.side.facts])
    if first.seen is None or other.seen is None:
        without = first if first.seen is None else other
        return Found(None, f"not compared, since {without.side.name} has no analysis", changed)
    try:
        comparison = compare_fitted([first.seen], [other.seen], Choices(any_gait=True))
    except UndulogError as error:
        return Found(None, f"not compared: {error}", changed)
    return Found(comparison, None, changed)


def _placements(
    sessions: Sequence[Converted], how: Align, place: Place, warnings: list[str]
) -> dict[str, Placement]:
    """Return the placements of the other bodies onto the first one; append a warning for each."""
    bodies = [session.side for session in sessions if session.recording.content.start is not None]
    placements: dict[str, Placement] = {}
    for body in bodies[1:] if place is Place.START else ():
        placed, first = placement(bodies[0], body, how), bodies[0].name
        text = f"{body.name} and {first} have no body at a shared moment: each in its own world"
        if placed is not None:
            placements[body.name], text = placed, placement_text(placed, body.name, first)
        warnings.append(text)
    if len(bodies) > 1 and place is Place.WORLD:
        warnings.append("every body is drawn at the pose of its own session")
    return placements


def _log(
    rec: rr.RecordingStream,
    sessions: Sequence[Converted],
    outcomes: Mapping[str, Found],
    placements: Mapping[str, Placement],
    how: Align,
) -> tuple[SessionContent, ...]:
    """Write the entities that aren't in the sessions' own recordings."""
    rec.log("/", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    a, content = sessions[0].side, sessions[0].recording.content
    shown = [SessionContent(a, content, draw.log_lines(rec, a, 0, content.places))]
    for rank, session in enumerate(sessions[1:], start=1):
        b, other = session.side, session.recording.content
        placed = placements.get(b.name, Placement())
        lines = draw.log_lines(rec, b, rank, draw.places_in(b, content.places, other.places))
        angles = draw.angle_differences(a, b, how)
        angles = draw.log_differences(rec, a, f"{b.compared}{ANGLES}", angles, content.measured)
        apart = _log_apart(rec, (a, b), how, placed, draw.tint(rank))
        bars = draw.log_difference_bars(rec, a, b, outcomes[b.name].comparison)
        shown.append(SessionContent(b, other, lines, angles, apart, bars))
    bodies = [session.side for session in shown if session.body]
    for rank, side in enumerate(bodies):
        _log_body(rec, side, rank, placements)
    draw.log_ends(rec, bodies)
    draw.log_power_names(
        rec, {k: session.side for k, session in enumerate(shown) if session.content.has_power}
    )
    return tuple(shown)


def _log_apart(
    rec: rr.RecordingStream,
    pair: tuple[Side, Side],
    how: Align,
    placed: Placement,
    color: Color,
) -> bool:
    """Write the distance of the heads, if both were tracked."""
    a, b = pair
    head, other = a.head, b.head
    if head is None or other is None or not (head.tracked and other.tracked):
        return False
    t_ns = head.t_ns[decimate(head.t_ns, _APART_RATE_HZ)]
    apart = head_distance(a, b, how, placed, t_ns)
    drawn = bool(np.isfinite(apart).any())
    if drawn:
        name = f"{b.name}, {a.name}"
        plot = Plot(f"{b.compared}{SEPARATE}", [(name,)])
        plot.style(rec, {name: color})
        plot.write(rec, a.clock, [Track(name, t_ns, apart)])
    return drawn


def _log_body(
    rec: rr.RecordingStream, side: Side, rank: int, placements: Mapping[str, Placement]
) -> None:
    if side.head is None or side.robot is None:
        return
    draw.log_name(rec, side, rank, side.head, side.robot)
    if rank:
        draw.log_wireframe(rec, side.entity, rank, side.robot)
    if side.name in placements:
        draw.log_placement(rec, side.entity, placements[side.name])


def _title(shown: Sequence[SessionContent]) -> str:
    """Return the name of the bodies' view, which names the sessions."""
    first, *others = [session.side.name for session in shown if session.body] or [""]
    if not others:
        return f"{first}; the others have no body" if first else ""
    return f"{first} solid, {' and '.join(others)} as wireframe"


def _legend(shown: Sequence[SessionContent], title: str) -> str:
    bodies = [session for session in shown if session.body]
    if not bodies:
        return "No session has the data to draw a body."
    scale = body_title(bodies[0].content)
    return (
        f"{title}. {scale}. The grey wireframe and lines are commanded, of {shown[0].side.name}. "
        f"In the plots {shown[0].side.name} is solid, the others are dashed."
    )


def combine_sessions(
    files: Sequence[Path],
    path: Path,
    *,
    topics: tuple[str, str] = (COMMAND_TOPIC, RESPONSE_TOPIC),
    robot: str | None = None,
    names: Sequence[str] | None = None,
    how: Align = Align.TIME,
    place: Place = Place.START,
    on_step: Callable[[int, str], None] = lambda _done, _note: None,
    stop: StopRequest | None = None,
) -> Overlay:
    """Convert sessions and combine them in one recording.

    Args:
        files: Two or more sessions; differences are from the first.
        path: Where the .rrd file goes; an existing one is replaced when the new one is whole.
        topics: Of commands and responses.
        robot: Description for logs without one.
        names: What they are called, or None for the files' names.
        place: Where the bodies are drawn.
        on_step: Called before each of :func:`steps` with how many are done, and what comes.
        stop: Checked now and then; once a stop is requested, nothing is written.

    Raises:
        UsageError: If the names don't fit, or a session has no gait to be aligned by.
        LogError: If a session can't be read, or the file can't be written.
        DataError: If a session holds nothing that can be drawn.
    """
    done = itertools.count()

    def step(note: str) -> None:
        check_stop(path, stop)
        on_step(next(done), note)

    called = names_of(files, names)
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="undulog-beside-")))
        pairs: list[tuple[SessionView, str]] = []
        for file, name in zip(files, called, strict=True):
            opened = Session.open(file, column_folder=folder, robot=robot)
            session = stack.enter_context(opened)
            session = session.with_joints(*topics)
            pairs.append((session.view(on_read=partial(check_stop, path, stop)), name))
        step("angles")
        # Aligned before the long part, since that may refuse.
        aligned = align([read_side(session, name) for session, name in pairs], how)
        converted: list[Converted] = []
        for k, ((session, name), side) in enumerate(zip(pairs, aligned, strict=True)):
            step(f"recording of {name}")
            converted.append(Converted(side, *convert(session, folder / f"{k}.rrd")))
        step("side by side")
        return write_overlay(converted, path, how, place=place, stop=stop)


def steps(count: int) -> int:
    """Return the number of steps."""
    return count + 2
