"""What an overlay draws beside the sessions' own recordings.

In space the first body is solid and keeps its colours of power; each of the others is a wireframe
of one tint, which is neither on the map along the body nor on that of power. Every head carries its
session's name.

In plots the first session's lines are solid, the others' dashed; a joint keeps its colour in all
sessions. Rerun has no dashes: they are a copy of the samples with some left out, beside the whole
columns under ``/NAME/joints/measured``.

Response of the joints as bars: the first session's are wide, the others' narrow, all in their
joints' colours and at the joints' places along their own bodies. Differences are those of
``undulog compare``, with simultaneous intervals. A whisker reaches to the far end of a bar's 95 %
interval; it is left out where it ends with its bar, since it would only brighten the bar.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import rerun as rr
from rerun.components import FillMode

from undulog.analysis.common.estimate import Estimate
from undulog.analysis.compare.quantities import Known
from undulog.analysis.compare.side import ComparedSession
from undulog.analysis.estimators.intervals import around, t_factor
from undulog.analysis.results.comparison import BODY, Comparison
from undulog.capture.common.arrays import FloatArray, IntArray
from undulog.capture.robot.model import Robot

from ..draw.body import MEASURED, MESHES, meshed
from ..draw.lines import DEGREES, log_look, log_rows
from ..draw.motion import HeadPath
from ..draw.plots import Plot
from ..draw.stage import TRAIL
from ..draw.steps import bar_of, log_bar
from ..samples.content import GREY, TOTAL, Bar, BodyPlaces, Color, PlottedSeries, line_title
from ..samples.timeline import GAIT_CYCLE, SESSION_TIME
from ..samples.tracks import (
    Track,
    decimate,
    interpolate,
    mark_gaps,
    pairs,
    typical_step_ns,
)
from .sessions import COMPARED, Align, Placement, Side, counterparts

_SNAKE = "/world/snake"
NAME = f"{_SNAKE}/name"

_WHITE: Color = (236, 236, 240, 255)
_TINTS: tuple[Color, ...] = (_WHITE, (240, 140, 200, 255), (176, 150, 250, 255))
# Mesh and line radius [points] of the second body, the third, and so on in turn.
_WIRES = ((FillMode.MajorWireframe, 1.0), (FillMode.DenseWireframe, 0.4))
_NAME_RATE_HZ = 25.0
_LIFT_RADII, _LIFT, _TIER = 5.0, 0.05, 0.08
_MESH_OPACITY = 90

LINES = f"{COMPARED}/places"
POWER = f"{TOTAL}/mechanical"

_DASH_S, _SPACE_S = (0.1, 0.04, 0.2), 0.06
_WIDTH = 2.0

BARS = f"{COMPARED}/segments"
DIFFERENCES = "/segments"

_WIDE, _NARROW = 0.5, 0.26
_ALL = _WIDE + _NARROW
_WHISKER = 0.25  # of the bar's width
_SEEN = 0.02  # a whisker is drawn if it ends further from its bar's end than this share of the bar


def tint(place: int) -> Color:
    """Return the colour of a session as a whole.

    Args:
        place: 0 for the first session.
    """
    return _WHITE if place == 0 else _TINTS[(place - 1) % len(_TINTS)]


def log_wireframe(rec: rr.RecordingStream, entity: str, place: int, robot: Robot | None) -> None:
    """Draw a body other than the first as a wireframe of one tint.

    What is static shadows the colours of each moment, which stay in the recording.

    Args:
        entity: The session's path.
        place: Which session it is, 1 for the second.
    """
    mesh, wire = _WIRES[(place - 1) % len(_WIRES)]
    look = rr.Capsules3D.from_fields(
        fill_mode=mesh, colors=tint(place), line_radii=rr.Radius.ui_points(wire)
    )
    rec.log(f"{entity}{MEASURED}", look, static=True)
    rec.log(f"{entity}{TRAIL}", rr.LineStrips3D.from_fields(colors=tint(place)), static=True)
    if robot is None:
        return
    glass = (*tint(place)[:3], _MESH_OPACITY)
    for i in np.flatnonzero(meshed(robot)).tolist():
        shape = rr.Asset3D.from_fields(albedo_factor=glass)
        rec.log(f"{entity}{MESHES}/{robot.links[i].name}", shape, static=True)


def log_placement(rec: rr.RecordingStream, entity: str, placed: Placement) -> None:
    """Move a session's world.

    Args:
        entity: The session's path.
    """
    moved = rr.Transform3D(
        translation=(placed.x, placed.y, 0.0), quaternion=rr.Quaternion(xyzw=placed.quaternion)
    )
    rec.log(f"{entity}/world", moved, static=True)


def log_name(rec: rr.RecordingStream, side: Side, place: int, head: HeadPath, robot: Robot) -> None:
    """Write the session's name over its head.

    Args:
        place: Which session it is, 0 for the first: names of bodies at one place lie in tiers.
        head: The head's path.
    """
    entity = f"{side.entity}{NAME}"
    look = rr.Points3D.from_fields(
        colors=tint(place), radii=rr.Radius.ui_points(0.5), show_labels=True
    )
    rec.log(entity, look, static=True)
    span = sum(link.length for link in robot.links)
    lift = _LIFT_RADII * robot.links[0].radius + (_LIFT + _TIER * place) * span
    chosen = decimate(head.t_ns, _NAME_RATE_HZ)
    point = (head.position[chosen] + [0.0, 0.0, lift]).astype(np.float32)
    finite = np.isfinite(point).sum(axis=1) == point.shape[1]  # no name where there is no body
    for rows, times in side.clock.rows(head.t_ns[chosen]):
        there = finite[rows].astype(np.int64)
        text = rr.Points3D.columns(
            positions=point[rows][there > 0], labels=[side.name] * int(there.sum())
        )
        rec.send_columns(entity, times, text.partition(there))


def log_ends(rec: rr.RecordingStream, sessions: Sequence[Side]) -> None:
    """Remove each body when its session ends before the others."""
    for timeline in (SESSION_TIME, GAIT_CYCLE):
        ends = {session.entity: _end(session, timeline) for session in sessions}
        last_ns = {entity: end for entity, end in ends.items() if end is not None}
        for entity, end in last_ns.items():
            if end < max(last_ns.values()):
                after = np.array([end + 1], dtype="timedelta64[ns]")
                cleared = rr.Clear.columns(is_recursive=[True])
                times = [rr.TimeColumn(timeline, duration=after)]
                rec.send_columns(f"{entity}{_SNAKE}", times, cleared)


def _end(side: Side, timeline: str) -> int | None:
    """Return a session's end on a timeline [ns], or None if it isn't on it."""
    if timeline == SESSION_TIME:
        return side.end_ns - side.zero_ns
    rhythm = side.clock.rhythm
    return None if rhythm is None else round(float(rhythm.cycles.max()) * 1e9)


def _dashed(values: FloatArray, t_ns: IntArray, rank: int) -> FloatArray:
    """Replace the spaces of a dashed line by NaN; each session has dashes of its own length.

    A dash has at least two samples, which make a piece of line, and a space has one.
    """
    step_s = max(typical_step_ns(t_ns), 1) * 1e-9
    drawn = max(round(_DASH_S[(rank - 1) % len(_DASH_S)] / step_s), 2)
    is_drawn = np.arange(len(values)) % (drawn + max(round(_SPACE_S / step_s), 1)) < drawn
    return np.where(is_drawn[:, None], values, np.nan)


def places_in(
    other: Side, first: BodyPlaces | None, places: BodyPlaces | None
) -> BodyPlaces | None:
    """Return the joints of another session that stand for its body.

    Args:
        first: The first session's joints.

    Returns:
        The first session's where the other has them too, else its own.
    """
    names = {track.name for track in other.measured}
    return first if first is not None and set(first.names) <= names else places


def log_lines(rec: rr.RecordingStream, side: Side, rank: int, places: BodyPlaces | None) -> bool:
    """Write head, middle and tail of a session in degrees.

    Args:
        rank: Which session it is, 0 for the first, whose lines are solid.
        places: The joints, or None.

    Returns:
        Whether any of them was measured.
    """
    labels = {} if places is None else places.labelled
    tracks = {track.name: track for track in side.measured if track.name in labels}
    for name, label in labels.items():
        if (track := tracks.get(name)) is None:
            continue
        entity = f"{LINES}{side.entity}/{rr.escape_entity_path_part(label)}"
        title = f"{side.name}: {line_title(name, label)}"
        log_look(rec, entity, [name], side.palette, titles={name: title}, width=_WIDTH)
        t_ns, values = mark_gaps(track.t_ns, track.values[:, None])
        if rank:
            values = _dashed(values, track.t_ns, rank)
        log_rows(rec, side.clock, entity, t_ns, values, degrees=True)
    return bool(tracks)


def log_power_names(rec: rr.RecordingStream, powers: Mapping[int, Side]) -> None:
    """Name the bodies' power after their sessions; the first keeps its colour.

    Args:
        powers: Sessions whose power was written, by their place, 0 for the first.
    """
    for place, side in powers.items():
        style: dict[str, Any] = {"colors": tint(place), "widths": 1.0} if place else {}
        look = rr.SeriesLines.from_fields(names=side.name, **style)
        rec.log(f"{side.entity}{POWER}", look, static=True)


@dataclass(frozen=True)
class ChartQuantity:
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
    ChartQuantity("gain", "Gain − 1 [%]", "Δ gain [%]", 1.0, 100.0),
    ChartQuantity("lag", "Lag [°]", "Δ lag [°]", 0.0, math.degrees(1.0)),
    ChartQuantity("energy_abs", "E_abs per cycle [J]", "Δ E_abs [J]", 0.0, 1.0),
)


def log_bars(
    rec: rr.RecordingStream, sides: Sequence[tuple[Side, ComparedSession]]
) -> tuple[ChartQuantity, ...]:
    """Write the sessions' bars next to each other.

    Args:
        sides: The sessions that could be analysed, in their order.

    Returns:
        Quantities that at least one joint has.
    """
    keys: set[str] = set()
    narrow = _NARROW / max(len(sides) - 1, 1)
    for k, (side, seen) in enumerate(sides):
        left, width = (_WIDE + (k - 1) * narrow, narrow) if k else (0.0, _WIDE)
        for quantity in QUANTITIES:
            for (key, joint), statistic in seen.estimates.items():
                if key != quantity.key or joint == BODY:
                    continue
                estimate = _estimate(statistic, log=key == "gain")
                bar = _bar(side, joint, estimate, quantity.scale, quantity.baseline)
                entity = f"{BARS}/{key}{side.entity}"
                _log(rec, entity, side, bar, left=left - _ALL / 2, width=width)
                keys.add(key)
    return tuple(quantity for quantity in QUANTITIES if quantity.key in keys)


def log_difference_bars(
    rec: rr.RecordingStream, first: Side, other: Side, comparison: Comparison | None
) -> tuple[ChartQuantity, ...]:
    """Write how a session's joints respond differently from the first one's.

    Args:
        first: The first session.
        comparison: Their comparison, or None.

    Returns:
        Quantities of which there is a difference.
    """
    keys: set[str] = set()
    for quantity in QUANTITIES:
        for difference in () if comparison is None else comparison.differences:
            if difference.quantity == quantity.key and difference.place != BODY:
                bar = _bar(first, difference.place, difference.difference, quantity.scale, 0.0)
                entity = f"{other.compared}{DIFFERENCES}/{quantity.key}"
                _log(rec, entity, first, bar, left=-_ALL / 2, width=_ALL)
                keys.add(quantity.key)
    return tuple(quantity for quantity in QUANTITIES if quantity.key in keys)


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


def _estimate(statistic: Known, *, log: bool) -> Estimate:
    value, variance, dof = statistic
    ends = around(value, t_factor(dof) * math.sqrt(variance))
    if log:
        return Estimate(math.exp(value), (math.exp(ends[0]), math.exp(ends[1])))
    return Estimate(value, ends)


def angle_differences(a: Side, b: Side, how: Align) -> tuple[Track, ...]:
    """Return the measured angles of one session minus those of another.

    Args:
        a: The session that is subtracted, and whose times count.

    Returns:
        A track [rad] for each joint that both have; ``b`` is taken on the straight line between
        its samples, NaN where it has none.
    """
    return tuple(
        Track(track.name, track.t_ns, _taken(a, b, how, track, other) - track.values)
        for track, other in pairs(a.measured, b.measured)
    )


def _taken(a: Side, b: Side, how: Align, track: Track, other: Track) -> np.ndarray:
    at_ns, valid = counterparts(a, b, how, track.t_ns)
    values = np.full(track.t_ns.size, np.nan)
    values[valid] = interpolate(other.t_ns, other.values, at_ns[valid])
    return values


def log_differences(
    rec: rr.RecordingStream,
    a: Side,
    entity: str,
    differences: Sequence[Track],
    drawn: Sequence[PlottedSeries],
) -> tuple[PlottedSeries, ...]:
    """Write differences as the angles of the session that was subtracted are drawn.

    Args:
        a: The session that was subtracted.
        differences: The differences [rad].
        drawn: Its measured angles; joints of one series are drawn at common times.
    """
    names = {track.name for track in differences}
    parts = [tuple(name for name in series.names if name in names) for series in drawn]
    plot = Plot(entity, [part for part in parts if part], degrees=True, component=DEGREES)
    plot.style(rec, a.palette)
    plot.write(rec, a.clock, differences)
    return plot.series
