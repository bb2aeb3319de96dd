"""Where the head has been: a line on the ground behind it."""

from __future__ import annotations

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from undulog.capture.common.arrays import FloatArray, IntArray

from ...samples.sampling import decimate, gaps
from ...samples.stretches import Span
from ...samples.timeline import Clock
from .motion import HeadPath

TRAIL = "/world/trail"
TRAIL_RATE_HZ = 10.0
TRAIL_SECONDS = 20.0

_COLOR = (104, 108, 128, 255)
_WHOLE = Span()


def trail_segments(t_ns: IntArray, position: FloatArray) -> tuple[IntArray, NDArray[np.float32]]:
    """Straight pieces between successive head positions.

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


def log_trail(rec: rr.RecordingStream, clock: Clock, head: HeadPath, span: Span = _WHOLE) -> None:
    """Draw the head's path; the view shows its last 20 s.

    Args:
        rec: The recording.
        clock: Its timelines.
        head: The head's path.
        span: The part that is drawn.
    """
    chosen = decimate(head.t_ns, TRAIL_RATE_HZ)
    t_ns, pieces = trail_segments(head.t_ns[chosen], head.position[chosen])
    part = span.rows(t_ns)
    t_ns, pieces = t_ns[part], pieces[part]
    look = rr.LineStrips3D.from_fields(colors=_COLOR, radii=rr.Radius.ui_points(1.0))
    rec.log(TRAIL, look, static=True)
    for rows, times in clock.rows(t_ns):
        rec.send_columns(TRAIL, times, rr.LineStrips3D.columns(strips=pieces[rows]))
