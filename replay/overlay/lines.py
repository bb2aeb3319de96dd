"""Lines of several sessions in one plot: the first session solid, the others dashed.

A joint keeps its colour, whichever session it is of. Rerun has no dashes: they are a copy of the
samples with some left out, beside the whole columns under ``/NAME/joints/measured``.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import rerun as rr

from undulog.capture.common.arrays import FloatArray, IntArray

from ..content.entities import TOTAL, Places
from ..draw.plots.joints import log_look, log_rows
from ..samples.sampling import mark_gaps, typical_step_ns
from .alignment import Aligned
from .dress import tint
from .side import COMPARED, Side

LINES = f"{COMPARED}/places"
POWER = f"{TOTAL}/mechanical"

_DASH_S, _SPACE_S = (0.1, 0.04, 0.2), 0.06
_WIDTH = 2.0


@dataclass(frozen=True)
class Dashes:
    """A dashed line's rhythm in samples.

    Attributes:
        drawn: Samples in a dash.
        left_out: Samples in a space.
    """

    drawn: int
    left_out: int


def dashes_of(t_ns: IntArray, place: int) -> Dashes:
    """How a line is dashed.

    Args:
        t_ns: Sampling times [ns].
        place: Which session it is, 1 for the second: each has dashes of a length of its own.

    Returns:
        At least two samples a dash, which make a piece of line, and one a space.
    """
    step_s = max(typical_step_ns(t_ns), 1) * 1e-9
    long = _DASH_S[(place - 1) % len(_DASH_S)]
    return Dashes(max(round(long / step_s), 2), max(round(_SPACE_S / step_s), 1))


def dashed(values: FloatArray, dashes: Dashes) -> FloatArray:
    """Leave spaces in a line.

    Args:
        values: Shape (n, k).
        dashes: Their rhythm.

    Returns:
        Shape (n, k), NaN in the spaces.
    """
    place = np.arange(len(values)) % (dashes.drawn + dashes.left_out)
    return np.where((place < dashes.drawn)[:, None], values, np.nan)


def places_in(other: Side, first: Places | None, own: Places | None) -> Places | None:
    """The joints of another session that stand for its body.

    Args:
        other: The session.
        first: The first session's joints.
        own: Its own.

    Returns:
        The first session's where the other has them too, else its own.
    """
    known = {track.name for track in other.measured}
    return first if first is not None and set(first.names) <= known else own


def log_lines(rec: rr.RecordingStream, one: Aligned, rank: int, places: Places | None) -> bool:
    """Write head, middle and tail of a session in degrees.

    Args:
        rec: The recording.
        one: The session.
        rank: Which session it is, 0 for the first, whose lines are solid.
        places: The joints, or None.

    Returns:
        Whether any of them was measured.
    """
    side, tracks = one.side, {track.name: track for track in one.side.measured}
    named = () if places is None else zip(places.names, places.labels, strict=True)
    measured = [(tracks[name], label) for name, label in named if name in tracks]
    for track, label in measured:
        name = track.name
        entity = f"{LINES}{side.entity}/{rr.escape_entity_path_part(label)}"
        title = f"{side.name}: {name}" if label == name else f"{side.name}: {name} {label}"
        log_look(rec, entity, [name], side.palette, titles={name: title}, width=_WIDTH)
        t_ns, values = mark_gaps(track.t_ns, track.values[:, None])
        if rank:
            values = dashed(values, dashes_of(track.t_ns, rank))
        log_rows(rec, one.clock, entity, t_ns, values, degrees=True)
    return bool(measured)


def log_power_names(rec: rr.RecordingStream, powers: Mapping[int, Side]) -> None:
    """Name the bodies' power after their sessions; the first keeps its colour.

    Args:
        rec: The recording.
        powers: Sessions whose power was written, by their place, 0 for the first.
    """
    for place, side in powers.items():
        look = rr.SeriesLines.from_fields(names=side.name)
        if place:
            look = rr.SeriesLines.from_fields(names=side.name, colors=tint(place), widths=1.0)
        rec.log(f"{side.entity}{POWER}", look, static=True)
