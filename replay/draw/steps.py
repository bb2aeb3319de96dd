"""Gain, lag and energy of each joint in each cycle: steps in a plot, and rows of the heat maps.

The numbers are the analysis's own: gain and lag by the logged phase over the whole session
(``over_time`` of a result), or, where no phase was logged, of the steady gait (the report's maps);
net energy over the cycles of the analysed window (``energy`` of a result). A value is written where
its cycle starts and holds until the cycle ends, so a step lies over the samples that it was
computed from.

Response of each joint as bars, head to tail: how much, how late, at what cost.

The baseline of gain and lag is perfect tracking: a gain of one and no lag. The coloured bar is the
whole analysed stretch, and a whisker in it reaches to the far end of its 95 % interval; the white
bar on its right is the cycle at the time cursor. One bar chart a joint, so that each bar has its
joint's colour and name.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from itertools import chain
from typing import Any, cast

import numpy as np
import pyarrow as pa
import rerun as rr

from undulog.analysis.common.estimate import Estimate
from undulog.analysis.parts.joints.result import JointResult
from undulog.analysis.parts.over_time.result import JointOverTime
from undulog.analysis.results.analysis import Analysis
from undulog.analysis.session.cycle_maps import LEAST_COVERED, CycleMaps
from undulog.capture.common.arrays import FloatArray, IntArray

from ..samples.content import (
    ENERGY,
    GAIN,
    GREY,
    LAG,
    NAMED,
    Bar,
    Chart,
    Color,
    CycleQuantity,
    CycleTable,
    PlottedSeries,
)
from ..samples.timeline import TimeColumns
from ..samples.tracks import Track
from ..samples.tracks import tables as tables_of
from .lines import log_look, log_rows, part_entities

arrow: Any = cast("Any", pa)  # without types

CYCLES = "/cycles"

SEGMENTS = "/segments"
CURRENT: Color = (235, 235, 240, 255)

# Side by side, since Rerun adds the light of bars that lie on each other; the whisker is thin.
_LEFT, _WIDTH = -0.42, 0.54
_WHISKER = 0.14
_CURRENT_LEFT, _CURRENT_WIDTH = 0.16, 0.26
_MARK_LEFT, _MARK_WIDTH = -0.56, 0.12


def cycle_tables(analysis: Analysis, steady: CycleMaps | None = None) -> tuple[CycleTable, ...]:
    """Return an analysis's values by joint and cycle.

    Args:
        analysis: The session's analysis.
        steady: Cycles of its steady gait, for a session whose phase was not logged.

    Returns:
        Tables of gain, lag and net energy; of one quantity several where planes have cycles of
        their own, none where it has no value.
    """
    if analysis.over_time is not None:
        response = _over_time(analysis.over_time.joints)
    elif steady is not None:
        stop_s = steady.start_s + steady.period_s
        table = CycleTable(GAIN, steady.driven, steady.start_s, stop_s, 100.0 * (steady.gain - 1.0))
        response = [table, replace(table, quantity=LAG, value=np.degrees(steady.lag_rad))]
    else:
        response = []
    tables = [*response, *_energy(analysis)]
    return tuple(table for table in tables if np.isfinite(table.value).any())


def together(tables: Sequence[CycleTable]) -> CycleTable:
    """Combine tables of one quantity on the cycles of the one with most of them.

    Args:
        tables: At least one, of one quantity.

    Returns:
        The table; a joint with cycles of its own has in each row the value of that cycle of its
        own which holds the middle of the row.
    """
    main = max(tables, key=lambda table: table.start_s.size)
    middle = 0.5 * (main.start_s + main.stop_s)

    def rows(table: CycleTable) -> FloatArray:
        at = np.searchsorted(table.start_s, middle, side="right") - 1
        cycle = np.maximum(at, 0)
        return np.where((at >= 0) & (middle < table.stop_s[cycle]), table.value[:, cycle], np.nan)

    names = tuple(name for table in tables for name in table.names)
    return replace(main, names=names, value=np.concatenate([rows(table) for table in tables]))


def log_cycles(
    rec: rr.RecordingStream,
    clock: TimeColumns,
    tables: Sequence[CycleTable],
    palette: Mapping[str, Color],
) -> tuple[tuple[CycleQuantity, tuple[PlottedSeries, ...]], ...]:
    """Write the steps.

    Args:
        palette: Colour by joint name.

    Returns:
        Each quantity with where it was written.
    """
    quantities: list[tuple[CycleQuantity, tuple[PlottedSeries, ...]]] = []
    for quantity in dict.fromkeys(table.quantity for table in tables):
        steps = [_steps(table, clock.start_ns) for table in tables if table.quantity == quantity]
        parts = tables_of(list(chain.from_iterable(steps)))
        paths = part_entities(f"{CYCLES}/{quantity.key}", [part.names for part in parts])
        series: list[PlottedSeries] = []
        for entity, part in zip(paths, parts, strict=True):
            log_look(rec, entity, part.names, palette, steps=True)
            rec.flush()  # else what comes first in the file is chance
            log_rows(rec, clock, entity, part.t_ns, part.values)
            series.append(PlottedSeries(entity, part.names))
        quantities.append((quantity, tuple(series)))
    return tuple(quantities)


def cycle_times_ns(table: CycleTable, start_ns: int) -> tuple[IntArray, IntArray]:
    """Return the times at which the cycles start and end.

    Args:
        start_ns: Unix time of the session's start [ns].

    Returns:
        Unix times [ns], each of shape (c,).
    """
    far_s = 4e9  # keeps the times of a damaged result within int64
    start_s, stop_s = (np.clip(t_s, -far_s, far_s) for t_s in (table.start_s, table.stop_s))
    start, stop = (np.round(t_s * 1e9).astype(np.int64) for t_s in (start_s, stop_s))
    return start_ns + start, start_ns + stop


def cycle_edges_ns(table: CycleTable, start_ns: int) -> tuple[IntArray, IntArray]:
    """Return the times at which a cycle starts, or ends without a following one.

    Args:
        start_ns: Unix time of the session's start [ns].

    Returns:
        Unix times [ns], and the indices of the cycles that no other follows.
    """
    start, stop = cycle_times_ns(table, start_ns)
    # A microsecond is the rounding of edges in seconds, not a pause.
    ends = np.flatnonzero(np.append(start[1:] - stop[:-1] > 1000, True))
    return np.insert(start, ends + 1, stop[ends]), ends


def _steps(table: CycleTable, start_ns: int) -> list[Track]:
    """Values at the starts, and NaN at each end that no cycle follows."""
    t_ns, ends = cycle_edges_ns(table, start_ns)
    values = np.insert(table.value, ends + 1, np.nan, axis=1)
    return [Track(name, t_ns, row) for name, row in zip(table.names, values, strict=True)]


def _over_time(joints: Sequence[JointOverTime]) -> list[CycleTable]:
    together: dict[tuple[float, ...], list[JointOverTime]] = {}
    for joint in joints:
        if joint.start_s:
            together.setdefault(joint.start_s, []).append(joint)
    gains: list[CycleTable] = []
    lags: list[CycleTable] = []
    for start_s, group in together.items():
        gain = np.array([joint.gain for joint in group], dtype=np.float64)
        lag = np.array([joint.lag_rad for joint in group], dtype=np.float64)
        names, stop_s = tuple(joint.name for joint in group), np.array(group[0].stop_s)
        table = CycleTable(GAIN, names, np.array(start_s), stop_s, 100.0 * (gain - 1.0))
        gains.append(table)
        lags.append(replace(table, quantity=LAG, value=np.degrees(_about_its_mean(lag))))
    return [*gains, *lags]


def _about_its_mean(lag_rad: FloatArray) -> FloatArray:
    """Lags within pi of each joint's mean direction, so that no step is a mere turn, (m, c)."""
    mean = np.angle(np.nansum(np.exp(1j * lag_rad), axis=1, keepdims=True))
    return mean + np.angle(np.exp(1j * (lag_rad - mean)))


