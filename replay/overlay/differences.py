"""Response of the joints as bars: all sessions next to each other, and their differences.

The first session's bars are wide, the others' narrow, all in their joints' colours and at the
joints' places along their own bodies. Differences are those of ``undulog compare``, with the
intervals that hold together. A whisker reaches to the far end of a bar's 95 % interval; where it
would end with its bar, it only added its light to the bar's colour, so there is none.

Lines of several sessions in one plot: the first session solid, the others dashed.

A joint keeps its colour, whichever session it is of. Rerun has no dashes: they are a copy of the
samples with some left out, beside the whole columns under ``/NAME/joints/measured``.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import rerun as rr

from undulog.analysis.compare.side import ComparedSession, Known
from undulog.analysis.estimators.intervals import around, t_factor
from undulog.analysis.results.comparison import BODY, Comparison
from undulog.analysis.results.estimate import Estimate
from undulog.capture.common.arrays import FloatArray, IntArray

from ..draw.cycles.steps import bar_of, log_bar
from ..draw.plots.joints import log_look, log_rows
from ..samples.content import GREY, TOTAL, Bar, Places, line_title
from ..samples.sampling import mark_gaps, typical_step_ns
from .alignment import Aligned
from .side import COMPARED, Side
from .style import tint

LINES = f"{COMPARED}/places"
POWER = f"{TOTAL}/mechanical"

_DASH_S, _SPACE_S = (0.1, 0.04, 0.2), 0.06
_WIDTH = 2.0


@dataclass(frozen=True)
class Dashes:
    """A dashed line's rhythm in samples."""

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

    Returns:
        Shape (n, k), NaN in the spaces.
    """
    place = np.arange(len(values)) % (dashes.drawn + dashes.left_out)
    return np.where((place < dashes.drawn)[:, None], values, np.nan)


def places_in(other: Side, first: Places | None, own: Places | None) -> Places | None:
    """The joints of another session that stand for its body.

    Args:
        first: The first session's joints.

    Returns:
        The first session's where the other has them too, else its own.
    """
    known = {track.name for track in other.measured}
    return first if first is not None and set(first.names) <= known else own


def log_lines(rec: rr.RecordingStream, one: Aligned, rank: int, places: Places | None) -> bool:
    """Write head, middle and tail of a session in degrees.

    Args:
        rank: Which session it is, 0 for the first, whose lines are solid.
        places: The joints, or None.

    Returns:
        Whether any of them was measured.
    """
    side, labels = one.side, {} if places is None else places.labelled
    tracks = {track.name: track for track in side.measured if track.name in labels}
    for name in (name for name in labels if name in tracks):
        track, label = tracks[name], labels[name]
        entity = f"{LINES}{side.entity}/{rr.escape_entity_path_part(label)}"
        title = f"{side.name}: {line_title(name, label)}"
        log_look(rec, entity, [name], side.palette, titles={name: title}, width=_WIDTH)
        t_ns, values = mark_gaps(track.t_ns, track.values[:, None])
        if rank:
            values = dashed(values, dashes_of(track.t_ns, rank))
        log_rows(rec, one.clock, entity, t_ns, values, degrees=True)
    return bool(tracks)


def log_power_names(rec: rr.RecordingStream, powers: Mapping[int, Side]) -> None:
    """Name the bodies' power after their sessions; the first keeps its colour.

    Args:
        powers: Sessions whose power was written, by their place, 0 for the first.
    """
    for place, side in powers.items():
        look = rr.SeriesLines.from_fields(names=side.name)
        if place:
            look = rr.SeriesLines.from_fields(names=side.name, colors=tint(place), widths=1.0)
        rec.log(f"{side.entity}{POWER}", look, static=True)


BARS = f"{COMPARED}/segments"
DIFFERENCES = "/segments"

_WIDE, _NARROW = 0.5, 0.26
_ALL = _WIDE + _NARROW
_WHISKER = 0.25  # of the bar's width
_SEEN = 0.02
"""A whisker is drawn if it ends further from its bar's end than this share of the bar."""


