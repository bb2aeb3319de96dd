"""Response of the joints as bars: all sessions next to each other, and their differences.

The first session's bars are wide, the others' narrow, all in their joints' colours and at the
joints' places along their own bodies. Differences are those of ``undulog compare``, with the
intervals that hold together. A whisker reaches to the far end of a bar's 95 % interval; where it
would end with its bar, it only added its light to the bar's colour, so there is none.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import rerun as rr

from undulog.analysis.compare.side import Known, Seen
from undulog.analysis.estimators.intervals import around, t_factor
from undulog.analysis.results.comparison import BODY, Comparison
from undulog.analysis.results.estimate import Estimate

from ..content.entities import GREY
from .side import COMPARED, Side

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
        title: With unit.
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


@dataclass(frozen=True)
class _Bar:
    """Where a bar stands and what it shows, in the unit shown."""

    left: float
    width: float
    height: float
    far: float | None


def log_bars(rec: rr.RecordingStream, sides: Sequence[tuple[Side, Seen]]) -> tuple[Quantity, ...]:
    """Write the sessions' bars next to each other.

    Args:
        rec: The recording.
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
                bar = _bar(estimate, quantity.baseline, quantity.scale, left - _ALL / 2, width)
                _log(rec, f"{BARS}/{key}{side.entity}", side, joint, bar)
                found.add(key)
    return tuple(quantity for quantity in QUANTITIES if quantity.key in found)


def log_differences(
    rec: rr.RecordingStream, first: Side, other: Side, comparison: Comparison
) -> tuple[Quantity, ...]:
    """Write how a session's joints answer otherwise than the first one's.

    Args:
        rec: The recording.
        first: The first session.
        other: The other one.
        comparison: Of the two.

    Returns:
        Quantities of which there is a difference.
    """
    found: set[str] = set()
    for quantity in QUANTITIES:
        for one in comparison.differences:
            if one.quantity == quantity.key and one.place != BODY:
                bar = _bar(one.difference, 0.0, quantity.scale, -_ALL / 2, _ALL)
                _log(rec, f"{other.own}{DIFFERENCES}/{quantity.key}", first, one.place, bar)
                found.add(quantity.key)
    return tuple(quantity for quantity in QUANTITIES if quantity.key in found)


def _bar(
    estimate: Estimate, baseline: float, scale: float, left: float, width: float
) -> _Bar | None:
    if estimate.value is None:
        return None
    ends = [scale * (end - baseline) for end in estimate.ci95 or ()]
    return _Bar(left, width, scale * (estimate.value - baseline), max(ends, key=abs, default=None))


def _log(rec: rr.RecordingStream, entity: str, side: Side, joint: str, bar: _Bar | None) -> None:
    if bar is None or joint not in side.joints:
        return
    name, place = rr.escape_entity_path_part(joint), side.joints.index(joint) + 1
    color = side.palette.get(joint, GREY)
    drawn = rr.BarChart([bar.height], abscissa=[place + bar.left], widths=[bar.width], color=color)
    rec.log(f"{entity}/estimate/{name}", drawn, static=True)
    if bar.far is not None and abs(bar.far - bar.height) > _SEEN * abs(bar.height):
        width = _WHISKER * bar.width
        left = place + bar.left + (bar.width - width) / 2
        thin = rr.BarChart([bar.far], abscissa=[left], widths=[width], color=GREY)
        rec.log(f"{entity}/ci95/{name}", thin, static=True)


def _estimate(known: Known, *, log: bool) -> Estimate:
    value, variance, dof = known
    ends = around(value, t_factor(dof) * math.sqrt(variance))
    if log:
        return Estimate(math.exp(value), (math.exp(ends[0]), math.exp(ends[1])))
    return Estimate(value, ends)
