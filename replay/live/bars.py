"""The last cycle of each joint as bars, and all cycles as steps, while they are recorded.

The entities are the replay's; here a bar is the newest cycle, and a joint of which the cycle tells
nothing has none. Power takes the place of the net energy: its mean over the cycle.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence

import numpy as np
import rerun as rr
from rerun.components import InterpolationMode

from undulog.capture.common.arrays import FloatArray

from ..content.entities import GAIN, LAG, Chart, Color, Quantity, Series
from ..draw.cycles.heat_maps import POWER
from ..draw.cycles.response import SEGMENTS
from ..draw.cycles.steps import CYCLES
from ..samples.timeline import SESSION_TIME, Clock
from ..samples.tracks import Track
from .cycles import Cycle
from .plot import LivePlot

_WIDTH = 0.8
_STEPS = rr.SeriesLines.from_fields(interpolation_mode=InterpolationMode.StepAfter)


class CycleBars:
    """Bars and steps of gain, lag and power."""

    def __init__(self) -> None:
        """Nothing has been drawn."""
        self._plots: dict[Quantity, LivePlot] = {}
        self._drawn: set[str] = set()
        self._waiting: deque[tuple[Quantity, Cycle, FloatArray]] = deque()

    @property
    def charts(self) -> tuple[Chart, ...]:
        """The bar charts that have been written to."""
        return tuple(
            Chart(quantity.key, f"{quantity.name} [{quantity.unit}]", ())
            for quantity in (GAIN, LAG, POWER)
            if quantity in self._plots
        )

    @property
    def cycles(self) -> tuple[tuple[Quantity, tuple[Series, ...]], ...]:
        """The quantities whose steps have been written, each with where."""
        return tuple(
            (quantity, self._plots[quantity].series)
            for quantity in (GAIN, LAG, POWER)
            if quantity in self._plots
        )

    def take(self, cycle: Cycle) -> None:
        """Take a cycle, to be drawn a quantity at a time, so that no batch is late for it.

        Args:
            cycle: The cycle.
        """
        for quantity, values in (
            (GAIN, 100.0 * (cycle.gain - 1.0)),
            (LAG, np.degrees(cycle.lag_rad)),
            (POWER, 1e3 * cycle.power_w),
        ):
            if quantity in self._plots or np.isfinite(values).any():
                self._waiting.append((quantity, cycle, values))

    def write(
        self,
        rec: rr.RecordingStream,
        clock: Clock,
        palette: Mapping[str, Color],
        *,
        everything: bool = False,
    ) -> None:
        """Draw what waits, at the time at which its cycle started.

        Args:
            rec: The recording.
            clock: Its timelines.
            palette: Colour by joint name, head to tail.
            everything: Whether to draw all of it rather than one quantity of one cycle.
        """
        while self._waiting:
            quantity, cycle, values = self._waiting.popleft()
            t_ns = np.array([cycle.start_ns], dtype=np.int64)
            tracks = [Track(name, t_ns, values[i : i + 1]) for i, name in enumerate(cycle.names)]
            rec.set_time(
                SESSION_TIME, duration=np.timedelta64(cycle.start_ns - clock.start_ns, "ns")
            )
            self._write_bars(rec, quantity, tracks, palette)
            rec.reset_time()
            plot = self._plots.setdefault(quantity, LivePlot(f"{CYCLES}/{quantity.key}"))
            plot.write(rec, clock, tracks, palette)
            for one in plot.series:
                rec.log(one.entity, _STEPS, static=True)
            if not everything:
                return

    def _write_bars(
        self,
        rec: rr.RecordingStream,
        quantity: Quantity,
        tracks: Sequence[Track],
        palette: Mapping[str, Color],
    ) -> None:
        place = {name: i + 1 for i, name in enumerate(palette)}
        for track in tracks:
            part = rr.escape_entity_path_part(track.name)
            entity = f"{SEGMENTS}/{quantity.key}/estimate/{part}"
            if np.isfinite(track.values).all():
                left = place[track.name] - _WIDTH / 2
                color = palette[track.name]
                bar = rr.BarChart(track.values, abscissa=[left], widths=[_WIDTH], color=color)
                rec.log(entity, bar)
                self._drawn.add(entity)
            elif entity in self._drawn:
                rec.log(entity, rr.Clear(recursive=False))
                self._drawn.discard(entity)
