"""The gait: its phase for the timeline, its mode as coloured lanes, and events as text."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import rerun as rr

from undulog.capture import SessionView
from undulog.capture.common.errors import DataError

from ...samples.timeline import Clock, Rhythm
from ...samples.tracks import Track

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


def rhythm_of(gait: Sequence[Track]) -> Rhythm | None:
    """The phase of the plane that swings most.

    Args:
        gait: Tracks named ``<plane>.A``, ``<plane>.phase`` and so on.

    Returns:
        The rhythm, or None where there is no phase or none advances by a whole cycle.
    """
    by_name = {track.name: track for track in gait}
    found: list[tuple[float, Rhythm]] = []
    for name, track in by_name.items():
        if name.endswith(".phase"):
            rhythm = Rhythm.from_phase(track.t_ns, track.values)
            if np.ptp(rhythm.cycles) >= 1.0:
                amplitude = by_name.get(f"{name.removesuffix('.phase')}.A")
                swing = float(np.nanmax(np.abs(amplitude.values))) if amplitude else 0.0
                found.append((swing, rhythm))
    return max(found, key=lambda one: one[0], default=(0.0, None))[1]


def changes(states: Sequence[str]) -> list[int]:
    """Indices at which the state differs from the one before.

    Returns:
        Indices, the first message's included.
    """
    return [i for i, state in enumerate(states) if i == 0 or state != states[i - 1]]


def log_mode(
    rec: rr.RecordingStream, clock: Clock, session: SessionView, warnings: list[str]
) -> int:
    """Write the gait mode as a state that lasts until the next one.

    Args:
        warnings: Grows by a sentence where messages can't be read.

    Returns:
        How often a mode began.
    """
    found = _read(session, MODE, {"data": str}, warnings)
    turns = [(found[i][0], found[i][1].data) for i in changes([one.data for _, one in found])]
    log_states(rec, clock, turns)
    return len(turns)


def log_states(rec: rr.RecordingStream, clock: Clock, states: Sequence[tuple[int, str]]) -> None:
    """Write states, each lasting until the next one.

    Args:
        states: When each began [ns], and its name.
    """
    t_ns = np.array([time for time, _ in states], dtype=np.int64)
    names = [name for _, name in states]
    for rows, times in clock.rows(t_ns):
        rec.send_columns(MODE, times, rr.StateChange.columns(state=names[rows]))


def log_events(
    rec: rr.RecordingStream, clock: Clock, session: SessionView, warnings: list[str]
) -> bool:
    """Write events and faults from ``/rosout``.

    Args:
        warnings: Grows by a sentence where messages can't be read.
    """
    events = _read(session, "/rosout", {"name": str, "msg": str, "level": int}, warnings)
    log_lines(rec, clock, events)
    return bool(events)


def log_lines(rec: rr.RecordingStream, clock: Clock, events: Sequence[tuple[int, Any]]) -> None:
    """Write events as lines of text.

    Args:
        events: When each happened [ns], and its ``rcl_interfaces/msg/Log``.
    """
    lines = [(t_ns, f"{one.name}: {one.msg}" if one.name else one.msg) for t_ns, one in events]
    levels = [_LEVELS.get(event.level, INFO) for _, event in events]
    log_texts(rec, clock, EVENTS, lines, levels)


def log_texts(
    rec: rr.RecordingStream,
    clock: Clock,
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
    found: list[tuple[int, Any]] = []
    if topic in session.channels:
        try:
            found.extend(session.messages(topic))
        except DataError as error:
            warnings.append(f"{topic}: shown up to a message that can't be read: {error}")
    for name, kind in fields.items():
        if found and not isinstance(getattr(found[0][1], name, None), kind):
            warnings.append(f"{topic}: not shown: its schema has no field {name} ({kind.__name__})")
            return []
    return found
