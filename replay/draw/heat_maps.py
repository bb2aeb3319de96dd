"""Segments against cycles: how gain, lag and power went on, as maps beside the plots.

Head to tail from left to right, time downwards, a cell for each joint and cycle. Gain and lag wear
the project's one even colour map, power the colours of the body. The colours end at the extremes
of the analysed window, so that a start that decays doesn't wash out the spread over the joints;
what lies beyond wears the end's colour. A cell that tells nothing is dark with a stroke through it.
A frame marks the cycle at the time cursor.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import replace

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from undulog.analysis.common.formats import number
from undulog.analysis.results.analysis import Analysis
from undulog.capture.common.arrays import FloatArray
from undulog.capture.common.palette import joint_colors, scale_ends

from ..samples.content import ENERGY, GAIN, LAG, NAMED, Color, CycleQuantity, CycleTable, HeatMap
from ..samples.timeline import TimeColumns
from .body import power_colors
from .steps import cycle_edges_ns, together

POWER = CycleQuantity("power_milliwatt", "Power", "mW")

SIZE = (360.0, 300.0)
"""Width and height of the cells together [scene units]."""

VISIBLE = ((-50.0, SIZE[0] + 10.0), (-8.0, SIZE[1] + 84.0))
"""What a view of a map shows: its x and its y [scene units]."""

# Smallest span of the colours: noise isn't magnified.
_LEAST = {GAIN.key: 0.5, LAG.key: 0.5, POWER.key: 1.0}

_NOTHING = (34, 34, 38)
_STROKE = (110, 110, 116, 255)
_TEXT = (205, 205, 210, 255)
_FRAME = (255, 255, 255, 255)
_DOT = rr.Radius.ui_points(0.5)
_ROW_LABELS = 8
_COLUMN_LABELS = 13
_MOST_TOLD = 1000
_BAR = (120.0, 9.0)
_BAR_TOP = SIZE[1] + 58.0


def heat_maps(
    analysis: Analysis, tables: Sequence[CycleTable], names: Sequence[str]
) -> tuple[HeatMap, ...]:
    """Return the maps of gain, lag and power by joint and cycle.

    Args:
        analysis: The session's analysis, for its windows.
        names: All joints, head to tail.

    Returns:
        Gain, lag and power, those of them that are known.
    """
    place = {name: i + 1 for i, name in enumerate(names)}
    maps: list[HeatMap] = []
    for quantity in (GAIN, LAG, ENERGY):
        parts = [table for table in tables if table.quantity == quantity]
        if not parts:
            continue
        table = _in_order(together(parts), place)
        if quantity is ENERGY:
            milliwatt = 1e3 * table.value / (table.stop_s - table.start_s)
            table = replace(table, quantity=POWER, value=milliwatt)
        low, high = scale_ends(
            _settled(analysis, table), _LEAST[table.quantity.key], signed=quantity is ENERGY
        )
        places = tuple(place.get(name, i + 1) for i, name in enumerate(table.names))
        maps.append(HeatMap(table, places, low, high, quantity is ENERGY))
    return tuple(maps)


def cell_colors(shown: HeatMap) -> NDArray[np.uint8]:
    """Return the colours of a map's cells.

    Args:
        shown: The map, m joints and c cycles.

    Returns:
        sRGB, shape (c, m, 3).
    """
    value = shown.table.value.T
    finite = np.isfinite(value)
    filled = np.where(finite, value, shown.low)
    if shown.signed:
        colors = power_colors(filled, shown.high)[..., :3]
    else:
        share = np.clip((filled - shown.low) / (shown.high - shown.low), 0.0, 1.0)
        colors = joint_colors(256)[np.rint(255.0 * share).astype(np.int64), :3]
    return np.where(finite[..., None], colors, np.array(_NOTHING, dtype=np.uint8))


def log_maps(
    rec: rr.RecordingStream,
    clock: TimeColumns,
    maps: Sequence[HeatMap],
    named: Collection[str] = (),
) -> None:
    """Write the maps.

    Args:
        named: Joints whose numbers below the maps carry a mark.
    """
    for shown in maps:
        _, width, height = _cells(shown)
        cells = rr.Image(cell_colors(shown))
        scale = rr.Transform3D(scale=[width, height, 1.0])
        rec.log(f"{shown.entity}/cells", cells, scale, static=True)
        missing = np.argwhere(~np.isfinite(shown.table.value.T))
        if missing.size:
            side = np.array([width, height], dtype=np.float32)
            corner = (missing[:, ::-1] * side).astype(np.float32)
            strokes = np.stack([corner, corner + side], axis=1)
            drawn = rr.LineStrips2D(strokes, colors=_STROKE, radii=_DOT)
            rec.log(f"{shown.entity}/missing", drawn, static=True)
        _log_axes(rec, shown, named)
        _log_bar(rec, shown)
        if shown.table.value.size <= _MOST_TOLD:
            _log_cell_texts(rec, shown)
        _log_frame(rec, clock, shown)


def _cells(shown: HeatMap) -> tuple[int, float, float]:
    """Number of cycles, and a cell's width and height."""
    m, c = shown.table.value.shape
    return c, SIZE[0] / m, SIZE[1] / c


def _in_order(table: CycleTable, place: dict[str, int]) -> CycleTable:
    order = sorted(range(len(table.names)), key=lambda i: place.get(table.names[i], len(place) + i))
    return replace(table, names=tuple(table.names[i] for i in order), value=table.value[order])