@dataclass(frozen=True)
class Quantity:
    """What the bars of one chart show.

    Attributes:
        key: As the comparison calls it; also the last part of the entity's path.
        difference: Title of its differences, with unit.
        baseline: Where the sessions' bars start, in SI.
        scale: From SI to the unit shown.
    """

    key: str
    title: str
    difference: str
    baseline: float
    scale: float


QUANTITIES = (
    Quantity("gain", "Gain − 1 [%]", "Δ gain [%]", 1.0, 100.0),
    Quantity("lag", "Lag [°]", "Δ lag [°]", 0.0, math.degrees(1.0)),
    Quantity("energy_abs", "E_abs per cycle [J]", "Δ E_abs [J]", 0.0, 1.0),
)


def log_bars(
    rec: rr.RecordingStream, sides: Sequence[tuple[Side, ComparedSession]]
) -> tuple[Quantity, ...]:
    """Write the sessions' bars next to each other.

    Args:
        sides: The sessions that could be analysed, in their order.

    Returns:
        Quantities that at least one joint has.
    """
    found: set[str] = set()
    narrow = _NARROW / max(len(sides) - 1, 1)
    for k, (side, seen) in enumerate(sides):
        left, width = (_WIDE + (k - 1) * narrow, narrow) if k else (0.0, _WIDE)
        for quantity in QUANTITIES:
            for (key, joint), known in seen.estimates.items():
                if key != quantity.key or joint == BODY:
                    continue
                estimate = _estimate(known, log=key == "gain")
                bar = _bar(side, joint, estimate, quantity.scale, quantity.baseline)
                entity = f"{BARS}/{key}{side.entity}"
                _log(rec, entity, side, bar, left=left - _ALL / 2, width=width)
                found.add(key)
    return tuple(quantity for quantity in QUANTITIES if quantity.key in found)


def log_difference_bars(
    rec: rr.RecordingStream, first: Side, other: Side, comparison: Comparison | None
) -> tuple[Quantity, ...]:
    """Write how a session's joints answer otherwise than the first one's.

    Args:
        first: The first session.
        comparison: What it says; None where there is none.

    Returns:
        Quantities of which there is a difference.
    """
    found: set[str] = set()
    for quantity in QUANTITIES:
        for one in () if comparison is None else comparison.differences:
            if one.quantity == quantity.key and one.place != BODY:
                bar = _bar(first, one.place, one.difference, quantity.scale, 0.0)
                entity = f"{other.own}{DIFFERENCES}/{quantity.key}"
                _log(rec, entity, first, bar, left=-_ALL / 2, width=_ALL)
                found.add(quantity.key)
    return tuple(quantity for quantity in QUANTITIES if quantity.key in found)


def _log(
    rec: rr.RecordingStream, entity: str, side: Side, bar: Bar | None, *, left: float, width: float
) -> None:
    """Write a bar that stands by ``left`` off its joint's place."""
    if bar is None:
        return
    if bar.far is not None and abs(bar.far - bar.value) <= _SEEN * abs(bar.value):
        bar = replace(bar, far=None)
    log_bar(
        rec,
        entity,
        bar,
        left=bar.place + left,
        width=width,
        whisker=_WHISKER * width,
        color=side.palette.get(bar.joint, GREY),
    )


def _bar(side: Side, joint: str, estimate: Estimate, scale: float, baseline: float) -> Bar | None:
    if joint not in side.joints:
        return None
    return bar_of(joint, side.joints.index(joint) + 1, estimate, scale, baseline)


def _estimate(known: Known, *, log: bool) -> Estimate:
    value, variance, dof = known
    ends = around(value, t_factor(dof) * math.sqrt(variance))
    if log:
        return Estimate(math.exp(value), (math.exp(ends[0]), math.exp(ends[1])))
    return Estimate(value, ends)
