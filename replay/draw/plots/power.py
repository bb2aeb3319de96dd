"""Power: what the joints give to the body, and what the motors take from the battery."""

from __future__ import annotations

import rerun as rr

from ...content.entities import TOTAL
from ...samples.sampling import mark_gaps
from ...samples.timeline import Clock
from ...samples.tracks import Track
from .joints import log_rows

# Vermilion as on the body; violet is on no other map and reads on black and on white.
_COLORS = {"mechanical": (255, 84, 48, 255), "electrical": (150, 124, 230, 255)}


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