def _settled(analysis: Analysis, table: CycleTable) -> FloatArray:
    """The values of the cycles in the analysed windows; all of them where those hold none."""
    middle = 0.5 * (table.start_s + table.stop_s)
    inside = np.zeros(middle.size, dtype=np.bool_)
    for window in analysis.gait.windows:
        inside |= (window.start_s <= middle) & (middle < window.stop_s)
    chosen = table.value[:, inside]
    return chosen if np.isfinite(chosen).any() else table.value


def _log_axes(rec: rr.RecordingStream, shown: HeatMap, named: Collection[str]) -> None:
    count, width, height = _cells(shown)
    m = len(shown.places)
    marked = [i for i, name in enumerate(shown.table.names) if name in named]
    column = [i for i in range(0, m, -(-m // _COLUMN_LABELS)) if i not in marked]
    row = range(0, count, -(-count // _ROW_LABELS))
    points = [((i + 0.5) * width, SIZE[1] + 2.0) for i in column]
    texts = [str(shown.places[i]) for i in column]
    points += [(-22.0, k * height) for k in row]
    digits = 0 if shown.table.start_s[-1] >= 100.0 else 1
    texts += [f"{number(float(shown.table.start_s[k]), digits)} s" for k in row]
    points.append((SIZE[0] / 2, SIZE[1] + 21.0))
    texts.append("joint, head to tail; a row is one cycle")
    _log_text(rec, f"{shown.entity}/axes", points, texts)
    if marked:
        points = [((i + 0.5) * width, SIZE[1] + 2.0) for i in marked]
        texts = [str(shown.places[i]) for i in marked]
        _log_text(rec, f"{shown.entity}/named", points, texts, NAMED)


def _log_bar(rec: rr.RecordingStream, shown: HeatMap) -> None:
    """Draw the colour bar with the values at its ends."""
    low, high = shown.low, shown.high
    ramp = np.linspace(low, high, 128)
    whole = CycleTable(shown.table.quantity, ("",), ramp, ramp, np.stack([ramp, ramp]))
    colors = cell_colors(HeatMap(whole, (1,), low, high, shown.signed)).transpose(1, 0, 2)
    left = (SIZE[0] - _BAR[0]) / 2
    place = rr.Transform3D(
        translation=[left, _BAR_TOP, 0.0], scale=[_BAR[0] / 128, _BAR[1] / 2, 1.0]
    )
    rec.log(f"{shown.entity}/colors", rr.Image(np.ascontiguousarray(colors)), place, static=True)
    unit = shown.table.quantity.unit
    ends = [f"{end}{'' if unit == '°' else ' '}{unit}" for end in shown.ends]
    y = _BAR_TOP - 8.0
    _log_text(rec, f"{shown.entity}/ends", [(left - 32.0, y), (left + _BAR[0] + 32.0, y)], ends)


def _log_text(
    rec: rr.RecordingStream,
    entity: str,
    points: Sequence[tuple[float, float]],
    texts: list[str],
    color: Color = _TEXT,
) -> None:
    drawn = rr.Points2D(points, labels=texts, show_labels=True, radii=_DOT, colors=color)
    rec.log(entity, drawn, static=True)


def _log_cell_texts(rec: rr.RecordingStream, shown: HeatMap) -> None:
    """Write the text of each cell, shown under the mouse: a dot of the cell's own colour."""
    count, width, height = _cells(shown)
    m = len(shown.places)
    at = np.stack(np.meshgrid(np.arange(m), np.arange(count)), axis=-1).reshape(-1, 2)
    dots = rr.Points2D(
        (at + 0.5) * (width, height),
        labels=list(_cell_texts(shown)),
        show_labels=False,
        colors=cell_colors(shown).reshape(-1, 3),
        radii=_DOT,
    )
    rec.log(f"{shown.entity}/values", dots, static=True)


def _cell_texts(shown: HeatMap) -> Iterator[str]:
    table = shown.table
    unit = table.quantity.unit
    for k, (start, stop) in enumerate(zip(table.start_s, table.stop_s, strict=True)):
        for i, name in enumerate(table.names):
            value = number(float(table.value[i, k]), 3)
            yield f"{name}, {start:.2f} to {stop:.2f} s: {value} {unit}"


def _log_frame(rec: rr.RecordingStream, clock: TimeColumns, shown: HeatMap) -> None:
    """Draw a frame about the cycle at the cursor; none where there is no cycle."""
    count, _, height = _cells(shown)
    t_ns, ends = cycle_edges_ns(shown.table, clock.start_ns)
    drawn = np.insert(np.ones(count, dtype=np.int64), ends + 1, 0)
    center = np.stack([np.full(count, SIZE[0] / 2), (np.arange(count) + 0.5) * height], axis=1)
    half = np.tile([SIZE[0] / 2 + 3.0, height / 2], (count, 1))
    at = np.cumsum(drawn) - drawn
    for rows, times in clock.rows(t_ns):
        which = at[rows][drawn[rows] == 1]
        frames = rr.Boxes2D.columns(
            half_sizes=half[which],
            centers=center[which],
            colors=np.tile(np.array(_FRAME, dtype=np.uint8), (which.size, 1)),
        )
        rec.send_columns(f"{shown.entity}/now", times, frames.partition(drawn[rows]))