def _energy(analysis: Analysis) -> list[CycleTable]:
    """Net energies of the analysed window's cycles; none without a gait, or without samples."""
    energy = analysis.energy
    if energy is None or analysis.gait.frequency_hz.value is None:
        return []
    joints = [joint for joint in energy.joints if joint.net_j is not None]
    if not joints:
        return []
    value = np.array([joint.net_j for joint in joints], dtype=np.float64)
    covered = np.array([joint.coverage for joint in joints], dtype=np.float64)
    value = np.where(covered >= LEAST_COVERED, value, np.nan)
    names, start_s = tuple(joint.name for joint in joints), np.array(energy.start_s)
    return [CycleTable(ENERGY, names, start_s, np.array(energy.stop_s), value)]


def charts(analysis: Analysis) -> tuple[Chart, ...]:
    """Return an analysis's values by joint, in the units that are shown.

    Args:
        analysis: The session's analysis.

    Returns:
        Gain less one [%], lag [degrees] and net mechanical energy [J], of a mean cycle where
        there is a gait, else of the whole window; without those of which no joint has a value.
    """
    joints = analysis.joints
    share = 1.0 / (sum(window.cycles for window in analysis.gait.windows) or 1)
    energy = [Estimate(joint.energy_net_j) for joint in joints]
    bar_charts = (
        Chart(GAIN.key, "Gain − 1 [%]", _bars(joints, [j.gain for j in joints], 100.0, 1.0)),
        Chart(LAG.key, "Lag [°]", _bars(joints, [j.lag_rad for j in joints], math.degrees(1.0))),
        Chart(ENERGY.key, "Net energy [J]", _bars(joints, energy, share)),
    )
    return tuple(chart for chart in bar_charts if chart.bars)


