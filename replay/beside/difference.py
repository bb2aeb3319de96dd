"""B minus A, joint by joint, at A's own sampling times."""

from __future__ import annotations

import numpy as np

from ..sampling import interpolate
from ..tracks import Track
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
