"""The plots of a session, written stretch by stretch."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import rerun as rr

from undulog.capture.common.arrays import FloatArray

from ...content.entities import COMMANDED, ERROR, MEASURED, SCALARS, TOTAL, Color, Places, Series
from ...samples.quantities import SIGNALS, quantities
from ...samples.sampling import mark_gaps, plot_step
from ...samples.stretches import Span, Stretch
from ...samples.survey import Survey
from ...samples.timeline import Clock
from ...samples.tracks import Track, brought_together
from .joints import (
    DEGREES,
    PLACES,
    PLACES_WIDTHS,
    joint_palette,
    log_look,
    log_rows,
    log_total_look,
    part_entity,
    places_titles,
)

_ANGLES = (COMMANDED, MEASURED, ERROR)


class Plot:
    """One quantity of all joints."""

    def __init__(
        self,
        entity: str,
        samples: Sequence[Track],
        parts: Sequence[tuple[str, ...]],
        *,
        degrees: bool,
        component: str = SCALARS,
    ) -> None:
        """Prepare it.

        Args:
            entity: E.g. ``/joints/measured``.
            samples: Some samples of each line, by which it is rounded.
            parts: Names of the lines, those in one part that are drawn at common times.
            degrees: Whether the values are angles [rad], to be plotted in degrees.
            component: What is written.
        """
        paths = [entity if len(parts) == 1 else part_entity(entity, part[0]) for part in parts]
        self.series = tuple(
            Series(path, part, component) for path, part in zip(paths, parts, strict=True)
        )
        """What is written."""
        self._degrees = degrees
        self._steps = {
            track.name: plot_step(np.rad2deg(track.values) if degrees else track.values)
            for track in samples
        }

    def write(
        self, rec: rr.RecordingStream, clock: Clock, tracks: Sequence[Track], span: Span
    ) -> None:
        """Write the samples of a stretch.

        Args:
            rec: The recording.
            clock: Its timelines.
            tracks: The samples, with those just before and after it.
            span: What of them is drawn.
        """
        by_name = {track.name: track for track in tracks}
        for one in self.series:
            own = [by_name[name] for name in one.names if name in by_name]
            if not own:
                continue
            table = brought_together(own)
            values = np.full((table.t_ns.size, len(one.names)), np.nan)
            values[:, [one.names.index(name) for name in table.names]] = table.values
            t_ns, values = mark_gaps(table.t_ns, values, span.known_ns)
            rows = span.rows(t_ns)
            steps: FloatArray = np.array([self._steps.get(name, 0.0) for name in one.names])
            if rows.stop > rows.start:
                log_rows(
                    rec,
                    clock,
                    one.entity,
                    t_ns[rows],
                    values[rows],
                    degrees=self._degrees,
                    component=one.component,
                    steps=steps,
                )


class Plots:
    """All plots of a session."""

    def __init__(
        self,
        rec: rr.RecordingStream,
        clock: Clock,
        found: Survey,
        places: Places | None,
        palette: Mapping[str, Color],
    ) -> None:
        """Say how the lines look.

        Args:
            rec: The recording.
            clock: Its timelines.
            found: What the session holds.
            places: Joints that stand for the body, or None.
            palette: Colour by joint name.
        """
        self._rec, self._clock = rec, clock
        self._plots = {
            entity: Plot(
                entity,
                samples,
                found.parts[entity],
                degrees=entity in _ANGLES,
                component=DEGREES if entity in _ANGLES else SCALARS,
            )
            for entity, samples in found.samples.items()
        }
        self._places: dict[str, tuple[Plot, Places]] = {}
        for entity, plot in self._plots.items():
            if entity.startswith(f"{TOTAL}/"):
                log_total_look(rec, entity.removeprefix(f"{TOTAL}/"))
                continue
            colors = None if entity == COMMANDED else _colors(entity, plot, palette)
            for one in plot.series:
                log_look(rec, one.entity, one.names, colors)
        if places is not None:
            for source, kind in ((COMMANDED, "commanded"), (MEASURED, "measured")):
                self._add_places(found, places, source, kind, palette)

    def series(self, entity: str) -> tuple[Series, ...]:
        """What is written of a quantity.

        Args:
            entity: E.g. ``/joints/measured``.

        Returns:
            One series where all joints are drawn at common times; none where there is none.
        """
        return self._plots[entity].series if entity in self._plots else ()

    @property
    def signals(self) -> dict[str, tuple[Series, ...]]:
        """Entity of a topic to what is written of it, where it has no views of its own."""
        return {
            entity: plot.series
            for entity, plot in self._plots.items()
            if entity.startswith(f"{SIGNALS}/")
        }

    def write(self, stretch: Stretch) -> None:
        """Write a stretch.

        Args:
            stretch: Its samples.
        """
        tracks = quantities(stretch.columns)
        for entity, plot in self._plots.items():
            if entity in tracks:
                plot.write(self._rec, self._clock, tracks[entity], stretch.span)
        for source, (plot, places) in self._places.items():
            chosen = [track for track in tracks.get(source, ()) if track.name in places.names]
            plot.write(self._rec, self._clock, chosen, stretch.span)

    def _add_places(
        self,
        found: Survey,
        places: Places,
        source: str,
        kind: str,
        palette: Mapping[str, Color],
    ) -> None:
        """Head, middle and tail once more, for a plot that can be read at a glance."""
        samples = [one for one in found.samples.get(source, ()) if one.name in places.names]
        parts = [
            tuple(n for n in part if n in places.names) for part in found.parts.get(source, ())
        ]
        parts = [part for part in parts if part]
        if not samples:
            return
        plot = Plot(f"{PLACES}/{kind}", samples, parts, degrees=True)
        self._places[source] = (plot, places)
        for one in plot.series:
            log_look(
                self._rec,
                one.entity,
                one.names,
                palette if kind == "measured" else None,
                titles=places_titles(places, kind),
                width=PLACES_WIDTHS[kind],
            )


def _colors(entity: str, plot: Plot, palette: Mapping[str, Color]) -> Mapping[str, Color]:
    """The joints' colours, or colours of its own for a signal that is not of the joints."""
    names = [name for one in plot.series for name in one.names]
    if entity.startswith(f"{SIGNALS}/") and not set(names) & set(palette):
        return joint_palette(names)
    return palette