def log_charts(
    rec: rr.RecordingStream,
    bar_charts: tuple[Chart, ...],
    palette: Mapping[str, Color],
    named: Collection[str] = (),
) -> None:
    """Write the bars, valid for the whole session.

    Args:
        palette: Colour by joint name.
        named: Joints whose bars carry a mark, a thin line on their left.
    """
    for chart in bar_charts:
        tallest = max((bar.value for bar in chart.bars), key=abs, default=0.0)
        marked = [bar.place + _MARK_LEFT for bar in chart.bars if bar.joint in named]
        entity = f"{SEGMENTS}/{chart.key}"
        if many := len(marked):
            tall, wide = [tallest] * many, [_MARK_WIDTH] * many
            drawn = rr.BarChart(tall, abscissa=marked, widths=wide, color=NAMED)
            rec.log(f"{entity}/named", drawn, static=True)
        for bar in chart.bars:
            look: dict[str, Any] = {"whisker": _WHISKER, "color": palette.get(bar.joint, GREY)}
            log_bar(rec, entity, bar, left=bar.place + _LEFT, width=_WIDTH, **look)


def log_bar(
    rec: rr.RecordingStream,
    entity: str,
    bar: Bar,
    *,
    left: float,
    width: float,
    whisker: float,
    color: Color,
) -> None:
    """Write a bar and, where its interval is known, a whisker in its middle.

    Args:
        entity: The chart's.
        left: Where it starts; its joint's place is 1 from the next.
        whisker: Width of the whisker.
    """
    name = rr.escape_entity_path_part(bar.joint)
    parts = [("estimate", bar.value, left, width, color)]
    if bar.far is not None:
        parts.append(("ci95", bar.far, left + (width - whisker) / 2, whisker, GREY))
    for kind, height, start, wide, shade in parts:
        drawn = rr.BarChart([height], abscissa=[start], widths=[wide], color=shade)
        rec.log(f"{entity}/{kind}/{name}", drawn, static=True)


def log_current(
    rec: rr.RecordingStream,
    clock: TimeColumns,
    bar_charts: Sequence[Chart],
    tables: Sequence[CycleTable],
) -> None:
    """Write the bars of the cycle at the time cursor."""
    for chart in bar_charts:
        parts = [table for table in tables if table.quantity.key == chart.key]
        if parts:
            _log_rows(rec, clock, chart, together(parts))


