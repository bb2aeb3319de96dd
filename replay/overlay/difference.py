"""B minus A, joint by joint, at A's own sampling times."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import rerun as rr

from ..content.entities import Series
from ..draw.plots.joints import log_table, part_entity
from ..samples.sampling import interpolate
from ..samples.tracks import Track, brought_together
from .alignment import Align, Aligned, counterparts


def angle_differences(a: Aligned, b: Aligned, how: Align) -> tuple[Track, ...]:
    """Measured angles of one session minus those of another.

    Args:
        a: The session that is subtracted, and whose times count.
        b: The other one.
        how: What happens at once.

    Returns:
        A track [rad] for each joint that both have; ``b`` is taken on the straight line between
        its samples, NaN where it has none.
    """
    other = {track.name: track for track in b.side.measured}
    return tuple(
        Track(track.name, track.t_ns, _taken(a, b, how, track, other[track.name]) - track.values)
        for track in a.side.measured
        if track.name in other
    )


def _taken(a: Aligned, b: Aligned, how: Align, track: Track, other: Track) -> np.ndarray:
    at_ns, known = counterparts(a, b, how, track.t_ns)
    values = np.full(track.t_ns.size, np.nan)
    values[known] = interpolate(other.t_ns, other.values, at_ns[known])
    return values


def log_differences(
    rec: rr.RecordingStream,
    a: Aligned,
    entity: str,
    differences: Sequence[Track],
    drawn: Sequence[Series],
) -> tuple[Series, ...]:
    """Write differences as the angles of the session that was subtracted are drawn.

    Args:
        rec: The recording.
        a: The session that was subtracted.
        entity: Where to.
        differences: The differences [rad].
        drawn: Its measured angles; joints of one series are drawn at common times.

    Returns:
        What was written.
    """
    known = {track.name: track for track in differences}
    parts = [[known[name] for name in one.names if name in known] for one in drawn]
    parts = [part for part in parts if part]
    return tuple(
        log_table(
            rec,
            a.clock,
            entity if len(parts) == 1 else part_entity(entity, part[0].name),
            brought_together(part),
            a.side.palette,
            degrees=True,
        )
        for part in parts
    )
