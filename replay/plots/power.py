"""Power: what the joints give to the body, and what the motors take from the battery."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import rerun as rr

from ..samples.sampling import interpolate, mark_gaps
from ..samples.timeline import Clock
from ..samples.tracks import Columns, Track
from .joints import log_rows

MECHANICAL = "/power/mechanical"
TOTAL = "/power/total"

# Vermilion as on the body; violet is on no other map and reads on black and on white.
_COLORS = {"mechanical": (255, 84, 48, 255), "electrical": (150, 124, 230, 255)}


def mechanical_power(columns: Columns) -> tuple[Track, ...]:
    """Power at the joints, tau q', at the sampling times of the efforts.

    Args:
        columns: The session's columns.

    Returns:
        A track [W] for each joint with effort and velocity; positive where the joint drives.
    """
    return products(
        columns.get(("/joint_states", "effort"), ()), columns.get(("/joint_states", "velocity"), ())
    )


def electrical_power(columns: Columns) -> tuple[Track, ...]:
    """Power of the motors, u i, at the sampling times of the currents.

    Args:
        columns: The session's columns.

    Returns:
        A track [W] for each joint with current and voltage.
    """
    return products(
        columns.get(("/joint_current", "position"), ()),
        columns.get(("/joint_voltage", "position"), ()),
    )


def products(first: Sequence[Track], second: Sequence[Track]) -> tuple[Track, ...]:
    """Product of two quantities of each joint.

    Args:
        first: Gives the sampling times.
        second: Taken at those times.

    Returns:
        A track for each joint that has both; NaN where either is missing.
    """
    other = {track.name: track for track in second}
    return tuple(
        Track(
            track.name,
            track.t_ns,
            track.values
            * interpolate(other[track.name].t_ns, other[track.name].values, track.t_ns),
        )
        for track in first
        if track.name in other
    )


def total(tracks: Sequence[Track]) -> Track | None:
    """Sum over the joints, at the first joint's sampling times.

    Args:
        tracks: The joints' power [W].

    Returns:
        The sum [W], NaN where any joint's power is missing; None without joints.
    """
    if not tracks:
        return None
    t_ns = tracks[0].t_ns
    parts = [interpolate(track.t_ns, track.values, t_ns) for track in tracks]
    return Track("total", t_ns, np.sum(parts, axis=0))


def log_total_look(rec: rr.RecordingStream, kind: str) -> None:
    """Say how the line of one kind of the body's power is drawn.

    Args:
        rec: The recording.
        kind: ``mechanical`` or ``electrical``.
    """
    look = rr.SeriesLines(names=kind, colors=_COLORS[kind], widths=1.5)
    rec.log(f"{TOTAL}/{kind}", look, static=True)


def log_sum(rec: rr.RecordingStream, clock: Clock, kind: str, whole: Track) -> None:
    """Write one kind of the body's power.

    Args:
        rec: The recording.
        clock: Its timelines.
        kind: ``mechanical`` or ``electrical``.
        whole: The body's power [W].
    """
    log_total_look(rec, kind)
    t_ns, values = mark_gaps(whole.t_ns, whole.values[:, None])
    log_rows(rec, clock, f"{TOTAL}/{kind}", t_ns, values)