def _log_rows(rec: rr.RecordingStream, clock: TimeColumns, chart: Chart, table: CycleTable) -> None:
    place = {bar.joint: bar.place for bar in chart.bars}
    row = [i for i, name in enumerate(table.names) if name in place]
    left = np.array([place[table.names[i]] + _CURRENT_LEFT for i in row])
    start, stop = cycle_times_ns(table, clock.start_ns)
    t_ns = np.append(start, stop[-1])
    # After the last cycle there is none.
    heights = np.append(table.value[row], np.full((len(row), 1), np.nan), axis=1).T
    for rows, times in clock.rows(t_ns):
        height = heights[rows]
        finite = np.isfinite(height)
        many = np.count_nonzero(finite, axis=1)
        singles = np.ones_like(many)
        wide = np.full(many.sum(), _CURRENT_WIDTH, np.float32)
        look: Any = rr.BarChart([0.0], color=CURRENT).color
        columns = [
            _column(rr.BarChart.descriptor_values(), _tensors(height[finite], many), singles),
            _column(
                rr.BarChart.descriptor_abscissa(),
                _tensors(np.broadcast_to(left, height.shape)[finite], many),
                singles,
            ),
            _column(rr.BarChart.descriptor_widths(), arrow.array(wide), many),
            _column(
                rr.BarChart.descriptor_color(),
                arrow.array(np.repeat(look.as_arrow_array().to_numpy(), many.size)),
                singles,
            ),
        ]
        rec.send_columns(f"{SEGMENTS}/{chart.key}/current", times, columns)


def _column(kind: rr.ComponentDescriptor, values: Any, lengths: IntArray) -> rr.ComponentColumn:
    return rr.ComponentColumn(kind, _Arrow(values), lengths=lengths.tolist())


def _tensors(numbers: FloatArray, lengths: IntArray) -> Any:
    """Vectors as Rerun's tensors: it makes one at a time, in a millisecond.

    Args:
        numbers: Of all vectors, one after the other.
        lengths: Of each vector, shape (n,).

    Returns:
        Arrow array of n structures.
    """
    tensor: Any = rr.BarChart([0.0]).values
    shape, names, buffer = tensor.as_arrow_array().type
    fields: list[Any] = list(buffer.type)
    number = [field.name for field in fields].index("F64")
    bounds = np.arange(lengths.size + 1, dtype=np.int32)
    ends = np.concatenate(([0], np.cumsum(lengths))).astype(np.int32)
    children = [arrow.nulls(0, field.type) for field in fields]
    children[number] = arrow.ListArray.from_arrays(ends, numbers, type=fields[number].type)
    codes = np.full(lengths.size, number, dtype=np.int8)
    offsets = [None, arrow.py_buffer(codes), arrow.py_buffer(bounds[:-1])]
    parts = [
        arrow.ListArray.from_arrays(bounds, lengths.astype(np.uint64), type=shape.type),
        arrow.nulls(lengths.size, names.type),
        arrow.Array.from_buffers(buffer.type, lengths.size, offsets, children=children),
    ]
    return arrow.StructArray.from_arrays(parts, fields=[shape, names, buffer])


class _Arrow:
    """An Arrow array as Rerun takes it."""

    def __init__(self, array: Any) -> None:
        self._array = array

    def as_arrow_array(self) -> Any:
        """The array."""
        return self._array


def _bars(
    joints: Sequence[JointResult],
    estimates: Sequence[Estimate],
    scale: float,
    baseline: float = 0.0,
) -> tuple[Bar, ...]:
    pairs = zip(joints, estimates, strict=True)
    bars = (
        bar_of(j.name, i + 1, estimate, scale, baseline) for i, (j, estimate) in enumerate(pairs)
    )
    return tuple(bar for bar in bars if bar is not None)


def bar_of(
    joint: str, place: int, estimate: Estimate, scale: float, baseline: float = 0.0
) -> Bar | None:
    """Return a joint's bar.

    Args:
        place: Its number along the body, the head's joint is 1.
        scale: From SI to the unit shown.
        baseline: Where the bar starts, in SI.

    Returns:
        The bar in the unit shown; None without a value.
    """
    if estimate.value is None:
        return None
    far = max([scale * (end - baseline) for end in estimate.ci95 or ()], key=abs, default=None)
    return Bar(joint, place, scale * (estimate.value - baseline), far)
