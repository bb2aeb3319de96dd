"""Response of each joint as bars, head to tail: how much, how late, at what cost.

The baseline of gain and lag is perfect tracking: a gain of one and no lag. The coloured bar is the
whole analysed stretch, and a whisker in it reaches to the far end of its 95 % interval; the white
bar on its right is the cycle at the time cursor. One bar chart a joint, so that each bar has its
joint's colour and name.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from typing import Any, cast

import numpy as np
import pyarrow as pa
import rerun as rr

from undulog.analysis.results.analysis import Analysis
from undulog.analysis.results.estimate import Estimate

from ...content.entities import ENERGY, GAIN, GREY, LAG, NAMED, Bar, Chart, Color, CycleTable
from ...samples.timeline import Clock
from .steps import cycle_times_ns, together

SEGMENTS = "/segments"
CURRENT: Color = (235, 235, 240, 255)

# Side by side, since Rerun adds the light of bars that lie on each other; the whisker is thin.
_LEFT, _WIDTH = -0.42, 0.54
_WHISKER = 0.14
_CURRENT_LEFT, _CURRENT_WIDTH = 0.16, 0.26
_MARK_LEFT, _MARK_WIDTH = -0.56, 0.12


def charts(analysis: Analysis) -> tuple[Chart, ...]:
    """What an analysis says about each joint, in the units that are shown.

    Args:
        analysis: The session's analysis.

    Returns:
        Gain less one [%], lag [degrees] and net mechanical energy [J], of a mean cycle where
        there is a gait, else of the whole window; without those of which no joint has a value.
    """
    gain = [(j.name, _scaled(j.gain, 100.0, 1.0)) for j in analysis.joints]
    lag = [(j.name, _scaled(j.lag_rad, math.degrees(1.0), 0.0)) for j in analysis.joints]
    count = sum(window.cycles for window in analysis.gait.windows)
    share = 1.0 / count if count else 1.0
    energy = [(j.name, _scaled(Estimate(j.energy_net_j), share, 0.0)) for j in analysis.joints]
    found = (
        Chart(GAIN.key, "Gain − 1 [%]", _bars(gain)),
        Chart(LAG.key, "Lag [°]", _bars(lag)),
        Chart(ENERGY.key, "Net energy [J]", _bars(energy)),
    )
    return tuple(chart for chart in found if chart.bars)


def log_charts(
    rec: rr.RecordingStream,
    found: tuple[Chart, ...],
    palette: Mapping[str, Color],
    named: Collection[str] = (),
) -> None:
    """Write the bars, valid for the whole session.

    Args:
        rec: The recording.
        found: The charts.
        palette: Colour by joint name.
        named: Joints whose bars carry a mark, a thin line on their left.
    """
    for chart in found:
        tallest = max((bar.value for bar in chart.bars), key=abs, default=0.0)
        marked = [bar.place + _MARK_LEFT for bar in chart.bars if bar.joint in named]
        if marked:
            many = len(marked)
            drawn = rr.BarChart(
                [tallest] * many, abscissa=marked, widths=[_MARK_WIDTH] * many, color=NAMED
            )
            rec.log(f"{SEGMENTS}/{chart.key}/named", drawn, static=True)
        for bar in chart.bars:
            name = rr.escape_entity_path_part(bar.joint)
            left = bar.place + _LEFT
            parts = [("estimate", bar.value, left, _WIDTH, palette.get(bar.joint, GREY))]
            if bar.far is not None:
                left += (_WIDTH - _WHISKER) / 2
                parts.append(("ci95", bar.far, left, _WHISKER, GREY))
            for kind, height, left, width, color in parts:
                drawn = rr.BarChart([height], abscissa=[left], widths=[width], color=color)
                rec.log(f"{SEGMENTS}/{chart.key}/{kind}/{name}", drawn, static=True)


def log_current(
    rec: rr.RecordingStream,
    clock: Clock,
    found: Sequence[Chart],
    tables: Sequence[CycleTable],
) -> None:
    """Write the bars of the cycle at the time cursor.

    Args:
        rec: The recording.
        clock: Its timelines.
        found: The charts.
        tables: The cycles.
    """
    for chart in found:
        parts = [table for table in tables if table.quantity.key == chart.key]
        if parts:
            _log_rows(rec, clock, chart, together(parts))


def _log_rows(rec: rr.RecordingStream, clock: Clock, chart: Chart, table: CycleTable) -> None:
    place = {bar.joint: bar.place for bar in chart.bars}
    row = [i for i, name in enumerate(table.names) if name in place]
    left = np.array([place[table.names[i]] + _CURRENT_LEFT for i in row])
    start, stop = cycle_times_ns(table, clock.start_ns)
    t_ns = np.append(start, stop[-1])
    # After the last cycle there is none.
    heights = np.append(table.value[row], np.full((len(row), 1), np.nan), axis=1).T
    for rows, times in clock.rows(t_ns):
        known = [np.isfinite(height) for height in heights[rows]]
        bars = [
            rr.BarChart(
                height[sure],
                abscissa=left[sure],
                widths=np.full(np.count_nonzero(sure), _CURRENT_WIDTH),
                color=CURRENT,
            )
            for height, sure in zip(heights[rows], known, strict=True)
        ]
        rec.send_columns(f"{SEGMENTS}/{chart.key}/current", times, _columns(bars))


def _columns(bars: Sequence[rr.BarChart]) -> list[rr.ComponentColumn]:
    """Bar charts as rows: Rerun has no columns of tensors that differ in length."""
    parts = [chart.as_component_batches() for chart in bars]
    columns: list[rr.ComponentColumn] = []
    for same in zip(*parts, strict=True):
        arrays = [batch.as_arrow_array() for batch in same]
        rows = _Arrow(cast("Any", pa).concat_arrays(arrays))
        lengths = [len(array) for array in arrays]
        columns.append(rr.ComponentColumn(same[0].component_descriptor(), rows, lengths=lengths))
    return columns


class _Arrow:
    """An Arrow array as Rerun takes it."""

    def __init__(self, array: Any) -> None:
        self._array = array

    def as_arrow_array(self) -> Any:
        """The array."""
        return self._array


def _scaled(estimate: Estimate, scale: float, baseline: float) -> Estimate:
    if estimate.value is None:
        return estimate
    low_high = estimate.ci95
    if low_high is not None:
        low_high = (scale * (low_high[0] - baseline), scale * (low_high[1] - baseline))
    return Estimate(scale * (estimate.value - baseline), low_high)


def _bars(values: list[tuple[str, Estimate]]) -> tuple[Bar, ...]:
    return tuple(
        Bar(name, i + 1, value.value, _far(value))
        for i, (name, value) in enumerate(values)
        if value.value is not None
    )


def _far(estimate: Estimate) -> float | None:
    return None if estimate.ci95 is None else max(estimate.ci95, key=abs)
