"""Lines of the joints, the gait's mode as coloured lanes, and events as text.

``/joints/commanded``, ``/joints/measured`` and ``/joints/error`` hold the angles of all joints in a
row, in degrees, as the component ``Angle:degrees``. Joints that were sampled at times of their own
get an entity each below these, named after the first joint of those sampled together. All values
are 32-bit: the recording is for looking at, and the session keeps what was logged.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import rerun as rr
from rerun.components import InterpolationMode
from rerun.encodings import Float32Batch

from undulog.capture import SessionView
from undulog.capture.common.arrays import FloatArray, IntArray
from undulog.capture.common.errors import DataError
from undulog.capture.common.palette import joint_colors
from undulog.capture.robot.model import Plane, Robot

from ..samples.content import GREY, SCALARS, TOTAL, BodyPlaces, Color, line_title
from ..samples.timeline import LoggedRhythm, TimeColumns
from ..samples.tracks import Track, rounded

PLACES = "/joints/places"
DEGREES = "Angle:degrees"

_DESCRIPTORS = {
    DEGREES: rr.ComponentDescriptor(DEGREES, archetype="Angle"),
    # Without a type, which would have to be 64-bit: the viewer plots either.
    SCALARS: rr.ComponentDescriptor(SCALARS, archetype="rerun.archetypes.Scalars"),
}

# Vermilion as on the body; violet is on no other map and reads on black and on white.
_COLORS = {"mechanical": (255, 84, 48, 255), "electrical": (150, 124, 230, 255)}

MODE = "/gait/mode"
EVENTS = "/events"

INFO = rr.TextLogLevel.INFO

# Levels of rcl_interfaces/msg/Log.
_LEVELS = {
    10: rr.TextLogLevel.DEBUG,
    20: INFO,
    30: rr.TextLogLevel.WARN,
    40: rr.TextLogLevel.ERROR,
    50: rr.TextLogLevel.CRITICAL,
}


def joint_palette(names: Sequence[str]) -> dict[str, Color]:
    """Return the colour of each joint, the same in all views.

    Args:
        names: All joints, head to tail.

    Returns:
        sRGB and opacity by joint name.
    """
    colors: list[list[int]] = joint_colors(len(names)).tolist() if names else []
    return {name: (r, g, b, a) for name, (r, g, b, a) in zip(names, colors, strict=True)}


def head_middle_tail(robot: Robot | None, moving: Sequence[Track]) -> BodyPlaces | None:
    """Choose the joints that stand for the whole body.

    Args:
        robot: The robot; without it all joints count as one plane.
        moving: Angles that determine the busiest plane: commands, or else measurements [rad].

    Returns:
        First, middle and last joint of the plane that moves most, or None without joints.
    """
    swing = {track.name: float(np.nanstd(track.values)) for track in moving}
    if not swing:
        return None
    if robot is None:
        names, plane = tuple(swing), None
    else:
        planes = {plane: [j.name for j in robot.joints if j.plane is plane] for plane in Plane}
        plane = max(Plane, key=lambda p: max((swing.get(n, -1.0) for n in planes[p]), default=-1.0))
        names = tuple(name for name in planes[plane] if name in swing) or tuple(swing)
    return BodyPlaces(tuple(dict.fromkeys((names[0], names[len(names) // 2], names[-1]))), plane)


def places_look(places: BodyPlaces, kind: str) -> dict[str, Any]:
    """Return names and width of the lines of head, middle and tail, for :func:`log_look`.

    Args:
        kind: ``measured`` or ``commanded``.
    """
    measured = kind == "measured"
    labels = places.labelled.items()
    titles = {name: line_title(name, label if measured else "command") for name, label in labels}
    return {"titles": titles, "width": 2.0 if measured else 1.0}


def part_entities(entity: str, parts: Sequence[Sequence[str]]) -> list[str]:
    """Return the entities of joints that were sampled at times of their own.

    Args:
        entity: E.g. ``/joints/measured``.
        parts: Joints that were sampled together.

    Returns:
        A path for each part: the entity where there is one only, else below it by the first joint.
    """
    if len(parts) == 1:
        return [entity]
    return [f"{entity}/{rr.escape_entity_path_part(part[0])}" for part in parts]


def log_look(
    rec: rr.RecordingStream,
    entity: str,
    names: Sequence[str],
    palette: Mapping[str, Color] | None,
    *,
    titles: Mapping[str, str] | None = None,
    width: float | None = None,
    steps: bool = False,
) -> None:
    """Write the style of an entity's lines.

    Args:
        names: Joints, a line each.
        palette: Colour by joint name; None for grey.
        titles: Lines' names by joint name; None for the joints' own.
        width: Of the lines [points]; None for the viewer's own.
        steps: Whether a value holds until the next one.
    """
    look = rr.SeriesLines(
        names=[name if titles is None else titles.get(name, name) for name in names],
        colors=[GREY if palette is None else palette.get(name, GREY) for name in names],
        widths=None if width is None else [width] * len(names),
        interpolation_mode=InterpolationMode.StepAfter if steps else None,
    )
    rec.log(entity, look, static=True)


def log_rows(
    rec: rr.RecordingStream,
    clock: TimeColumns,
    entity: str,
    t_ns: IntArray,
    values: FloatArray,
    *,
    degrees: bool = False,
    component: str = SCALARS,
    steps: FloatArray | None = None,
) -> None:
    """Write rows of lines.

    Args:
        t_ns: Their times [ns], shape (n,).
        values: Shape (n, k); NaN ends a line.
        degrees: Whether they are angles [rad], to be plotted in degrees.
        component: ``Scalars:scalars``, or ``Angle:degrees`` for all joints' angles.
        steps: What each line is rounded to, as it is plotted, shape (k,); None for nothing.
    """
    shown = np.rad2deg(values) if degrees else values
    if steps is not None:
        shown = rounded(shown, steps)
    packed = shown.astype(np.float32)
    for rows, times in clock.rows(t_ns):
        column = rr.ComponentColumn(_DESCRIPTORS[component], Float32Batch(packed[rows].ravel()))
        size = np.full(rows.stop - rows.start, values.shape[1])
        rec.send_columns(entity, times, [column.partition(size)])


def log_total_look(rec: rr.RecordingStream, kind: str) -> None:
    """Write the style of one kind of the body's power.

    Args:
        kind: ``mechanical`` or ``electrical``.
    """
    look = rr.SeriesLines(names=kind, colors=_COLORS[kind], widths=1.5)
    rec.log(f"{TOTAL}/{kind}", look, static=True)


def rhythm_of(gait: Sequence[Track]) -> LoggedRhythm | None:
    """Return the phase of the plane that swings most.

    Args:
        gait: Tracks named ``<plane>.A``, ``<plane>.phase`` and so on.

    Returns:
        The rhythm, or None where there is no phase or none advances by a whole cycle.
    """
    by_name = {track.name: track for track in gait}
    rhythms: list[tuple[float, LoggedRhythm]] = []
    for name, track in by_name.items():
        if name.endswith(".phase"):
            rhythm = LoggedRhythm.from_phase(track.t_ns, track.values)
            if np.ptp(rhythm.cycles) >= 1.0:
                amplitude = by_name.get(f"{name.removesuffix('.phase')}.A")
                swing = float(np.nanmax(np.abs(amplitude.values))) if amplitude else 0.0
                rhythms.append((swing, rhythm))
    return max(rhythms, key=lambda pair: pair[0], default=(0.0, None))[1]


def changes(states: Sequence[str]) -> list[int]:
    """Return the indices at which the state differs from the one before.

    Returns:
        Indices, the first message's included.
    """
    return [i for i, state in enumerate(states) if i == 0 or state != states[i - 1]]


def log_mode(
    rec: rr.RecordingStream, clock: TimeColumns, session: SessionView, warnings: list[str]
) -> int:
    """Write the gait mode as a state that lasts until the next one.

    Args:
        warnings: Grows by a sentence where messages can't be read.

    Returns:
        How often a mode began.
    """
    modes = _read(session, MODE, {"data": str}, warnings)
    turns = [(modes[i][0], modes[i][1].data) for i in changes([mode.data for _, mode in modes])]
    log_states(rec, clock, turns)
    return len(turns)


def log_states(
    rec: rr.RecordingStream, clock: TimeColumns, states: Sequence[tuple[int, str]]
) -> None:
    """Write states, each lasting until the next one.

    Args:
        states: When each began [ns], and its name.
    """
    t_ns = np.array([time for time, _ in states], dtype=np.int64)
    names = [name for _, name in states]
    for rows, times in clock.rows(t_ns):
        rec.send_columns(MODE, times, rr.StateChange.columns(state=names[rows]))


def log_events(
    rec: rr.RecordingStream, clock: TimeColumns, session: SessionView, warnings: list[str]
) -> bool:
    """Write events and faults from ``/rosout``.

    Args:
        warnings: Grows by a sentence where messages can't be read.
    """
    events = _read(session, "/rosout", {"name": str, "msg": str, "level": int}, warnings)
    log_lines(rec, clock, events)
    return bool(events)


def log_lines(
    rec: rr.RecordingStream, clock: TimeColumns, events: Sequence[tuple[int, Any]]
) -> None:
    """Write events as lines of text.

    Args:
        events: When each happened [ns], and its ``rcl_interfaces/msg/Log``.
    """
    lines = [
        (t_ns, f"{event.name}: {event.msg}" if event.name else event.msg) for t_ns, event in events
    ]
    log_texts(rec, clock, EVENTS, lines, [_LEVELS.get(event.level, INFO) for _, event in events])


def log_texts(
    rec: rr.RecordingStream,
    clock: TimeColumns,
    entity: str,
    lines: Sequence[tuple[int, str]],
    levels: Sequence[rr.TextLogLevel],
) -> None:
    """Write lines of text, each at its time [ns]."""
    for rows, times in clock.rows(np.array([t_ns for t_ns, _ in lines], dtype=np.int64)):
        texts = [text for _, text in lines[rows]]
        rec.send_columns(entity, times, rr.TextLog.columns(text=texts, level=levels[rows]))


def _read(
    session: SessionView, topic: str, fields: Mapping[str, type], warnings: list[str]
) -> list[tuple[int, Any]]:
    """Log time [ns] and message, up to the first one that is damaged; none without the fields."""
    messages: list[tuple[int, Any]] = []
    if topic in session.channels:
        try:
            messages.extend(session.messages(topic))
        except DataError as error:
            warnings.append(f"{topic}: shown up to a message that can't be read: {error}")
    for name, kind in fields.items():
        if messages and not isinstance(getattr(messages[0][1], name, None), kind):
            warnings.append(f"{topic}: not shown: its schema has no field {name} ({kind.__name__})")
            return []
    return messages
