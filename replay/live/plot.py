"""A plot that grows: the same entities, names and colours as in a replay.

The last cycle of each joint as bars, and all cycles as steps, while they are recorded.

The entities are the replay's; here a bar is the newest cycle, and a joint of which the cycle tells
nothing has none. Power takes the place of the net energy: its mean over the cycle.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import rerun as rr

from undulog.capture.common.arrays import FloatArray

from ..draw.cycles.heat_maps import POWER
from ..draw.cycles.steps import CYCLES, SEGMENTS
from ..draw.plots.lines import DEGREES, log_look, log_rows, part_entities
from ..samples.content import GAIN, LAG, SCALARS, Chart, Color, Quantity, Series
from ..samples.timeline import SESSION_TIME, Clock
from ..samples.tracks import GAP_STEPS, Table, Track, mark_gaps, tables, typical_step_ns
from .cycles import Cycle


class LiveStream(rr.RecordingStream):
    """A recording stream that logs static data only when they change."""

    def __init__(self, application_id: str, recording_id: str) -> None:
        """Make a stream that isn't connected yet."""
        super().__init__(application_id, recording_id=recording_id, send_properties=False)
        self._said: dict[tuple[str, str], Any] = {}  # Arrow arrays

    def log(
        self,
        entity_path: str | list[object],
        entity: Any,
        *extra: Any,
        static: bool = False,
        strict: bool | None = None,
    ) -> None:
        """Log, unless it is static and known already.

        Args:
            static: Whether it has no time.
            strict: Whether to raise on data that can't be logged.
        """
        if static and not self._is_news(str(entity_path), [entity, *extra]):
            return
        super().log(entity_path, entity, *extra, static=static, strict=strict)

    def _is_news(self, entity_path: str, archetypes: Sequence[Any]) -> bool:
        batches = [batch for one in archetypes for batch in one.as_component_batches()]
        values = {
            (entity_path, str(batch.component_descriptor())): batch.as_arrow_array()
            for batch in batches
        }
        known = self._said
        news = [key for key in values if key not in known or not known[key].equals(values[key])]
        known.update(values)
        return bool(news)


class LivePlot:
    """One quantity of all joints.

    Joints that were sampled together share an entity, as in a replay. Here the whole isn't known
    at first, so the parts only get smaller: joints that part once stay apart.
    """

    def __init__(
        self,
        entity: str,
        *,
        degrees: bool = False,
        component: str | None = None,
        **look: Any,
    ) -> None:
        """Start without joints.

        Args:
            entity: E.g. ``/joints/measured``.
            degrees: Whether the values are angles [rad], to be plotted in degrees.
            component: What is written; None for ``Angle:degrees`` or ``Scalars:scalars``.
            look: As :func:`~.replay.draw.plots.lines.log_look` takes it.
        """
        self._entity, self._degrees = entity, degrees
        self._component = component or (DEGREES if degrees else SCALARS)
        self._kind = look
        self._parts: list[tuple[str, ...]] = []
        self._last: dict[str, tuple[int, int]] = {}
        self._looks: dict[str, tuple[tuple[str, ...], list[Color | None] | None]] = {}

    @property
    def series(self) -> tuple[Series, ...]:
        """The series that have been written."""
        paths = part_entities(self._entity, self._parts)
        pairs = zip(paths, self._parts, strict=True)
        return tuple(Series(path, part, self._component) for path, part in pairs)

    def write(
        self,
        rec: rr.RecordingStream,
        clock: Clock,
        tracks: Sequence[Track],
        palette: Mapping[str, Color] | None = None,
    ) -> None:
        """Write new samples.

        Args:
            palette: Colour by joint name; None for the grey of everything commanded.
        """
        by_name = {track.name: track for track in tracks if track.t_ns.size}
        known = {name for part in self._parts for name in part}
        new = [track for name, track in by_name.items() if name not in known]
        self._parts += [table.names for table in tables(new)]
        for part in tuple(self._parts):
            own = [by_name[name] for name in part if name in by_name]
            if own and (len(own) < len(part) or len(tables(own)) > 1):
                at = self._parts.index(part)
                self._parts[at : at + 1] = [(name,) for name in part]
        for path, part in zip(part_entities(self._entity, self._parts), self._parts, strict=True):
            if part[0] in by_name:
                (table,) = tables([by_name[name] for name in part])
                table = self._with_gap(path, table)
                look = part, None if palette is None else [palette.get(name) for name in part]
                if self._looks.get(path) != look:
                    self._looks[path] = look
                    log_look(rec, path, part, palette, **self._kind)
                t_ns, values = mark_gaps(table.t_ns, table.values)
                component = self._component
                log_rows(rec, clock, path, t_ns, values, degrees=self._degrees, component=component)

    def _with_gap(self, path: str, table: Table) -> Table:
        """Insert a row of NaN before the samples after a gap, which ends the line."""
        last_ns, step_ns = self._last.get(path, (0, 0))
        first_ns = int(table.t_ns[0])
        self._last[path] = (int(table.t_ns[-1]), typical_step_ns(table.t_ns) or step_ns)
        if not step_ns or first_ns - last_ns <= GAP_STEPS * step_ns:
            return table
        t_ns = np.insert(table.t_ns, 0, last_ns + step_ns)
        return Table(table.names, t_ns, np.insert(table.values, 0, np.nan, axis=0))


_WIDTH = 0.8


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
            for quantity, _ in self.cycles
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
        """Take a cycle, to be drawn a quantity at a time, so that no batch is late for it."""
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
        """Draw waiting cycles, at the times at which they started.

        Args:
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
            entity = f"{CYCLES}/{quantity.key}"
            plot = self._plots.setdefault(quantity, LivePlot(entity, steps=True))
            plot.write(rec, clock, tracks, palette)
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
